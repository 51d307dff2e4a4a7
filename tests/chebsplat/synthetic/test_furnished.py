"""Rooms of modelled furniture, from a small library that the test writes."""

import numpy as np
import pytest
from furniture_library import STOCK, write_library

from chebsplat.cameras import centers
from chebsplat.errors import InputError
from chebsplat.synthetic import CLASS_NAMES, furnished
from chebsplat.synthetic.catalogue import read_catalogue, read_mesh
from chebsplat.synthetic.furnished import PIECES, RECIPES, Catalogue, Furnishing
from chebsplat.synthetic.rays import walk

SIZE = (4.5, 4.0, 2.7)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_library(tmp_path_factory.mktemp("furniture"))


def piece_of(folder, name):
    return next(piece for piece in read_catalogue(folder) if piece.name == name)


def test_a_piece_has_its_size_stands_on_the_floor_and_turns_its_front_to_the_room(folder):
    mesh = read_mesh(piece_of(folder, "Table"))
    assert np.allclose(mesh.vertices.min(0), (-0.7, 0, 0), atol=1e-6)
    assert np.allclose(mesh.vertices.max(0), (0.7, 0.8, 0.75), atol=1e-6)
    (color, red), (_, others) = mesh.parts
    assert color == (1, 0, 0) and (len(red), len(others)) == (4, 8)
    # the file's face at the largest z, whose corners turn left as one looks at it from the room
    front = mesh.vertices[red[2:]]
    assert np.allclose(front[..., 1], 0.8)
    assert np.cross(front[0, 1] - front[0, 0], front[0, 2] - front[0, 0])[1] > 0  # not mirrored


def test_a_model_is_turned_before_it_is_measured_and_its_colours_may_be_missing(folder):
    turned, bare = (read_mesh(piece_of(folder, name)) for name in ("Book", "Vase"))
    assert np.allclose(np.ptp(turned.vertices, axis=0), (0.28, 0.18, 0.03), atol=1e-6)
    (_, back_and_front), _ = turned.parts  # of the file; it lies with its front up or down
    assert np.isin(turned.vertices[back_and_front][..., 2], (0, np.float32(0.03))).all()
    assert all(np.ptp(corners) == 0 for corners in turned.vertices[back_and_front][..., 2])
    assert [color for color, _ in bare.parts] == [(0.6, 0.6, 0.6)]


def test_things_lie_on_a_piece_s_top_unless_the_library_forbids_it(folder):
    assert piece_of(folder, "Table").top == pytest.approx(0.75)
    assert piece_of(folder, "Chest").top is None


def test_groups_hold_pieces_of_their_names_categories_and_heights_that_stand_where_they_should(
    folder,
):
    groups = Catalogue(folder).groups
    assert set(groups) == set(PIECES)
    assert [piece.size[2] for piece in groups["floor lamp"]] == [pytest.approx(1.2)]
    assert {piece.name for piece in groups["table lamp"]} == {"Desk lamp"}
    assert [piece.size[0] for piece in groups["sofa"]] == [pytest.approx(1.9)]
    assert {piece.name for piece in groups["office chair"]} == {"Chair"}
    assert {piece.size[1] for piece in groups["window"]} == {0.08}  # of .2 in the library
    assert {rule["class"] for rule in PIECES.values() if "class" in rule} < set(CLASS_NAMES)


def test_a_folder_that_lacks_libraries_or_pieces_and_a_damaged_library_name_the_package(
    folder, tmp_path, monkeypatch
):
    with pytest.raises(InputError, match=r"no \.sh3f library: apt install sweethome3d-furniture"):
        Catalogue(tmp_path)
    monkeypatch.setattr("furniture_library.STOCK", [one for one in STOCK if one[0] != "Bed"])
    with pytest.raises(InputError, match="has no bed: apt install sweethome3d-furniture"):
        Catalogue(write_library(tmp_path))
    library = tmp_path / "some.sh3f"
    library.write_bytes(library.read_bytes()[:-30])
    with pytest.raises(InputError, match=r"some\.sh3f is damaged .* apt install --reinstall"):
        Catalogue(tmp_path)


@pytest.mark.parametrize("recipe", RECIPES, ids=range(len(RECIPES)))
def test_pieces_stand_apart_in_the_room_on_the_floor_or_a_top_or_hang_away_from_the_camera(
    folder, recipe, monkeypatch
):
    pieces = []

    def add(self, label, piece, frame):
        corners = read_mesh(piece).vertices @ frame.rotation.T + np.asarray(frame.origin)
        pieces.append((piece, corners.min(0), corners.max(0)))

    monkeypatch.setattr(Furnishing, "add", add)
    eyes = centers(walk(SIZE, 40, 3))
    for seed in range(4):
        pieces.clear()
        rng = np.random.default_rng(seed)
        Furnishing(Catalogue(folder), recipe, rng, SIZE, eyes).furnish()
        pieces = [one for one in pieces if one[0].name != "Oriental rug"]
        assert len(pieces) > 8
        low, high = (np.array([one[k] for one in pieces]) for k in (1, 2))
        assert (low > -0.05).all() and (high < np.array(SIZE) + 0.05).all()
        for k in range(1, len(low)):
            overlap = np.minimum(high[k], high[:k]) - np.maximum(low[k], low[:k])
            assert (overlap.min(1) < 0.03).all()
        inside = (eyes[:, None] > low) & (eyes[:, None] < high)
        assert not inside.all(-1).any()
        for k, (piece, bottom, top) in enumerate(pieces):
            below = (low[:, :2] < (bottom + top)[:2] / 2) & ((bottom + top)[:2] / 2 < high[:, :2])
            stands = abs(bottom[2] - high[:, 2]) < 1e-5
            hangs = bottom[2] == pytest.approx(piece.elevation) or top[2] == pytest.approx(SIZE[2])
            on_a_wall = piece.elevation and bottom[2] >= 1.2
            assert hangs or on_a_wall or (below.all(1) & stands).any(), (k, piece)


def test_a_seed_gives_one_room_whose_triangles_have_a_class_or_none(folder):
    catalogue = Catalogue(folder)
    room, again, other = (furnished.furnished(seed, catalogue).soup for seed in (5, 5, 14))
    for field in ("vertices", "triangles", "labels", "materials"):
        assert np.array_equal(getattr(room, field), getattr(again, field))
    assert len(other.triangles) != len(room.triangles)
    names = {CLASS_NAMES[k] for k in np.unique(room.labels) if k >= 0}
    assert {"wall", "floor", "ceiling", "door", "cabinet", "table", "chair"} <= names
    assert room.labels.min() == -1  # of the suitcase, say
