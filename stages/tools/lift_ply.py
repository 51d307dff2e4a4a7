"""A splat of another program as a scene: alone, with features lifted from a capture's photos, or
with labels of its Gaussians by shape and knowledge alone.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.files import atomic_path
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.knowledge import Knowledge, read_knowledge
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.names import suggest
from chebsplat.formats.ply import write_ply
from chebsplat.formats.points import Points
from chebsplat.formats.splats import read_semantics, read_splats, splat_file
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.formats.world import HERE, World
from chebsplat.labels.decode import decode
from chebsplat.lifting.observations import carry
from chebsplat.lifting.smoothing import room_unit
from chebsplat.lifting.surface import LOOKOUT_SIZE, lookouts
from chebsplat.settings import DescribeSection
from chebsplat.shape.lessons import novelty, scaled_novelty, summed
from chebsplat.shape.point_inputs import point_inputs
from chebsplat.splats.gaussians import surface_of
from chebsplat.stages import export, lift
from chebsplat.stages.learn import KNOWN
from chebsplat.stages.runtime.command import publish
from chebsplat.stages.shape_models.answers import encoded, units
from chebsplat.stages.shape_models.surfaces import from_splat
from chebsplat.stages.teacher_models.text_encoder import match_names
from chebsplat.stages.tools.page import foreign
from chebsplat.stages.tools.up import Up, up_of
from chebsplat.stages.training.placing import in_frame

log = logging.getLogger("chebsplat")


def lift_ply(
    ply: Path,
    capture: Path,
    points: Path | None,
    features: Path | None,
    model: Path | None,
    out: Path,
) -> dict[str, Any]:
    """Lift features to the Gaussians of a PLY, and export them.

    Args:
      ply:      a 3DGS PLY, which is moved into the frame of the cameras.
      capture:  a `capture` artifact; points: a `points` artifact with its cameras, where the
        capture has no poses.
      features: a `features` artifact of this capture; None: the teacher is run.
      model:    .onnx of the teacher to run; None: the embedded one.
      out:      becomes a folder of artifacts by name, as a scene's: gaussians, lift, export, and
        the teacher's artifacts.
    Returns: counts.
    Raises:  InputError on what cannot be read or fits in no frame, DataFailure if no view sees a
      Gaussian.
    """
    photos = Capture.read(capture)
    cameras, world = cameras_of(capture, points), World.read(photos.source)
    surface = photos.points if points is None else Points.read(points).means
    original = read_splats(ply)[0] if world.notes else None
    # the added camera is left out, so that its up is of no account
    theirs = foreign(ply, np.array([0.0, -1, 0]), world).parameters
    parameters = in_frame(ply, theirs, photos, cameras, surface, original)
    write_gaussians(ply, parameters, cameras, out, world)
    config = out / "settings.json"
    config.write_text(json.dumps({"train": {"features": "lifted"}}))
    if features is None:
        features = run_teacher(capture, model, out)
    inputs = {"capture": capture, "gaussians": out / "gaussians", "features": features}
    publish("lift", lift.run, out / "lift", inputs, config)
    inputs = {"gaussians": out / "gaussians", "features": features, "lifted": out / "lift"}
    publish("export", export.run, out / "export", inputs, config)
    for name, path in {"ingest": capture, "teacher": features}.items():  # like the links of a scene
        if not (out / name).exists():
            (out / name).symlink_to(path.resolve())
    facts = artifact.read_manifest(out / "lift").facts
    return {
        "gaussians": facts["n_gaussians"],
        "seen by no view": facts["n_unseen"],
        "views": facts["n_views"],
        "labels": len(Features.read(features).label_names),
    }


def import_ply(ply: Path, out: Path, up: Up | None = None) -> dict[str, Any]:
    """A PLY as a scene without semantics, `gaussians` and `export` below `out`, with one camera.

    Args: up: of that camera, and so of pages and orbits; None: by the shape of a room, else -y.
    Returns: counts. Raises: InputError on what cannot be read.
    """
    scene = foreign(ply, up)
    if read_semantics(ply) is not None:
        log.warning("what %s says of its Gaussians is left out; page and view show it", ply)
    write_gaussians(ply, scene.parameters, scene.cameras, out, World.read(scene.summary))
    publish("export", export.run, out / "export", {"gaussians": out / "gaussians"})
    return {"gaussians": artifact.read_manifest(out / "export").facts["n_gaussians"]}


def write_gaussians(
    ply: Path, parameters: dict[str, np.ndarray], cameras: Cameras, out: Path, world: World = HERE
) -> None:
    """Make the folder `out`, and in it `gaussians` from a PLY; world: the capture's."""
    out.mkdir(parents=True)
    origin = {"path": ply.name, "sha256": artifact.sha256_file(splat_file(ply))}
    manifest = Manifest(
        Gaussians.SCHEMA, artifact.digest(origin), "train", facts={"source": origin}
    )
    with artifact.publish(out / "gaussians", manifest) as tmp:
        Gaussians(
            parameters,
            cameras,
            notes=world.notes | {"left_out": {"training": "the splat was given"}},
        ).write(tmp)


def cameras_of(capture: Path, points: Path | None) -> Cameras:
    """The cameras of a capture, or of its reconstructed points. Raises InputError without poses."""
    photos = Capture.read(capture)
    if points is not None:
        cloud = Points.read(points)
        return Cameras(cloud.names, cloud.Ks, cloud.cam_from_world, *photos.size)
    if photos.cam_from_world is None:
        raise InputError(
            f"{capture} has no poses; name the scene, whose sfm has them, or ingest "
            "a source with poses"
        )
    return Cameras(photos.names, photos.Ks, photos.cam_from_world, *photos.size)


def run_teacher(capture: Path, model: Path | None, out: Path) -> Path:
    """Features of a capture by an ONNX teacher below `out`, in the channels of a scene's run."""
    from chebsplat.stages import channels, teacher

    model_path = str((model or EMBEDDED).absolute())
    config, inputs = out / "teacher.json", {"capture": capture}
    config.write_text(
        json.dumps(
            {"teacher": {"kind": "onnx", "model": model_path}, "channels": {"model": model_path}}
        )
    )
    if read_teacher(Path(model_path)).output == "features":
        publish("channels", channels.run, out / "channels", {}, config)
        inputs["channels"] = out / "channels"
    publish("teacher", teacher.run, out / "teacher", inputs, config)
    return out / "teacher"


def label_ply(
    ply: Path, knowledge: Path, words: list[str], up_option: Up, unit: float | None, out: Path
) -> dict[str, Any]:
    """Write the PLY with a label a Gaussian, and an .npz of names, labels [N], confidence f32 [N].

    Args:
      ply:       a 3DGS PLY of a room; knowledge: a `knowledge` artifact; words: to choose among.
      up_option: against gravity, in the PLY's frame; unit: its units in a metre; None: by the
        room's extent.
    Returns: counts, and the share of each name.
    Raises:  ConfigError if `out` exists or a word is unknown; InputError on unreadable files;
      DataFailure where the splat shows no surface.
    Choices: shape is described on the surface rendered from inside, and carried to the Gaussians
      beside it. The confidence is that of the label among the words, times the length of the
      answer, the agreement of a teacher's views for such shapes.
    """
    beside = out.with_suffix(".npz")
    for path in (out, beside):
        if path.exists():
            raise ConfigError(f"{path} exists; remove it, or choose another --out")
    prior = read_knowledge(knowledge)
    rows = match_names(words, prior.words)
    if -1 in rows:
        word = words[rows.index(-1)]
        near = ", ".join(suggest(word, prior.words))
        raise ConfigError(f"{knowledge} has no word {word}" + (f"; near: {near}" if near else ""))
    parameters, degree, _ = read_splats(ply)
    up = up_of(up_option, parameters)
    unit = room_unit(parameters["means"]) if unit is None else unit
    poses, Ks = lookouts(
        parameters["means"].astype(np.float64), expit(parameters["logit_opacities"]), up
    )
    cloud = from_splat(parameters, poses, Ks, LOOKOUT_SIZE, unit)
    log.info("%d points of a surface, %.3g units a metre", len(cloud.means), unit)
    shape = encoded(
        prior, point_inputs(*cloud, up=up, unit=unit, describe=DescribeSection(**prior.describe))
    )
    answers = shape @ prior.map
    warn_of_new_kind(prior, shape, answers)
    normals = surface_of(parameters)[0]
    carried, _ = carry(answers, cloud.means, cloud.normals, parameters["means"], normals, unit)
    labels, sure = decode(carried, units(prior.embeddings[rows]))
    confidence = sure * np.linalg.norm(carried, axis=1).clip(0, 1)
    with atomic_path(beside) as temporary, temporary.open("wb") as stream:
        np.savez(
            stream, names=np.array(words), labels=labels, confidence=confidence.astype(np.float32)
        )
    with atomic_path(out) as temporary:
        write_ply(temporary, parameters, degree, labels, words)
    shares = {word: float((labels == k).mean()) for k, word in enumerate(words)}
    return {"gaussians": len(labels), "points": len(cloud.means), "unit": unit, "shares": shares}


def warn_of_new_kind(knowledge: Knowledge, shape: np.ndarray, answers: np.ndarray) -> None:
    """Warn if shape features [N, p] are unlike all rooms of knowledge, so that its answers [N, d]
    are unreliable: ρ′ of Eq 15 is compared with that of held-out rooms, with surfaces worn as a
    splat's.
    """
    sums = summed(shape, answers, np.ones(len(shape)))
    new = scaled_novelty(novelty(sums, knowledge.scale, knowledge.basis), sums.spread())
    if new > (largest := KNOWN * knowledge.card["novelty"]["held_out_worn"]):
        log.warning(
            "this scene's shape is unlike the rooms that names were learned in (rho' %.3f; rooms "
            "have up to %.3f): do not rely on its labels",
            new,
            largest,
        )
