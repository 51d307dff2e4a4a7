"""Structure from motion on real photos: triangulation keeps the given poses."""

import numpy as np
import pytest
from shared import data, run_stage

from chebsplat.cameras import centers
from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.points import Points

pytestmark = [pytest.mark.data, pytest.mark.xdist_group("sfm")]


def points_of(tmp_path, kind, folder, views, ingest=(), **sfm):
    config = {
        "sfm": sfm,
        "scene": {"name": "fox"},
        "source": {"kind": kind, "path": str(folder)},
        "ingest": {"max_side": 400, "max_views": views} | dict(ingest),
    }
    assert run_stage("ingest", tmp_path / kind, config=config) == 0
    assert run_stage("sfm", tmp_path / f"{kind}-points", {"capture": tmp_path / kind}, config) == 0
    return Points.read(tmp_path / f"{kind}-points")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("posed")


@pytest.fixture(scope="module")
def triangulated(folder):
    return points_of(folder, "transforms", data("fox"), 12)


def test_triangulation_keeps_poses_and_finds_points_that_reproject(triangulated, folder):
    capture = Capture.read(folder / "transforms")
    assert triangulated.names == capture.names and len(capture.names) == 12
    np.testing.assert_allclose(triangulated.cam_from_world, capture.cam_from_world, atol=1e-6)
    assert triangulated.notes["how"] == "triangulation"
    assert triangulated.notes["reprojection_error_px"] < 1
    assert len(triangulated.means) > 300
    point, view = triangulated.tracks.T
    pose, K = triangulated.cam_from_world[view], triangulated.Ks[view]
    camera = np.einsum("nij,nj->ni", pose[:, :3, :3], triangulated.means[point]) + pose[:, :3, 3]
    assert (camera[:, 2] > 0).all()
    image = np.einsum("nij,nj->ni", K, camera)
    image = image[:, :2] / image[:, 2:]
    assert ((image > -5) & (image < np.array(capture.size) + 5)).all()


def test_normals_face_a_camera_of_their_track_and_covariances_are_anisotropic(triangulated):
    spread = np.linalg.eigvalsh(triangulated.covariances)
    assert (spread > 0).all()
    assert np.median(spread[:, 2] / spread[:, 0]) > 4
    assert np.allclose(np.linalg.norm(triangulated.normals, axis=1), 1, atol=1e-4)
    point, view = triangulated.tracks.T
    sight = centers(triangulated.cam_from_world)[view] - triangulated.means[point]
    faces = (triangulated.normals[point] * sight).sum(1) > 0
    assert np.bincount(point, faces).min() >= 1


def test_poses_that_do_not_fit_make_no_lines_to_match_along(triangulated, tmp_path):
    turned = points_of(
        tmp_path, "transforms", data("fox"), 12, {"disturb_degrees": 1.0}, poses="given"
    )
    facts = artifact.read_manifest(tmp_path / "transforms-points").facts
    assert "n_matches_along_lines" not in facts
    assert facts["epipolar_px"] > 0.5
    assert len(turned.means) < len(triangulated.means)


def test_few_neighbours_by_pose_are_enough_and_counted(triangulated, tmp_path):
    found = points_of(tmp_path, "transforms", data("fox"), 12, n_matched=3)
    facts = artifact.read_manifest(tmp_path / "transforms-points").facts
    assert 18 <= facts["n_pairs"] <= 36 < 66
    assert facts["n_matches_along_lines"] > 1000
    assert facts["epipolar_px"] < 0.5
    assert len(found.means) > 0.6 * len(triangulated.means)
    assert found.notes["reprojection_error_px"] < 1


def test_points_and_tracks_of_a_colmap_model_are_taken_and_nothing_is_matched(tmp_path):
    found = points_of(tmp_path, "colmap", data("statue_colmap") / "dense/0", 23, dense="off")
    facts = artifact.read_manifest(tmp_path / "colmap-points").facts
    assert (
        facts["how"] == "source"
        and "feature matching" in facts["left_out"]
        and "n_pairs" not in facts
    )
    assert len(found.means) > 1000
    assert np.bincount(found.tracks[:, 0], minlength=len(found.means)).min() >= 1
    point, view = found.tracks.T
    pose = found.cam_from_world[view]
    camera = np.einsum("nij,nj->ni", pose[:, :3, :3], found.means[point]) + pose[:, :3, 3]
    assert (camera[:, 2] > 0).all()
