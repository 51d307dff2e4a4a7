"""A GPU computes where it answers, and torch's CUDA and gsplat are there; where one is missing, the
CPU says so.
"""

import json
import re
import sys
import types

import pytest
import torch
from click.testing import CliRunner
from shared import ROOT

from chebsplat.errors import ConfigError
from chebsplat.formats import artifact
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.pipelines.running.run import entry
from chebsplat.stages.runtime import device

LACKS = {
    "CUDA": "torch .* is built without CUDA .`make setup device=cuda` adds it.",
    "GPU": "no GPU answers .`nvidia-smi` says more",
    "gsplat": "gsplat cannot be imported: .* .`make setup device=cuda` adds it.",
}


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Makes this machine one with or without an NVIDIA driver, CUDA in torch, a GPU that answers,
    and gsplat.
    """

    def make(driver=True, lacks=""):
        if driver:
            (tmp_path / "version").write_text("NVRM version: 1")
        monkeypatch.setattr(device, "DRIVER", tmp_path / "version")
        monkeypatch.setattr(torch.version, "cuda", None if lacks == "CUDA" else "13.0")
        monkeypatch.setattr(torch.cuda, "is_available", lambda: lacks not in ("CUDA", "GPU"))
        monkeypatch.setitem(
            sys.modules, "gsplat", None if lacks == "gsplat" else types.SimpleNamespace()
        )

    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.chdir(ROOT)
    return make


@pytest.mark.parametrize("lacks", LACKS)
def test_what_is_missing_is_named_with_its_remedy(lacks, machine):
    machine(lacks=lacks)
    used, why = device.resolve("auto")
    assert used == "cpu" and "\n" not in why
    assert [name for name, words in LACKS.items() if re.search(words, why)] == [lacks]
    with pytest.raises(ConfigError, match=LACKS[lacks]):
        device.resolve("cuda")
    assert device.resolve("cpu") == ("cpu", "")


def test_a_machine_with_all_three_computes_on_its_gpu(machine):
    machine()
    assert device.resolve("auto") == device.resolve("cuda") == ("cuda", "")
    assert device.resolve("cpu") == ("cpu", "")


def test_a_machine_without_a_driver_is_not_asked_unless_cuda_is_asked_for(machine):
    machine(driver=False)
    assert device.resolve("auto") == ("cpu", "")
    assert device.resolve("cuda") == ("cuda", "")


def test_a_stage_runs_and_its_manifest_names_what_computed(machine, tmp_path):
    machine(lacks="gsplat")
    (tmp_path / "toy.json").write_text(
        json.dumps({"source": {"kind": "generated", "preset": "toy", "seed": 1}})
    )
    command = ["ingest", "--config", str(tmp_path / "toy.json"), "--out", str(tmp_path / "capture")]
    assert CliRunner().invoke(main, [*command, "--device", "cuda"]).exit_code == 2
    assert not (tmp_path / "capture").exists()
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0
    assert done.stderr.count("everything runs on the CPU") == 1
    assert artifact.read_manifest(tmp_path / "capture").device == "cpu"


def test_a_run_says_it_once_for_all_its_stages(machine):
    machine(lacks="CUDA")
    done = CliRunner().invoke(main, ["run", "--scene", "toy", "--stage", "ingest"])
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count("an NVIDIA driver was found, but") == 1
    path = Planner().plan("toy").targets["ingest"]
    assert artifact.read_manifest(path).device == "cpu"


def test_the_device_is_in_the_keys_of_what_it_computes_and_of_all_that_follows(quick_plans):
    on_cpu, on_gpu = (
        {step.stage: step for step in Planner(device=name).plan("toy").steps}
        for name in ("cpu", "cuda")
    )
    same = {stage for stage in on_cpu if on_cpu[stage].key == on_gpu[stage].key}
    assert same == {"ingest", "sfm", "teacher", "agree"}
    computing = {step.stage: entry(step, {}, "cuda")["device"] for step in on_gpu.values()}
    assert {stage for stage, used in computing.items() if used == "cuda"} == {"train", "evaluate"}
    seen = {step.stage: step for step in Planner(device="cuda").plan("office0").steps}
    # a model runs there; labels with noise do not
    assert entry(seen["teacher"], {}, "cuda")["device"] == "cuda"
