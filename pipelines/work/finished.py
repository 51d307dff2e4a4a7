"""Finished scenes by a user's name for them: scene, photos' folder, links, artifact."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from shlex import quote

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.names import suggest
from chebsplat.formats.splats import is_splat
from chebsplat.pipelines.work import folders, store
from chebsplat.pipelines.work.scenes import escape_text, is_source, names
from chebsplat.stages.registry import STAGES


def is_artifact(path: Path) -> bool:
    """True where a folder holds a manifest."""
    return os.path.isfile(path / "artifact.json")


def links(folder: Path) -> dict[str, Path]:
    """Artifacts that a folder links to, in order of stages; its other entries are ignored."""
    try:
        stages = [entry.name for entry in os.scandir(folder) if is_artifact(Path(entry.path))]
    except OSError:
        return {}
    order = list(STAGES)
    stages.sort(key=lambda name: (order.index(name) if name in order else len(order), name))
    return {name: folder / name for name in stages}


def titles() -> list[str]:
    """Names of the folders of links in work: of scenes with their settings, sequences, studies."""
    base = store.work()
    there = sorted(os.listdir(base)) if os.path.isdir(base) else []
    return [
        name
        for name in there
        if not name.startswith(".") and name != "store" and links(base / name)
    ]


def scene_folder(scene: str) -> Path:
    """The folder of a finished scene's links.

    Raises: ConfigError with the nearest names, or if several are meant; InputError for a path that
      leads to none.
    """
    path = Path(os.path.expanduser(scene))
    if "/" not in scene and links(store.work() / scene):
        return store.work() / scene
    if is_artifact(path):
        if folder := holder(path):
            return folder
        raise InputError(f"{path} belongs to no scene in {store.work()}; name the scene")
    if links(path):
        return path
    name = folders.name_of(Path(os.path.realpath(path))) if is_source(path) else scene
    runs = [title for title in titles() if title.partition("@")[0] == name]
    if len(runs) == 1 or name in runs:
        return store.work() / (name if name in runs else runs[0])
    if runs:
        raise ConfigError(
            f"{escape_text(scene)} was run with different settings: name one of {', '.join(runs)}"
        )
    raise unknown_scene(scene)


def holder(artifact: Path) -> Path | None:
    """The scene that an artifact belongs to; None if no links of a scene name it."""
    if artifact.is_symlink() and artifact.name in STAGES:
        return artifact.parent
    real = artifact.resolve()
    for title in titles():
        if any(
            link.resolve() == real
            for stage, link in links(store.work() / title).items()
            if stage in STAGES
        ):
            return store.work() / title
    return None


def unknown_scene(scene: str) -> ConfigError | InputError:
    """The error for a scene that is not there, with the nearest names."""
    where = f"no finished scene in {store.work()}"
    run = f"run it first: make scene={quote(escape_text(scene))}"
    if is_splat(path := os.path.expanduser(scene)) and os.path.exists(path):
        return InputError(
            f"{escape_text(scene)} is a splat and {where}; make one of it: chebsplat lift "
            f"{quote(escape_text(scene))} --out ..."
        )
    if is_source(os.path.expanduser(scene)):
        return InputError(f"{escape_text(scene)} is {where}, nor the folder of one; {run}")
    if "/" in scene:
        word = "is" if os.path.lexists(os.path.expanduser(scene)) else "is missing:"
        return InputError(
            f"{escape_text(scene)} {word} neither a scene, its folder nor an artifact; "
            "correct the path"
        )
    existing = titles()
    near = suggest(scene, existing) or existing[:8]
    if near and scene not in names("scenes"):
        return ConfigError(
            f"{escape_text(scene)} is {where}, and no folder of one; there is {', '.join(near)}"
        )
    return ConfigError(f"{escape_text(scene)} is {where}, and no folder of one; {run}")


def artifact_of(scene: str, stage: str) -> Path:
    """A scene's artifact of a stage; a path of an artifact is returned unchecked.

    Raises: as `scene_folder`; ConfigError if the scene has no such artifact.
    """
    if path := _named(scene):
        return path
    folder = scene_folder(scene)
    if not is_artifact(folder / stage):
        run = f"run it to its end: make scene={quote(escape_text(folder.name.partition('@')[0]))}"
        raise ConfigError(f"{folder} has no {stage}: it is not finished, or leaves that out; {run}")
    return folder / stage


def teacher_of(scene: str) -> Path | None:
    """A scene's `features` artifact; None without semantics, or outside a scene in `work`."""
    with suppress(ConfigError, InputError):
        path = scene_folder(scene) / "teacher"
        return path if is_artifact(path) else None
    return None


def artifacts(scene: str) -> list[Path]:
    """All that a scene's links name, or the artifact alone that is named."""
    path = _named(scene)
    return [path] if path else list(links(scene_folder(scene)).values())


def _named(scene: str) -> Path | None:
    """The artifact that is named itself, if one is rather than a scene."""
    path = Path(os.path.expanduser(scene))
    is_scene = "/" not in scene and links(store.work() / scene)
    return path if is_artifact(path) and not is_scene else None
