"""What seconds were measured on is told of every process, and nothing of it is part of a key."""

import json
import os

import pytest
from shared import INPUTS, KEY, TOY, run_stage

from chebsplat.errors import Stopped
from chebsplat.formats import artifact
from chebsplat.formats.manifest import Manifest, measured_on
from chebsplat.formats.teacher_model import EMBEDDED
from chebsplat.stages.runtime import machine
from chebsplat.stages.runtime.command import publish
from chebsplat.stages.training import saves

MACHINE = {
    "processor": "A",
    "gpu": "",
    "cores": 8,
    "threads": 2,
    "load": [0.5, 2.0],
    "seconds": 100.0,
}


def test_a_manifest_says_on_what_its_seconds_were_measured_and_its_key_does_not(
    tmp_path, monkeypatch
):
    made = []
    for name in ("A", "B"):
        monkeypatch.setattr(machine, "processor", lambda name=name: name)
        publish("ingest", lambda job: (job.out / "a.txt").write_text("a"), tmp_path / name, {})
        made.append(artifact.read_manifest(tmp_path / name))
    assert made[0].key == made[1].key and made[0].files == made[1].files
    for name, manifest in zip("AB", made, strict=True):
        (process,) = manifest.processes
        assert (process["processor"], process["cores"]) == (name, len(os.sched_getaffinity(0)))
        assert (
            process["threads"] == manifest.threads and manifest.seconds == process["seconds"] >= 0
        )
        assert process["megabytes"] > 50  # Python and NumPy
        assert len(process["load"]) == 2 and min(process["load"]) >= 0
        assert measured_on(manifest).startswith(f"{name}, {manifest.threads} thread")
    assert made[0].versions.keys() >= {"numpy", "python"}


@pytest.mark.parametrize(
    ("processes", "words"),
    [
        ([], "a machine that was not recorded"),
        ([MACHINE], "A, 2 threads"),
        ([MACHINE, MACHINE | {"load": [9, 9]}], "A, 2 threads"),
        ([MACHINE, MACHINE | {"processor": "B", "threads": 1}], "A, 2 threads and B, 1 thread"),
        ([MACHINE | {"gpu": "H"}], "H, A, 2 threads"),
    ],
)
def test_machines_are_the_same_where_their_names_and_threads_are(processes, words):
    assert measured_on(Manifest("s/1", KEY, "train", processes=processes)) == words


@pytest.mark.parametrize("lines", [None, "CPU part\t: 0xd0c\n", "model name\t:\n"])
def test_a_processor_without_a_name_is_told_from_others_of_its_architecture(
    tmp_path, monkeypatch, lines
):
    monkeypatch.setattr(machine, "CPUS", tmp_path / "cpuinfo")
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_name", lambda: "neoverse-n1")
    if lines is not None:
        machine.CPUS.write_text(lines)
    assert machine.processor.__wrapped__() == "neoverse-n1"


def stopped_after(monkeypatch, cls, method, calls):
    """Let a stage be stopped as it calls a method for the `calls`-th time, after what that does."""
    original, count = getattr(cls, method), []

    def counted(self, *args, **kwargs):
        original(self, *args, **kwargs)
        count.append(1)
        if len(count) == calls:
            raise Stopped(15, "stopped")

    monkeypatch.setattr(cls, method, counted)


def test_what_is_begun_anew_counts_no_process_before_it(tmp_path, caplog):
    watch, scratch = machine.Stopwatch(), tmp_path / "scratch"
    watch.keep(scratch)
    assert len(machine.Stopwatch().processes()) == 1
    (scratch / machine.PROCESSES).write_text("{")
    watch.go_on(scratch)
    assert len(watch.processes()) == 1
    assert "seconds of what was done before are not counted" in caplog.text


@pytest.mark.xdist_group("toy")
@pytest.mark.parametrize(
    "stage", ["train", "teacher", pytest.param("teach", marks=pytest.mark.slow)]
)
def test_a_resumed_stage_has_the_seconds_of_all_its_processes(toy, tmp_path, monkeypatch, stage):
    inputs = {role: toy[of] for role, of in INPUTS[stage].items()}
    if stage == "teacher":
        inputs["channels"] = EMBEDDED.with_suffix(".channels")
    config, out = (
        TOY | {"teacher": {"kind": "auto"}} | artifact.read_manifest(toy["teach"]).config,
        tmp_path / stage,
    )
    monkeypatch.setattr(saves, "SECONDS", 0.0)
    with monkeypatch.context() as patched:
        stopped_after(patched,
                      *{"train": (saves.Saves, "offer", 5),
                        "teacher": (machine.Stopwatch, "keep", 2),
                                 "teach": (machine.Stopwatch, "keep", 1)}[stage])  # fmt: skip
        assert run_stage(stage, out, inputs, config) == Stopped(15, "").exit_code
    kept = tmp_path / f".part-{stage}" / machine.PROCESSES
    kept.write_text(json.dumps([MACHINE]))
    assert run_stage(stage, out, inputs, config) == 0
    manifest = artifact.read_manifest(out)
    assert manifest.processes[0] == MACHINE and len(manifest.processes) == 2
    assert manifest.seconds == pytest.approx(100 + manifest.processes[1]["seconds"], abs=2e-3)
