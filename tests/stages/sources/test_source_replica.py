"""Semantic-NeRF's rendering of Replica becomes a capture; rows of a trajectory belong to the frames
they count.
"""

import pytest
from layouts import write_semantic_nerf
from source_folders import SETTINGS, tiny

from chebsplat.stages.sources import common, replica


def test_semantic_nerf_layout_reads_and_joins_on_number(tmp_path):
    folder = tmp_path / "office_0"
    write_semantic_nerf(folder, tiny(11))
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
