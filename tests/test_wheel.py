"""The wheel holds everything under one name."""

import shutil
import subprocess
import sys
import zipfile

from shared import ROOT


def test_a_wheel_mounts_every_layer_under_chebsplat(tmp_path):
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns(".*", "work", "build", "*.egg-info", "__pycache__", "tests")
    shutil.copytree(ROOT, source, ignore=ignored)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    names = zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist()
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
