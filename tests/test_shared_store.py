"""Several people at one store: what one makes the other waits for, and takes."""

import os
import re
import shutil
import subprocess
import sys
from collections import Counter

import pytest
from shared import ROOT
from soak.tiny import artifacts, contents, hidden

STUDY = """
title = "Toys"
about = "Runs of the toy scene."
scenes = ["toy"]
seeds = [0]
baseline = "features-only"
budgets.steps = [12]

[settings]
sfm = {{ max_points = 200 }}
train = {{ n_densify = 1, report_every = 6, encoder = "off" }}
evaluate = {{ timing_repeats = 0 }}

[variants]
features-only = {{ ablation = "features-only" }}
{variants}
"""
FIRST = "full = {}\ndense = { train = { n_densify = 2 } }"
SECOND = 'dense = { train = { n_densify = 2 } }\nplain = { ablation = "plain" }'


@pytest.fixture
def another_checkout(tmp_path):
    """A copy of the code, as another user has it; what finds it before ours."""
    folder = tmp_path / "theirs"
    shutil.copytree(ROOT / "chebsplat", folder / "chebsplat", ignore=shutil.ignore_patterns("__pycache__"))
    for layer in ("formats", "stages", "pipelines", "teachers"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / layer, folder / "chebsplat" / layer, ignore=ignored)
    return {"PYTHONPATH": str(folder)}


@pytest.mark.slow
def test_overlapping_studies_of_two_checkouts_make_every_artifact_once(tmp_path, another_checkout):
    work, running = tmp_path / "work", []
    for name, variants, environment in (("ours", FIRST, {}), ("theirs", SECOND, another_checkout)):
        (tmp_path / f"{name}.toml").write_text(STUDY.format(variants=variants))
        command = [sys.executable, "-P", "-m", "chebsplat.pipelines.cli", "study", tmp_path / f"{name}.toml"]
        command += ["--cores", "2", "--threads", "1", "--out", tmp_path / name]
        environment = os.environ | {"CHEBSPLAT_WORK": str(work)} | environment
        running.append(subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True))
    said = [process.communicate()[1] for process in running]
    assert [process.returncode for process in running] == [0, 0], said
    told = Counter(re.findall(r"^\S+ (\w+): done in", "\n".join(said), re.MULTILINE))
    assert told == Counter(path.parent.name for path in artifacts(work))
    assert told["ingest"] == 1 and told["train"] == 4
    assert "another run is making it" in "".join(said)
    contents(work)
    assert not hidden(work)
