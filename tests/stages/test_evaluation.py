"""What evaluate measures: joined by name, LPIPS from weights, the time of a frame by part."""

import layouts
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from shared import INPUTS, published, run_stage

from chebsplat.cameras import centers, unproject
from chebsplat.errors import InputError
from chebsplat.evaluation.lpips import BLOCKS, SCALE, SHIFT, Lpips
from chebsplat.evaluation.protocols import scannet_closed, scannet_open
from chebsplat.formats import artifact
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.features import Features
from chebsplat.formats.points import Points
from chebsplat.formats.scene import Scene
from chebsplat.photos.exposures import relit
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.work import summary
from chebsplat.render import SceneRenderer, frame_parts
from chebsplat.stages.evaluate import camera
from chebsplat.stages.measuring import image_quality
from chebsplat.stages.measuring.image_quality import (
    covisible_figures,
    enlarged,
    image_figures,
    load_lpips,
)
from chebsplat.stages.report import summary_rows
from chebsplat.stages.sources import generated
from tests.stages.test_stages import changed, inputs_of


def widths():
    """(layer, inputs, outputs) of the convolutions; (tap, channels)."""
    before, layers, taps = 3, [], []
    for k, block in enumerate(BLOCKS):
        for layer, channels in block.items():
            layers.append((layer, before, channels))
            before = channels
        taps.append((k, before))
    return layers, taps


@pytest.fixture(scope="module")
def weights():
    generator = torch.Generator().manual_seed(0)
    layers, taps = widths()
    state = {}
    for layer, inputs, outputs in layers:
        state[f"features.{layer}.weight"] = (
            torch.randn(outputs, inputs, 3, 3, generator=generator) * (2 / 9 / inputs) ** 0.5
        )
        state[f"features.{layer}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    for k, channels in taps:
        state[f"lin{k}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    return state


def pictures(count=3, side=24):
    return np.random.default_rng(1).integers(0, 255, (count, side, side + 8, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    "names",
    [
        ("features.{}", "lin{}.model.1"),
        ("net.slice1.{}", "lins.{}.model.1"),
        ("net.layers.{}", "lin.{}.1"),
    ],
)
def test_lpips_of_weights_that_pass_colours_on_is_the_distance_of_their_directions(names):
    """Every layer keeps the first three channels; so each tap compares the unit vectors of the
    scaled colours.
    """
    layers, taps = widths()
    state = {}
    for layer, inputs, outputs in layers:
        kernel = torch.zeros(outputs, inputs, 3, 3)
        kernel[[0, 1, 2], [0, 1, 2], 1, 1] = 1
        place = names[0].format(layer)
        state |= {f"{place}.weight": kernel, f"{place}.bias": torch.zeros(outputs)}
    for k, channels in taps:
        tap = torch.zeros(1, channels, 1, 1)
        tap[0, :3, 0, 0] = torch.tensor([1.0, 2.0, 3.0]) * (k + 1)
        state[f"{names[1].format(k)}.weight"] = tap
    a, b = (np.full((32, 32, 3), color, np.uint8) for color in ((200, 10, 60), (30, 90, 255)))
    units = []
    for image in (a, b):
        # in [0, 1]: not scaled to [-1, 1]
        color = np.maximum((image[0, 0] / 255 - SHIFT) / SCALE, 0)
        units.append(color / np.linalg.norm(color))
    wanted = (1 + 2 + 3 + 4 + 5) * (np.array([1, 2, 3]) * (units[0] - units[1]) ** 2).sum()
    assert Lpips(state).distance(a, b) == pytest.approx(wanted, rel=1e-4)


def test_weights_of_lpips_are_read_from_both_kinds_of_file_and_wrong_ones_are_named(
    weights, tmp_path
):
    a, b, _ = pictures()
    save_file(weights, tmp_path / "vgg.safetensors")
    torch.save(weights, tmp_path / "vgg.pth")
    found = [load_lpips(tmp_path / name).distance(a, b) for name in ("vgg.safetensors", "vgg.pth")]
    assert found[0] == found[1] == Lpips(weights).distance(a, b)
    damaged = {
        "no tensor lin3": {name: t for name, t in weights.items() if not name.startswith("lin3")},
        r"features.5.bias is \(64,\), not \(128,\)": weights | {"features.5.bias": torch.zeros(64)},
        "features.0.weight is not finite": weights
        | {"features.0.weight": torch.full((64, 3, 3, 3), torch.nan)},
        "no tensor features.0.weight": {"a": torch.zeros(1)},
    }
    for message, state in damaged.items():
        torch.save(state, tmp_path / "bad.pth")
        with pytest.raises(InputError, match=rf"bad\.pth holds no weights of LPIPS \({message}"):
            load_lpips(tmp_path / "bad.pth")
    (tmp_path / "bad.pth").write_bytes(b"no pickle")
    (tmp_path / "bad.safetensors").write_bytes(b"no header")
    torch.save(torch.nn.Linear(1, 1), tmp_path / "module.pth")
    for name in ("bad.pth", "bad.safetensors", "module.pth"):
        with pytest.raises(InputError, match=f"{name} holds no weights"):
            load_lpips(tmp_path / name)
    with pytest.raises(InputError, match=r"evaluate\.lpips_weights"):
        load_lpips(tmp_path / "nowhere.pth")


def test_what_is_masked_counts_in_no_image_figure_and_no_lpips_is_none(weights):
    truth = pictures(2)
    renders, masks = truth.copy(), [np.ones(truth.shape[1:3], bool) for _ in truth]
    renders[:, :5], masks[0][:5], masks[1][:5] = 0, False, False
    found = image_figures(renders, truth, masks, Lpips(weights))
    assert (found["psnr"], found["ssim"], found["lpips"]) == (100, pytest.approx(1), 0)
    assert len(found["per_view"]["lpips"]) == 2
    assert image_figures(renders, truth, masks)["lpips"] is None


def wall_capture(**fields):
    """A wall two units before four cameras of 4x2 pixels: a test view; one that sees half of it,
    two of its columns further; one that looks away; one before which something stands.
    """
    depth = np.full((4, 2, 4), 2.0, np.float32)
    depth[3] = 1.0
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1, 0, 3] = 2.0
    poses[2, :3, :3] = np.diag([-1, 1, -1])
    fields = {"depth": depth, "cam_from_world": poses, "loss_mask": None} | fields
    Ks = np.tile(np.array([[2.0, 0, 2], [0, 2.0, 1], [0, 0, 1]]), (4, 1, 1))
    is_test, images = np.arange(4) == 0, np.tile(pictures(1)[:, :2, :4], (4, 1, 1, 1))
    names = ["test", "half", "away", "behind"]
    return Capture(names, images, Ks, is_test=is_test, **fields)


def covisible_of(capture, views=(0, 1, 2, 3), poses=None):
    """Figures of a render that is wrong in the right half, by the cameras of some views."""
    render = capture.images[:1].copy()
    render[0, :, 2:] = 255 - render[0, :, 2:]
    rows = list(views)
    poses = wall_capture().cam_from_world if poses is None else poses
    cameras = Cameras([capture.names[k] for k in rows], capture.Ks[rows], poses[rows], 4, 2)
    return covisible_figures(capture, cameras, ["test"], render)


def test_covisible_pixels_are_those_whose_surface_a_training_photo_shows(monkeypatch):
    wall = wall_capture()
    assert covisible_of(wall) == {"psnr": 100.0, "share": 0.5}
    assert covisible_of(wall, views=(0, 2, 3)) is None  # what no camera of the scene shows
    assert covisible_of(wall, poses=np.tile(np.eye(4), (4, 1, 1)))["share"] == 1.0
    assert covisible_of(wall_capture(depth=None)) is None
    monkeypatch.setattr(image_quality, "COVISIBLE_SIDE", 2)  # every other row and column
    assert covisible_of(wall) == {"psnr": 100.0, "share": 0.5}
    assert covisible_of(wall_capture(cam_from_world=None)) is None


def test_covisible_pixels_are_counted_among_those_of_known_depth_that_no_mask_hides():
    depth = wall_capture().depth.copy()
    depth[0, :, 3], depth[0, 0, 2] = np.nan, np.inf
    assert covisible_of(wall_capture(depth=depth))["share"] == pytest.approx(4 / 5)
    mask = np.ones((4, 2, 4), bool)
    mask[0, :, 2:] = False
    assert covisible_of(wall_capture(loss_mask=mask))["share"] == 1.0
    mask[1] = False  # a training photo shows nothing where it is masked
    assert covisible_of(wall_capture(loss_mask=mask)) is None


@pytest.mark.xdist_group("toy")
def test_views_are_rendered_in_the_exposure_that_photos_from_there_are_expected_to_have(
    toy, tmp_path
):
    """Test photos of other exposures, which the scene's cameras tell, cost next to nothing."""
    capture, scene = Capture.read(toy["ingest"]), Scene.read(toy["export"])
    n, tested = len(scene.cameras.names), np.flatnonzero(capture.is_test)
    scene.cameras.exposures = np.linspace(-0.8, -0.4, 3 * n).reshape(n, 3)
    stops = dict(zip(scene.cameras.names, scene.cameras.exposures, strict=True))
    capture.images = capture.images[:].copy()
    for view in tested:
        capture.images[view] = relit(capture.images[view], stops[capture.names[view]])
    inputs = inputs_of(toy, "evaluate") | {
        "capture": published(tmp_path / "capture", capture),
        "scene": published(tmp_path / "scene", scene),
    }
    assert run_stage("evaluate", tmp_path / "out", inputs) == 0
    lit, plain = (Evaluation.read(path).figures for path in (tmp_path / "out", toy["evaluate"]))
    renders, plain_renders = (
        Evaluation.read(path).pictures["renders"] for path in (tmp_path / "out", toy["evaluate"])
    )
    for render, before, name in zip(renders, plain_renders, lit["names"], strict=True):
        off = render.astype(int) - relit(before, stops[name])
        assert np.abs(off[before < 255]).max() <= 1
    assert lit["image"]["psnr"] > plain["image"]["psnr"]  # darker: differences are smaller
    assert lit["image"]["psnr_as_shown"] < plain["image"]["psnr"] - 5
    assert "psnr_as_shown" not in plain["image"]
    named = [
        [
            row.name
            for row in summary_rows(
                of, None, {"milliseconds": {}}, dict.fromkeys(("evaluation", "gaussians"), "A")
            )
        ]
        for of in (lit, plain)
    ]
    assert [any("one exposure" in name for name in names) for names in named] == [True, False]
    assert artifact.read_manifest(tmp_path / "out").facts["layout_error"] == 0


@pytest.mark.xdist_group("toy")
def test_a_drift_of_exposures_is_measured_in_training_and_expected_of_test_photos(toy, tmp_path):
    """Photos are the brighter the further their camera stands along x."""
    capture, points = Capture.read(toy["ingest"]), Points.read(toy["sfm"])
    eyes = centers(capture.cam_from_world)[:, 0]
    stops = 0.4 * (eyes - eyes[~capture.is_test].mean()) / np.abs(eyes - eyes.mean()).max()
    images = zip(capture.images[:], stops, strict=True)
    capture.images = np.stack([relit(image, np.full(3, more)) for image, more in images])
    capture.source["kind"] = "colmap"
    train = {"steps": 60, "max_gaussians": 500, "semantics": False, "opacity": 0.7}
    inputs = {"capture": published(tmp_path / "capture", capture), "points": toy["sfm"]}
    settings = {"train": train, "teacher": {"kind": "none"}}
    assert run_stage("train", tmp_path / "train", inputs, settings) == 0
    assert run_stage("export", tmp_path / "scene", {"gaussians": tmp_path / "train"}) == 0
    cameras = Scene.read(tmp_path / "scene").cameras
    assert cameras.names == points.names
    expected = dict(zip(cameras.names, cameras.exposures, strict=True))
    for name, more in zip(capture.names, stops, strict=True):
        assert expected[name] == pytest.approx([more] * 3, abs=0.1)
    inputs = {"capture": tmp_path / "capture", "scene": tmp_path / "scene"}
    assert run_stage("evaluate", tmp_path / "out", inputs) == 0
    image = Evaluation.read(tmp_path / "out").figures["image"]
    assert image["psnr"] > image["psnr_as_shown"] + 0.5


@pytest.mark.xdist_group("toy")
def test_a_test_view_without_a_pixel_that_counts_is_left_out_and_undistorted_photos_are_named(
    toy, tmp_path
):
    capture = Capture.read(toy["ingest"])
    capture.loss_mask = np.ones(capture.images.shape[:3], bool)
    capture.loss_mask[np.flatnonzero(capture.is_test)[0]] = False
    capture.source["undistorted"] = ["OPENCV"]
    inputs = inputs_of(toy, "evaluate") | {"capture": published(tmp_path / "capture", capture)}
    assert run_stage("evaluate", tmp_path / "out", inputs) == 0
    found, whole = (Evaluation.read(path).figures for path in (tmp_path / "out", toy["evaluate"]))
    assert found["names"] == whole["names"][1:]
    assert found["image"]["per_view"]["psnr"] == whole["image"]["per_view"]["psnr"][1:]
    n = len(whole["names"])
    assert "no pixel" in found["left_out"][f"1 of {n} views"]
    assert "as_taken" not in found["image"]  # its capture holds none
    assert 0.5 < whole["image"]["covisible"]["share"] <= 1
    assert whole["image"]["covisible"]["psnr"] > 0
    timed = {"evaluation": "A", "gaussians": "B"}
    rows = [
        summary_rows(figures, None, {"milliseconds": {}}, timed)[0].name
        for figures in (whole, found)
    ]
    names = [row.name for row in summary_rows(whole, None, {"milliseconds": {}}, timed)]
    assert any(name.startswith("PSNR of co-visible pixels") for name in names)
    assert "undistorted" not in rows[0] and "of undistorted photos" in rows[1]


@pytest.mark.xdist_group("toy")
def test_lpips_given_weights_and_the_time_by_part_are_in_the_evaluation(toy, weights, tmp_path):
    save_file(weights, tmp_path / "vgg.safetensors")
    config = changed(
        evaluate={"lpips_weights": str(tmp_path / "vgg.safetensors"), "timing_repeats": 1}
    )
    assert run_stage("evaluate", tmp_path / "out", inputs_of(toy, "evaluate"), config) == 0
    figures = Evaluation.read(tmp_path / "out").figures
    assert figures["lpips"] > 0 and figures["lpips_net"] == {"net": "vgg", "normalize": False}
    assert "LPIPS" not in figures["left_out"]
    split = figures["milliseconds"]
    assert all(split[part] > 0 for part in ("projection", "sh", "sort", "blend"))
    assert (split["width"], split["height"], split["device"]) == (96, 72, "cpu") and split[
        "threads"
    ] >= 1
    config = changed(evaluate={"timing_repeats": 0})
    assert run_stage("evaluate", tmp_path / "untimed", inputs_of(toy, "evaluate"), config) == 0
    untimed = Evaluation.read(tmp_path / "untimed").figures
    assert (
        untimed["frames_per_second"] == untimed["milliseconds"] == {}
        and "frames a second" in untimed["left_out"]
    )
    without = Evaluation.read(toy["evaluate"]).figures
    assert without["lpips"] is None and "not measured" in without["left_out"]["LPIPS"]


@pytest.mark.xdist_group("toy")
def test_the_clocked_steps_render_the_same_frame(toy):
    scene = Scene.read(toy["export"])
    renderer = SceneRenderer(scene.parameters)
    for k in range(3):
        view = camera(scene, k)
        assert np.array_equal(frame_parts(renderer, view)[1], renderer.render(view)[0])


@pytest.mark.xdist_group("toy")
def test_a_finer_view_is_blurred_as_what_was_trained_on(toy):
    scene, far = Scene.read(toy["export"]), []
    for Ks in (scene.cameras.Ks, None):
        renderer = SceneRenderer(scene.parameters, Ks=Ks)
        view = camera(scene, 0)
        picture = renderer.render(view)[0].astype(float)
        fine = renderer.render(enlarged(view, 3))[0].astype(float)
        far.append(
            np.abs(fine.reshape(view.height, 3, view.width, 3, 3).mean((1, 3)) - picture).mean()
        )
    # grey levels; 0.79 to 0.90 by four seeds of the regions that the training grows by
    assert far[0] < 0.95 * far[1]


@pytest.mark.xdist_group("toy")
def test_views_of_capture_and_teacher_in_another_order_change_no_figure(toy, tmp_path):
    rng = np.random.default_rng(0)
    capture, features = Capture.read(toy["ingest"]), Features.read(toy["teacher"])
    for record, parts in ((capture,
                           ("images", "depth", "labels", "Ks", "cam_from_world", "is_test")),
                          (features, ("features", "pseudo_labels", "confidence"))):  # fmt: skip
        order = rng.permutation(len(record.names))
        for part in parts:
            setattr(record, part, np.asarray(getattr(record, part)[:])[order])
        record.names = [record.names[k] for k in order]
    inputs = inputs_of(toy, "evaluate") | {
        "capture": published(tmp_path / "c", capture),
        "features": published(tmp_path / "f", features),
    }
    assert run_stage("evaluate", tmp_path / "out", inputs) == 0
    found, wanted = (Evaluation.read(path).figures for path in (tmp_path / "out", toy["evaluate"]))
    for part in ("names", "image", "segmentation"):
        assert found[part] == wanted[part]


@pytest.mark.xdist_group("toy")
def test_points_are_measured_where_depth_and_poses_say_where_they_lie(toy, tmp_path):
    measured = Evaluation.read(toy["evaluate"]).figures["segmentation"]
    for side in ("scene", "teacher"):  # other weights of the same surfaces
        assert 0 < abs(measured[side]["point_miou"] - measured[side]["miou"]) < 0.1
    record = Capture.read(toy["ingest"])
    record.depth = None
    inputs = inputs_of(toy, "evaluate")
    inputs["capture"] = published(tmp_path / "c", record)
    assert run_stage("evaluate", tmp_path / "out", inputs) == 0
    figures = Evaluation.read(tmp_path / "out").figures
    assert figures["segmentation"]["scene"]["point_miou"] is None
    assert "depth" in figures["left_out"]["3D point mIoU"]
    assert figures["segmentation"]["scene"]["miou"] == measured["scene"]["miou"]


@pytest.mark.xdist_group("toy")
def test_names_are_matched_however_they_are_spelt_and_the_end_of_a_run_lists_what_matches_nothing(
    toy, tmp_path
):
    record, wanted = (
        Capture.read(toy["ingest"]),
        Evaluation.read(toy["evaluate"]).figures["segmentation"],
    )
    own = record.class_names
    for k, names in enumerate(
        ([name.upper().replace("-", "_") for name in own], ["my own word", *own[1:]])
    ):
        record.class_names = names
        inputs = inputs_of(toy, "evaluate") | {"capture": published(tmp_path / f"c{k}", record)}
        assert run_stage("evaluate", tmp_path / f"out{k}", inputs) == 0
        found = Evaluation.read(tmp_path / f"out{k}").figures["segmentation"]
        shown = {row[0]: row[1:] for row in summary.table(tmp_path / f"out{k}")}
        assert "classes" in shown["mIoU"][1] and "pixels" in shown["mIoU"][1]
        if k == 0:
            assert found["scene"]["miou"] == wanted["scene"]["miou"] and found["unmatched"] == {}
        else:
            assert found["scene"]["miou"] < wanted["scene"]["miou"]
            assert found["unmatched"] == {"scene": own[:1], "truth": ["my own word"]}
            assert shown["true classes without a label"] == ("1", "my own word")
            assert shown["labels that are no class"] == ("1", own[0])


@pytest.mark.xdist_group("toy")
def test_a_truth_of_one_class_gives_no_miou_and_says_why(toy, tmp_path):
    record = Capture.read(toy["ingest"])
    record.labels = np.where(np.asarray(record.labels[:]) == 0, np.int16(0), np.int16(-1))
    inputs = inputs_of(toy, "evaluate") | {"capture": published(tmp_path / "c", record)}
    assert run_stage("evaluate", tmp_path / "out", inputs) == 0
    figures = Evaluation.read(tmp_path / "out").figures
    assert figures["segmentation"]["scene"]["miou"] is None
    assert "one class alone" in figures["left_out"]["mIoU"]
    shown = {row[0]: row[1:] for row in summary.table(tmp_path / "out")}
    assert shown["mIoU"] == ("none", figures["left_out"]["mIoU"])


@pytest.mark.slow
def test_a_scannet_scene_runs_from_its_folder_to_the_figures_of_scannet_open(tmp_path):
    """All 16 views are trained on and evaluated; points come from the scene's own file."""
    fields = generated.capture("toy", 1, "toy")
    fields["labels"], fields["class_names"] = (
        (fields["labels"] + 7) % 20,
        list(scannet_open.CLASSES),
    )
    pixels = np.argwhere(np.ones((72, 96), bool))[::17]
    parts = [
        unproject(fields["depth"][k], fields["Ks"][k], fields["cam_from_world"][k], pixels)
        for k in range(16)
    ]
    fields["points"] = np.concatenate(parts).astype(np.float32)
    fields["point_colors"] = np.concatenate(
        [image[pixels[:, 0], pixels[:, 1]] for image in fields["images"]]
    )
    folder = tmp_path / "scene0000_00"
    layouts.write_scannet_sg(folder, fields)
    config = changed(source={"kind": "scannet", "path": str(folder)},
                     ingest={"protocol": "scannet-open"},
                     scene={"name": "scene0000_00"})  # fmt: skip
    made = {}
    for stage in ("ingest", "sfm", "teacher", "describe", "train", "export", "evaluate", "report"):
        roles = {role: made[of] for role, of in INPUTS[stage].items() if of in made}
        made[stage] = tmp_path / stage
        assert run_stage(stage, made[stage], roles, config) == 0, stage
    assert artifact.read_manifest(made["sfm"]).facts["how"] == "source"
    figures = Evaluation.read(made["evaluate"]).figures
    assert len(figures["names"]) == 16
    assert (figures["protocol"]["name"], figures["protocol"]["resolution"]) == (
        "scannet-open",
        "96x72",
    )
    matrix = np.array(figures["segmentation"]["scene"]["confusion"])
    assert matrix.shape == (20, 20) and matrix.sum() == 16 * 484 * 648
    assert figures["segmentation"]["teacher"]["miou"] > 0.3
    assert figures["segmentation"]["scene"] == scannet_open.summed([matrix])


def test_the_content_of_the_weights_is_part_of_what_an_evaluation_is(quick_plans, tmp_path):
    plans = []
    for content in (b"one", b"other"):
        (tmp_path / "vgg.pth").write_bytes(content)
        plans.append(Planner().plan("toy", "evaluate.lpips_weights=vgg.pth"))
    changed = [
        a.stage for a, b in zip(plans[0].steps, plans[1].steps, strict=True) if a.key != b.key
    ]
    assert changed == ["evaluate", "report"]
    with pytest.raises(InputError, match=r"gone\.pth is missing"):
        Planner().plan("toy", "evaluate.lpips_weights=gone.pth")


def test_a_scannet_folder_is_planned_without_the_stages_it_does_not_need(quick_plans, tmp_path):
    fields = {"images": np.zeros((5, 6, 8, 3), np.uint8), "depth": np.ones((5, 6, 8), np.float32),
              "labels": np.zeros((5, 6, 8), np.int16), "class_names": list(scannet_closed.CLASSES),
              "Ks": np.tile([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]], (5, 1, 1)),
              "cam_from_world": np.tile(np.eye(4), (5, 1, 1))}  # fmt: skip
    layouts.write_scannet_pl(tmp_path / "scene0000_00", fields)
    plan = Planner().plan("./scene0000_00", "ingest.protocol=scannet-closed")
    assert plan.steps[0].sections["source"]["kind"] == "scannet"
    assert "sfm: matching" in plan.left_out
    assert (
        "sfm: matching"
        not in Planner()
        .plan("./scene0000_00", "ingest.protocol=scannet-closed,ingest.depth=off")
        .left_out
    )
    (tmp_path / "scene0000_00/splits.json").write_text('{"train": ["0"], "test": ["10"]}')
    again = Planner().plan("./scene0000_00", "ingest.protocol=scannet-closed")
    assert plan.steps[0].key != again.steps[0].key
