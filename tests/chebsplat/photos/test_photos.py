"""Exposures that a training measures, depth that a capture brings, and disturbances for
studies.
"""

import chebsplat  # noqa: F401  # isort: skip
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.stability.training import tiny_trainer
from chebsplat.cameras import centers
from chebsplat.errors import ConfigError
from chebsplat.evaluation.metrics import color_fitted
from chebsplat.formats.capture import Capture
from chebsplat.formats.points import Points
from chebsplat.photos import exposures as measuring
from chebsplat.photos.exposures import expected_exposures, measured_exposures, relit
from chebsplat.settings import TrainSection
from chebsplat.splats.planes import at_pixels
from chebsplat.stages.ingest import displaced, recolored
from chebsplat.stages.runtime import config
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.training.assembly import Inputs, assemble, measure_exposures
from chebsplat.stages.training.defaults import DEPTH_WEIGHT, evidence_of, resolved
from chebsplat.stages.training.photos import exposures_of
from chebsplat.stages.training.views import training_views
from chebsplat.training.losses import depth_distance
from chebsplat.views import reduced

K = torch.tensor([[40.0, 0, 24], [0, 40, 20], [0, 0, 1]])


def test_measured_exposures_are_those_the_photos_were_taken_with():
    """In linear light, of a wall of many colours; and none is told where two photos share no
    points.
    """
    g = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = 5
    points, image = (
        g.normal(size=(2000, 3)),
        np.repeat(np.repeat(g.integers(90, 200, (5, 6, 3)), 8, 0), 8, 1),
    )
    stops = np.array(
        [[-0.4, 0.1, 0], [0.2, 0.2, 0.2], [0, 0, 0], [0.1, -0.2, 0], [0.1, -0.1, -0.2]]
    )
    images = np.stack([relit(image.astype(np.uint8), own) for own in stops])
    Ks = np.tile(K.double().numpy(), (5, 1, 1))
    assert measured_exposures(images, Ks, poses, points) == pytest.approx(stops, abs=0.02)
    assert measured_exposures(images[[2] * 5], Ks, poses, points) == pytest.approx(0, abs=1e-9)
    assert np.isnan(measured_exposures(images, Ks, poses, points, np.zeros((0, 2), int))).all()
    tracks = np.stack(np.meshgrid(np.arange(2000), np.arange(4)), -1).reshape(-1, 2)
    some = measured_exposures(images, Ks, poses, points, tracks)
    assert np.isnan(some[4]).all() and some[:4] == pytest.approx(
        stops[:4] - stops[:4].mean(0), abs=0.02
    )


def test_the_darker_half_of_points_does_not_tell_of_exposures():
    """Blue of most of the wall is dark, and brighter in every second photo; nothing else is."""
    images = np.full((6, 40, 48, 3), 150, np.uint8)
    images[:, :, 22:, 2] = np.linspace(18, 40, 40)[:, None]
    images[::2, :, 22:, 2] = np.linspace(18, 40, 40)[:, None] * 1.5
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 2, 3] = 5
    points = np.random.default_rng(0).normal(size=(2000, 3))
    Ks = np.tile(K.double().numpy(), (6, 1, 1))
    assert measured_exposures(images, Ks, poses, points) == pytest.approx(0, abs=0.03)


def test_a_drift_is_measured_where_few_neighbours_see_the_same_points():
    """And in spite of a photo that something covers for a third of its points."""
    drift = 0.4 * np.sin(np.linspace(0, 3, 40))[:, None] * np.array([1, 0.8, 1.1])
    wall = np.full((40, 48, 3), 110, np.uint8)
    images = np.stack([relit(wall, own) for own in drift])
    images[20, :, :16] = 20
    poses, g = np.tile(np.eye(4), (40, 1, 1)), np.random.default_rng(0)
    poses[:, 2, 3] = 5
    points, seen_by = 0.8 * g.normal(size=(2000, 3)), np.arange(2000) % 36
    tracks = np.stack([np.repeat(np.arange(2000), 5), (seen_by[:, None] + np.arange(5)).ravel()], 1)
    Ks = np.tile(K.double().numpy(), (40, 1, 1))
    found = measured_exposures(images, Ks, poses, points, tracks)
    assert found == pytest.approx(drift - drift.mean(0), abs=0.03)


def test_a_photo_relit_and_back_is_the_same_but_for_what_was_cut_off():
    image = np.random.default_rng(0).integers(60, 150, (8, 8, 3)).astype(np.uint8)
    back = relit(relit(image, np.array([0.5, 0.3, -0.3])), -np.array([0.5, 0.3, -0.3]))
    assert np.abs(back.astype(int) - image).max() <= 1
    assert (relit(np.full((1, 1, 3), 250, np.uint8), np.ones(3)) == 255).all()
    assert np.array_equal(relit(image, np.zeros(3)), image)


def ring(n):
    """Cameras about the origin that look at it."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, n, endpoint=False)):
        poses[k, :3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        poses[k, 2, 3] = 3
    return poses


def test_exposures_that_drift_along_the_path_are_expected_between_and_those_of_single_photos_not():
    g, poses, angle = (
        np.random.default_rng(0),
        ring(40),
        np.linspace(0, 2 * np.pi, 40, endpoint=False)[:, None],
    )
    drift = 0.3 * np.sin(angle) * np.array([1, 0.9, 1.2])
    some = np.arange(0, 40, 2)
    assert np.abs(expected_exposures(drift[some], poses[some], poses) - drift).max() < 0.01
    noise = g.normal(size=(40, 1)) * 0.2 + g.normal(size=(40, 3)) * 0.02
    off = expected_exposures(drift + noise, poses, poses) - drift - noise.mean(0)
    assert off.std() < 0.55 * noise.std()
    known = np.where(np.arange(40)[:, None] == 7, np.nan, drift)
    assert np.abs(expected_exposures(known, poses, poses[7:8]) - drift[7]).max() < 0.02
    assert expected_exposures(np.full((40, 3), 0.4), poses, poses[:5]) == pytest.approx(0.4)
    known[2:] = np.nan
    assert not expected_exposures(known, poses, poses).any()


def test_of_many_photos_every_second_one_tells_what_to_expect(monkeypatch):
    poses, values = ring(40), np.random.default_rng(0).normal(size=(40, 3))
    expected = expected_exposures(values, poses, poses)
    others = np.stack([values, values + 9], 1).reshape(80, 3)  # which do not count
    monkeypatch.setattr(measuring, "MOST_VIEWS", 40)
    assert np.allclose(expected_exposures(others, np.repeat(poses, 2, 0), poses), expected)


def undone(views):
    """Mean brightness of each photo without its exposure."""
    photos = zip(views.images.numpy(), views.exposures.numpy(), strict=True)
    return np.array([relit(photo, -stops).mean() for photo, stops in photos])


def test_exposures_are_measured_and_expected_of_views_between():
    """Photos along a path grow brighter: all are compared alike, and what is expected of the test
    views among them follows the path. One photo's own exposure is measured as well.
    """
    capture, points = photographed("colmap", 1.3 ** np.linspace(-1, 1, 9))
    capture.is_test = np.isin(np.arange(9), (2, 6))
    points.cam_from_world[:, 0, 3] = np.linspace(-0.2, 0.2, 9)
    exposures = exposures_of(capture, points)
    assert exposures.spread > 0.3
    views = training_views(capture, points, None, exposures=exposures.measured)
    assert undone(views).std() < 3
    steps = np.diff(exposures.expected.mean(1))  # 1.3 ** .25 in sRGB, about 2.2 times in stops
    assert steps == pytest.approx(2.2 * 0.25 * np.log2(1.3), abs=0.06)
    capture, points = photographed("colmap", [1, 1, 1, 0.5, 1, 1, 1, 1])
    order = [5, 2, 7, 0, 3, 6, 1, 4]  # of the points' views
    points.names = [points.names[k] for k in order]
    points.cam_from_world[:, 0, 3] = np.linspace(-0.2, 0.2, 8)[order]
    measured = exposures_of(capture, points).measured
    assert measured[4].max() < measured[[0, 1, 2, 3, 5, 6, 7]].min() - 1
    assert undone(training_views(capture, points, None, exposures=measured)).std() < 3
    capture.is_test[5] = True  # the first of the points' views: training views are fewer
    without = exposures_of(capture, points).measured
    assert without[3].max() < without[[0, 1, 2, 4, 5, 6]].min() - 1
    assert undone(training_views(capture, points, None, exposures=without)).std() < 3
    alone = exposures_of(*photographed("colmap", [1, 0.5]))  # too few to expect anything
    assert not alone.expected.any() and alone.measured.any()


def test_depth_is_a_channel_that_changes_no_colour():
    made = tiny_trainer()
    view = made.views.camera(0, 1)
    with_depth, without = (made.model.render(view, 3, depth=wanted) for wanted in (True, False))
    torch.testing.assert_close(with_depth.rgb, without.rgb, rtol=0, atol=1e-6)
    assert without.planes is None
    covered = with_depth.alpha[..., 0] > 0.5
    near = (with_depth.alpha[..., 0] / at_pixels(with_depth.planes))[covered]
    assert covered.any() and near.min() > 2.5 and near.max() < 5.5  # a unit sphere four units away


def test_depth_distance_counts_what_is_known_alone():
    truth = torch.full((4, 4), 2.0)
    truth[0, 0], truth[0, 1] = float("nan"), 0.0
    inverse = torch.full((4, 4), 0.55, requires_grad=True)
    distance = depth_distance(inverse, torch.ones(4, 4, 1), truth, None)
    distance.backward()
    assert (
        distance.item() == pytest.approx(0.1)
        and not inverse.grad[0, :2].any()
        and (inverse.grad[1:] > 0).all()
    )
    assert depth_distance(inverse, torch.ones(4, 4, 1), truth * float("nan"), None) == 0


def test_gaussians_go_where_depth_is_measured():
    """The same training with and without a depth a tenth beyond what the Gaussians show at
    first.
    """

    def distance(weight):
        made = tiny_trainer(
            steps=60, densify="off", prune=False, depth_every=2, weight_depth=weight
        )
        with torch.no_grad():
            shown = [
                made.model.render(made.views.camera(v, 1), 0, depth=True)
                for v in range(len(made.views.names))
            ]
        depths = [r.alpha[..., 0] / at_pixels(r.planes) for r in shown]
        truths = [
            torch.where(r.alpha[..., 0] > 0.5, 1.1 * z, torch.nan)
            for r, z in zip(shown, depths, strict=True)
        ]
        made.views.depth = lambda index, factor: truths[index][::factor, ::factor]
        losses = list(made.steps())
        assert ["loss_depth" in figures for figures in losses] == [
            step % 2 == 1 for step in range(60)
        ]
        with torch.no_grad():
            r = made.model.render(made.views.camera(0, 1), 0, depth=True)
            return float(depth_distance(at_pixels(r.planes), r.alpha, truths[0], None))

    without, pulled = distance(0.0), distance(3.0)
    assert pulled < 0.5 * without


def test_the_depth_loss_is_on_where_views_tell_the_same_depth():
    capture, points = photographed("colmap", [1, 1, 1])

    def decided(**given):
        evidence = evidence_of(TrainSection(**given), capture, points, None)
        return resolved(TrainSection(**given), evidence).weight_depth, evidence.no_depth

    assert decided() == (0, "the capture has no depth in the unit of its poses")
    points.depths = np.full((3, 20, 24), 5, np.float32)
    assert decided() == (DEPTH_WEIGHT, "")
    points.depths = None
    # each half a unit farther back
    capture.cam_from_world[1, 2, 3], capture.cam_from_world[2, 2, 3] = 5.5, 6.0
    capture.depth = np.stack([np.full((40, 48), z, np.float32) for z in (5, 5.5, 6)])
    capture.depth[:, :3] = np.nan
    assert decided() == (DEPTH_WEIGHT, "")
    assert decided(weight_depth=0.5) == (0.5, "") and decided(weight_depth=0) == (0, "")
    capture.depth[1] *= 1.01
    weight, why = decided()
    assert weight == 0 and "differ by 0.9% between views" in why  # as seen from the farther one
    capture.cam_from_world = None  # of matched photos: another unit
    assert decided()[0] == 0


def test_a_colour_fit_undoes_an_affine_map():
    g = np.random.default_rng(1)
    truth = g.integers(60, 200, (20, 30, 3), np.uint8)
    image = (
        (truth @ np.array([[0.7, 0.1, 0], [0, 0.8, 0.1], [0.1, 0, 0.9]]) + 10)
        .round()
        .astype(np.uint8)
    )
    # of rounding to 8 bits, twice
    assert np.abs(color_fitted(image, truth).astype(int) - truth).max() <= 2
    constant = color_fitted(np.full_like(truth, 7), truth)  # one colour fits as the mean
    assert np.abs(constant - truth.mean((0, 1))).max() <= 0.5 + 1e-6


def test_disturbances_leave_test_views_and_the_mean_alone():
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(2).normal(size=(9, 3))
    is_test = np.arange(9) % 3 == 0
    changed = displaced(poses, is_test, 0.5, 0.01)
    assert np.array_equal(changed[is_test], poses[is_test])
    motions = np.linalg.inv(poses[~is_test]) @ changed[~is_test]
    rotations = Rotation.from_matrix(motions[:, :3, :3])
    assert (
        np.abs(rotations.as_rotvec().mean(0)).max() < 1e-4
        and np.abs(motions[:, :3, 3].mean(0)).max() < 1e-4
    )
    turns = np.degrees(rotations.magnitude())
    shifts = np.linalg.norm(centers(changed) - centers(poses), axis=1)[~is_test]
    assert 0.3 < turns.mean() < 0.7 and 0.005 < shifts.mean() < 0.015
    images = np.full((9, 4, 4, 3), 128, np.uint8)
    other = recolored(images, is_test, 0.5)
    assert np.array_equal(other[is_test], images[is_test]) and other[~is_test].std() > 10


def photographed(kind, gains):
    """A capture of one wall, a view for each gain, and points on it."""
    g, n = np.random.default_rng(0), len(gains)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 2, 3] = 5
    images = np.stack([np.full((40, 48, 3), 100 * gain, np.uint8) for gain in gains])
    Ks, names = np.tile(K.double().numpy(), (n, 1, 1)), [f"v{k}" for k in range(n)]
    capture = Capture(names, images, Ks, poses, np.zeros(n, bool), source={"kind": kind})
    means = g.normal(size=(2000, 3))
    flat = np.zeros((2000, 3), np.float32)
    colors, shapes = (
        np.full((2000, 3), 100, np.uint8),
        np.tile(np.eye(3, dtype=np.float32), (2000, 1, 1)),
    )
    points = Points(names, Ks, poses, means, colors, flat, shapes, np.zeros((0, 2), np.int32))
    return capture, points


@pytest.mark.parametrize(
    ("kind", "gains", "chosen", "wanted", "why"),
    [
        ("generated", [0.5, 1, 1.5, 2], "auto", False, "generated"),
        ("colmap", [0.8, 1.4, 0.7, 1.2], "auto", True, ""),
        ("colmap", [1, 1, 1, 1], "auto", False, "differ by 0.00 stops"),
        ("colmap", [1, 1, 1, 1], "measured", True, ""),
        ("colmap", [0.8, 1.4, 0.7, 1.2], "off", False, "train.exposure is off"),
    ],
)
def test_exposures_are_measured_where_photos_of_the_same_points_differ(
    tmp_path, kind, gains, chosen, wanted, why
):
    job = Job({}, config.build({"train": {"exposure": chosen}}, "test"), tmp_path, tmp_path)
    capture, points = photographed(kind, gains)
    exposures = measure_exposures(job, capture, points)
    trainer = assemble(job, Inputs(capture, points, exposures=exposures))
    assert (trainer.settings.exposure == "measured") == wanted and why in job.facts.get(
        "left_out", {}
    ).get("exposure by photo", "")
    assert (trainer.views.exposures is not None) == wanted
    if wanted:
        assert undone(trainer.views).std() < 2
    assert ("exposure_spread" in job.facts) == (chosen != "off" and kind != "generated")


def test_depth_that_is_asked_for_and_is_not_there_is_an_error():
    with pytest.raises(ConfigError, match="no depth"):
        training_views(*photographed("colmap", [1, 1, 1]), None, with_depth=True)


def test_depth_of_a_view_is_thinned_like_its_picture():
    capture, points = photographed("colmap", [1, 1, 1])
    capture.depth = np.arange(3 * 40 * 48, dtype=np.float32).reshape(3, 40, 48)
    views = training_views(capture, points, None, with_depth=True)
    for factor in (1, 2, 3):
        target, _ = reduced(*views.photo(2), factor)
        assert views.depth(2, factor).shape == target.shape[:2]
    assert views.depth(2, 2)[1, 3] == capture.depth[2, 2, 6]
    assert training_views(capture, points, None).depth is None


def test_swept_depth_stands_for_blocks_of_pixels_of_its_view():
    capture, points = photographed("colmap", [1, 1, 1])
    capture.is_test[0] = True  # and so the first training view is the second of the points
    points.depths = np.arange(3 * 13 * 16, dtype=np.float32).reshape(3, 13, 16)
    depth = training_views(capture, points, None, with_depth=True).depth
    assert np.array_equal(depth(0, 3)[:13], points.depths[1])
    assert depth(0, 1).shape == (40, 48) and not depth(0, 1)[39].any()  # a line that no block holds
    assert depth(1, 1)[4, 5] == points.depths[2, 1, 1]
