"""`chebsplat view`: pictures for a state of its controls; slow tests open the live page in a real browser."""

import sys

import numpy as np
import pytest
from box_room import LABELS, SIZE, N, foreign_ply, looking, made, room
from click.testing import CliRunner

from chebsplat.errors import ConfigError
from chebsplat.labels.decode import decode_labels
from chebsplat.pipelines.api import load
from chebsplat.pipelines.cli import main
from chebsplat.render import SceneRenderer
from chebsplat.splats.parts import connected_to
from chebsplat.stages import view
from chebsplat.stages.camera_paths import between
from chebsplat.stages.evaluate import camera as evaluated
from chebsplat.stages.opened import Camera, OpenedScene
from chebsplat.stages.page import foreign
from chebsplat.stages.pages.pictures import colored, error_map, heat
from chebsplat.stages.viewing import MODES, Shown, Viewing, coded, padded, pixel_of

SOFA = LABELS.index("sofa")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """(folder, as read, opened)."""
    folder, held = made(tmp_path_factory.mktemp("view") / "box room")
    return folder, held, load(folder)


@pytest.fixture(scope="module")
def viewing(scene):
    _, _, opened = scene
    photos = {camera.name: np.full((SIZE[1], SIZE[0], 3), 90, np.uint8) for camera in opened.cameras}
    return Viewing(opened, photos.get)


def test_colour_and_labels_are_those_that_evaluate_measures(scene, viewing):
    _, held, opened = scene
    color, features = SceneRenderer(held.parameters).render(evaluated(held, 1), with_features=True)
    covered = SceneRenderer(held.parameters).render_depth(evaluated(held, 1))[1] >= 0.5
    labels = np.where(covered, decode_labels(features, held.label_embeddings), -1)
    np.testing.assert_array_equal(viewing.picture(opened.cameras[1], Shown()), color)
    np.testing.assert_array_equal(viewing.beneath(opened.cameras[1], Shown()).labels, labels)
    np.testing.assert_array_equal(viewing.picture(opened.cameras[1], Shown("labels")), colored(labels, len(LABELS)))
    photo = viewing.photo(opened.cameras[1].name)
    np.testing.assert_array_equal(viewing.picture(opened.cameras[1], Shown("error")), error_map(color, photo))
    mse = np.mean((color.astype(float) - photo) ** 2)
    assert viewing.psnr(opened.cameras[1], Shown("error")) == pytest.approx(10 * np.log10(255**2 / mse))


def test_what_a_page_reads_under_a_pixel_is_its_label_and_probability(scene, viewing):
    beneath = viewing.beneath(scene[2].cameras[0], Shown())
    codes = coded(beneath).astype(int)
    np.testing.assert_array_equal(codes[..., 0] + 256 * codes[..., 1] - 1, beneath.labels)
    assert np.abs(codes[..., 2] / 255 - beneath.probability).max() < 0.002


def test_a_hidden_class_is_gone_and_others_stay(scene, viewing):
    view_ = scene[2].cameras[1]
    labels = viewing.beneath(view_, Shown()).labels
    before, after = (viewing.picture(view_, Shown(hidden=hidden)).astype(int) for hidden in (frozenset(), {SOFA}))
    assert np.abs(after - before)[labels == SOFA].mean() > 20
    assert (viewing.beneath(view_, Shown(hidden=frozenset({SOFA}))).labels != SOFA).mean() > 0.995
    assert np.abs(after - before)[labels == LABELS.index("floor")].mean() < 6


def test_controls_leave_what_they_say(scene, viewing):
    opened = scene[2]
    opacity = 1 / (1 + np.exp(-opened.parameters["logit_opacities"]))
    np.testing.assert_array_equal(viewing.kept(Shown(min_opacity=0.7)), np.flatnonzero(opacity >= 0.7))
    box = (-1.0, -1.0, 0.0, 1.0, 1.0, 2.0)
    kept = opened.parameters["means"][viewing.kept(Shown(box=box))]
    assert len(kept) and (kept >= box[:3]).all() and (kept <= box[3:]).all()
    flat = SceneRenderer(opened.parameters | {"degrees": np.zeros(N, np.uint8)})
    drawn = viewing.picture(opened.cameras[0], Shown(sh_degree=0))
    np.testing.assert_array_equal(drawn, flat.render(opened.cameras[0].view())[0])
    assert not viewing.picture(opened.cameras[0], Shown(box=(50.0, 50.0, 50.0, 51.0, 51.0, 51.0))).any()


def test_a_pixel_alone_renders_as_in_its_picture(scene, viewing):
    view_ = scene[2].cameras[1]
    whole = viewing.picture(view_, Shown())
    for x, y in [(10, 10), (160, 120), (250, 200)]:
        np.testing.assert_allclose(
            viewing.picture(pixel_of(view_, x, y), Shown())[0, 0].astype(int), whole[y, x], atol=1
        )


def test_a_click_takes_what_is_connected_and_of_its_label(scene, viewing):
    opened = scene[2]
    labels = viewing.beneath(opened.cameras[1], Shown()).labels
    y, x = np.argwhere(labels == SOFA)[len(np.argwhere(labels == SOFA)) // 2].tolist()
    touched = viewing.touched(opened.cameras[1], Shown(), x, y)
    mask = touched.mask
    assert touched.label == SOFA
    assert np.linalg.norm(opened.parameters["means"][mask] - touched.place, axis=1).min() < 0.1
    assert (opened.labels[mask] == SOFA).all()
    assert mask.sum() > 0.9 * (opened.labels == SOFA).sum()
    shown = viewing.picture(opened.cameras[1], Shown(selected=mask)).astype(int)
    plain = viewing.picture(opened.cameras[1], Shown()).astype(int)
    assert (shown - plain)[labels == SOFA][:, 0].mean() > (shown - plain)[labels == 0][:, 0].mean() + 20
    assert viewing.touched(looking_away(opened), Shown(), 5, 5) is None


def looking_away(opened):
    return Camera("out", opened.cameras[0].K, looking((9, 9, 9), (20, 20, 20)), *SIZE)


def test_two_apart_are_not_connected_and_a_chain_is():
    means = np.array([[x, 0, 0] for x in (0, 1, 2, 3, 10, 11)], float)
    scales, among = np.full((6, 3), 0.3), np.array([1, 1, 1, 1, 1, 1], bool)
    np.testing.assert_array_equal(np.flatnonzero(connected_to(1, means, scales, among)), [0, 1, 2, 3])
    among[2] = False
    np.testing.assert_array_equal(np.flatnonzero(connected_to(1, means, scales, among)), [0, 1])
    np.testing.assert_array_equal(np.flatnonzero(connected_to(3, means, scales, among)), [3])
    with pytest.raises(ValueError, match="not among"):
        connected_to(2, means, scales, among)


def test_every_mode_has_a_picture_and_what_is_missing_is_said(scene, viewing):
    opened = scene[2]
    query = opened.understood("seat")
    for mode in MODES:
        image = viewing.picture(opened.cameras[0], Shown(mode, query=query))
        assert (image.shape, image.dtype) == ((SIZE[1], SIZE[0], 3), np.uint8)
        assert np.ptp(image) > 30
    with pytest.raises(ConfigError, match="ask for some"):
        viewing.picture(opened.cameras[0], Shown("relevancy"))
    with pytest.raises(ConfigError, match="jump to a view"):
        viewing.picture(looking_away(opened), Shown("error"))


def test_a_calibrated_question_is_shown_as_the_probability_that_the_api_gives(tmp_path):
    folder, held = made(tmp_path / "box room", calibrated=True)
    theirs = Viewing(load(folder))
    query, view_ = theirs.scene.understood("sofa"), theirs.scene.cameras[1]
    assert query.calibration is not None
    color, features = SceneRenderer(held.parameters).render(view_.view(), with_features=True)
    np.testing.assert_array_equal(
        theirs.picture(view_, Shown("relevancy", query=query)), heat(color, query.scores(features))
    )


def test_a_foreign_splat_has_no_semantic_modes(tmp_path):
    ply = foreign_ply(tmp_path / "theirs.ply")
    opened = OpenedScene(foreign(ply), ply)
    theirs = Viewing(opened)
    assert theirs.modes == ["color", "depth", "density"]
    with pytest.raises(ConfigError, match="has no labels"):
        theirs.picture(opened.cameras[0], Shown("labels"))
    assert theirs.touched(opened.cameras[0], Shown(), 3, 3) is None
    assert theirs.picture(opened.cameras[0], Shown()).any()


def test_density_tells_dense_from_sparse():
    rng = np.random.default_rng(0)
    plane = np.concatenate([rng.random((100, 2)) * 10, rng.random((900, 2)) * 10 + [20, 0]])
    parameters, _, _ = room(1000)
    parameters["means"] = np.c_[plane, np.zeros(1000)].astype(np.float32)

    class Held:
        def __len__(self):
            return 1000

    held = Held()
    held.parameters = parameters
    found = 10 ** Viewing(held).density
    assert np.median(found[:100]) == pytest.approx(1, rel=0.4)
    assert np.median(found[100:]) == pytest.approx(9, rel=0.4)


def test_a_picture_is_padded_to_an_aspect_without_a_resampling():
    image = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
    assert padded(image, 1.0).shape == (4, 4, 3)
    np.testing.assert_array_equal(padded(image, 1.0)[1:3], image)
    np.testing.assert_array_equal(padded(image, 4.0)[:, 2:6], image)


def test_a_path_goes_through_its_cameras(scene):
    keys = scene[2].cameras
    path = between(keys, 5)
    for k, key in ((0, 0), (2, 1), (4, 2)):
        np.testing.assert_allclose(path[k].cam_from_world, keys[key].cam_from_world, atol=1e-9)
    assert path[1].position[0] == pytest.approx(-0.75, abs=0.2)
    with pytest.raises(ConfigError, match="two cameras"):
        between(keys[:1], 5)


def test_without_viser_the_command_says_how_to_install_it(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    done = CliRunner().invoke(main, ["view", str(scene[0])])
    assert done.exit_code == 2
    assert view.INSTALL in done.stderr
