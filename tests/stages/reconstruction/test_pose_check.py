"""Given poses are tested by the matches of photos: exact ones are kept, wrong ones are found
out.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chebsplat.cameras import centers
from chebsplat.photos.guided import fundamental, sampson_distance
from chebsplat.stages.reconstruction import pose_check
from chebsplat.stages.settings import SfmSection

# synthetic is a fixture
from tests.stages.reconstruction.test_adjustment import poses_of, synthetic  # noqa: F401

K = np.array([[900.0, 0, 512], [0, 900, 384], [0, 0, 1]])


@pytest.fixture
def matched(synthetic, monkeypatch):  # noqa: F811
    """As `synthetic`, its views called as the check calls them."""
    monkeypatch.setattr(pose_check, "file_of", lambda view: synthetic[2][view])
    return synthetic


def capture_of(poses, **more):
    """What the check reads of a capture with these poses; images are left to the database."""
    fields = {
        "source": {"kind": "transforms"},
        "tracks": None,
        "Ks": np.tile(K, (len(poses), 1, 1)),
    } | more
    return SimpleNamespace(cam_from_world=poses, **fields)


def test_sampson_distance_is_the_distance_to_the_epipolar_line_where_one_view_is_noisy():
    rng = np.random.default_rng(0)
    poses = poses_of(
        Rotation.from_rotvec([[0, 0, 0], [0, 0.1, 0]]).as_matrix(),
        np.array([[0.0, 0, 0], [1, 0.2, 0]]),
    )
    points = rng.uniform([-1, -1, 3], [1, 1, 6], (50, 3))
    at = [((points @ pose[:3, :3].T + pose[:3, 3]) @ K.T) for pose in poses]
    first, second = (pixel[:, :2] / pixel[:, 2:] for pixel in at)
    F = fundamental(K, poses[0], K, poses[1])
    np.testing.assert_allclose(sampson_distance(F, first, second), 0, atol=1e-9)
    lines = np.column_stack([first, np.ones(50)]) @ F.T
    away = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    # the least motion of both views, about 2 / sqrt(2)
    both = sampson_distance(F, first, second + 2 * away)
    np.testing.assert_allclose(both, np.sqrt(2), rtol=0.1)


def test_two_views_from_one_place_have_no_epipolar_lines():
    poses = poses_of(Rotation.from_rotvec([[0, 0, 0], [0, 0.1, 0]]).as_matrix(), np.zeros((2, 3)))
    F = fundamental(K, poses[0], K, poses[1])
    assert np.isnan(sampson_distance(F, np.ones((3, 2)), np.ones((3, 2)))).all()


@pytest.mark.parametrize(
    ("degrees", "wrong"), [(0.0, False), (0.02, False), (0.5, True), (2.0, True)]
)
def test_wrong_poses_are_told_from_exact_ones(matched, degrees, wrong):
    job, database, _, truth = matched
    turns = np.random.default_rng(0).normal(size=(len(truth), 3))
    turns *= np.radians(degrees) / np.linalg.norm(turns, axis=1, keepdims=True)
    turned = poses_of(Rotation.from_rotvec(turns).as_matrix() @ truth[:, :3, :3], centers(truth))
    assert pose_check.wants_adjustment(job, capture_of(turned), SfmSection(), database) == wrong
    assert (job.facts["epipolar_px"] > pose_check.MISFIT) == wrong


def test_too_few_pairs_tell_nothing_and_poses_stay(matched, monkeypatch, caplog):
    job, database, _, truth = matched
    monkeypatch.setattr(pose_check, "SHARED", 10_000)
    turned = truth[::-1].copy()
    with caplog.at_level("INFO"):
        assert not pose_check.wants_adjustment(job, capture_of(turned), SfmSection(), database)
    assert "too few to tell" in caplog.text


def test_what_is_asked_for_is_done_untested():
    poses = np.tile(np.eye(4), (3, 1, 1))
    for wanted, adjusted in (("given", False), ("adjusted", True)):
        assert (
            pose_check.wants_adjustment(None, capture_of(poses), SfmSection(poses=wanted))
            == adjusted
        )


@pytest.mark.parametrize(
    "kept",
    [
        {"source": {"kind": "generated"}},
        {"source": {"kind": "colmap"}, "tracks": np.zeros((5, 2), np.int32)},
    ],
)
def test_poses_that_are_exact_or_made_from_the_photos_are_kept_untested(kept):
    assert not pose_check.wants_adjustment(
        None, capture_of(np.tile(np.eye(4), (3, 1, 1)), **kept), SfmSection()
    )


def test_views_that_face_away_from_each_other_tell_nothing():
    poses = poses_of(Rotation.from_rotvec([[0, 0, 0], [0, 2, 0], [0, 4, 0]]).as_matrix(), np.eye(3))
    job = SimpleNamespace(facts={})
    assert not pose_check.wants_adjustment(job, capture_of(poses), SfmSection())
    assert job.facts["epipolar_px"] == 0
