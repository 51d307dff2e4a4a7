"""Splats that others wrote, 150,000 of them, open in the page and the renderer: what is shown is
theirs.
"""

import numpy as np
import pytest
from box_room import room
from browser import BROWSER
from click.testing import CliRunner
from driven import driven
from scipy.special import expit
from shared import INPUTS, TOY, data, run_stage

from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.packed import Packed, unpack
from chebsplat.formats.ply import read_ply, write_ply
from chebsplat.formats.splats import write_splats
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.render import SceneRenderer
from chebsplat.stages.tools.page import foreign
from chebsplat.stages.tools.scene import OpenedScene
from tests.stages.tools.test_page import decibels, held_in, picture

N = 150_000


@pytest.fixture(scope="module")
def written_by_gsply(tmp_path_factory):
    """(parameters of 150,000 Gaussians, the PLY of them that gsply wrote)."""
    import gsply

    parameters, _, _ = room(N)
    parameters["log_scales"] -= np.float32(0.7)
    ply = tmp_path_factory.mktemp("gsply") / "theirs.ply"
    raw = [parameters[name] for name in ("means", "log_scales", "quats", "logit_opacities")]
    gsply.plywrite(ply, *raw, parameters["sh0"][:, 0], parameters["shN"][:, :3])
    return parameters, ply


@pytest.fixture(scope="module")
def trained_elsewhere():
    """A PLY of 90,854 Gaussians of degree 0, in the layout of 17 floats."""
    return data("gs_ply") / "guitar_decoded_sh0.ply"


def shown_in_both(ply, tmp_path):
    """The scene as opened, the first picture of it, what its page holds, and the page."""
    opened = OpenedScene(foreign(ply), ply)
    shown = opened.render(opened.cameras[0])
    assert shown.color.any() and np.isfinite(shown.depth).any()
    out = tmp_path / "theirs.html"
    done = CliRunner().invoke(main, ["page", str(ply), "--out", str(out), "--sh", "1"])
    assert done.exit_code == 0, done.output
    about, arrays = held_in(out)
    held = unpack(
        Packed(
            {name: values for name, values in arrays.items() if name != "views"}, about["ranges"]
        )
    )
    return opened, shown.color, held, out


def test_150000_splats_of_gsply_open_in_renderer_and_page(written_by_gsply, tmp_path):
    parameters, ply = written_by_gsply
    opened, image, held, _ = shown_in_both(ply, tmp_path)
    assert len(opened) == len(held["means"]) == N
    truth = SceneRenderer(parameters | {"degrees": np.ones(N, np.uint8)}).render(
        opened.cameras[0].view()
    )[0]
    np.testing.assert_array_equal(image, truth)
    np.testing.assert_array_equal(
        np.sort(opened.parameters["means"][:, 0]), np.sort(parameters["means"][:, 0])
    )
    assert np.abs(held["means"] - opened.parameters["means"]).max() < 1e-5
    opacities = expit(opened.parameters["logit_opacities"])
    assert np.abs(expit(held["logit_opacities"]) - opacities).max() < 0.51 / 255


@pytest.mark.data
def test_a_splat_trained_elsewhere_opens_in_renderer_and_page(trained_elsewhere, tmp_path):
    opened, _, held, _ = shown_in_both(trained_elsewhere, tmp_path)
    assert len(opened) == len(held["means"]) == 90_854
    assert opened.parameters["degrees"].max() == 0
    extent = np.ptp(opened.parameters["means"], axis=0).max()
    assert np.abs(held["means"] - opened.parameters["means"]).max() < 1e-5 * extent


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="neither chromium nor google-chrome is installed")
def test_in_a_browser_150000_splats_are_drawn_as_we_draw_them(written_by_gsply, tmp_path):
    _, truth, _, out = shown_in_both(written_by_gsply[1], tmp_path)
    with driven(tmp_path) as browser:
        browser.open(out, 960, 720)
        browser.run("scene.ready")
        assert decibels(picture(browser, 0, (640, 480)), truth) > 40
        browser.screenshot(tmp_path / "theirs.png")
        assert browser.complaints == []


@pytest.mark.xdist_group("toy")
def test_training_goes_on_from_a_splat_that_others_made(toy, tmp_path):
    """It begins where the PLY is, not at the points, and as many Gaussians as it holds must be
    allowed.
    """
    ply, inputs = (
        toy["export"] / "scene.ply",
        {role: toy[of] for role, of in INPUTS["train"].items()},
    )
    n = len(read_ply(ply)[0]["means"])

    def trained(name, **train):
        settings = (
            TOY["train"] | {"steps": 4, "report_every": 1, "densify": "off", "prune": False} | train
        )
        assert run_stage("train", tmp_path / name, inputs, TOY | {"train": settings}) == 0
        found = Gaussians.read(tmp_path / name)
        return found.notes["n_initial"], found.trace[0]["psnr"]

    count, on = trained("on", start=str(ply))
    assert count == n
    assert on > trained("anew")[1] + 1
    config = TOY | {"train": TOY["train"] | {"start": str(ply), "max_gaussians": n - 1}}
    assert run_stage("train", tmp_path / "no", inputs, config) == 2
    (tmp_path / "cut.ply").write_bytes(ply.read_bytes()[:400])
    config = TOY | {"train": TOY["train"] | {"start": str(tmp_path / "cut.ply")}}
    assert run_stage("train", tmp_path / "no", inputs, config) == 3


@pytest.mark.parametrize("name", ["a.splat", "a.glb", "theirs"])
def test_a_splat_file_and_a_folder_of_3dgs_become_a_scene_and_a_page(tmp_path, name):
    """Whose name says nothing of a PLY."""
    path = tmp_path / name
    if path.suffix == ".glb":
        write_splats(path, room(9)[0])
    elif path.suffix:
        row = np.array([(0, 0, 1, 0.1, 0.1, 0.1)], "<f4").tobytes() + bytes(
            [9, 99, 200, 255, 255, 128, 128, 128]
        )
        path.write_bytes(row * 9)
    else:
        (path / "point_cloud/iteration_7").mkdir(parents=True)
        write_ply(path / "point_cloud/iteration_7/point_cloud.ply", room(9)[0], 1)
    for command, out in (("lift", "made"), ("page", "made.html")):
        done = CliRunner().invoke(main, [command, str(path), "--out", str(tmp_path / out)])
        assert done.exit_code == 0, done.output
    assert len(Gaussians.read(tmp_path / "made/gaussians").parameters["means"]) == 9
    done = CliRunner().invoke(main, ["render", str(path), "--out", str(tmp_path / "frames")])
    assert (
        done.exit_code == 3
        and "is a splat and no finished scene" in done.output
        and ("chebsplat lift") in done.output
    )


def test_a_key_holds_what_training_starts_from_and_not_where_that_lies(tmp_path, quick_plans):
    keys = []
    for name, tail in (("a/theirs.ply", b""), ("b/theirs.ply", b""), ("c/theirs.ply", b"\0")):
        path = tmp_path / name
        path.parent.mkdir()
        path.write_bytes(b"ply\n" + tail)
        plan = Planner().plan("toy", f"train.start={path}")
        keys.append(next(step.key for step in plan.steps if step.stage == "train"))
    assert keys[0] == keys[1] != keys[2]


def test_a_key_holds_the_file_that_says_in_which_frame_a_splat_lies(tmp_path, quick_plans):
    (tmp_path / "theirs.ply").write_bytes(b"ply\n")
    keys = []
    for text in (None, "{}", "{} "):
        if text:
            (tmp_path / "dataparser_transforms.json").write_text(text)
        plan = Planner().plan("toy", f"train.start={tmp_path / 'theirs.ply'}")
        keys.append(next(step.key for step in plan.steps if step.stage == "train"))
    assert len(set(keys)) == 3
