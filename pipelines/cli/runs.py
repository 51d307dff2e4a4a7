"""Commands that run and plan: scenes, sequences, studies, and the job that Snakemake calls."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from shlex import quote
from typing import Any

import click

from chebsplat.pipelines.cli.group import Known
from chebsplat.stages.runtime.device import DEVICES

OPTIONS = [
    click.option(
        "--scene", type=Known("scenes"), help="a name from `chebsplat scenes`, a folder, or a video"
    ),
    click.option(
        "--sequence",
        type=Known("sequences"),
        help="scenes in order, each with the lessons of those before it",
    ),
    click.option("--set", "settings", default="", help="section.key=value,..."),
    click.option(
        "--quality",
        type=Known("qualities"),
        default="",
        help="of photos: draft (640 pixels, as by default), standard (1000), high (1600)",
    ),
    click.option("--ablation", type=Known("ablations"), default="", help="a named set of settings"),
    click.option(
        "--knowledge",
        default="",
        help="starting knowledge: none, shipped, a set of lessons, a folder/",
    ),
    click.option(
        "--newer",
        is_flag=True,
        help="pin the scene to the present lessons",
    ),
]


ON = click.option(
    "--on",
    default="local",
    show_default=True,
    help="local, slurm, or the folder/ of a Snakemake profile",
)
ON_DEVICE = click.option("--device", type=click.Choice(DEVICES), default="auto", show_default=True)


def with_scene(command: Any) -> Any:
    """Give a command the options that choose a scene and its settings."""
    for option in reversed(OPTIONS):
        command = option(command)
    return command


@click.command()
@with_scene
@click.option("--stage", help="stop after this stage")
@click.option(
    "--cores", type=click.IntRange(1), help="default: all; on a cluster, 4 of a node for each job"
)
@ON_DEVICE
@ON
def run(stage: str | None, cores: int | None, device: str, on: str, **choice: Any) -> int:
    """Bring a scene up to date; recompute only what is stale."""
    from chebsplat.pipelines.running import cluster
    from chebsplat.pipelines.running.run import device_of, execute

    where = cluster.checked(on)
    computing = device_of(device, where)
    cores = cores or (os.cpu_count() or 1 if where == cluster.LOCAL else 4)
    from chebsplat.pipelines.selection import checked_stage, plans

    scene_plans = plans(**choice, running=True, device=computing)
    return execute(scene_plans, checked_stage(stage or None, scene_plans), cores, computing, where)


@click.command()
@with_scene
@ON_DEVICE
def plan(device: str, **choice: Any) -> None:
    """Show how long a scene takes, its steps to run, the fresh ones, and those left out."""
    from chebsplat.pipelines.planning.forecast import forecast, sentence
    from chebsplat.pipelines.running.run import device_of
    from chebsplat.pipelines.selection import plans

    used, cores = device_of(device), os.cpu_count() or 1
    for scene_plan in plans(**choice, device=used):
        stale = [step for step in scene_plan.steps if not step.fresh]
        expected = forecast(scene_plan, stale, cores, used)
        print(f"{scene_plan.title}: {sentence(scene_plan, expected, cores, used)}")
        print(f"{scene_plan.title}: {scene_plan.source}")
        for step in scene_plan.steps:
            state = "fresh" if step.fresh else "would run"
            time = f"{expected.seconds[step.stage]:6.0f} s" if expected and not step.fresh else ""
            print(f"  {state:9s} {step.stage:9s} {step.key}{time}")
        for what, why in scene_plan.left_out.items():
            print(f"  left out  {what}: {why}")


@click.command()
@click.argument("name", type=Known("studies"))
@click.option(
    "--cores",
    type=click.IntRange(1),
    help="shared by the jobs that run at once; default: all, or of 100 jobs",
)
@click.option("--threads", type=click.IntRange(1), default=2, show_default=True, help="of each job")
@click.option("--out", type=click.Path(path_type=Path), help="default: build/studies/NAME")
@click.option("--plan", "only_plan", is_flag=True, help="list the steps to run, and stop")
@click.option("--no-run", is_flag=True, help="write the tables of finished runs, and run nothing")
@ON_DEVICE
@ON
def study(
    name: str,
    cores: int | None,
    threads: int,
    out: Path | None,
    only_plan: bool,
    no_run: bool,
    device: str,
    on: str,
) -> int:
    """Run or resume a study (of pipelines/configs/studies, or a .toml): table, figure and page."""
    from chebsplat.pipelines.running import cluster
    from chebsplat.pipelines.running.run import Outcome, device_of, say
    from chebsplat.pipelines.studies import page, published, results, tables
    from chebsplat.pipelines.studies import study as studies

    where, spec = cluster.checked(on), studies.read_study(name)
    computing = device_of(device, where)
    cores = cores or (os.cpu_count() or 1 if where == cluster.LOCAL else 100 * threads)
    runs = studies.expand(spec, running=not (only_plan or no_run), device=computing)
    say(
        f"{name}: {len(runs)} runs, {sum(run.plan.targets['evaluate'].is_dir() for run in runs)} "
        "of them done"
    )
    if only_plan:
        print(studies.describe(studies.outstanding(runs)))
        return 0
    job_threads = min(threads, cores)
    folder = out or Path("build/studies") / Path(name).stem
    command = f"make study={quote(name)} cores={cores} threads={job_threads}"
    command += f" on={quote(on)}" if where != cluster.LOCAL else ""

    def write(failed: dict[str, tuple[int, str, Path]]) -> Path:
        rows = [results.row_of(run, failed) for run in runs]
        more = [*published.published_sections(spec, rows), *tables.sections(spec, rows)]
        return page.write(folder, spec, runs, rows, command, more).absolute()

    outcome = Outcome()
    if not no_run:
        outcome = studies.execute(
            Path(name).stem, runs, cores, job_threads, computing, where, lambda: write({})
        )
    print(write(outcome.failed))
    return outcome.code


@click.command(hidden=True)
@click.argument("plan", type=click.Path(path_type=Path))
@click.argument("keys", nargs=-1, required=True)
@click.option(
    "--elsewhere", is_flag=True, help="on a node of a cluster, which no pipe of the run reaches"
)
def job(plan: Path, keys: tuple[str, ...], elsewhere: bool) -> int:
    """Steps of a plan, one after the other until one fails, as Snakemake runs them."""
    from chebsplat.pipelines.running import job as jobs
    from chebsplat.pipelines.running.cluster import watch_run
    from chebsplat.pipelines.running.processes import run_in_turn

    jobs.use_threads()
    if len(keys) > 1:
        return run_in_turn(
            _main, [["job", *["--elsewhere"] * elsewhere, str(plan), key] for key in keys]
        )
    if elsewhere:
        watch_run(plan)
    return jobs.run(plan, keys[0], again=elsewhere)


@click.command(hidden=True)
@click.option("--semantic", is_flag=True)
def rehearse(semantic: bool) -> int:
    """Compile the kernels of a training while the run that calls this lasts."""
    from chebsplat.pipelines.running.precompile import precompile

    os.nice(5)
    with precompile(2, semantic):
        return 0


def _main(arguments: list[str]) -> None:
    """The command, run in a forked process; imported by name, since it imports this module."""
    import_module("chebsplat.pipelines.cli").main(arguments, prog_name="chebsplat")


COMMANDS = (run, plan, study, job, rehearse)
