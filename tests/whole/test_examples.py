"""The examples run as they stand: the scripts, and the notebook cell by cell, without Jupyter."""

import json
import os
import runpy
import subprocess
import sys

import numpy as np
import pytest
from shared import ROOT

from chebsplat.formats.ply import read_ply

EXAMPLES = ROOT / "examples"


def test_asking_and_taking_writes_what_is_selected(toy, tmp_path, capsys):
    import chebsplat

    folder = str(toy["export"].parent)
    scene = chebsplat.load(folder)
    word = scene.label_names[0]
    main = runpy.run_path(str(EXAMPLES / "ask_and_take.py"))["main"]
    main(folder, word, str(tmp_path / "part.ply"))
    parameters, _, _ = read_ply(tmp_path / "part.ply")
    assert len(parameters["means"]) == scene.ask(word).selected.sum() > 0
    assert "Gaussians" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["spz", "sog", "glb"])
def test_classes_of_an_exported_file_are_counted_without_us(toy, tmp_path, kind):
    import chebsplat

    scene = chebsplat.load(toy["export"])
    out = scene.export(tmp_path / f"toy.{kind}")
    command = [sys.executable, EXAMPLES / "count_labels.py", out]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    found = [line.rsplit(maxsplit=1) for line in shown.stdout.splitlines()]
    counts = np.bincount(scene.labels + 1, minlength=len(scene.label_names) + 1)
    assert found == [[n, str(c)] for n, c in zip(["none", *scene.label_names], counts, strict=True)]
    assert (counts > 0).sum() > 2


def test_the_notebook_runs_cell_by_cell(toy, monkeypatch, capsys):
    import matplotlib

    monkeypatch.setenv("CHEBSPLAT_EXAMPLE", str(toy["export"].parent))
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    notebook = json.loads((EXAMPLES / "look_around.ipynb").read_text())
    # kept without, so that none is stale
    assert not any(cell.get("outputs") for cell in notebook["cells"])
    names: dict = {}
    for number, cell in enumerate(
        cell for cell in notebook["cells"] if cell["cell_type"] == "code"
    ):
        exec(compile("".join(cell["source"]), f"look_around.ipynb, cell {number}", "exec"), names)
    assert names["answer"].selected.sum() > 0
    assert len(plt.get_fignums()) == 2
    plt.close("all")


@pytest.mark.slow
def test_photos_become_a_picture(tmp_path):
    command = [sys.executable, EXAMPLES / "photos_to_picture.py", "toy", tmp_path / "toy.png", "30"]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env=os.environ | {"CHEBSPLAT_WORK": str(tmp_path / "work")},
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr.decode()
    assert (tmp_path / "toy.png").stat().st_size > 1000
