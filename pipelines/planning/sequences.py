"""Plans of more than a scene: scenes in order, each with the knowledge of the one before; what teaches knowledge."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError
from chebsplat.formats.names import unprintable
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.pipelines.planning.plan import Overrides, Plan, Planner, merged, overrides, placed
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
        raise ConfigError(f'sequence {name}: it says scenes = ["...", ...], at most {LONGEST}, and nothing else')
    for scene in scenes:
        if not isinstance(scene, str) or not scene or unprintable(scene):
            raise ConfigError(f"sequence {name}: scenes: {scene!r:.60} is no scene's name")
    return scenes


def chain(planner: Planner, name: str, settings: Overrides = "", ablation: str = "") -> list[Plan]:
    """Plans of a sequence's scenes, each of whose trainings reads that of the scene before.

    Raises: ConfigError without the ablation `paper`, whose printed form alone carries knowledge.
    """
    scenes = scenes_of(name)
    if ablation != "paper":
        raise ConfigError("sequences carry knowledge in the paper's printed form only; add ablation=paper")
    found: list[Plan] = []
    for place, scene in enumerate(scenes, start=1):
        plan = planner.plan(scene, settings, ablation, earlier=found[-1].targets["train"] if found else None)
        plan.title = f"{Path(name).stem}-{place}-{plan.title}"
        found.append(plan)
    return found


def teaching(planner: Planner, model: Path | None, settings: str = "") -> Plan:
    """The steps that teach knowledge for a teacher, the embedded one if none is named.

    Raises: ConfigError on a closed-set teacher, whose classes no shape is taught.
    """
    file = (model or EMBEDDED).expanduser().resolve()
    teacher = read_teacher(file)
    if teacher.output != "features":
        raise ConfigError(f"{teacher.settings}: output is {teacher.output}; knowledge is taught in features")
    of: dict[str, Any] = {"channels": {"model": str(file)}, "knowledge": {"model": str(file)} if model else {}}
    config = placed(configs.build(merged(of, overrides(settings)), f"knowledge for {teacher.name}"))
    channels = planner.step(STAGES["channels"], config, {}, {})
    inputs = {"channels": channels.path}
    teach = planner.step(STAGES["teach"], config, inputs, {"channels": channels.key})
    return Plan(f"knowledge-{teacher.name}", f"knowledge for the teacher {teacher.name}", [channels, teach])
