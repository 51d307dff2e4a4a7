"""Plans of several scenes in order, each with the lessons of those before it; and plans without a
scene: training an encoder of shape, and learning lessons again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError
from chebsplat.formats import artifact
from chebsplat.formats.knowledge import SCHEMA, SHIPPED
from chebsplat.formats.names import unprintable
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.pipelines.planning.plan import (
    Overrides,
    Plan,
    PlannedLesson,
    Planner,
    merged,
    overrides,
    resolve_paths,
)
from chebsplat.pipelines.work import heads, store
from chebsplat.pipelines.work.scenes import read_named
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime import config as configs

LONGEST = 1000  # scenes of a sequence


def scenes_of(name: str) -> list[str]:
    """Scenes of a sequence of ours by name, or of a file of the user's that ends in .toml.

    Raises: ConfigError naming the file, or the nearest sequence's name.
    """
    values = read_named("sequences", name)
    scenes = values.get("scenes")
    if set(values) != {"scenes"} or not isinstance(scenes, list) or not 0 < len(scenes) <= LONGEST:
        raise ConfigError(
            f'sequence {name}: it says scenes = ["...", ...], at most {LONGEST}, and nothing else'
        )
    for scene in scenes:
        if not isinstance(scene, str) or not scene or unprintable(scene):
            raise ConfigError(f"sequence {name}: scenes: {scene!r:.60} is no scene's name")
    return scenes


def plan_sequence(
    planner: Planner, name: str, settings: Overrides = "", ablation: str = ""
) -> list[Plan]:
    """Plans of a sequence's scenes, each with the lessons of those before it, or in the printed
    method with the bases of the training before it.
    """
    plans: list[Plan] = []
    for number, scene in enumerate(scenes_of(name), start=1):
        earlier = plans[-1].targets["train"] if plans and ablation == "paper" else None
        lessons, place = (
            [plan.lesson for plan in plans if plan.lesson is not None],
            f"{Path(name).stem}-{number}-",
        )
        plans.append(
            planner.plan(scene, settings, ablation, earlier=earlier, place=place, lessons=lessons)
        )
    return plans


def plan_teaching(planner: Planner, model: Path | None, settings: str = "") -> Plan:
    """The steps that train an encoder of shape for a teacher, by default the embedded one.

    Raises: ConfigError on a closed-set teacher, which has no features to learn.
    """
    file = (model or EMBEDDED).expanduser().resolve()
    teacher = read_teacher(file)
    if teacher.output != "features":
        raise ConfigError(
            f"{teacher.settings}: output is {teacher.output}; knowledge is taught in features"
        )
    of: dict[str, Any] = {
        "channels": {"model": str(file)},
        "teach": {"model": str(file)} if model else {},
    }
    config = resolve_paths(
        configs.build(merged(of, overrides(settings)), f"knowledge for {teacher.name}")
    )
    channels = planner.step(STAGES["channels"], config, {}, {})
    inputs = {"channels": channels.path}
    teach = planner.step(STAGES["teach"], config, inputs, {"channels": channels.key})
    return Plan(
        f"knowledge-{teacher.name}", f"knowledge for the teacher {teacher.name}", [channels, teach]
    )


def plan_relearning(planner: Planner, name: str) -> list[Plan]:
    """The steps that learn the lessons of a set again by the encoder that ships now, from stored
    artifacts. Lessons by that encoder, and of scenes whose artifacts are gone, stay as they are.
    """
    plans: list[Plan] = []
    start = store.import_artifact(SHIPPED, "teach", SCHEMA, planner.running)
    for key, record in heads.members(name).items():
        manifest = artifact.read_manifest(heads.folder(name) / key)
        inputs = {
            role: store.artifact_path(STAGES["learn"].roles[role], entry["key"])
            for role, entry in manifest.inputs.items()
            if role not in ("start", "encoding")
        }
        if record["start"] == start.name:
            continue
        if not all(map(store.is_fresh, inputs.values())):
            store.say(
                f"{record['scene']}: its artifacts are gone; run the scene again, and it is "
                "learned anew"
            )
            continue
        config = configs.build(manifest.config, f"lesson {key}")
        roles = {"descriptors": inputs["descriptors"], "start": start}
        encode = planner.step(
            STAGES["encode"], config, roles, {role: path.name for role, path in roles.items()}
        )
        roles = inputs | {"encoding": encode.path, "start": start}
        learn = planner.step(
            STAGES["learn"], config, roles, {role: path.name for role, path in roles.items()}
        )
        lesson = PlannedLesson(name, learn.path, record["capture"], start.name, record["scene"])
        plans.append(
            Plan(f"learned-{key}", f"the lesson of {record['scene']}", [encode, learn], {}, lesson)
        )
    return plans
