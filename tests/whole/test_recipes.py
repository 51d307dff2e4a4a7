"""The recipes of docs/architecture.md work as they stand there, and make no scene anew."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from shared import ROOT

from chebsplat.formats import artifact
from chebsplat.formats.capture import Capture
from chebsplat.formats.files import parse_json
from chebsplat.pipelines.planning.code import PACKAGE
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.work import store
from chebsplat.stages.registry import STAGES, Stage

pytestmark = pytest.mark.usefixtures("own_work")
BLOCK = re.compile(r"^```python\n# (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
STEP = re.compile(r"^  (?:would run|fresh) +(\w+) +([0-9a-f]{16})", re.MULTILINE)


@pytest.fixture
def extended(tmp_path):
    """A function that runs a command of a copy of the package to which the recipes were applied."""
    copy = tmp_path / "site-packages/chebsplat"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for name, text in BLOCK.findall((ROOT / "docs/architecture.md").read_text()):
        path = copy / name.removeprefix("chebsplat/")
        if path.exists():  # a row
            before, last, after = path.read_text().partition('        Stage("report"')
            text = f"{before}{text.rstrip()},\n{last}{after}"
        path.write_text(text)

    def run(*words):
        return subprocess.run(
            [sys.executable, "-m", "chebsplat.pipelines.cli", *words],
            env=os.environ | {"PYTHONPATH": str(copy.parent)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )

    return run


def keys(done):
    assert done.returncode == 0, done.stderr
    return dict(STEP.findall(done.stdout))


def test_a_stage_and_a_protocol_are_added_as_the_architecture_says(extended):
    known = {
        scene: {step.stage: step.key for step in Planner().plan(scene).steps}
        for scene in ("toy", "office0")
    }
    planned = {scene: keys(extended("plan", "--scene", scene)) for scene in known}
    assert {scene: found.pop("brightness") for scene, found in planned.items()}
    assert planned == known

    ours = ("--scene", "toy", "--set", "ingest.protocol=every-fourth")
    others = keys(extended("plan", *ours))
    assert not {stage for stage in known["toy"] if others[stage] == known["toy"][stage]}

    done = extended("run", *ours, "--stage", "brightness", "--cores", "1")
    assert done.returncode == 0, done.stderr
    made = {stage: store.artifact_path(stage, others[stage]) for stage in ("ingest", "brightness")}
    capture = Capture.read(made["ingest"])
    assert (capture.protocol["name"], capture.protocol["test_every"]) == ("every-fourth", 4)
    manifest = artifact.verify(made["brightness"], "chebsplat.brightness/1")
    means = parse_json(made["brightness"] / "brightness.json", "make it again")
    assert list(means) == capture.names and 0 < manifest.facts["mean"] < 255
    assert manifest.facts["mean"] == pytest.approx(capture.images[:].mean())


def test_a_stage_whose_input_a_scene_leaves_out_is_left_out(monkeypatch):
    monkeypatch.setitem(STAGES, "more", Stage("more", "more/1", (), (("features", "teacher"),)))
    assert "more" in Planner().plan("toy").targets
    plan = Planner().plan("toy", "teacher.kind=none")
    assert "more" not in plan.targets and plan.left_out["more"] == "teacher is left out"
