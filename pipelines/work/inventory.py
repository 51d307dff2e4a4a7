"""An inventory of work by scene: stages, bytes, and artifacts that only one scene refers to."""

from __future__ import annotations

import os
import time
from collections import Counter
from itertools import chain
from pathlib import Path

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact
from chebsplat.formats.manifest import Manifest
from chebsplat.pipelines.work import folders, store, summary
from chebsplat.pipelines.work.finished import is_artifact, links, scene_folder, titles
from chebsplat.stages.registry import STAGES

PAGE = "view.html"  # of `chebsplat view`, in a scene's folder


COLUMNS = ("scene", "source", "done", "MB", "alone", "when", "PSNR", "mIoU")


def scenes() -> list[tuple[str, ...]]:
    """A row of COLUMNS for each scene or study in work: MB of its artifacts and their inputs, of
    those that no other needs, and the date of the newest. Damaged artifacts count 0.
    """
    store_paths = store.work().glob("store/*/*")
    manifests = {
        path.name: _manifest(path) for path in store_paths if not path.name.startswith(".")
    }
    reached = {title: _made_of(title, manifests) for title in titles()}
    sizes, times = (
        {key: _size(manifest) for key, manifest in manifests.items()},
        Counter(chain(*reached.values())),
    )
    rows: list[tuple[str, ...]] = []
    for title, keys in reached.items():
        linked = links(store.work() / title)
        newest = max((path / "artifact.json").stat().st_mtime for path in linked.values())
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(newest))
        stages = [stage for stage in linked if stage in STAGES]
        finished = "all" if "report" in linked else " ".join(stages) or f"{len(linked)} artifacts"
        source = (
            _source(title, _manifest(linked["ingest"]) if "ingest" in linked else None)
            if stages
            else ""
        )
        psnr, miou, _ = summary.quality(
            summary.figures(linked["evaluate"]) if "evaluate" in linked else None
        )
        size = sum(sizes[key] for key in keys)
        alone = sum(sizes[key] for key in keys if times[key] == 1)
        rows.append(
            (title, source, finished, f"{size / 1e6:.1f}", f"{alone / 1e6:.1f}", when, psnr, miou)
        )
    return rows


def _manifest(path: Path) -> Manifest | None:
    try:
        return artifact.read_manifest(path)
    except InputError:
        return None


def _size(manifest: Manifest | None) -> int:
    return sum(entry["bytes"] for entry in manifest.files.values()) if manifest else 0


def _source(title: str, ingest: Manifest | None) -> str:
    """A scene's source: the folder behind its name, or its capture's path or preset."""
    try:
        if folder := folders.owner(title.partition("@")[0]):
            return folder
        source = ingest.config["source"] if ingest else {}
        return source["path"] or f"generated {source['preset']}, seed {source['seed']}"
    except (TypeError, KeyError):
        return "damaged"


def in_work(scene: str) -> Path:
    """A scene's folder of links. Raises InputError outside work, ConfigError on an artifact."""
    folder = scene_folder(scene)
    if is_artifact(Path(os.path.expanduser(scene))):
        raise ConfigError(f"{scene} is an artifact; whole scenes are removed: name {folder.name}")
    if folder.absolute().parent.resolve() != store.work().resolve() or folder.is_symlink():
        raise InputError(f"{folder} does not lie in {store.work()}: nothing is removed there")
    return store.work() / folder.name


def list_exclusive(scene_folders: list[Path]) -> list[tuple[Path, int]]:
    """Artifacts, with bytes, that nothing would name without the links in `chosen`."""
    before = {path for path, _ in store.list_unreferenced()}
    return [
        (path, size)
        for path, size in store.list_unreferenced(set(scene_folders))
        if path not in before
    ]


def list_idle(age: float) -> list[Path]:
    """Folders of scenes and studies whose artifacts are all older than so many seconds."""
    link_paths = {title: links(store.work() / title) for title in titles()}
    ours = {
        title: paths
        for title, paths in link_paths.items()
        if set(paths) & set(STAGES) or title.startswith("study-")
    }
    return [
        store.work() / title
        for title, paths in ours.items()
        if min(map(store.age, paths.values())) >= age
    ]


def _made_of(title: str, manifests: dict[str, Manifest | None]) -> set[str]:
    """Keys of the artifacts in the store that a folder's links lead to, directly and as inputs."""
    keys: set[str] = set()
    waiting = [Path(os.path.realpath(link)).name for link in links(store.work() / title).values()]
    while waiting:
        key = waiting.pop()
        if key in keys or key not in manifests:
            continue
        keys.add(key)
        manifest = manifests[key]
        waiting += [entry["key"] for entry in manifest.inputs.values()] if manifest else []
    return keys


def others(folder: Path) -> list[str]:
    """Entries of a scene's folder that are not ours, and are never removed."""
    return sorted(e.name for e in os.scandir(folder) if not e.is_symlink() and e.name != PAGE)


def unlink(folder: Path) -> None:
    """Remove a scene's links and page, and the folder if that leaves it empty."""
    for entry in list(os.scandir(folder)):
        if entry.is_symlink() or entry.name == PAGE:
            os.unlink(entry.path)
    if not others(folder):
        folder.rmdir()
