"""Raw files, which stages read outside the store: their hashes, and a check for changes."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats import dataparser
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.files import regular
from chebsplat.formats.images import images_below
from chebsplat.formats.splats import splat_file
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher

# ns, coarser than any file system's clock: a younger file may change without a new time stamp
SETTLED = 2_000_000_000
Hashes = dict[str, list[Any]]  # path -> [stamp, sha256, older than SETTLED when it was read]


def raw_files(stage: str, sections: dict[str, Any]) -> tuple[Path | None, list[Path]]:
    """The files that a stage reads with these settings, and their folder (None: names alone count).

    Raises: InputError if there are none where there must be.
    """
    if stage in ("pose", "ingest"):
        root, files = _of_source(sections["source"])
        volumes = sections.get("ingest", {}).get("volumes")
        return root, [*files, _named(volumes, "ingest.volumes")] if volumes else files
    if stage == "channels" and sections["channels"]["model"]:
        return None, _of_channels(sections["channels"])
    if stage == "teacher" and sections["teacher"]["model"]:
        return None, _of_teacher(sections["teacher"])
    if stage == "train" and sections["train"]["start"]:
        start = splat_file(Path(sections["train"]["start"]))
        return None, [path for path in (start, dataparser.beside(start)) if path is not None]
    if stage == "learn" and sections["learn"]["points"]:
        return None, [_named(sections["learn"]["points"], "learn.points")]
    if stage == "teach":
        return None, read_teacher(Path(sections["teach"]["model"] or EMBEDDED)).files()
    if stage == "evaluate" and sections["evaluate"]["lpips_weights"]:
        return None, [_named(sections["evaluate"]["lpips_weights"], "evaluate.lpips_weights")]
    return None, []


def _of_source(source: dict[str, Any]) -> tuple[Path | None, list[Path]]:
    """The files of photos and what belongs to them, and their folder."""
    if source["kind"] == "generated":
        return None, []
    folder, kind = Path(source["path"]), source["kind"]
    if kind == "video" and not folder.is_dir():
        return folder.parent, [folder]
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; correct source.path")
    return folder, import_module(f"chebsplat.stages.sources.{kind}").files(folder)


def _of_teacher(settings: dict[str, Any]) -> list[Path]:
    """The model's files, and the file of labels."""
    labels = [_named(settings["labels"], "teacher.labels")] if settings["labels"] else []
    return [*read_teacher(Path(settings["model"])).files(), *labels]


def _of_channels(settings: dict[str, Any]) -> list[Path]:
    """The model's files, its channel map's if any, and the reference images; none of a scene's."""
    folder = settings["reference"]
    images = images_below(Path(folder), "correct channels.reference") if folder else []
    teacher = read_teacher(Path(settings["model"]))
    brought = sorted(path for path in teacher.channels.rglob("*") if path.is_file())
    return [*teacher.files(), *brought, *images]


def _named(path: str, setting: str) -> Path:
    regular(Path(path), f"correct {setting}")
    return Path(path)


def hashes(files: Iterable[Path], memo: dict[str, Any]) -> Hashes:
    """Stamp and content hash of each file; one whose stamp `memo` holds is not read again.

    Choices: the stamp holds the time of the last change of content or name (ctime), which no user
      can set, unlike that of modification. A file that has changed just now could change again
      within the same tick of that clock: it is not remembered.
    """
    entries: Hashes = {}
    for path in files:
        now, state = time.time_ns(), regular(path)
        stamp = [state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns]
        entry = memo.get(str(path))
        if not (
            isinstance(entry, list)
            and len(entry) == 3
            and entry[0] == stamp
            and isinstance(entry[1], str)
        ):
            entry = [stamp, sha256_file(path), now - state.st_ctime_ns > SETTLED]
            if entry[2]:
                memo[str(path)] = entry
        entries[str(path)] = entry
    return entries


def content_hash(entries: Hashes, root: Path | None) -> str:
    """One hash of files: their contents, and their paths below `root`, which tell a label from a
    depth image; of a file elsewhere its name.
    """
    total = hashlib.sha256()
    for path, (_, digest, _) in entries.items():
        below = root is not None and Path(path).is_relative_to(root)
        name = os.path.relpath(path, root).replace(os.sep, "/") if below else os.path.basename(path)
        total.update(os.fsencode(f"{name} {digest}\n"))
    return total.hexdigest()[:16]


@contextmanager
def unchanged(stage: str, sections: dict[str, Any], planned: Hashes) -> Iterator[None]:
    """Check before and after the block that a stage's raw files are those that its key hashes.

    Raises: InputError naming a file that has changed, is new or gone.
    """
    memo = {path: entry for path, entry in planned.items() if entry[2]}

    def check() -> None:
        now = hashes(raw_files(stage, sections)[1], memo)
        for path in (*planned, *now):
            if path not in now or path not in planned or now[path][1] != planned[path][1]:
                what = (
                    "is gone"
                    if path not in now
                    else "is new"
                    if path not in planned
                    else "has changed"
                )
                raise InputError(f"{path} {what} since the run was planned; run again")

    check()
    yield
    check()
