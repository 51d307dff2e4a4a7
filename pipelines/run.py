"""Running plans: nothing when all is fresh, otherwise Snakemake over the steps that are not."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from chebsplat.pipelines import store
from chebsplat.pipelines.plan import Plan, Step, git_state

HERE = Path(__file__).parent


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def execute(plans: list[Plan], stage: str | None, cores: int) -> int:
    """Bring plans up to date, up to `stage`; prints the last artifact (the report's page) on stdout. Exit code."""
    wanted = [wanted_steps(plan, stage) for plan in plans]
    steps = {step.key: step for some in wanted for step in some}
    stale = [step for step in steps.values() if not step.fresh]
    for plan in plans:
        say(f"{plan.title}: {plan.source}")
        for what, why in plan.left_out.items():
            say(f"  left out: {what} ({why})")
    code = 0
    if stale:
        say(f"  to run: {' '.join(step.stage for step in stale)}   fresh: {len(steps) - len(stale)}")
        code = snakemake(list(steps.values()), cores)
    for plan, some in zip(plans, wanted, strict=True):
        store.link(plan.title, {step.stage: step.path for step in some if step.fresh})
    if code:
        return code
    if stale:
        seconds(list(steps.values()), {step.key for step in stale})
    for some in wanted:
        last = some[-1].path
        print(last / "report.html" if some[-1].stage == "report" else last)
    return 0


def wanted_steps(plan: Plan, stage: str | None) -> list[Step]:
    """All steps, or `stage` and what it needs."""
    if stage is None:
        return plan.steps
    by_path = {step.path: step for step in plan.steps}
    waiting, needed = [step for step in plan.steps if step.stage == stage], set()
    while waiting:
        step = waiting.pop()
        needed.add(step.key)
        waiting += [by_path[path] for path in step.inputs.values() if path in by_path]
    return [step for step in plan.steps if step.key in needed]


def snakemake(steps: list[Step], cores: int) -> int:
    """Run what is not fresh. Returns 0, or the exit code of the stage that failed."""
    work = store.work()
    state = git_state(HERE)
    entries = [entry(step, state) for step in steps]
    text = json.dumps({"steps": entries}, indent=1)
    folder = work / ".plans" / hashlib.sha256(text.encode()).hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("exit-*"):
        old.unlink()
    plan = folder / "plan.json"
    plan.write_text(text)
    for item in entries:
        (folder / f"{item['stage']}-{item['key']}.json").write_text(json.dumps(item["config"], indent=1))
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(HERE / "Snakefile"), "--directory", str(work)]
    command += ["--profile", str(HERE / "profiles/default"), "--cores", str(cores), "--config", f"plan={plan}"]
    # Jobs inherit stderr, which stays readable because Snakemake itself keeps quiet; stdout is ours.
    done = subprocess.run(command, stdout=subprocess.DEVNULL, env=os.environ | {"CHEBSPLAT_THREADS": str(cores)})
    if done.returncode == 0:
        return 0
    failed = sorted(folder.glob("exit-*"))
    for file in failed:
        say(f"{file.name.split('-')[1]} failed with exit code {file.read_text()}")
    if not failed:
        say(f"the run stopped before a stage could report; Snakemake's log is in {work / '.snakemake/log'}")
    return max((int(file.read_text()) for file in failed), default=1)


def entry(step: Step, state: dict[str, Any]) -> dict[str, Any]:
    """A step as the Snakefile and the job read it."""
    return {
        "stage": step.stage,
        "key": step.key,
        "path": str(step.path),
        "inputs": {role: str(path) for role, path in step.inputs.items()},
        "config": step.sections,
        "code": step.code | state,
    }


def job(plan: Path, key: str) -> int:
    """One Snakemake job: the stage's own command, in this process."""
    from importlib import import_module

    # Snakemake sets OMP_NUM_THREADS to the one thread that a rule declares; a stage may use all cores of the run.
    if threads := os.environ.get("CHEBSPLAT_THREADS"):
        os.environ |= {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
    step = next(s for s in json.loads(plan.read_text())["steps"] if s["key"] == key)
    arguments = ["--config", str(plan.parent / f"{step['stage']}-{key}.json"), "--out", step["path"], "--key", key]
    arguments += ["--code", json.dumps(step["code"])]
    for role, path in step["inputs"].items():
        arguments += [f"--in-{role}", path]
    code = 0
    try:
        import_module(f"chebsplat.stages.{step['stage']}").main(arguments, prog_name=step["stage"])
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    if code:
        (plan.parent / f"exit-{step['stage']}-{key}").write_text(str(code))
    return code


def seconds(steps: list[Step], ran: set[str]) -> None:
    """Seconds of each stage, from the manifests; what did not run now says so."""
    total = 0.0
    for step in steps:
        spent = json.loads((step.path / "artifact.json").read_text())["seconds"]
        if step.key in ran:
            total += spent
        say(f"  {step.stage:9s} {spent:7.1f} s{'' if step.key in ran else '  (fresh, ran before)'}")
    say(f"  total     {total:7.1f} s, {time.strftime('%H:%M:%S')}")
