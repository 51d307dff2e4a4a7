"""Sequences: scenes in order, each starting from the knowledge of those before it."""

from __future__ import annotations

import tomllib
from pathlib import Path

from chebsplat.errors import ConfigError
from chebsplat.pipelines import plan as planning
from chebsplat.pipelines.plan import Plan, Planner


def scenes_of(name: str) -> list[str]:
    """Scenes of a sequence of ours by name, or of a file of the user's that ends in .toml.

    Raises: ConfigError naming the file, or the nearest sequence's name.
    """
    try:
        text = Path(name).expanduser().read_text() if name.endswith(".toml") else None
        values = planning.read_toml("sequences", name) if text is None else tomllib.loads(text)
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{name}: {error}") from None
    scenes = values.get("scenes")
    if set(values) != {"scenes"} or not scenes or not all(isinstance(scene, str) for scene in scenes):
        raise ConfigError(f'sequence {name}: it says scenes = ["...", ...], and nothing else')
    return list(scenes)


def chain(planner: Planner, name: str, settings: str = "", ablation: str = "", length: int | None = None) -> list[Plan]:
    """Plans of the first `length` scenes of a sequence; the basis of each is what its `cks` step makes.

    Choices: a scene that has no knowledge to give (no encoder) passes on the basis that it was given.
    """
    found: list[Plan] = []
    basis: Path | None = None
    for place, scene in enumerate(scenes_of(name)[:length], start=1):
        plan = planner.plan(scene, settings, ablation, basis, keep_knowledge=True)
        plan.title = f"{Path(name).stem}-{place}-{plan.title}"
        basis = plan.targets.get("cks", basis)
        found.append(plan)
    return found
