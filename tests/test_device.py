"""On a machine with an NVIDIA driver everything runs on the CPU, says so once, and is recorded so."""

import json

import pytest
from click.testing import CliRunner
from shared import ROOT

from chebsplat.errors import ConfigError
from chebsplat.formats import artifact
from chebsplat.pipelines.cli import main
from chebsplat.pipelines.plan import Planner
from chebsplat.stages import device

SAID = "an NVIDIA driver was found, but this version does not train on a GPU yet: everything runs on the CPU"


@pytest.fixture(params=[True, False], ids=["driver", "no driver"])
def driver(request, tmp_path, monkeypatch):
    """Whether the machine that is simulated has one."""
    if request.param:
        (tmp_path / "version").write_text("NVRM version: 1")
    monkeypatch.setattr(device, "DRIVER", tmp_path / "version")
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.chdir(ROOT)
    return request.param


def test_auto_is_the_cpu_and_says_why_where_a_gpu_might_be_expected(driver, tmp_path):
    assert device.resolve("auto") == ("cpu", SAID if driver else "")
    assert device.resolve("cpu") == ("cpu", "")
    with pytest.raises(ConfigError, match="an NVIDIA driver was found, but" if driver else "no NVIDIA driver"):
        device.resolve("cuda")
    assert device.resolve("auto", tmp_path / "nowhere") == ("cpu", "")


def test_a_stage_runs_and_its_manifest_names_what_computed(driver, tmp_path, capfd):
    (tmp_path / "toy.json").write_text(json.dumps({"source": {"kind": "generated", "preset": "toy", "seed": 1}}))
    command = ["ingest", "--config", str(tmp_path / "toy.json"), "--out", str(tmp_path / "capture")]
    assert CliRunner().invoke(main, [*command, "--device", "cuda"]).exit_code == 2
    assert not (tmp_path / "capture").exists()
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0
    assert done.stderr.count(SAID) == int(driver)
    assert artifact.read_manifest(tmp_path / "capture").device == "cpu"


@pytest.mark.parametrize("driver", [True], indirect=True)
def test_a_run_says_it_once_for_all_its_stages(driver):
    key = Planner().plan("toy").steps[0].key
    refused = CliRunner().invoke(main, ["run", "--scene", "toy", "--stage", "ingest", "--device", "cuda"])
    assert refused.exit_code == 2
    assert "--device cuda" in refused.stderr
    done = CliRunner().invoke(main, ["run", "--scene", "toy", "--stage", "ingest"])
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count(SAID) == 1
    path = Planner().plan("toy").targets["ingest"]
    assert path.name == key
    assert artifact.read_manifest(path).device == "cpu"
