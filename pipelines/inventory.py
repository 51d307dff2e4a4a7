"""What lies in work, by scene: what was done, how much it takes, and what only one scene names."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError, InputError
from chebsplat.pipelines import folders, store, summary
from chebsplat.pipelines.finished import is_artifact, links, scene_folder, titles
from chebsplat.stages.registry import STAGES

QUERIES = "query"  # answers of `chebsplat query`, in a scene's folder


@dataclass(frozen=True)
class Scene:
    """One folder of links. size: bytes of the artifacts that it names; when: the newest of them, seconds since 1970."""

    title: str
    source: str
    stages: list[str]
    size: int
    when: float
    psnr: str
    miou: str

    def row(self) -> tuple[str, ...]:
        done = "all" if "report" in self.stages else " ".join(self.stages)
        day = time.strftime("%Y-%m-%d %H:%M", time.localtime(self.when))
        return self.title, self.source, done, f"{self.size / 1e6:.1f}", day, self.psnr, self.miou


def scenes() -> list[Scene]:
    """Those in work, each as far as it can be read; what is damaged counts nothing."""
    rows = []
    for title in titles():
        artifacts = {stage: path for stage, path in links(store.work() / title).items() if stage in STAGES}
        if not artifacts:
            continue
        manifests = {stage: _manifest(path) for stage, path in artifacts.items()}
        size = sum(_size(manifest) for manifest in manifests.values())
        when = max((path / "artifact.json").stat().st_mtime for path in artifacts.values())
        psnr, miou, _ = summary.quality(summary.figures(artifacts["evaluate"]) if "evaluate" in artifacts else None)
        rows.append(Scene(title, _source(title, manifests.get("ingest")), list(artifacts), size, when, psnr, miou))
    return rows


def _manifest(path: Path) -> Any:
    try:
        return json.loads((path / "artifact.json").read_text())
    except (OSError, ValueError, RecursionError):
        return None


def _size(manifest: Any) -> int:
    try:
        return sum(int(entry["bytes"]) for entry in manifest["files"].values())
    except (TypeError, KeyError, AttributeError, ValueError):
        return 0


def _source(title: str, ingest: Any) -> str:
    """Where a scene comes from: the folder that its name stands for, or what its capture was made of."""
    try:
        if folders.record(name := title.partition("@")[0]).exists():
            return folders.owner(name) or ""
        source = ingest["config"]["source"]
        return source["path"] or f"generated {source['preset']}, seed {source['seed']}"
    except (InputError, TypeError, KeyError):
        return "damaged"


def in_work(scene: str) -> Path:
    """A scene's folder of links. Raises InputError if it lies elsewhere: nothing is removed there; ConfigError if an
    artifact is named.
    """
    folder = scene_folder(scene)
    if is_artifact(Path(os.path.expanduser(scene))):
        raise ConfigError(f"{scene} is an artifact; whole scenes are removed: name {folder.name}")
    if folder.absolute().parent.resolve() != store.work().resolve() or folder.is_symlink():
        raise InputError(f"{folder} does not lie in {store.work()}: nothing is removed there")
    return store.work() / folder.name


def only_of(chosen: list[Path]) -> list[tuple[Path, int]]:
    """Artifacts, with bytes, that nothing would name without the links in `chosen`."""
    before = {path for path, _ in store.unnamed()}
    return [(path, size) for path, size in store.unnamed(set(chosen)) if path not in before]


def untouched(age: float) -> list[Path]:
    """Folders of scenes and studies whose artifacts are all older than so many seconds."""
    found = {title: links(store.work() / title) for title in titles()}
    ours = {title: paths for title, paths in found.items() if set(paths) & set(STAGES) or title.startswith("study-")}
    return [store.work() / title for title, paths in ours.items() if min(map(store.age, paths.values())) >= age]


def usage() -> tuple[list[tuple[str, int, int]], list[tuple[str, int, int]]]:
    """What artifacts take: (stage, how many, bytes), and (folder of links, bytes, of it alone), the largest first.

    What a folder takes is what its links name, and all that this was made of.
    """
    paths = [path for path in store.work().glob("store/*/*") if not path.name.startswith(".")]
    manifests = {path.name: _manifest(path) for path in paths}
    sizes = {key: _size(manifest) for key, manifest in manifests.items()}
    stages: dict[str, list[int]] = {}
    for path in paths:
        stages.setdefault(path.parent.name, []).append(sizes[path.name])
    reached = {title: _made_of(title, manifests) for title in titles()}
    times = Counter(key for keys in reached.values() for key in keys)
    scenes = [
        (title, sum(sizes[key] for key in keys), sum(sizes[key] for key in keys if times[key] == 1))
        for title, keys in reached.items()
    ]
    by_size = sorted(((stage, len(found), sum(found)) for stage, found in stages.items()), key=lambda row: -row[2])
    return by_size, sorted(scenes, key=lambda row: -row[1])


def _made_of(title: str, manifests: dict[str, Any]) -> set[str]:
    """Keys of the artifacts in the store that a folder's links lead to, directly and as inputs."""
    found: set[str] = set()
    waiting = [Path(os.path.realpath(link)).name for link in links(store.work() / title).values()]
    while waiting:
        key = waiting.pop()
        if key in found or key not in manifests:
            continue
        found.add(key)
        inputs = manifests[key].get("inputs") if isinstance(manifests[key], dict) else None
        entries = inputs.values() if isinstance(inputs, dict) else ()
        waiting += [str(entry["key"]) for entry in entries if isinstance(entry, dict) and "key" in entry]
    return found


def others(folder: Path) -> list[str]:
    """What lies in a scene's folder and is none of ours; it is never removed."""
    return sorted(e.name for e in os.scandir(folder) if not e.is_symlink() and e.name != QUERIES)


def unlink(folder: Path) -> None:
    """Remove a scene's links and queries, and the folder if that leaves it empty."""
    for entry in list(os.scandir(folder)):
        if entry.is_symlink():
            os.unlink(entry.path)
    if not (folder / QUERIES).is_symlink():
        shutil.rmtree(folder / QUERIES, ignore_errors=True)
    if not others(folder):
        folder.rmdir()
