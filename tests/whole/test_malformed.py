"""Malformed inputs end in a clear error: no traceback, the documented exit code, the file or
setting by name.
"""

import json
import shutil

import numpy as np
import pytest
from malformed import artifacts, commands, sources, teachers
from malformed.edits import cut, flipped, remove
from malformed.row import BYTES, called, fault_of, run_alone, stage, state_of
from PIL import Image
from source_folders import alone

from chebsplat.formats.capture import Capture
from chebsplat.stages import ingest
from chebsplat.stages.settings import IngestSection, SourceSection
from chebsplat.stages.sources import common

ROWS = [*commands.rows(), *artifacts.rows(), *sources.rows(), *teachers.rows()]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.id)
def test_a_malformed_input_is_a_clear_error(row, tmp_path, quick_plans):
    arguments = row.build(tmp_path)
    before = state_of(tmp_path)
    answer = run_alone(arguments, tmp_path) if row.alone else called(arguments)
    assert not fault_of(row, answer, state_of(tmp_path) != before), answer.stderr[-3000:]


def test_no_row_is_listed_twice():
    ids = [row.id for row in ROWS]
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize("of", artifacts.WRITERS)
def test_whatever_file_of_an_artifact_is_damaged_it_is_named(of, tmp_path):
    whole = artifacts.artifacts() / of
    assert called(["verify", whole]).code == 0
    for name, entry in json.loads((whole / "artifact.json").read_text())["files"].items():
        for damage in (remove(name), cut(name, 1), flipped(name))[: 3 if entry["bytes"] else 1]:
            path = artifacts.copied(of, tmp_path)
            damage(path)
            answer = called(["verify", path])
            assert (answer.code, str(path / name) in answer.stderr) == (3, True), (name, answer)
            shutil.rmtree(path)


@pytest.mark.parametrize("what", sources.WHOLE)
def test_a_source_is_whole_before_it_is_spoiled(tmp_path, what):
    write, layout, n_views = sources.WHOLE[what]
    folder = tmp_path / "shared/scene"
    folder.mkdir(parents=True)
    write(folder)
    assert common.detect(folder) == layout
    section = SourceSection(kind=layout, path=str(folder))
    if layout == "photos":
        assert len(alone(folder)["names"]) == n_views
        return
    assert len(ingest.read("scene", section, IngestSection(min_views=2))["names"]) == n_views


@pytest.mark.slow
def test_photos_of_64_megapixels_are_read_within_a_gibibyte(tmp_path):
    source = tmp_path / "photos"
    source.mkdir()
    Image.new("RGBA", (8000, 8000), (9, 9, 9, 255)).save(source / "0.png", compress_level=1)
    (source / "1.png").symlink_to(source / "0.png")
    frames = [{"file_path": f"{k}.png", "transform_matrix": np.eye(4).tolist()} for k in range(2)]
    (source / "transforms.json").write_text(json.dumps({"fl_x": 8000.0, "frames": frames}))
    config = {"source": {"kind": "transforms", "path": str(source)}, "ingest": {"min_views": 2}}
    answer = run_alone(stage("ingest", tmp_path, config), tmp_path, 120)
    assert answer.code == 0, answer.stderr
    assert answer.peak < BYTES
    notes = Capture.read(tmp_path / "out").source["notes"]
    assert "Images are reduced by 0.080 (ingest.max_side)." in notes
