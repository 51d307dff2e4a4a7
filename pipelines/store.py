"""The work folder: artifacts by key, links for people, remembered hashes, and the collection of what nothing names."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def work() -> Path:
    """Where everything lies: CHEBSPLAT_WORK, or ./work."""
    return Path(os.environ.get("CHEBSPLAT_WORK") or "work").absolute()


def artifact_path(stage: str, key: str) -> Path:
    return work() / "store" / stage / key


def is_fresh(path: Path) -> bool:
    """Finished; damage inside is found by the stage that reads it, or by `chebsplat verify`."""
    return (path / "artifact.json").is_file()


class Memo:
    """A small JSON file of remembered results; losing it costs time, never correctness."""

    def __init__(self, name: str):
        self.path = work() / ".cache" / f"{name}.json"
        try:
            self.values: dict[str, Any] = json.loads(self.path.read_text())
        except (OSError, ValueError):
            self.values = {}
        self._before = json.dumps(self.values, sort_keys=True)

    def save(self) -> None:
        text = json.dumps(self.values, sort_keys=True)
        if text != self._before:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            tmp = self.path.with_suffix(f".{os.getpid()}")
            tmp.write_text(text)
            os.replace(tmp, self.path)


def content_hash(files: Iterable[Path], memo: dict[str, Any]) -> str:
    """One hash of the files' names and contents; a file is read again only if its time or size changed."""
    total = hashlib.sha256()
    for path in files:
        state = path.stat()
        stamp, key = [state.st_mtime_ns, state.st_size], str(path)
        held = memo.get(key)
        if held is None or held[0] != stamp:
            with path.open("rb") as handle:
                held = memo[key] = [stamp, hashlib.file_digest(handle, "sha256").hexdigest()]
        total.update(f"{path.name} {held[1]}\n".encode())
    return total.hexdigest()[:16]


def link(scene: str, targets: dict[str, Path]) -> Path:
    """Point `work/<scene>/<stage>` at the artifacts; stages that are left out lose their link."""
    folder = work() / scene
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        if old.is_symlink() and old.name not in targets:
            old.unlink()
    for stage, target in targets.items():
        relative = os.path.relpath(target, folder)
        place = folder / stage
        if place.is_symlink() and os.readlink(place) == relative:
            continue
        fresh = folder / f".{stage}-{os.getpid()}"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(relative)
        os.replace(fresh, place)
    return folder


def unnamed() -> list[tuple[Path, int]]:
    """Artifacts that no link reaches, neither directly nor as an input, and leftovers of killed runs; with bytes."""
    base = work()
    if not (base / "store").is_dir():
        return []
    waiting = [p.resolve() for p in base.glob("*/*") if p.is_symlink()]
    by_key = {p.name: p.resolve() for p in base.glob("store/*/*") if not p.name.startswith(".")}
    named: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path in named or not is_fresh(path):
            continue
        named.add(path)
        inputs = json.loads((path / "artifact.json").read_text()).get("inputs", {})
        waiting += [by_key[entry["key"]] for entry in inputs.values() if entry["key"] in by_key]
    found = [p for p in sorted(base.glob("store/*/*")) if p.resolve() not in named and not _in_use(p)]
    return [(p, sum(f.stat().st_size for f in p.rglob("*") if f.is_file())) for p in found]


def _in_use(path: Path) -> bool:
    """A hidden folder of a running process, or younger than an hour."""
    if not path.name.startswith("."):
        return False
    owner = path.name.rsplit("-", 1)[-1]
    if path.name.startswith(".tmp-") and owner.isdigit() and Path(f"/proc/{owner}").exists():
        return True
    return path.name.startswith(".part-") and time.time() - path.stat().st_mtime < 3600


def remove(path: Path) -> None:
    (path / "artifact.json").unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)
