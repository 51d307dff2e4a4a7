"""Points that stay: one a cube, of cubes that are smaller where colours change."""

from types import SimpleNamespace

import numpy as np
import pytest

from chebsplat.formats.points import Points
from chebsplat.splats.parts import cubes_of, first_of_each, means_of_each
from chebsplat.stages.reconstruction.thinning import LEVELS, by_color, edge_of, even, thin
from chebsplat.stages.runtime.config import Config
from chebsplat.stages.sfm import reduced
from chebsplat.stages.training.assembly import model_of
from chebsplat.stages.training.defaults import evidence_of, resolved


def wall(n=60_000, seed=0):
    """Points of a wall of 4 × 2, plain on the left; stripes on the right."""
    places = np.random.default_rng(seed).random((n, 3)) * [4, 2, 0]
    bright = (places[:, 0] > 2) & (np.sin(40 * places[:, 0]) > 0)
    return places, np.where(bright, 220, 60)[:, None].repeat(3, 1).astype(np.uint8)


def error(colors, cube):
    """Sum of squares by which colours differ from the mean of their cube."""
    sums = np.stack([np.bincount(cube, colors[:, k]) for k in range(3)], 1)
    return float(((colors - (sums / np.bincount(cube)[:, None])[cube]) ** 2).sum())


def test_the_first_of_each_cube_is_kept_in_order_wherever_the_grid_begins():
    points = np.random.default_rng(2).normal(size=(2000, 3)) * [3, 1, 0.2]
    for origin in (None, [0.1, -0.2, 0.3]):  # points on both sides of it
        seen: set = set()
        place = (
            np.floor((points - (points.min(0) if origin is None else origin)) / 0.25)
            .astype(int)
            .tolist()
        )
        wanted = [
            k for k, row in enumerate(place) if tuple(row) not in seen and not seen.add(tuple(row))
        ]
        assert first_of_each(points, 0.25, origin).tolist() == wanted


def test_means_are_of_the_points_of_a_cube_that_holds_enough_of_them():
    points = np.array(
        [[0.1, 0, 0], [0.3, 0, 0], [0.2, 0.3, 0], [5, 0, 0], [0, 5, 0], [0, 5.5, 0], [0.5, 5, 0.5]]
    )
    cube = np.unique(cubes_of(points, 1.0), return_inverse=True)[1]
    kept, middles = means_of_each(cube, 0.5, points)
    assert kept.tolist() == [True, True, False]  # the last one has a single point
    np.testing.assert_allclose(middles, [[0.2, 0.1, 0], [0.5 / 3, 15.5 / 3, 0.5 / 3]])


def test_cubes_are_smaller_where_colours_change_and_say_more_of_the_picture():
    places, colors = wall()
    kept, cube = by_color(places, colors, 4000, edge_of(places, 2000))
    assert 3500 < len(kept) <= 4000
    assert (places[kept, 0] > 2).mean() > 0.75
    alike = np.unique(cubes_of(places, edge_of(places, 4000)), return_inverse=True)[1]
    assert error(colors, cube) < 0.7 * error(colors, alike)


def test_each_point_kept_is_the_first_of_its_cube_and_cubes_lie_within_the_largest():
    places, colors = wall(5000)
    edge = edge_of(places, 450)
    kept, cube = by_color(places, colors, 900, edge)
    assert (np.diff(kept) > 0).all() and (cube[kept] == np.arange(len(kept))).all()
    assert (kept[cube] <= np.arange(len(places))).all()
    largest, smallest = cubes_of(places, edge), cubes_of(places, edge / 2 ** (LEVELS - 1))
    assert all(len(np.unique(largest[cube == k])) == 1 for k in range(0, len(kept), 7))
    of = np.full(smallest.max() + 1, -1)
    of[smallest] = cube
    assert (of[smallest] == cube).all()  # none is divided further


@pytest.mark.parametrize("count", [16, 17, 64, 5000])
def test_no_more_than_asked_for(count):
    places, colors = wall(2000)
    assert 1 <= len(by_color(places, colors, count, edge_of(places, count // 2))[0]) <= count


def test_points_of_one_colour_and_of_one_place():
    places, colors = wall(4000)
    kept, _ = by_color(places, np.full_like(colors, 7), 1000, edge_of(places, 500))
    assert len(kept) > 300
    kept, cube = by_color(np.zeros((40, 3)), colors[:40], 16, 1.0)
    assert kept.tolist() == [0] and (cube == 0).all()


def cloud(places, colors):
    nothing = np.zeros((0, 2), np.int32)
    return {
        "means": places,
        "colors": colors,
        "seen_from": np.zeros(len(places), int),
        "tracks": nothing,
        "notes": {},
    }


def test_an_even_part_of_what_follows_colours_is_found_again():
    places, colors = wall()
    _, found = reduced(cloud(places, colors), 4000, "color")
    nothing = np.zeros((len(found["means"]), 3), np.float32)
    shapes = np.zeros((len(nothing), 3, 3), np.float32)
    given = Points(
        [], np.zeros((0, 3, 3)), np.zeros((0, 4, 4)), found["means"], found["colors"], nothing,
        shapes,
        found["tracks"], found["notes"],
    )  # fmt: skip
    rows = even(given)
    assert 1700 < len(rows) <= 2200
    assert (found["means"][rows, 0] > 2).mean() == pytest.approx(0.5, abs=0.05)
    given.notes.clear()
    assert len(even(given)) == len(found["means"])


def test_colours_are_means_where_cubes_follow_them_and_a_points_own_elsewhere():
    places, colors = wall()
    kept, found = reduced(cloud(places, colors), 600, "color")
    assert set(np.unique(colors)) == {60, 220} and len(np.unique(found["colors"])) > 10
    kept, found = reduced(cloud(places, colors), 600, "even")
    assert (found["colors"] == colors[kept]).all() and (kept == thin(places, 600)).all()
    assert not found["notes"]


@pytest.mark.parametrize(
    ("notes", "opacity"),
    [
        ({"how": "depth"}, 0.7),
        ({"how": "exhaustive", "n_from_depth": 5}, 0.7),
        ({"how": "source"}, 0.3),
    ],
)
def test_gaussians_start_surer_where_depth_is_measured(notes, opacity):
    places, colors = wall(50)
    shapes = np.tile(np.eye(3, dtype=np.float32), (50, 1, 1))
    nothing = np.zeros((0, 2), np.int32)
    given = Points(
        ["a"], np.zeros((1, 3, 3)), np.zeros((1, 4, 4)), places, colors, np.zeros((50, 3)), shapes,
        nothing, notes
    )  # fmt: skip
    config = Config()
    capture = SimpleNamespace(
        names=["a"], is_test=np.zeros(1, bool), size=(1, 1), depth=None, cam_from_world=None
    )
    for wanted, train in (
        (opacity, config.train),
        (0.2, config.train.model_copy(update={"opacity": 0.2})),
    ):
        train = resolved(train, evidence_of(train, capture, given, None))
        model = model_of(given, None, train, config.describe)
        assert model.raw["logit_opacities"].detach().sigmoid().numpy() == pytest.approx(wanted)
