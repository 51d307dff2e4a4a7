"""The wheel holds everything under one name."""

import os
import shutil
import subprocess
import sys
import zipfile

import pytest
from shared import ROOT


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("wheel")
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns(".*", "work", "build", "*.egg-info", "__pycache__", "tests")
    shutil.copytree(ROOT, source, ignore=ignored)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(tmp_path.glob("*.whl"))


def test_a_wheel_mounts_every_layer_under_chebsplat(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"chebsplat"}
    for wanted in (
        "chebsplat/shape/descriptor.py",
        "chebsplat/evaluation/protocols/labels.py",
        "chebsplat/synthetic/layout.py",
        "chebsplat/formats/artifact.py",
        "chebsplat/stages/train.py",
        "chebsplat/stages/sources/colmap.py",
        "chebsplat/stages/pages/report.html",
        "chebsplat/stages/pages/style.css",
        "chebsplat/stages/pages/viewer.js",
        "chebsplat/stages/pages/scene/page.html",
        "chebsplat/stages/pages/scene/splats.js",
        "chebsplat/teachers/embedded.onnx",
        "chebsplat/teachers/embedded.toml",
        "chebsplat/teachers/embedded.npz",
        "chebsplat/teachers/words.toml",
        "chebsplat/teachers/quality.json",
        "chebsplat/teachers/training.csv",
        "chebsplat/pipelines/Snakefile",
        "chebsplat/pipelines/studies/page.html",
        "chebsplat/pipelines/cli/__main__.py",
        "chebsplat/pipelines/profiles/default/config.yaml",
        "chebsplat/pipelines/configs/scenes/office0.toml",
        "chebsplat/teachers/embedded.npz",
        "chebsplat/teachers/labels/ade20k.txt",
    ):
        assert wanted in names
    assert not any("test" in name for name in names)


USE = """
import sys, chebsplat
assert chebsplat.__file__.startswith(sys.argv[1]), chebsplat.__file__
scene = chebsplat.load(sys.argv[2])
shown = scene.render(scene.cameras[0])
assert shown.color.std() > 0 and shown.labels.shape == shown.depth.shape
print(scene.query(scene.label_names[0], against=scene.label_names[1:]).shape == (len(scene),))
"""


@pytest.mark.slow
@pytest.mark.xdist_group("toy")
def test_an_installed_wheel_opens_renders_and_asks_a_scene_from_another_folder(wheel, toy, tmp_path):
    """All but the wheel itself comes from where the tests run: its dependencies take gigabytes."""
    place, folder = tmp_path / "site", tmp_path / "scene"
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--target", str(place), str(wheel)]
    subprocess.run(command, check=True, capture_output=True)
    folder.mkdir()
    for stage in ("export", "teacher"):
        (folder / stage).symlink_to(toy[stage])
    environment = os.environ | {"PYTHONPATH": str(place)}
    command = [sys.executable, "-P", "-c", USE, str(place), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "True"
