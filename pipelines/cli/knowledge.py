"""Commands on sets of lessons: list, verify, forget, learn again; and a new encoder of shape."""

from __future__ import annotations

import os
from pathlib import Path

import click

from chebsplat.pipelines.cli.group import Known, NewPath
from chebsplat.pipelines.work.heads import ROOMS

NAME = click.option(
    "--set", "name", default=ROOMS, show_default=True, help="of lessons, in the work folder"
)


@click.group()
def knowledge() -> None:
    """Lessons and encoder that scenes start from: show, verify, forget, rebuild, teach anew."""


@knowledge.command()
@NAME
def log(name: str) -> None:
    """The lessons of a set, in the order in which they were added."""
    from chebsplat.pipelines.work import heads

    for key, record in sorted(heads.members(name).items(), key=lambda entry: entry[1]["date"]):
        print(f"{record['date']}  {key}  {record['scene']}")


@knowledge.command()
@NAME
def show(name: str) -> None:
    """Points, novelty and trust of each lesson of a set, and the reason for its trust."""
    from chebsplat.formats.lesson import read_notes
    from chebsplat.pipelines.work import heads
    from chebsplat.pipelines.work.summary import align_columns
    from chebsplat.stages.recall import trusted, why

    rows = [("lesson", "scene", "points", "novelty", "trust", "because")]
    for key, record in heads.members(name).items():
        notes = read_notes(heads.folder(name) / key)
        figures = f"{notes['n_points']}", f"{notes['novelty']:.3f}", f"{trusted(notes):.2f}"
        rows.append((key, record["scene"], *figures, why(notes)))
    for line in align_columns(rows):
        print(line)


@knowledge.command()
@NAME
def verify(name: str) -> None:
    """Recompute every digest of a set's lessons."""
    from chebsplat.formats import artifact
    from chebsplat.formats.lesson import SCHEMA
    from chebsplat.pipelines.work import heads

    lessons = heads.members(name)
    for key in lessons:
        artifact.verify(heads.folder(name) / key, SCHEMA)
    print(f"{name}: {len(lessons)} lessons, whole")


@knowledge.command()
@click.argument("lesson")
@NAME
def forget(lesson: str, name: str) -> None:
    """Take a LESSON out of a set: scenes that are pinned from now on start without it."""
    from chebsplat.pipelines.work import heads

    heads.forget(name, lesson)
    print(f"{name}: {len(heads.members(name))} lessons")


@knowledge.command()
@NAME
@click.option("--cores", type=click.IntRange(1), default=os.cpu_count())
def rebuild(name: str, cores: int) -> int:
    """Learn every lesson of a set again by the encoder that ships now, from stored artifacts."""
    from chebsplat.pipelines.planning.plan import Planner
    from chebsplat.pipelines.planning.sequences import plan_relearning
    from chebsplat.pipelines.running.run import execute

    planner = Planner(running=True)
    try:
        lesson_plans = plan_relearning(planner, name)
    finally:
        planner.save()
    return execute(lesson_plans, "learn", cores) if lesson_plans else 0


@knowledge.command()
@click.option(
    "--teacher", type=click.Path(path_type=Path), help=".onnx; default: the embedded teacher"
)
@click.option("--set", "settings", default="", help="section.key=value,... of teach and channels")
@click.option("--out", type=NewPath(), help="folder to copy it to; later: --knowledge FOLDER/")
@click.option("--cores", type=click.IntRange(1), default=os.cpu_count())
def teach(teacher: Path | None, settings: str, out: Path | None, cores: int) -> int:
    """Train an encoder of shape for a TEACHER on generated rooms; its scenes start from it."""
    from chebsplat.formats import artifact
    from chebsplat.pipelines.planning.plan import Planner
    from chebsplat.pipelines.planning.sequences import plan_teaching
    from chebsplat.pipelines.running.run import execute
    from chebsplat.pipelines.work import store

    planner = Planner(running=True)
    try:
        store.make_work()
        plan = plan_teaching(planner, teacher, settings)
    finally:
        planner.save()
    code = execute([plan], "teach", cores)
    if code == 0 and out is not None:
        published = plan.targets["teach"]
        artifact.copy(published, out, artifact.verify(published))
        print(out.absolute())
    return code


@click.command("teach")
@click.argument("scene", type=Known("scenes"))
@click.option(
    "--points",
    type=click.Path(path_type=Path),
    required=True,
    help="a CSV of x, y, z, word in its frame",
)
@NAME
@click.option("--cores", type=click.IntRange(1), default=os.cpu_count())
def teach_points(scene: str, points: Path, name: str, cores: int) -> int:
    """Teach other scenes from labelled points of a SCENE instead of its 2D teacher's labels.

    Without a SCENE, the stage of this name: --help says more.
    """
    from chebsplat.pipelines.running.run import execute
    from chebsplat.pipelines.selection import checked_stage, plans

    scene_plans = plans(
        scene, None, {"learn": {"points": str(points)}}, "", running=True, knowledge=name
    )
    return execute(scene_plans, checked_stage("learn", scene_plans), cores)


COMMANDS = (knowledge, teach_points)
