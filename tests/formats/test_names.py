"""Labels in any language go through a scene's files; names that nothing could print or write are
refused.
"""

import numpy as np
import pytest
from shared import gaussian_parameters

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.names import check_names, suggest
from chebsplat.formats.ply import read_ply
from chebsplat.formats.scene import Scene
from chebsplat.stages.tools.camera_files import file_names
from chebsplat.stages.tools.extract import extract
from chebsplat.stages.tools.scene import OpenedScene

LABELS = ["café", "Tür", "沙发", "two\nlines", "🛋️", "back\\slash"]


@pytest.fixture
def scene(tmp_path):
    p = gaussian_parameters(len(LABELS))
    p["features"] = np.eye(len(LABELS), dtype=np.float32)
    cameras = Cameras(["a"], np.eye(3)[None], np.eye(4)[None], 5, 4)
    labels = np.arange(len(LABELS), dtype=np.int32)
    held = Scene(
        p, cameras, labels.astype(np.int64), labels, LABELS, p["features"], {"left_out": {}}
    )
    with artifact.publish(tmp_path / "scene", Manifest(Scene.SCHEMA, "0" * 16, "export")) as tmp:
        held.write(tmp)
    return tmp_path / "scene"


def test_labels_in_any_language_survive_export(scene):
    from plyfile import PlyData

    assert Scene.read(scene).label_names == LABELS
    assert "沙发" in (scene / "labels.json").read_text(encoding="utf-8")
    (file,) = scene.glob("*.ply")
    assert sorted(read_ply(file)[2]) == list(range(len(LABELS)))
    comments = [comment.split(" ", 2) for comment in PlyData.read(str(file)).comments]
    assert [int(index) for _, index, _ in comments] == list(range(len(LABELS)))
    names = [name.encode("ascii").decode("unicode_escape") for _, _, name in comments]
    assert names == LABELS


@pytest.mark.parametrize("label", LABELS)
def test_a_label_in_any_language_can_be_extracted(scene, tmp_path, label):
    extract(OpenedScene(Scene.read(scene), scene), tmp_path / "part.ply", (label,), 0.0, None)
    parameters, _, labels = read_ply(tmp_path / "part.ply")
    assert labels.tolist() == [LABELS.index(label)] and len(parameters["means"]) == 1


@pytest.mark.parametrize(
    "names", ["wall", [1], ["a", "a"], [""], [" "], ["a\0b"], ["\udc80"], ["x" * 201], ["\x1b[0m"]]
)
def test_names_that_could_not_be_used_are_refused(names):
    with pytest.raises(InputError, match="mine: labels"):
        check_names(names, "labels", "mine", "correct them")


def test_views_of_one_file_name_keep_their_pictures_apart():
    views = [
        "a/img.jpg",
        "b/img.jpg",
        "a-img.png",
        "A/IMG.jpg",
        "../x.jpg",
        "沙/é.jpg",
        "...",
        "view_000",
    ]
    found = file_names(views)
    assert len({name.lower() for name in found}) == len(views)
    assert not any("/" in name or name.startswith(".") for name in found)
    assert found[-1] == "view_000" and found[0] == "a-img"


def test_names_that_look_like_a_word_are_suggested_however_long_it_is():
    known = {"chair": 0, "armchair": 1, "table": 2}
    assert suggest("chiar", known, 1) == ["chair"]
    assert suggest("charr", known) == ["chair", "armchair"]
    assert suggest("x" * 10**7, known) == []
