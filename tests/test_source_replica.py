"""Both renderings of Replica become the same capture; rows of a trajectory belong to the frames they count."""

import shutil

import numpy as np
import pytest
from source_folders import ROW, SETTINGS, write_nice_slam, write_semantic_nerf

from chebsplat.errors import InputError
from chebsplat.stages.sources import common, replica


def test_nice_slam_layout_reads(tmp_path):
    folder = write_nice_slam(tmp_path / "office0")
    assert common.detect(folder) == "replica"
    assert replica.probe(folder) == {"poses": True, "depth": True, "labels": False}
    assert len(replica.files(folder)) == 6 + 2
    fields = replica.read(folder, SETTINGS)
    assert fields["names"] == ["frame000000", "frame000001", "frame000002"]
    assert np.allclose(fields["depth"], 2.0)
    assert fields["Ks"][0][0, 2] == 4.0
    assert fields["cam_from_world"][2][0, 3] == -2
    assert "labels" not in fields


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ROW.format(0) * 2, "2 poses for 3 images"),
        ("", "0 poses for 3 images"),
        (ROW.format(0) * 2 + "1 2 3\n", "row 3"),
        (ROW.format("x") + ROW.format(0) * 2, "row 1"),
        (ROW.format(0) + ROW.format(0).replace("1", "3", 1) + ROW.format(0), "frame000001 is not a rotation"),
    ],
)
def test_a_bad_trajectory_is_named(tmp_path, text, message):
    folder = write_nice_slam(tmp_path / "office0")
    (folder / "traj.txt").write_text(text)
    with pytest.raises(InputError, match=rf"traj\.txt.*{message}"):
        replica.read(folder, SETTINGS)


@pytest.mark.parametrize("changes", [{"w": "x"}, {"scale": 0}, {"fx": None}, {"fx": -1}])
def test_bad_replica_parameters_are_named(tmp_path, changes):
    with pytest.raises(InputError, match=r"cam_params\.json"):
        replica.read(write_nice_slam(tmp_path / "office0", **changes), SETTINGS)


@pytest.mark.parametrize("lost", ["results/depth000001.png", "results/frame000001.jpg", "traj.txt", "results"])
def test_a_lost_part_of_replica_is_named(tmp_path, lost):
    folder = write_nice_slam(tmp_path / "office0")
    shutil.rmtree(folder / lost) if lost == "results" else (folder / lost).unlink()
    with pytest.raises(InputError, match=str(folder)):
        replica.read(folder, SETTINGS)


def test_a_missing_frame_cannot_shift_the_poses_of_the_others(tmp_path):
    folder = write_nice_slam(tmp_path / "office0", 4)
    (folder / "results/frame000001.jpg").unlink()
    (folder / "traj.txt").write_text(ROW.format(0) * 3)
    with pytest.raises(InputError, match="image 1 is missing"):
        replica.read(folder, SETTINGS)


def test_semantic_nerf_layout_reads_and_joins_on_number(tmp_path):
    folder = write_semantic_nerf(tmp_path / "office_0")
    assert common.detect(folder) == "replica"
    assert replica.probe(folder) == {"poses": True, "depth": True, "labels": True}
    fields = replica.read(folder, SETTINGS)
    assert fields["names"][9:] == ["rgb_9", "rgb_10"]
    assert fields["images"][10, 0, 0, 0] == 10
    assert fields["depth"][10, 0, 0] == pytest.approx(1.010)
    assert fields["cam_from_world"][10][0, 3] == -10
    assert fields["class_names"] == ["wall", "floor"]
    assert fields["labels"][:3, 0, 0].tolist() == [-1, 0, 1]
    assert fields["Ks"][0][0, 2] == 4.0
    (folder / "info_semantic.json").unlink()
    assert replica.read(folder, SETTINGS)["class_names"] == ["class_1", "class_2"]
