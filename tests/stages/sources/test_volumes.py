"""Volumes of a file label what the depth of a capture shows in them."""

import json

import numpy as np
import pytest
from shared import ROOT, TOY, data, run_stage

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.capture import Capture
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import seven_scenes, volumes
from tests.stages.sources.test_sources import agreement

SQUARE = [[-9, -9], [9, -9], [9, 9], [-9, 9]]
WHOLE = {
    "frame": np.eye(4)[:3].tolist(),
    "margin": 0.02,
    "volumes": [{"name": "floor", "polygon": SQUARE, "height": [-1, 0.01]},
                {"name": "void", "polygon": SQUARE, "height": [0.01, 1]},
                {"name": "high", "polygon": SQUARE, "height": [1, 9]}],
}  # fmt: skip


def written(folder, **changed):
    path = folder / "volumes.json"
    path.write_text(json.dumps(WHOLE | changed))
    return path


def test_a_generated_room_s_floor_is_found_by_its_depth(tmp_path):
    config = TOY | {"ingest": {"volumes": str(written(tmp_path))}}
    assert (
        run_stage("ingest", tmp_path / "exact", {}, TOY)
        == run_stage("ingest", tmp_path / "out", {}, config)
        == 0
    )
    exact, found = (Capture.read(tmp_path / name) for name in ("exact", "out"))
    assert found.class_names == ["floor", "high"]
    truth, labels = np.asarray(exact.labels[:]), np.asarray(found.labels[:])
    floor = truth == exact.class_names.index("floor")
    assert floor.mean() > 0.05
    assert (labels[floor] == 0).all()
    assert ((labels == 0) & ~floor).mean() < 0.02  # feet of furniture, within the margin
    assert (labels == -1).any()
    assert (labels == 1).any()


VOLUME = WHOLE["volumes"][0]


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"frame": np.eye(3).tolist()}, "its frame and margin"),
        ({"margin": "2 cm"}, "its frame and margin"),
        ({"volumes": [VOLUME, {"name": "x", "height": [0, 1]}]}, r"volume 1: 'polygon'"),
        ({"volumes": [VOLUME | {"height": [1, 0]}]}, "volume 0: holds no volume"),
        ({"volumes": [VOLUME | {"height": 1}]}, "volume 0"),
        ({"volumes": [VOLUME | {"polygon": [*SQUARE, [1, 1]]}]}, "volume 0: is not convex"),
    ],
)  # fmt: skip
def test_a_file_that_describes_no_volumes_is_named_with_the_place(tmp_path, changed, word):
    path = written(tmp_path, **changed)
    with pytest.raises(InputError, match=f"{path}: {word}"):
        volumes.read(path)


def test_volumes_need_depth_with_poses(tmp_path):
    with pytest.raises(ConfigError, match=r"ingest\.volumes"):
        volumes.give({"depth": None, "cam_from_world": np.eye(4)[None]}, written(tmp_path))


def test_what_a_file_of_volumes_says_makes_labels_anew_and_where_it_lies_does_not(tmp_path):
    def key(path):
        return Planner().plan("toy", f"ingest.volumes={path}").targets["ingest"].name

    (tmp_path / "other").mkdir()
    assert (
        key(written(tmp_path))
        == key(written(tmp_path / "other"))
        != key(written(tmp_path, margin=0.03))
    )


@pytest.mark.data
def test_the_red_kitchen_s_volumes_agree_between_its_frames():
    fields = seven_scenes.read(data("redkitchen"), IngestSection(max_side=320, max_views=12))
    known = np.isfinite(fields["depth"])
    volumes.give(fields, ROOT / "tests/photographs/redkitchen.json")
    assert (fields["labels"] >= 0)[known].mean() > 0.98
    assert np.unique(fields["labels"]).tolist() == list(range(-1, len(fields["class_names"])))
    assert len(fields["class_names"]) >= 20
    fields["depth"][fields["labels"] < 0] = np.nan  # of no label there is nothing to agree on
    shares = np.array([agreement(fields, a, b) for a in range(12) for b in range(12) if a != b])
    seen, same = shares[shares[:, 0] > 0.02].T
    assert len(seen) > 40
    assert np.average(same, weights=seen) > 0.97
