"""Scenes: ours, which have a name and a config, and the user's folders."""

from __future__ import annotations

import logging
import os
import re
import tomllib
from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.files import parse_toml
from chebsplat.formats.names import suggest
from chebsplat.formats.videos import is_video
from chebsplat.pipelines.work.store import is_name
from chebsplat.stages.sources.common import detect

log = logging.getLogger("chebsplat")

CONFIGS = Path(__file__).parents[1] / "configs"
ONE = {
    "scenes": "scene",
    "qualities": "quality",
    "ablations": "ablation",
    "sequences": "sequence",
    "studies": "study",
}
VARIABLE = re.compile(r"\$\{(\w+):-([^}]*)\}")  # ${NAME:-default}


def names(kind: str) -> list[str]:
    """Names of our configs of a kind (scenes, qualities, ablations, sequences, studies), sorted."""
    return sorted(path.stem for path in (CONFIGS / kind).glob("*.toml"))


def read_toml(kind: str, name: str) -> dict[str, Any]:
    """A config of ours. Raises ConfigError with the nearest names."""
    if name not in names(kind):
        near = suggest(name, names(kind)) or names(kind)
        raise ConfigError(
            f"no {ONE[kind]} is called {escape_text(name)}; did you mean {', '.join(near)}?"
        )
    return tomllib.loads((CONFIGS / kind / f"{name}.toml").read_text())


def read_named(kind: str, name: str) -> dict[str, Any]:
    """A config of ours by name, or a user's .toml file, whose name becomes that of the links.

    Raises ConfigError naming the file, or the nearest names.
    """
    if not is_name(Path(name).stem):
        raise ConfigError(f"no {ONE[kind]} can be called {name}: its links lie in the work folder")
    if name.endswith(".toml"):
        return parse_toml(Path(os.path.expanduser(name)), "correct it", ConfigError)
    return read_toml(kind, name)


def escape_text(text: str) -> str:
    """A user's input as a message can hold it: printable, in one line, at most 200 characters."""
    return text if text.isprintable() and 0 < len(text) <= 200 else f"{text[:80]!a}"


def expand_variables(text: str) -> str:
    """`${NAME:-default}` by the environment."""
    return VARIABLE.sub(lambda match: os.environ.get(match[1]) or match[2], text)


def beside(scene: str) -> str:
    """The scene, or with a warning the folder or video beside that has the same name."""
    if scene not in names("scenes") or not is_source(scene):
        return scene
    log.warning(
        "%s is taken to be the folder here, not chebsplat's scene of this name; for that run "
        "elsewhere, with CHEBSPLAT_WORK, or rename the folder",
        scene,
    )
    return f"./{scene}"


def folder_of(scene: str) -> Path | None:
    """The folder or video that `scene` names, absolute; None for a scene of ours.

    Raises: InputError if there is no such folder.
    """
    if not scene:
        raise ConfigError("scene= is empty; name a scene or a folder")
    folder = Path(os.path.expanduser(scene))
    if (
        "/" not in scene
        and scene not in (".", "..")
        and (scene in names("scenes") or not is_source(folder))
    ):
        return None
    if not is_source(folder):
        raise InputError(f"{escape_text(scene)} is not a folder; correct scene=")
    return Path(os.path.realpath(folder))


def is_source(path: str | Path) -> bool:
    """True for a folder, or the file of a video; no path is too long for this."""
    return os.path.isdir(path) or (is_video(os.path.basename(path)) and os.path.isfile(path))


def scene_values(scene: str) -> tuple[str, dict[str, Any]]:
    """(name, config values) of a named scene, or of a folder of photos, a COLMAP model, a video.

    The name is part of what is computed, and the same wherever a folder lies; its links' may be
    longer (`folders`).
    """
    folder = folder_of(scene)
    if folder is not None:
        name = folder_name(folder)
        return name, {
            "scene": {"name": name},
            "source": {"kind": detect(folder), "path": str(folder)},
        }
    values = read_toml("scenes", scene)
    values.setdefault("scene", {})["name"] = scene
    return scene, values


def folder_name(folder: Path) -> str:
    """A source's name: the last part of its path, and those above it up to one with a letter."""
    parts = (folder.with_suffix("") if is_video(folder.name) else folder).parts[1:]
    # "dense/0" is not named "0"
    words = next((k for k in range(1, len(parts)) if re.search(r"[a-zA-Z]", parts[-k])), 1)
    return re.sub(r"[^\w.-]+", "-", "-".join(parts[-words:])).lstrip(".") or "scene"


def data_of(scene: str) -> tuple[str, Path] | None:
    """(environment variable, folder) of external data that a scene of ours needs, or None."""
    path = (
        read_toml("scenes", scene).get("source", {}).get("path", "")
        if scene in names("scenes")
        else ""
    )
    if match := VARIABLE.match(path):
        return match[1], Path(os.path.realpath(os.path.expanduser(expand_variables(path))))
    return None


def missing_source(scene: str, folder: Path) -> InputError:
    """The error for a missing source, with its remedy."""
    needed = data_of(scene)
    if needed is None or needed[1] != folder:
        return InputError(f"{folder} is not a folder; correct source.path")
    lack = f"{scene} needs data that is no part of chebsplat: {folder} is not a folder"
    below = read_toml("scenes", scene)["source"]["path"].partition("}/")[2] or folder.name
    return InputError(f"{lack}; set {needed[0]} to the folder that holds {below}")
