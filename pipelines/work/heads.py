"""Sets of lessons from earlier scenes, and the lessons that a scene is pinned to.

A set is a folder of the work folder, `.heads/NAME`, with a copy of every lesson under its key, and
beside it a record of its photos, encoder and scene. A lesson is added by a rename, so that any
number of processes add at once, in any order, to the same set; none is ever changed.
"""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact, lesson
from chebsplat.formats.files import atomic_write, parse_json
from chebsplat.formats.names import suggest
from chebsplat.pipelines.work import store

ROOMS = "rooms"  # the set that scenes start from and add to
PIN = "pin.json"
FORGOTTEN = "forgotten"
REMEDY = "remove it: the scene's next run adds its lesson again"
RECORD = ("capture", "start", "scene", "date")


def now() -> str:
    """The time in UTC, by which lessons of the same photos are ordered."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def folder(name: str) -> Path:
    """Path of the set of this name. Raises ConfigError on a name that leads elsewhere."""
    if not store.is_name(name):
        raise ConfigError(
            f"{name!r} cannot name a set of lessons: no / in it, and no . at its beginning"
        )
    return store.work() / ".heads" / name


def members(name: str) -> dict[str, dict[str, Any]]:
    """Records of a set's lessons by key: identity of the photos (`capture`), key of the encoder
    (`start`), scene, date. Raises InputError naming a damaged record.
    """
    records = {}
    for path in sorted(folder(name).glob("[!.]*.json")):
        place = path.with_suffix("")
        record = _record(place)
        if store.is_fresh(place) and FORGOTTEN not in record:
            if not set(RECORD) <= set(record):
                raise InputError(f"{path} is no record of a lesson; {REMEDY}")
            records[path.stem] = record
    return records


def _record(place: Path) -> dict[str, Any]:
    """The record beside a lesson; empty without one. Raises InputError where it is damaged."""
    path = place.with_suffix(".json")
    record = parse_json(path, REMEDY) if path.is_file() else {}
    if not isinstance(record, dict):
        raise InputError(f"{path} is no record of a lesson; {REMEDY}")
    return record


def add(name: str, path: Path, capture: str, start: str, scene: str) -> None:
    """Copy a finished lesson into a set, unless it has no sums, is there, or was forgotten.

    Args: path: the artifact, whose folder bears its key; capture: identity of the photos; start:
      key of the encoder.
    """
    place = folder(name) / path.name
    if store.is_fresh(place) or "none" in lesson.read_notes(path) or FORGOTTEN in _record(place):
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    values = (capture, start, scene, now())
    atomic_write(place.with_suffix(".json"), json.dumps(dict(zip(RECORD, values, strict=True))))
    artifact.copy(path, place, artifact.verify(path, lesson.SCHEMA))


def forget(name: str, key: str) -> None:
    """Take a lesson out of a set. Raises ConfigError with the nearest key where it is unknown."""
    lessons = members(name)
    if key not in lessons:
        near = suggest(key, lessons, 1)
        raise ConfigError(
            f"{name} has no lesson {key}" + (f"; did you mean {near[0]}?" if near else "")
        )
    place = folder(name) / key
    # so that no run of the scene adds it again
    atomic_write(place.with_suffix(".json"), json.dumps({FORGOTTEN: True}))
    (place / "artifact.json").unlink()
    shutil.rmtree(place)


def usable(name: str, start: str, capture: str, scene: str) -> list[str]:
    """Keys of a set's lessons for an encoder, of other scenes; the latest of the same photos."""
    latest: dict[str, tuple[str, str]] = {}
    for key, record in members(name).items():
        if record["start"] == start and record["capture"] != capture and record["scene"] != scene:
            latest[record["capture"]] = max(
                latest.get(record["capture"], ("", "")), (record["date"], key)
            )
    return sorted(key for _, key in latest.values())


def pinned(
    title: str, name: str, start: str, capture: str, scene: str, *, running: bool, newer: bool
) -> list[str]:
    """Keys of the lessons that a scene starts from: those in `work/TITLE/pin.json` for this set,
    encoder and photos, else the usable ones now, or with `newer`; a run writes them down.

    Args: capture: identity of the photos, scene: whose own lessons are left out.
    Raises: InputError naming a pin that is damaged.
    """
    path, pins = store.work() / title / PIN, dict[str, list[str]]()
    of = f"{name} {start} {capture}"
    if path.is_file():
        pins = parse_json(path, "remove it: the next run pins the scene anew")
        if not isinstance(pins, dict) or not all(isinstance(keys, list) for keys in pins.values()):
            raise InputError(f"{path} is no pin; remove it: the next run pins the scene anew")
        if of in pins and not newer:
            return [str(key) for key in pins[of]]
    pins[of] = usable(name, start, capture, scene)
    if running:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, json.dumps(pins, indent=1) + "\n")
    return pins[of]


def fetch(title: str, name: str, key: str, running: bool) -> Path:
    """Path in the store of a pinned lesson, copied there from the set if it is to run.

    Args: title: of the scene that is pinned; name: of the set.
    Raises: ConfigError where the lesson is nowhere any more.
    """
    path = store.artifact_path("learn", key)
    if store.is_fresh(path):
        return path
    if not store.is_fresh(folder(name) / key):
        raise ConfigError(
            f"{title} is pinned to the lesson {key}, which {name} has no more; add "
            "newer=1 (--newer)"
        )
    return store.import_artifact(folder(name) / key, "learn", lesson.SCHEMA, running)
