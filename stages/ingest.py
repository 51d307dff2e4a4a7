"""ingest: read a source into a capture, with disturbed cameras and colours if settings ask."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from chebsplat.cameras import centers
from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.evaluation import protocols
from chebsplat.formats.capture import MAPS, Capture
from chebsplat.formats.names import natural
from chebsplat.formats.photo_model import PhotoModel
from chebsplat.formats.world import HERE, World
from chebsplat.labels.names import lacking, rows_of
from chebsplat.photos.exposures import relit
from chebsplat.photos.frames import blurred, detail
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import IngestSection, SourceSection
from chebsplat.stages.sources import (
    colmap,
    common,
    depth_units,
    generated,
    photos,
    replica,
    scannet,
    seven_scenes,
    transforms,
    video,
    volumes,
)
from chebsplat.stages.sources.assembly import as_taken
from chebsplat.stages.sources.common import resolve_source

log = logging.getLogger("chebsplat")

ALONE = ("photos", "video")  # kinds of source without poses
NAMED = 20  # blurred views in a message
SEED = 0  # of all disturbances: the studies compare trainings on the same ones


def read(
    name: str, source: SourceSection, settings: IngestSection, model: PhotoModel | None = None
) -> dict[str, Any]:
    """The fields of a capture, as its source gives them. model: of photos that come alone.

    Raises: InputError if the source's folder is absent; ConfigError if photos that come alone have
      no model.
    """
    if source.kind == "generated":
        return generated.capture(name, source.seed, source.preset)

    folder = Path(str(source.path)).expanduser()
    if source.kind in ALONE and model is None:
        raise ConfigError(
            f"{source.kind} bring no poses; give the artifact of stage pose (--in-model)"
        )
    if source.kind == "video" and model is not None:
        return video.read(folder, settings, model)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; correct source.path")
    modules = {
        "colmap": colmap,
        "transforms": transforms,
        "replica": replica,
        "scannet": scannet,
        "seven_scenes": seven_scenes,
    }
    fields: dict[str, Any] = (
        modules[source.kind].read(folder, settings)
        if model is None
        else photos.read(folder, settings, model)
    )
    if fields.get("depth") is not None and settings.depth == "auto":
        depth_units.fit(fields, folder)
    if unread := common.unread(folder):
        fields["source"]["notes"].append(f"{unread[0].upper()}{unread[1:]}.")
    return fields


def blur_note(fields: dict[str, Any]) -> str:
    """Names of views that are far less sharp than the others, in a sentence; "" where none is."""
    images = fields["images"]
    luma = np.array([0.299, 0.587, 0.114], np.float32)
    names = [
        fields["names"][k]
        for k in np.flatnonzero(blurred(np.array([detail(image @ luma) for image in images])))
    ]
    if not names:
        return ""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    listed = ", ".join(names[:NAMED])
    return (
        f"{len(names)} of {len(images)} views look blurred: {listed}{more}; they are used as "
        "they are."
    )


def every(names: list[str], step: int, offset: int) -> np.ndarray:
    """bool [V]: names whose index in natural order is `offset` modulo `step`.

    Choices: natural order, which is that of text where numbers are padded.
    """
    order = sorted(range(len(names)), key=lambda k: natural(names[k]))
    is_test = np.zeros(len(names), bool)
    is_test[order[offset % step :: step]] = True
    return is_test


def split(names: list[str], own: Any, settings: IngestSection) -> tuple[Any, dict[str, Any]]:
    """Test views by the protocol's rule, bool [V], and the protocol with its parameters.

    Args: own: bool [V], the source's own split, or None.
    Raises: ConfigError if the config changes a rule that is part of a protocol's name; DataFailure
      if it leaves no test or no training view.
    """
    rule = protocols.load(settings.protocol).RULE
    requested = {"test_every": settings.test_every, "test_offset": settings.test_offset}
    fixed = {"test_every": rule.test_every, "test_offset": rule.test_offset}
    used = {key: fixed[key] if value is None else value for key, value in requested.items()}
    if used != fixed and not rule.adjustable:
        raise ConfigError(
            f"ingest.protocol {settings.protocol} tests other views; leave test_every and "
            "test_offset away"
        )
    record: dict[str, Any] = {"name": settings.protocol}
    if rule.on_training:
        return np.zeros(len(names), bool), record | {
            "split": "no view is held out; all are evaluated"
        }
    if own is not None and rule.own_split:
        return own, record | {"split": "the source's own"}
    step, offset = used["test_every"], used["test_offset"] % used["test_every"]
    by_index = {
        "split": f"view index % {step} == {offset} is test",
        "test_every": step,
        "test_offset": offset,
    }
    is_test = every(names, step, offset)
    if is_test.all() or not is_test.any():
        raise DataFailure(
            f"of {len(names)} views every one whose index % {step} is {offset} is a test view "
            "(ingest.test_every, ingest.test_offset): that is "
            f"{'all' if is_test.any() else 'none'} of them; add views or change the rule"
        )
    return is_test, record | by_index


def thinned(fields: dict[str, Any], max_train_views: int | None) -> dict[str, Any]:
    """Per-view fields of a capture with at most `max_train_views` training views, evenly spaced."""
    training = np.flatnonzero(~fields["is_test"])
    if max_train_views is None or len(training) <= max_train_views:
        return {}
    training = training[np.linspace(0, len(training) - 1, max_train_views).round().astype(int)]
    rows = np.union1d(np.flatnonzero(fields["is_test"]), training)
    stacks = {
        name: fields.get(name) for name in ("images", "Ks", "cam_from_world", "is_test", *MAPS)
    }
    views = {
        name: np.asarray(values[:])[rows] for name, values in stacks.items() if values is not None
    }
    if fields.get("tracks") is not None:
        point, row = fields["tracks"].T
        stays = np.isin(row, rows)
        views["tracks"] = np.stack([point[stays], np.searchsorted(rows, row[stays])], 1).astype(
            np.int32
        )
    return views | {"names": [fields["names"][row] for row in rows]}


def renamed(fields: dict[str, Any], classes: dict[str, list[str]]) -> dict[str, Any]:
    """Labels [V, H, W] in these classes, -1 of source classes in none, and the classes' names.

    Raises: ConfigError where the source has no labels, or no class of one of the names.
    """
    own, labels = fields.get("class_names"), fields.get("labels")
    if own is None or labels is None:
        raise ConfigError(
            "ingest.classes renames a source's labels, and this one has none; leave it away"
        )
    number = {name: k for k, group in enumerate(classes.values()) for name in group}
    if absent := lacking(number, own):
        raise ConfigError(
            f"ingest.classes: the source has no class {absent[0]}; it has {', '.join(own)}"
        )
    table = np.array([*([*number.values(), -1][row] for row in rows_of(own, number)), -1], np.int16)
    return {"labels": table[np.asarray(labels[:])], "class_names": list(classes)}


def run(job: Job) -> None:
    """Read a source's images, cameras, depth and labels into one capture, and split off test views.

    Reads a source, of files or generated, and the `model` of photos that come alone. Writes
    `capture`.
    """
    name, settings = job.config.scene.name, job.config.ingest
    source = resolve_source(name, job.config.source)
    model = PhotoModel.read(job.inputs["model"]) if "model" in job.inputs else None
    fields = read(name, source, settings, model)
    if settings.volumes is not None:
        volumes.give(fields, Path(settings.volumes))
    # generated views are as large as they are made
    job.facts["variance_kept"] = fields.pop("variance_kept", 1.0)
    fields["source"] = {"name": name} | fields["source"]
    for note in (
        *filter(None, [fields["source"].get("labels")]),
        *fields["source"].get("notes", []),
    ):
        log.info("%s", note)
    if source.kind != "generated" and (blur := blur_note(fields)):
        log.warning("%s", blur)
        fields["source"]["notes"].append(blur)
    n_views = len(fields["names"])
    fields["is_test"], protocol = split(fields["names"], fields.pop("is_test", None), settings)
    fields |= thinned(fields, settings.max_train_views)
    if altered := fields.pop("altered", None):
        fields |= as_taken(
            altered({fields["names"][row] for row in np.flatnonzero(fields["is_test"])})
        )
    strengths = settings.disturb_colors, settings.disturb_degrees, settings.disturb_shift
    if any(strengths):
        if fields.get("cam_from_world") is None and any(strengths[1:]):
            raise ConfigError(
                "ingest.disturb_degrees and disturb_shift change poses, and this source has none"
            )
        fields |= disturbed(fields, *strengths)
    fields |= normalised(fields)
    if settings.classes is not None:
        fields |= renamed(fields, settings.classes)
    without = {
        what: f"the {source.kind} source has none"
        for what in ("depth", "labels")
        if fields.get(what) is None
    }
    if settings.depth == "off" and "depth" not in without:
        without["depth"] = "ingest.depth is off"
        del fields["depth"]
    for what, why in without.items():
        job.left_out(what, why)
    optional: dict[str, Any] = {
        "depth": None,
        "labels": None,
        "loss_mask": None,
        "class_names": None,
    }
    capture = Capture(**(optional | fields), protocol=protocol)
    if len(capture.names) < n_views:
        job.left_out(
            "views",
            f"{n_views - len(capture.names)} that ingest.max_train_views spares the training",
        )
    job.facts |= {
        "source": capture.source,
        "n_views": len(capture.names),
        "n_test": int(np.sum(capture.is_test)),
    }
    capture.write(job.out)


def normalised(fields: dict[str, Any]) -> dict[str, Any]:
    """Those fields of a capture that change as its scene is brought to a size and place for single
    precision (`formats.world.World.of`), and where it was.
    """
    poses, points, depth = (fields.get(name) for name in ("cam_from_world", "points", "depth"))
    world = HERE if poses is None else World.of(centers(poses))
    changed: dict[str, Any] = {}
    if points is not None:
        changed["points"] = world.inward(points).astype(np.float32)
    if world.notes and poses is not None:
        place = ", ".join(f"{value:.6g}" for value in world.origin)
        note = (
            f"Inside, the scene is moved by -({place}) and divided by {world.scale:g}; what is "
            "exported is not."
        )
        log.info("%s", note)
        changed["cam_from_world"] = world.poses_inward(poses)
        changed["source"] = (
            fields["source"] | world.notes | {"notes": [*fields["source"].get("notes", []), note]}
        )
        if depth is not None:
            changed["depth"] = (np.asarray(depth[:]) / world.scale).astype(np.float32)
    return changed


def recolored(images: np.ndarray, is_test: np.ndarray, stops: float) -> np.ndarray:
    """Images u8 [V, H, W, 3] of random exposures, ± `stops`, and white balances, by training view.

    Choices: linear light is multiplied, by uniform logarithms (white balance: of a quarter of the
      range) whose mean over the training views is 0; bright values are clipped, as by a sensor.
    """
    rng, rows = np.random.default_rng(SEED), np.flatnonzero(~is_test)
    logs = rng.uniform(-stops, stops, (len(rows), 1)) + rng.uniform(
        -stops / 4, stops / 4, (len(rows), 3)
    )
    changed = images.copy()
    for row, own in zip(rows, logs - logs.mean(0), strict=True):
        changed[row] = relit(images[row], own)
    return changed


def displaced(poses: np.ndarray, is_test: np.ndarray, degrees: float, shift: float) -> np.ndarray:
    """Poses [V, 4, 4]; each training view turned by `degrees` and shifted by `shift` scene units.

    Choices: directions are random; their mean, a motion of the world, is removed to first order.
    """
    rng, rows = np.random.default_rng(SEED), np.flatnonzero(~is_test)
    turns, shifts = (rng.normal(size=(len(rows), 3)) for _ in range(2))
    turns *= np.radians(degrees) / np.linalg.norm(turns, axis=1, keepdims=True)
    shifts *= shift / np.linalg.norm(shifts, axis=1, keepdims=True)
    eyes = centers(poses[rows])
    offsets = shifts - np.cross(turns, eyes)  # x' = x + turn × x + offset
    turns, offsets = turns - turns.mean(0), offsets - offsets.mean(0)
    motions = np.tile(np.eye(4), (len(rows), 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    moved = eyes + np.cross(turns, eyes) + offsets
    motions[:, :3, 3] = moved - np.einsum("vij,vj->vi", motions[:, :3, :3], eyes)
    changed = poses.copy()
    changed[rows] = poses[rows] @ np.linalg.inv(motions)
    return changed


def disturbed(
    fields: dict[str, Any], colors: float, degrees: float, shift: float
) -> dict[str, Any]:
    """Those fields of a capture that change, and a note of it. Poses that are None stay so."""
    changed: dict[str, Any] = {}
    is_test, notes = fields["is_test"], list(fields["source"].get("notes", []))
    if colors > 0:
        changed["images"] = recolored(np.asarray(fields["images"][:]), is_test, colors)
        notes.append(
            f"Exposures of the training views are disturbed by {colors:g} stops "
            "(ingest.disturb_colors)."
        )
    if degrees > 0 or shift > 0:
        changed["cam_from_world"] = displaced(fields["cam_from_world"], is_test, degrees, shift)
        changed["tracks"] = None  # they are of the original poses
        notes.append(
            f"Poses of the training views are disturbed by {degrees:g}° and {shift:g} scene units."
        )
    strengths = {"colors": colors, "degrees": degrees, "shift": shift}
    return changed | {"source": fields["source"] | {"notes": notes, "disturbed": strengths}}
