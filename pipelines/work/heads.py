"""Sets of lessons that scenes have taught, and which of them a scene is pinned to.

A set is a folder of the work folder, `.heads/NAME`, with a copy of every lesson under its key, and
beside it what it is of. A lesson is added by a rename, so that any number of processes add at once,
in any order, to the same set; none is ever changed.
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
    """The time in UTC, by which lessons of the same photos are told apart."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def folder(name: str) -> Path:
    """Where the set of this name lies, or will. Raises ConfigError on a name that leads
    elsewhere.
    """
    if not store.is_name(name):
        raise ConfigError(
            f"{name!r} cannot name a set of lessons: no / in it, and no . at its beginning"
        )
    return store.work() / ".heads" / name


def members(name: str) -> dict[str, dict[str, Any]]:
    """By key what each lesson of a set is of: the photos' identity (`capture`), the encoder's key
    (`start`), the scene, and when it was added. Raises InputError naming a record that is damaged.
    """
    found = {}
    for path in sorted(folder(name).glob("[!.]*.json")):
        place = path.with_suffix("")
        record = _record(place)
        if store.is_fresh(place) and FORGOTTEN not in record:
            if not set(RECORD) <= set(record):
                raise InputError(f"{path} is no record of a lesson; {REMEDY}")
            found[path.stem] = record
    return found


def _record(place: Path) -> dict[str, Any]:
    """What lies beside a lesson; empty where nothing does. Raises InputError where that is
    damaged.
    """
    path = place.with_suffix(".json")
    record = parse_json(path, REMEDY) if path.is_file() else {}
    if not isinstance(record, dict):
        raise InputError(f"{path} is no record of a lesson; {REMEDY}")
    return record


def add(name: str, made: Path, capture: str, start: str, scene: str) -> None:
    """Put a finished lesson into a set, unless it teaches nothing, or is there.

    Args: made: the artifact, whose folder bears its key; capture: identity of the photos; start:
      key of the encoder.
    """
    place = folder(name) / made.name
    if store.is_fresh(place) or "none" in lesson.read_notes(made) or FORGOTTEN in _record(place):
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    values = (capture, start, scene, now())
    atomic_write(place.with_suffix(".json"), json.dumps(dict(zip(RECORD, values, strict=True))))
    artifact.copy(made, place, artifact.verify(made, lesson.SCHEMA))


def forget(name: str, key: str) -> None:
    """Take a lesson out of a set. Raises ConfigError with the nearest keys where it is not
    there.
    """
    held = members(name)
    if key not in held:
        near = suggest(key, held, 1)
        raise ConfigError(
            f"{name} has no lesson {key}" + (f"; did you mean {near[0]}?" if near else "")
        )
    place = folder(name) / key
    # no run of the scene adds it again
    atomic_write(place.with_suffix(".json"), json.dumps({FORGOTTEN: True}))
    (place / "artifact.json").unlink()
    shutil.rmtree(place)


def usable(name: str, start: str, capture: str, scene: str) -> list[str]:
    """Keys of the lessons of a set for an encoder, of other scenes and photos; of the same photos
    the latest.
    """
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
    """Keys of the lessons that a scene starts from: those that `work/TITLE/pin.json` names for this
    set, encoder and photos; what stands now where it names none, or newer ones are asked for. A run
    writes them down.

    Args: capture: identity of the photos; scene: whose lessons are left out, too, as those of the
      photos are.
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


def taken(title: str, name: str, key: str, running: bool) -> Path:
    """The place in the store of a pinned lesson, copied there from the set if it is to run.

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
    return store.taken_in(folder(name) / key, "learn", lesson.SCHEMA, running)
