"""Runs on a cluster: resources of jobs, steps grouped into jobs, and jobs ended with their run.

Snakemake submits a job, and on its node starts one step after the other, each in a process of its
own as on one machine. The pipe that ends jobs with their run (processes.py) does not reach another
machine: there, a thread watches the run's lease on the shared store.
"""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml

from chebsplat.errors import ConfigError
from chebsplat.formats.extras import require
from chebsplat.pipelines.work import leases, store
from chebsplat.pipelines.work.store import say
from chebsplat.settings import MOST_STEPS
from chebsplat.stages.registry import MODEL_FREE, STAGES
from chebsplat.stages.runtime.stopping import end_itself

HERE = Path(__file__).parents[1]
LOCAL, SLURM = "local", "slurm"
PLUGIN = "snakemake_executor_plugin_slurm"
BESIDE = {  # a step joins the job that makes the first of these inputs
    "describe": ("points", "capture"),
    "encode": ("descriptors",),
    "learn": ("features", "encoding"),
    "onnx": ("knowledge", "descriptors"),
    "agree": ("features",),
    "evaluate": ("scene",),
}
STEP_SECONDS = 0.08  # upper bound of a training step
SHORT = 60.0  # seconds up to which a training is not a job of its own


def profile(on: str) -> Path:
    """The folder of Snakemake's settings for a run's destination: one of ours, or the user's.

    Raises: ConfigError where there is none.
    """
    folder = HERE / "profiles" / ("default" if on == LOCAL else on)
    if on in (LOCAL, SLURM):
        return folder
    folder = Path(on).expanduser().absolute()
    if "/" not in on or not (folder / "config.yaml").is_file():
        raise ConfigError(
            f"on={on}: local, slurm, or a folder (with a /) that holds a profile's "
            "config.yaml is needed"
        )
    return folder


def checked(on: str) -> str:
    """`on`, if it is usable here. Raises ConfigError naming what is missing and its remedy."""
    if on == LOCAL:
        return on
    executor = executor_of(on)
    if executor == SLURM:
        require(PLUGIN, f"on={on}")
    elif find_spec(f"snakemake_executor_plugin_{executor.replace('-', '_')}") is None:
        raise ConfigError(
            f"on={on}: Snakemake's plugin for {executor} is not installed; "
            f"install snakemake-executor-plugin-{executor}"
        )
    if executor == SLURM and shutil.which("sbatch") is None:
        raise ConfigError(
            f"on={on}: there is no sbatch on the PATH; run this where jobs are submitted from"
        )
    return on


def executor_of(on: str) -> str:
    """The Snakemake plugin that submits jobs. Raises ConfigError where a profile names none."""
    file = profile(on) / "config.yaml"
    try:
        settings = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        raise ConfigError(f"{file} cannot be read as YAML; correct it") from None
    executor = settings.get("executor") if isinstance(settings, dict) else None
    if not isinstance(executor, str):
        raise ConfigError(f"{file} names no executor; add the line `executor: slurm`")
    return executor


def arguments(plan: Path, on: str, cores: int, threads: int | None) -> list[str]:
    """Snakemake's options beside its profile; cores // threads jobs at once, if threads are set."""
    options = ["--jobs", str(max(cores // threads, 1))] if threads else []
    if executor_of(on) == SLURM:
        options += [
            "--slurm-jobname-prefix",
            job_prefix(plan),
            "--slurm-logdir",
            str(plan.parent / "slurm"),
        ]
    return options


def jobs_of(entries: list[dict[str, Any]], on: str) -> dict[str, dict[str, Any]]:
    """The jobs of a plan, by name: the keys of their steps in order, and what they ask for.

    Choices: on one machine a step is a job. On a cluster a step of seconds joins the job of the
      step that it follows.
    """
    jobs: dict[str, list[dict[str, Any]]] = {}
    for name, entry in zip(
        job_names(entries) if on != LOCAL else map(name_of, entries), entries, strict=True
    ):
        jobs.setdefault(name, []).append(entry)
    return {
        name: {
            "keys": [entry["key"] for entry in some],
            "threads": max(entry["threads"] for entry in some),
            "minutes": sum(map(minutes_of, some)),
            "mem_mb": max(STAGES[entry["stage"]].mem_mb for entry in some),
            "gpus": int(any(entry["device"] == "cuda" for entry in some)),
            "elsewhere": on != LOCAL,
        }
        for name, some in jobs.items()
    }


def name_of(entry: dict[str, Any]) -> str:
    """A step's name: of its job, its files beside the plan, its marker."""
    return f"{entry['stage']}-{entry['key']}"


def job_names(entries: list[dict[str, Any]]) -> list[str]:
    """For each step, in order, the name of its job, which is that of the job's first step.

    Choices: four kinds of jobs, without cycles: capture and points, a teacher that runs a model, a
      training, and the steps after it. A short training joins the steps after it. Other steps are
      jobs of their own.
    """
    by_path = {entry["path"]: entry for entry in entries}

    def group(entry: dict[str, Any]) -> tuple[str, str]:
        stage, inputs = entry["stage"], entry["inputs"]
        if stage == "ingest":
            return "capture", entry["path"]
        if stage == "sfm" or (
            stage == "teacher" and entry["config"]["teacher"]["kind"] in MODEL_FREE
        ):
            return "capture", inputs["capture"]
        if stage == "train":
            return "train", entry["path"]
        if before := [
            by_path[inputs[role]] for role in BESIDE.get(stage, ()) if inputs.get(role) in by_path
        ]:
            return group(before[0])
        if "gaussians" in inputs:
            train = by_path.get(inputs["gaussians"])
            return ("train" if train and seconds_of(train) <= SHORT else "after"), inputs[
                "gaussians"
            ]
        return stage, entry["path"]

    names: dict[tuple[str, str], str] = {}
    return [names.setdefault(group(entry), name_of(entry)) for entry in entries]


def seconds_of(train: dict[str, Any]) -> float:
    """Estimated seconds of a training."""
    settings = train["config"]["train"]
    return float(settings["seconds"] or (settings["steps"] or MOST_STEPS) * STEP_SECONDS)


def minutes_of(entry: dict[str, Any]) -> int:
    """Minutes that a step requests."""
    more = 10 * seconds_of(entry) / 60 if entry["stage"] == "train" else 0
    return STAGES[entry["stage"]].minutes + round(more)


def job_prefix(plan: Path) -> str:
    """Prefix of the names of a run's jobs in the cluster's queue."""
    return f"chebsplat-{plan.parent.name}"


def cancel_jobs(plan: Path, on: str) -> None:
    """Cancel a run's jobs in Slurm's queue; others watch the run's lease (`watch_run`)."""
    if executor_of(on) != SLURM:
        return
    listed = subprocess.run(
        ["squeue", "--me", "--noheader", "--format=%i %j"], capture_output=True, text=True
    )
    ours = [
        line.split()[0] for line in listed.stdout.splitlines() if f" {job_prefix(plan)}" in line
    ]
    if listed.returncode or (
        ours and subprocess.run(["scancel", *ours], capture_output=True).returncode
    ):
        say(
            f"jobs could not be taken out of the queue; those called {job_prefix(plan)}... end by "
            "themselves"
        )


def watch_run(plan: Path) -> None:
    """Stop this process, a job on a node, when its run releases its lease or lets it expire."""

    def watch() -> None:
        goes_on = True
        while goes_on:
            time.sleep(leases.EVERY)
            with suppress(OSError):  # a file system may be unavailable for a while
                goes_on = store.holder(store.run_lease(plan.parent)) is not None
        end_itself()

    threading.Thread(target=watch, daemon=True).start()
