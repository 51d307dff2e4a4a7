"""Running plans: nothing when all is fresh, otherwise Snakemake over the steps that are not."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from chebsplat.formats.files import atomic_write, explained
from chebsplat.pipelines.planning.forecast import forecast, sentence
from chebsplat.pipelines.planning.needs import LATER, UNASKED
from chebsplat.pipelines.planning.plan import Plan, Step
from chebsplat.pipelines.running import cluster, job, processes
from chebsplat.pipelines.work import heads, leases, store, summary
from chebsplat.pipelines.work.store import say
from chebsplat.pipelines.work.summary import align_columns
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.device import resolve
from chebsplat.stages.runtime.progress import is_verbose

HERE = Path(__file__).parents[1]  # the Snakefile's folder


@dataclass
class Outcome:
    """Exit code of a run (its steps' highest); failed steps: key -> (code, last line, log)."""

    code: int = 0
    failed: dict[str, tuple[int, str, Path]] = field(default_factory=dict)


def device_of(requested: str, on: str = cluster.LOCAL) -> str:
    """The device of all jobs of a run; a line says why it is not the GPU that is there. On a
    cluster the nodes decide: a job that requests a GPU in vain ends with exit code 2.
    """
    if on != cluster.LOCAL and requested == "cuda":
        return requested
    device, why = resolve(requested)
    if why:
        say(why)
    return device


def execute(
    plans: list[Plan], stage: str | None, cores: int, device: str = "cpu", on: str = cluster.LOCAL
) -> int:
    """Bring plans up to date, up to `stage`; prints the path of the report or last artifact."""
    steps = {step.key: step for plan in plans for step in needed_steps(plan, stage, plans)}
    stale = [step for step in steps.values() if not step.fresh]
    for plan in plans:
        awaited = [step for step in plan.steps if step.key in steps and not step.fresh]
        estimate = forecast(plan, awaited, cores, device)
        for step in awaited:
            step.expected = estimate.seconds[step.stage] if estimate else None
        say(f"{plan.title}: {sentence(plan, estimate, cores, device)}")
        say(f"{plan.title}: {plan.source}")
        if is_verbose():
            for what, why in plan.left_out.items():
                say(f"  left out: {what} ({why})")
        elif "teacher" in plan.left_out:
            say(f"  colour only, without labels: {plan.left_out['teacher']}")
    code = 0
    try:
        if stale:
            say(
                f"  to run: {' '.join(step.stage for step in stale)}   fresh: "
                f"{len(steps) - len(stale)}"
            )
            code = snakemake(stale, cores, device=device, on=on).code
    finally:  # a stopped run links its finished steps
        for plan in plans:
            store.link(plan.title, plan.targets)
            add_lesson(plan)
    if code:
        return code
    if stale:
        seconds(list(steps.values()), {step.key for step in stale})
    for plan in plans:
        say_result(plan, stage)
    return 0


def add_lesson(plan: Plan) -> None:
    """Add a scene's lesson, if its run has made one, to the set that later scenes start from."""
    lesson = plan.lesson
    if lesson is not None and lesson.lessons is not None and store.is_fresh(lesson.path):
        heads.add(lesson.lessons, lesson.path, lesson.capture, lesson.start, lesson.scene)


def say_result(plan: Plan, stage: str | None) -> None:
    """Report a scene's figures and doubts, and print the path of its report or last stage."""
    last = next(step for step in reversed(plan.steps) if stage in (None, step.stage))
    if last.stage == "report":
        for line in align_columns(summary.table(plan.targets["evaluate"])):
            say(f"  {line}")
        for doubt in summary.doubts(plan.targets):
            say(f"  doubtful: {doubt}")
        if plan.left_out.get("teacher", "").startswith(UNASKED):
            say(f"  {LATER}")
    link = store.work() / plan.title / last.stage
    print(summary.readable(link / "report.html" if last.stage == "report" else link))


def needed_steps(plan: Plan, stage: str | None, others: Iterable[Plan] = ()) -> list[Step]:
    """All steps of a plan, or its `stage` alone, with those they need, of other plans too."""
    by_path = {step.path: step for some in (*others, plan) for step in some.steps}
    stages = {stage} if stage else {step.stage for step in plan.steps}
    queue, needed = [step for step in plan.steps if step.stage in stages], set()
    while queue:
        step = queue.pop()
        needed.add(step.key)
        queue += [by_path[path] for path in (*step.inputs.values(), *step.after) if path in by_path]
    return [step for step in by_path.values() if step.key in needed]


def snakemake(
    steps: list[Step],
    cores: int,
    threads: int | None = None,
    device: str = "cpu",
    on: str = cluster.LOCAL,
) -> Outcome:
    """Run these steps; logs of those that fail stay in `work/.plans`.

    Args: threads: of one job, so that cores // threads run at once; `evaluate`, where it measures
      frames per second, then runs alone. None: every job may use all cores. on: of
      `cluster.profile`.
    """
    state = git_state(HERE)
    entries = [entry(step, state, device) for step in steps]
    for item in entries:
        timed = (
            item["stage"] == "evaluate"
            and item["config"]["evaluate"]["timing_repeats"] > 0
            and on == cluster.LOCAL
        )
        if threads is not None:
            item["threads"] = cores if timed else threads
        else:
            item["threads"] = 1 if on == cluster.LOCAL else cores
    with plan_of(entries, on) as plan:
        folder, words = plan.parent, plan.parent / "snakemake.log"
        arguments = ["--workflow-profile", "none", "--profile", str(cluster.profile(on))]
        arguments += (
            ["--cores", str(cores)]
            if on == cluster.LOCAL
            else cluster.arguments(plan, on, cores, threads)
        )
        arguments += ["--snakefile", str(HERE / "Snakefile"), "--directory", str(store.work())]
        arguments += ["--config", f"plan={plan.relative_to(store.work())}"]
        environment = {
            "CHEBSPLAT_THREADS": str(threads or cores),
            "CHEBSPLAT_WORK": str(store.work()),
        }
        code: int | None = None
        try:
            beside = rehearsal_command(entries) if on == cluster.LOCAL and cores > 1 else []
            code = processes.snakemake(
                words, store.work() / ".snakemake/cache", arguments, environment, beside
            )
            return failures(steps, folder, words) if code else Outcome()
        finally:
            if code != 0 and on != cluster.LOCAL:
                cluster.cancel_jobs(plan, on)
            elif code != 0:
                store.remove_halves([step.path for step in steps])
            if not code:
                shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def plan_of(entries: list[dict[str, Any]], on: str = cluster.LOCAL) -> Iterator[Path]:
    """The plan of a run, in a folder of its own with each job's config; as long as the block runs,
    `clean-stale` on any machine spares what it names.
    """
    folder = store.work() / ".plans" / f"{uuid.uuid4().hex[:16]}-{os.getpid()}"
    with leases.hold(store.run_lease(folder)):
        yield write_plan(folder, entries, cluster.jobs_of(entries, on))


def write_plan(
    folder: Path, entries: list[dict[str, Any]], jobs: dict[str, dict[str, Any]]
) -> Path:
    """The file of a plan, in `folder`, which is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for item in entries:
        file = folder / cluster.name_of(item)
        file.with_suffix(".json").write_text(json.dumps(item["config"], indent=1))
        file.with_suffix(".exit").write_text(job.CODE.format(0))
        file.with_suffix(".raw.json").write_text(json.dumps(item["raw"]))
    steps = [{name: value for name, value in item.items() if name != "raw"} for item in entries]
    plan = folder / "plan.json"
    atomic_write(plan, json.dumps({"steps": steps, "jobs": jobs}, indent=1))
    return plan


def failures(steps: list[Step], folder: Path, words: Path) -> Outcome:
    """Say which steps failed, and where their log is."""
    failed, killed = {}, False
    for step in steps:
        log, exit_file = (folder / f"{step.stage}-{step.key}.{kind}" for kind in ("log", "exit"))
        if code := int(exit_file.read_text()):
            failed[step.key] = (code, last_word(log), log)
            say(
                f"{step.stage} {'was stopped' if code > 128 else 'failed'} with exit code {code}; "
                f"log: {log}"
            )
        elif log.is_file() and not step.fresh:
            failed[step.key], killed = (1, "killed before it could report", log), True
            say(f"{step.stage} was killed before it could report; log: {log}")
    if killed or not failed:
        with explained(
            store.work()
        ):  # find out if the disk is full, which the failed job could not report
            atomic_write(folder / "room", bytes(1 << 20))
            (folder / "room").unlink()
    if not failed:
        say(f"the run stopped before a stage began; log: {words}")
    return Outcome(max((code for code, *_ in failed.values()), default=1), failed)


def last_word(log: Path) -> str:
    """The last line of a log."""
    lines = log.read_text().strip().splitlines() if log.is_file() else []
    return lines[-1] if lines else "no message"


def git_state(root: Path) -> dict[str, Any]:
    """{"commit", "dirty"} of the checkout that the layer `root` belongs to; empty if installed.

    Choices: a repository around an environment that chebsplat is installed in is not ours: git,
      which runs programs that a repository's settings name, is not started in it.
    """
    if not (root.parent / ".git").exists():
        return {}
    try:
        commit, status = (
            subprocess.run(
                ["git", *words], cwd=root, capture_output=True, text=True, check=True
            ).stdout.strip()
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain"))
        )
    except (OSError, subprocess.CalledProcessError):
        return {}
    return {"commit": commit, "dirty": bool(status)}


def entry(step: Step, state: dict[str, Any], device: str = "cpu") -> dict[str, Any]:
    """A step as a JSON-able entry for the Snakefile and the job."""
    return {
        "stage": step.stage,
        "key": step.key,
        "path": str(step.path),
        "inputs": {role: str(path) for role, path in step.inputs.items()},
        "after": [str(path) for path in step.after],
        "config": step.sections,
        "code": step.code | state,
        "raw": step.raw,
        "device": STAGES[step.stage].device(device, step.sections),
        "expected": step.expected,
    }


def rehearsal_command(entries: list[dict[str, Any]]) -> list[str]:
    """The command that compiles kernels during a run; empty without a CPU training in it."""
    trained = [
        entry for entry in entries if entry["stage"] == "train" and entry["device"] != "cuda"
    ]
    if not trained:
        return []
    semantic = any("features" in entry["inputs"] for entry in trained)
    return [
        sys.executable,
        "-P",
        "-m",
        "chebsplat.pipelines.cli",
        "rehearse",
        *["--semantic"] * semantic,
    ]


def job_command(plan: Path, of_job: dict[str, Any]) -> str:
    """The shell line of a job; `exec` so that signals reach it and not a shell."""
    command = [
        sys.executable,
        "-P",
        "-m",
        "chebsplat.pipelines.cli",
        "job",
        *["--elsewhere"] * of_job["elsewhere"],
    ]
    return "exec " + shlex.join([*command, str(plan), *of_job["keys"]])


def seconds(steps: list[Step], ran: set[str]) -> None:
    """Report seconds of each stage, from the manifests, and which ran before this run."""
    total = 0.0
    for step in steps:
        spent = json.loads((step.path / "artifact.json").read_text())["seconds"]
        if step.key in ran:
            total += spent
        say(f"  {step.stage:9s} {spent:7.1f} s{'' if step.key in ran else '  (fresh, ran before)'}")
    say(f"  total     {total:7.1f} s, {time.strftime('%H:%M:%S')}")
