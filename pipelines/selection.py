"""Plans for a command or a call from Python: of a scene or a sequence, up to a stage."""

from __future__ import annotations

from chebsplat.errors import ConfigError
from chebsplat.formats.names import suggest
from chebsplat.pipelines.planning import sequences
from chebsplat.pipelines.planning.plan import Overrides, Plan, Planner, merged, overrides
from chebsplat.pipelines.work.scenes import beside
from chebsplat.stages.registry import STAGES


def plans(
    scene: str | None,
    sequence: str | None,
    settings: Overrides,
    ablation: str,
    running: bool = False,
    device: str = "cpu",
    knowledge: str = "",
    newer: bool = False,
    quality: str = "",
) -> list[Plan]:
    """The plan of a scene, or the plans of a sequence.

    scene: of a scene of ours and a folder beside that are called alike, the folder; knowledge:
    `knowledge.start`, if any; newer, quality: as of `Planner`.
    """
    if (scene is None) == (sequence is None):
        raise ConfigError("name one of scene= and sequence=")
    if knowledge:
        settings = merged(overrides(settings), {"knowledge": {"start": knowledge}})
    planner = Planner(running=running, device=device, newer=newer, quality=quality)
    try:
        if sequence is not None:
            return sequences.plan_sequence(planner, sequence, settings, ablation)
        return [planner.plan(beside(str(scene)), settings, ablation)]
    finally:
        planner.save()


def checked_stage(stage: str | None, scene_plans: list[Plan]) -> str | None:
    """`stage`, if the plans have it. Raises ConfigError on one that is unknown or left out."""
    if stage is None:
        return None
    if stage not in STAGES:
        near = suggest(stage, STAGES, 1)
        raise ConfigError(
            f"no stage is called {stage}" + (f"; did you mean {near[0]}?" if near else "")
        )
    for plan in scene_plans:
        if stage not in plan.targets:
            raise ConfigError(
                f"{plan.title} leaves out {stage}: {plan.left_out.get(stage, 'not needed')}"
            )
    return stage
