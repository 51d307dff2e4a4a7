"""Plans that a command or a call from Python asks for: of a scene or a sequence, up to a stage."""

from __future__ import annotations

from typing import Any

from chebsplat.errors import ConfigError
from chebsplat.formats.names import suggest
from chebsplat.pipelines.bases import revisions
from chebsplat.pipelines.planning import sequences
from chebsplat.pipelines.planning.plan import Overrides, Planner, suffix, with_setting
from chebsplat.stages.registry import STAGES


def plans(
    scene: str | None,
    sequence: str | None,
    settings: Overrides,
    ablation: str,
    basis: str,
    running: bool = False,
    device: str = "cpu",
) -> list[Any]:
    """The plan of a scene, after those of the scenes that its basis comes from, or the plans of a sequence."""
    if (scene is None) == (sequence is None):
        raise ConfigError("name one of scene= and sequence=")
    if sequence is not None and basis:
        raise ConfigError("a sequence starts from nothing; basis= goes with scene=")
    planner = Planner(running=running, device=device)
    try:
        if sequence is not None:
            return sequences.chain(planner, sequence, settings, ablation)
        if basis == "none":
            settings = with_setting(settings, "refine", "knowledge", "none")
        if basis in ("", "none"):
            return [planner.plan(str(scene), settings, ablation)]
        earlier, path, name = revisions.before(planner, basis, settings, ablation)
        plan = planner.plan(str(scene), settings, ablation, path)
        plan.title += ("+" if ablation or suffix(settings) else "@") + f"basis={name}"
        for one in earlier:
            one.asked = False
        return [*earlier, plan]
    finally:
        planner.save()


def checked_stage(stage: str | None, chosen: list[Any]) -> str | None:
    """Raises ConfigError for a stage that does not exist or that this scene leaves out."""
    if stage is None:
        return None
    if stage not in STAGES:
        near = suggest(stage, STAGES, 1)
        raise ConfigError(f"no stage is called {stage}" + (f"; did you mean {near[0]}?" if near else ""))
    for plan in chosen:
        if plan.asked and stage not in plan.targets:
            raise ConfigError(f"{plan.title} leaves out {stage}: {plan.left_out.get(stage, 'not needed')}")
    return stage
