"""The `chebsplat` command: runs, plans, studies, upkeep, uses of a finished scene, and every stage as a command."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click

from chebsplat.errors import ConfigError
from chebsplat.pipelines.basis_cli import basis
from chebsplat.pipelines.guard import guarded
from chebsplat.pipelines.uses import USES
from chebsplat.stages.registry import STAGES


class Commands(click.Group):
    """Stages are listed from their table and imported only when called, so that --help stays instant."""

    def list_commands(self, context: click.Context) -> list[str]:
        return [*super().list_commands(context), *STAGES]

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        if name in STAGES:  # for the listing, which shows a name and a line
            return click.Command(name, help=STAGES[name].help)
        return super().get_command(context, name)

    def resolve_command(self, context: click.Context, args: list[str]) -> Any:
        if args[0] in STAGES:
            from importlib import import_module

            return args[0], import_module(f"chebsplat.stages.{args[0]}").main, args[1:]
        return super().resolve_command(context, args)


@click.group(cls=Commands)
def main() -> None:
    """Semantic 3D Gaussian Splatting that understands shape."""


for _command in (*USES, basis):
    main.add_command(_command)


def plans(scene: str | None, sequence: str | None, settings: str, ablation: str, basis: str) -> list[Any]:
    """The plan of a scene, after those of the scenes that its basis comes from, or the plans of a sequence."""
    from chebsplat.pipelines import bases, sequences
    from chebsplat.pipelines.plan import Planner

    if (scene is None) == (sequence is None):
        raise ConfigError("name one of scene= and sequence=")
    if sequence is not None and basis:
        raise ConfigError("a sequence starts from nothing; basis= goes with scene=")
    planner = Planner()
    try:
        if sequence is not None:
            return sequences.chain(planner, sequence, settings, ablation)
        if not basis:
            return [planner.plan(str(scene), settings, ablation)]
        earlier, path, name = bases.before(planner, basis, settings, ablation)
        plan = planner.plan(str(scene), settings, ablation, path)
        plan.title += ("+" if ablation or settings else "@") + f"basis={name}"
        for found in earlier:
            found.asked = False
        return [*earlier, plan]
    finally:
        planner.save()


def checked_stage(stage: str | None, found: list[Any]) -> str | None:
    """Raises ConfigError for a stage that does not exist or that this scene leaves out."""
    if stage is None:
        return None
    if stage not in STAGES:
        import difflib

        near = difflib.get_close_matches(stage, list(STAGES), 1)
        raise ConfigError(f"no stage is called {stage}" + (f"; did you mean {near[0]}?" if near else ""))
    for plan in found:
        if plan.asked and stage not in plan.targets:
            raise ConfigError(f"{plan.title} leaves out {stage}: {plan.left_out.get(stage, 'not needed')}")
    return stage


OPTIONS = [
    click.option("--scene", help="a name from `chebsplat scenes`, or a folder"),
    click.option("--sequence", help="scenes in order, each starting from the knowledge of those before"),
    click.option("--set", "settings", default="", help="section.key=value,..."),
    click.option("--ablation", default="", help="a named set of settings"),
    click.option(
        "--basis", default="", help="start from this knowledge: NAME[@REVISION] of a sequence or HEAD, FOLDER/"
    ),
]


def with_scene(command: Any) -> Any:
    for option in reversed(OPTIONS):
        command = option(command)
    return command


@main.command()
@with_scene
@click.option("--stage", help="stop after this stage")
@click.option("--cores", type=click.IntRange(1), default=os.cpu_count())
def run(stage: str | None, cores: int, **choice: Any) -> None:
    """Bring a scene up to date; recompute only what is stale."""

    def action() -> int:
        from chebsplat.pipelines.run import execute

        found = plans(**choice)
        return execute(found, checked_stage(stage or None, found), cores)

    guarded(action)


@main.command()
@with_scene
def plan(**choice: Any) -> None:
    """Show what would run, what is fresh, and what the scene leaves out, and why."""

    def action() -> int:
        from chebsplat.pipelines.run import wanted_steps

        chosen = plans(**choice)
        keys = {step.key for found in chosen if found.asked for step in wanted_steps(found, None, chosen)}
        for found in chosen:
            print(f"{found.title}: {found.source}")
            for step in (step for step in found.steps if step.key in keys):
                print(f"  {'fresh' if step.fresh else 'would run':9s} {step.stage:9s} {step.key}")
            for what, why in found.left_out.items():
                print(f"  left out  {what}: {why}")
        return 0

    guarded(action)


@main.command()
@click.argument("name")
@click.option("--cores", type=click.IntRange(1), default=os.cpu_count(), help="shared by the jobs that run at once")
@click.option("--threads", type=click.IntRange(1), default=2, show_default=True, help="of each job")
@click.option("--out", type=click.Path(path_type=Path), help="default: build/studies/NAME")
@click.option("--plan", "only_plan", is_flag=True, help="say what would run, and stop")
@click.option("--no-run", is_flag=True, help="write the tables of what is there, and run nothing")
def study(name: str, cores: int, threads: int, out: Path | None, only_plan: bool, no_run: bool) -> None:
    """Run a study (of pipelines/configs/studies, or a .toml): its table, figure and page; goes on where it stopped."""

    def action() -> int:
        from chebsplat.pipelines import results, study_page, transfer
        from chebsplat.pipelines import study as studies
        from chebsplat.pipelines.run import Outcome, say

        asked = studies.read_study(name)
        runs = studies.expand(asked)
        say(f"{name}: {len(runs)} runs, {sum(run.plan.targets['evaluate'].is_dir() for run in runs)} of them done")
        if only_plan:
            print(studies.describe(studies.outstanding(runs)))
            return 0
        used = min(threads, cores)
        folder = out or Path("build/studies") / Path(name).stem
        outcome = Outcome() if no_run else studies.execute(Path(name).stem, runs, cores, used)
        rows = [results.row_of(run, outcome.failed) for run in runs]
        command = f"make study={name} cores={cores} threads={used}"
        more = transfer.sections(folder, asked, rows) if asked.sequences else []
        print(study_page.write(folder, asked, runs, rows, command, more).absolute())
        return outcome.code

    guarded(action)


@main.command()
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path))
def verify(folders: tuple[Path, ...]) -> None:
    """Recompute every digest of artifacts."""

    def action() -> int:
        from chebsplat.formats.artifact import verify as check

        for folder in folders:
            manifest = check(folder)
            print(f"{folder}: {manifest.schema}, {len(manifest.files)} files, whole")
        return 0

    guarded(action)


@main.command("clean-stale")
@click.option("--yes", is_flag=True, help="remove what is listed")
def clean_stale(yes: bool) -> None:
    """List the artifacts that no scene names any more, and leftovers of killed runs."""

    def action() -> int:
        from chebsplat.pipelines import store

        found = store.unnamed()
        for path, size in found:
            print(f"{size / 2**20:9.1f} MB  {path}")
        total = sum(size for _, size in found) / 2**20
        print(
            f"{total:9.1f} MB  in {len(found)} folders" + ("" if yes or not found else "; yes=1 (--yes) removes them")
        )
        if yes:
            for path, _ in found:
                store.remove(path)
        return 0

    guarded(action)


@main.command()
def scenes() -> None:
    """List the scenes, ablations, sequences and studies that have a name."""
    from chebsplat.pipelines.bases import head_names
    from chebsplat.pipelines.plan import names

    for kind in ("scenes", "ablations", "sequences", "studies"):
        print(f"{kind}: {' '.join(names(kind))}")
    print(f"HEADs: {' '.join(head_names()) or 'none'}")


@main.command(hidden=True)
@click.argument("plan", type=click.Path(path_type=Path))
@click.argument("key")
def job(plan: Path, key: str) -> None:
    """One step of a plan, as Snakemake runs it."""
    from chebsplat.pipelines.run import job as run_job

    sys.exit(run_job(plan, key))


if __name__ == "__main__":
    main()
