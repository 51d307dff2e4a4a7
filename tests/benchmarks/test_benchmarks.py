"""`python -m benchmarks` lists what there is, and brings the scene that a benchmark measures on up
to date first.
"""

import ast
import csv
import re
import subprocess
import sys
from types import SimpleNamespace

import pytest
from shared import ROOT

import benchmarks.__main__ as bench
from chebsplat.stages.registry import STAGES


def test_every_benchmark_has_a_main_and_needs_stages_that_exist():
    for benchmark in bench.BENCHMARKS.values():
        file = ROOT / "benchmarks" / (benchmark.module.replace(".", "/") + ".py")
        functions = {
            node.name: node
            for node in ast.parse(file.read_text()).body
            if isinstance(node, ast.FunctionDef)
        }
        assert [a.arg for a in functions["main"].args.args] == ["arguments"], file
        assert set(benchmark.stages) <= set(STAGES)


def test_without_a_name_they_are_listed_and_a_wrong_one_is_refused(capsys):
    assert bench.main([]) == 0
    listed = capsys.readouterr().out
    assert all(f"{name} " in listed for name in bench.BENCHMARKS)
    assert bench.main(["rasterr"]) == 2
    assert "raster" in capsys.readouterr().err


@pytest.fixture
def ran(monkeypatch):
    """Stages that were run, and the arguments that the benchmark got."""
    calls = {"stages": [], "arguments": None}

    def stage(command, check):
        assert "chebsplat.pipelines.cli" in command
        assert check
        calls["stages"].append(command[command.index("--stage") + 1])

    monkeypatch.setattr(bench.subprocess, "run", stage)
    main = SimpleNamespace(main=lambda arguments: calls.update(arguments=arguments))
    monkeypatch.setattr(bench, "import_module", lambda name: main)
    return calls


def test_what_a_benchmark_needs_is_made_first(ran, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", "elsewhere")
    assert bench.main(["lift", "--rounds", "3"]) == 0
    assert ran == {
        "stages": ["train", "teacher"],
        "arguments": ["--work", "elsewhere/office0@train.features=lifted", "--rounds", "3"],
    }


@pytest.mark.parametrize("arguments", [["--work", "there"], ["--work=there"], ["--help"]])
def test_nothing_is_made_for_a_scene_of_the_user_s_or_for_help(ran, arguments):
    assert bench.main(["lift", *arguments]) == 0
    assert ran == {"stages": [], "arguments": arguments}


def test_a_stage_that_fails_ends_the_benchmark_with_its_exit_code(ran, monkeypatch):
    def fails(command, check):
        raise subprocess.CalledProcessError(3, command)

    monkeypatch.setattr(bench.subprocess, "run", fails)
    assert bench.main(["cost"]) == 3
    assert ran["arguments"] is None


@pytest.mark.parametrize("words", [["bench=cost"], ["bench-cost"]])
def test_make_runs_one_by_name(words):
    done = subprocess.run(
        ["make", "-n", "--no-print-directory", *words, "args=--steps 9"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert re.search(r'-m benchmarks "\$(bench|named)" --steps 9$', done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:CUDA is not available, disabling CUDA profiling")
def test_what_awaits_a_gpu_runs_to_its_end_where_the_cpu_stands_in(
    up_to_teacher, tmp_path, monkeypatch
):
    import torch

    from benchmarks.training import gpu
    from chebsplat.rasterize import rasterize

    def rasterization(means, quats, scales, opacities, colors, *camera, packed, sh_degree=None):
        return rasterize(
            means, quats, scales, opacities, colors if sh_degree is None else colors[:, 0], *camera
        )

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    for name, answer in (("get_device_name", "none"), ("max_memory_allocated", 0)):
        monkeypatch.setattr(torch.cuda, name, lambda answer=answer: answer)
    for name in ("synchronize", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, name, lambda: None)
    monkeypatch.setattr(gpu, "resolve", lambda device: None)
    monkeypatch.setattr(gpu, "launches_of_gsplat", lambda trainer: 0)
    monkeypatch.setattr("chebsplat.stages.runtime.command._versions", dict)
    runs = {name: (ablation, 20, "cpu") for name, (ablation, _, _) in gpu.RUNS.items()}
    for name, value in {"DEVICE": "cpu", "SIZES": (500,), "STEPS": 60, "RUNS": runs}.items():
        monkeypatch.setattr(gpu, name, value)
    found = gpu.main(["--work", str(up_to_teacher), "--out", str(tmp_path)])
    assert found in (0, 1)  # by frames a second, which a busy machine decides
    rows = list(csv.DictReader((tmp_path / "gpu.csv").read_text().splitlines()))
    assert len(rows) == len(runs) + 2 + 3 + 1
    assert rows[0]["psnr"] == rows[2]["psnr"] and rows[0]["miou"] and not rows[3]["miou"]
    assert rows[-1]["same_bytes"] == "True"
