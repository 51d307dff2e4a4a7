"""What the corpus spoils is whole before it is spoiled; large photos are read within the bound of a malformed one."""

import json

import pytest
from malformed import case, colmap, images, photos, scannet, seven_scenes
from malformed.case import BYTES, Case
from PIL import Image
from source_folders import write_colmap, write_nice_slam, write_semantic_nerf, write_transforms

from chebsplat.stages import ingest
from chebsplat.stages.settings import IngestSection, SourceSection
from chebsplat.stages.sources import common

WHOLE = {
    "photos": (photos.write, 3),
    "companions": (images.write, 3),
    "COLMAP, binary": (colmap.write, 3),
    "COLMAP, text": (write_colmap, 3),
    "transforms": (write_transforms, 3),
    "NICE-SLAM": (write_nice_slam, 3),
    "Semantic-NeRF": (write_semantic_nerf, 11),
    "ScanNet (SG)": (scannet.write_sg, 4),
    "ScanNet (PL)": (scannet.write_pl, 4),
    "7-Scenes": (seven_scenes.write, 3),
}


@pytest.mark.parametrize("what", WHOLE)
def test_a_source_is_whole_before_it_is_spoiled(tmp_path, what):
    write, n_views = WHOLE[what]
    folder = tmp_path / "shared/scene"
    folder.mkdir(parents=True)
    write(folder)
    source = SourceSection(kind=common.detect(folder), path=str(folder))
    assert len(ingest.read("scene", source, IngestSection(min_views=2))["names"]) == n_views


@pytest.mark.slow
def test_photos_of_64_megapixels_are_read_within_a_gibibyte(tmp_path, monkeypatch):
    monkeypatch.setattr(case, "SECONDS", 120.0)

    def build(folder):
        source = folder / "photos"
        source.mkdir()
        Image.new("RGBA", (8000, 8000), (9, 9, 9, 255)).save(source / "0.png", compress_level=1)
        (source / "1.png").symlink_to(source / "0.png")
        return case.ingest(folder, source, "0.png")

    outcome = case.run(Case("photos", "large", build), tmp_path)
    assert outcome.code == 0, outcome.stderr
    assert outcome.peak < BYTES
    notes = json.loads((tmp_path / "out/capture.json").read_text())["source"]["notes"]
    assert "Images are reduced by 0.080 (ingest.max_side)." in notes
