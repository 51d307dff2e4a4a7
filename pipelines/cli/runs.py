"""Running and planning: scenes, sequences, studies, and the one step that is a job of
Snakemake's.
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from shlex import quote
from typing import Any

import click

from chebsplat.stages.runtime.device import DEVICES

OPTIONS = [
    click.option("--scene", help="a name from `chebsplat scenes`, a folder, or a video"),
    click.option("--sequence", help="scenes in order, each with what those before it taught"),
    click.option("--set", "settings", default="", help="section.key=value,..."),
    click.option(
        "--quality",
        default="",
        help="of photos: draft (640 pixels, as by default), standard (1000), high (1600)",
    ),
    click.option("--ablation", default="", help="a named set of settings"),
    click.option(
        "--knowledge",
        default="",
        help="what it starts from: none, shipped, a set of lessons, a folder/",
    ),
    click.option(
        "--newer",
        is_flag=True,
        help="start from the lessons that there are now, and stay with these",
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
    used = device_of(device, where)
    cores = cores or (os.cpu_count() or 1 if where == cluster.LOCAL else 4)
    from chebsplat.pipelines.selection import checked_stage, plans

    chosen = plans(**choice, running=True, device=used)
    return execute(chosen, checked_stage(stage or None, chosen), cores, used, where)


@click.command()
@with_scene
@ON_DEVICE
def plan(device: str, **choice: Any) -> None:
    """Show how long it would take, what would run, what is fresh and what is left out, and why."""
    from chebsplat.pipelines.planning.forecast import forecast, sentence
    from chebsplat.pipelines.running.run import device_of
    from chebsplat.pipelines.selection import plans

    used, cores = device_of(device), os.cpu_count() or 1
    for one in plans(**choice, device=used):
        found = forecast(one, [step for step in one.steps if not step.fresh], cores, used)
        print(f"{one.title}: {sentence(one, found, cores, used)}")
        print(f"{one.title}: {one.source}")
        for step in one.steps:
            what = "fresh" if step.fresh else "would run"
            took = f"{found.seconds[step.stage]:6.0f} s" if found and not step.fresh else ""
            print(f"  {what:9s} {step.stage:9s} {step.key}{took}")
        for what, why in one.left_out.items():
            print(f"  left out  {what}: {why}")


@click.command()
@click.argument("name")
@click.option(
    "--cores",
    type=click.IntRange(1),
    help="shared by the jobs that run at once; default: all, or of 100 jobs",
)
@click.option("--threads", type=click.IntRange(1), default=2, show_default=True, help="of each job")
@click.option("--out", type=click.Path(path_type=Path), help="default: build/studies/NAME")
@click.option("--plan", "only_plan", is_flag=True, help="say what would run, and stop")
@click.option("--no-run", is_flag=True, help="write the tables of what is there, and run nothing")
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
    """Run a study (of pipelines/configs/studies, or a .toml): its table, figure and page; goes on
    where it stopped.
    """
    from chebsplat.pipelines.running import cluster
    from chebsplat.pipelines.running.run import Outcome, device_of, say
    from chebsplat.pipelines.studies import page, published, results, tables
    from chebsplat.pipelines.studies import study as studies

    where, asked = cluster.checked(on), studies.read_study(name)
    computing = device_of(device, where)
    cores = cores or (os.cpu_count() or 1 if where == cluster.LOCAL else 100 * threads)
    runs = studies.expand(asked, running=not (only_plan or no_run), device=computing)
    say(
        f"{name}: {len(runs)} runs, {sum(run.plan.targets['evaluate'].is_dir() for run in runs)} "
        "of them done"
    )
    if only_plan:
        print(studies.describe(studies.outstanding(runs)))
        return 0
    used = min(threads, cores)
    folder = out or Path("build/studies") / Path(name).stem
    command = f"make study={quote(name)} cores={cores} threads={used}"
    command += f" on={quote(on)}" if where != cluster.LOCAL else ""

    def write(failed: dict[str, tuple[int, str, Path]]) -> Path:
        rows = [results.row_of(run, failed) for run in runs]
        more = [*published.published_sections(asked, rows), *tables.sections(asked, rows)]
        return page.write(folder, asked, runs, rows, command, more).absolute()

    outcome = Outcome()
    if not no_run:
        outcome = studies.execute(
            Path(name).stem, runs, cores, used, computing, where, lambda: write({})
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
    from chebsplat.pipelines.running.processes import in_turn

    jobs.use_threads()
    if len(keys) > 1:
        return in_turn(
            _main, [["job", *["--elsewhere"] * elsewhere, str(plan), key] for key in keys]
        )
    if elsewhere:
        watch_run(plan)
    return jobs.run(plan, keys[0], again=elsewhere)


@click.command(hidden=True)
@click.option("--semantic", is_flag=True)
def rehearse(semantic: bool) -> int:
    """Compile what a training needs, as long as the run lasts that this is of."""
    from chebsplat.pipelines.running.precompile import rehearsed

    os.nice(5)
    with rehearsed(2, semantic):
        return 0


def _main(arguments: list[str]) -> None:
    """Our command in a process that was forked for it; by name, since it is the command that holds
    those of here.
    """
    import_module("chebsplat.pipelines.cli").main(arguments, prog_name="chebsplat")


COMMANDS = (run, plan, study, job, rehearse)
