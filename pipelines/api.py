"""The Python interface, as of the command: open a scene, bring it up to date, run one stage."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from chebsplat.errors import ChebsplatError, ConfigError
from chebsplat.formats.names import suggest
from chebsplat.formats.scene import Scene
from chebsplat.pipelines.running.run import device_of, execute
from chebsplat.pipelines.selection import plans
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.finished import artifact_of, teacher_of
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.command import publish
from chebsplat.stages.tools.scene import Camera, OpenedScene, Picture

__all__ = ["Camera", "OpenedScene", "Picture", "load", "run_stage", "train"]


def load(scene: str | Path) -> OpenedScene:
    """Open a finished scene.

    Args: scene: its name, its photo folder, its folder in `work`, or an `export` artifact.
    Raises: ConfigError or InputError, which name what is missing and the remedy.
    """
    return OpenedScene(
        Scene.read(artifact_of(str(scene), "export")), Path(scene), teacher_of(str(scene))
    )


def train(
    capture: str | Path,
    *,
    ablation: str = "",
    cores: int | None = None,
    device: str = "auto",
    **settings: dict[str, Any],
) -> OpenedScene:
    """Bring a scene up to date from photos to report, computing only what is stale, and open it.

    Args:
      capture:  a folder of photos or another source, or the name of a scene.
      ablation: a named set of settings; cores: default: all.
      settings: sections of settings by name, as `train={"steps": 1000}` (`chebsplat settings` lists
        them).
    Raises: ConfigError or InputError before anything runs; ChebsplatError if a stage fails, whose
      log says why.
    """
    computing_device = device_of(device)
    scene_plans = plans(
        str(capture), None, settings, ablation, running=True, device=computing_device
    )
    if execute(scene_plans, None, cores or os.cpu_count() or 1, computing_device):
        raise ChebsplatError(
            f"{capture} could not be finished; the lines above name the stage and its log"
        )
    return load(store.work() / scene_plans[-1].title)


def run_stage(
    name: str,
    out: str | Path,
    inputs: Mapping[str, str | Path] | None = None,
    **settings: dict[str, Any],
) -> Path:
    """Run one stage in this process and publish its artifact at `out`, unless it is there.

    Args: name: of a stage; inputs: artifacts by role (`chebsplat STAGE --help` lists them);
      settings: sections by name.
    Raises: ConfigError, InputError, DataFailure.
    """
    if name not in STAGES:
        near = suggest(name, STAGES, 1)
        raise ConfigError(
            f"no stage is called {name}" + (f"; did you mean {near[0]}?" if near else "")
        )
    stage, artifacts = STAGES[name], {role: Path(path) for role, path in (inputs or {}).items()}
    required = {role for role, _ in stage.inputs}
    if unfit := sorted(required - artifacts.keys()) or sorted(
        artifacts.keys() - stage.roles.keys()
    ):
        raise ConfigError(f"{name} {'needs' if unfit[0] in required else 'does not read'} "
                          f"inputs[{unfit[0]!r}]; "
                          f"it needs {', '.join(sorted(required)) or 'none'}")  # fmt: skip
    with TemporaryDirectory() as folder:
        config = Path(folder) / "settings.json"
        config.write_text(json.dumps(settings))
        publish(name, import_module(f"chebsplat.stages.{name}").run, Path(out), artifacts, config)
    return Path(out)
