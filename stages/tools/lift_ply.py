"""A splat that someone else trained, as a scene: as it is, with what the 2D teacher says by a
capture's photos, or with the names of its Gaussians by shape and knowledge alone.
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
from chebsplat.formats.splats import read_splats, splat_file
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
      ply:      a 3DGS PLY, which is brought into the frame of the cameras.
      capture:  a `capture` artifact; points: a `points` artifact with its cameras, where the
        capture has no poses.
      features: a `features` artifact of this capture; None: the teacher is run.
      model:    .onnx of the teacher to run; None: the embedded one.
      out:      becomes a folder of artifacts by name, as a scene's: gaussians, lift, export, and
        what the teacher made.
    Returns: counts.
    Raises:  InputError on what cannot be read or fits in no frame, DataFailure if no view sees a
      Gaussian.
    """
    held = Capture.read(capture)
    cameras, world = cameras_of(capture, points), World.read(held.source)
    surface = held.points if points is None else Points.read(points).means
    theirs = read_splats(ply)[0] if world.notes else None
    parameters = in_frame(ply, foreign(ply, world=world).parameters, held, cameras, surface, theirs)
    taken_over(ply, parameters, cameras, out, world)
    config = out / "settings.json"
    config.write_text(json.dumps({"train": {"features": "lifted"}}))
    if features is None:
        features = taught(capture, model, out)
    inputs = {"capture": capture, "gaussians": out / "gaussians", "features": features}
    publish("lift", lift.run, out / "lift", inputs, config)
    inputs = {"gaussians": out / "gaussians", "features": features, "lifted": out / "lift"}
    publish("export", export.run, out / "export", inputs, config)
    for name, path in {"ingest": capture, "teacher": features}.items():  # as the links of a scene
        if not (out / name).exists():
            (out / name).symlink_to(path.resolve())
    facts = artifact.read_manifest(out / "lift").facts
    return {"gaussians": facts["n_gaussians"], "seen by no view": facts["n_unseen"], "views": facts["n_views"],
            "labels": len(Features.read(features).label_names)}  # fmt: skip


def import_ply(ply: Path, out: Path, up: Up | None = None) -> dict[str, Any]:
    """A PLY as a scene without semantics, of `gaussians` and `export` below `out`; one camera sees
    its middle half.

    Args: up: of that camera, and so of pages and orbits; None: -y.
    Returns: counts. Raises: InputError on what cannot be read.
    """
    scene = foreign(ply, up)
    taken_over(ply, scene.parameters, scene.cameras, out, World.read(scene.summary))
    publish("export", export.run, out / "export", {"gaussians": out / "gaussians"})
    return {"gaussians": artifact.read_manifest(out / "export").facts["n_gaussians"]}


def taken_over(
    ply: Path, parameters: dict[str, np.ndarray], cameras: Cameras, out: Path, world: World = HERE
) -> None:
    """Make the folder `out`, and in it `gaussians` of what a PLY holds; world: of the capture."""
    out.mkdir(parents=True)
    given = {"path": ply.name, "sha256": artifact.sha256_file(splat_file(ply))}
    manifest = Manifest(Gaussians.SCHEMA, artifact.digest(given), "train", facts={"source": given})
    with artifact.publish(out / "gaussians", manifest) as tmp:
        Gaussians(
            parameters,
            cameras,
            notes=world.notes | {"left_out": {"training": "the splat was given"}},
        ).write(tmp)


def cameras_of(capture: Path, points: Path | None) -> Cameras:
    """The cameras of a capture, or of the points that were reconstructed from it. Raises InputError
    without poses.
    """
    held = Capture.read(capture)
    if points is not None:
        found = Points.read(points)
        return Cameras(found.names, found.Ks, found.cam_from_world, *held.size)
    if held.cam_from_world is None:
        raise InputError(
            f"{capture} has no poses; name the scene, whose sfm has them, or ingest "
            "a source with poses"
        )
    return Cameras(held.names, held.Ks, held.cam_from_world, *held.size)


def taught(capture: Path, model: Path | None, out: Path) -> Path:
    """Features of a capture by an ONNX teacher, in the channels that a run would give a scene;
    below `out`.
    """
    from chebsplat.stages import channels, teacher

    used = str((model or EMBEDDED).absolute())
    config, inputs = out / "teacher.json", {"capture": capture}
    config.write_text(
        json.dumps({"teacher": {"kind": "onnx", "model": used}, "channels": {"model": used}})
    )
    if read_teacher(Path(used)).output == "features":
        publish("channels", channels.run, out / "channels", {}, config)
        inputs["channels"] = out / "channels"
    publish("teacher", teacher.run, out / "teacher", inputs, config)
    return out / "teacher"


def label_ply(
    ply: Path, knowledge: Path, words: list[str], asked_up: Up, unit: float | None, out: Path
) -> dict[str, Any]:
    """Write the PLY again with a label a Gaussian, and beside it an .npz: names, labels [N],
    confidence f32 [N].

    Args:
      ply:       a 3DGS PLY of a room; knowledge: a `knowledge` artifact; words: to choose among.
      asked_up:  against gravity, in the PLY's frame; unit: its units in a metre; None: by the
        room's extent.
    Returns: counts, and the share of each name.
    Raises:  ConfigError if `out` exists or a word is not known; InputError on what cannot be read;
      DataFailure where
             the splat shows no surface.
    Choices: shape is described on the surface that is rendered from within, and carried to the
      Gaussians beside it. The confidence is that of the label among the words, times the length of
      the answer: how alike a teacher's views were where shapes were like this one.
    """
    beside = out.with_suffix(".npz")
    for path in (out, beside):
        if path.exists():
            raise ConfigError(f"{path} exists; remove it, or choose another --out")
    held = read_knowledge(knowledge)
    rows = match_names(words, held.words)
    if -1 in rows:
        word = words[rows.index(-1)]
        near = ", ".join(suggest(word, held.words))
        raise ConfigError(f"{knowledge} has no word {word}" + (f"; near: {near}" if near else ""))
    parameters, degree, _ = read_splats(ply)
    if not len(parameters["means"]):
        raise InputError(f"{ply} holds no Gaussians; choose another")
    up = up_of(asked_up, parameters)
    unit = room_unit(parameters["means"]) if unit is None else unit
    poses, Ks = lookouts(
        parameters["means"].astype(np.float64), expit(parameters["logit_opacities"]), up
    )
    cloud = from_splat(parameters, poses, Ks, LOOKOUT_SIZE, unit)
    log.info("%d points of a surface, %.3g units a metre", len(cloud.means), unit)
    shape = encoded(
        held, point_inputs(*cloud, up=up, unit=unit, describe=DescribeSection(**held.describe))
    )
    answers = shape @ held.map
    warn_of_new_kind(held, shape, answers)
    normals = surface_of(parameters)[0]
    carried, _ = carry(answers, cloud.means, cloud.normals, parameters["means"], normals, unit)
    labels, sure = decode(carried[:, carried.shape[1] // 2 :], units(held.embeddings[rows]))
    confidence = sure * np.linalg.norm(carried[:, carried.shape[1] // 2 :], axis=1).clip(0, 1)
    with atomic_path(beside) as temporary, temporary.open("wb") as stream:
        np.savez(
            stream, names=np.array(words), labels=labels, confidence=confidence.astype(np.float32)
        )
    with atomic_path(out) as temporary:
        write_ply(temporary, parameters, degree, labels, words)
    shares = {word: float((labels == k).mean()) for k, word in enumerate(words)}
    return {"gaussians": len(labels), "points": len(cloud.means), "unit": unit, "shares": shares}


def warn_of_new_kind(knowledge: Knowledge, shape: np.ndarray, answers: np.ndarray) -> None:
    """Warn where shape [N, p] is unlike all rooms of knowledge, whose answers [N, 2 d] then say
    little: by ρ′ of Eq 15, beside that of rooms held out, of worn surfaces as a splat's are.
    """
    sums = summed(shape, answers, np.ones(len(shape)))
    new = scaled_novelty(novelty(sums, knowledge.scale, knowledge.basis), sums.spread())
    if new > (known := KNOWN * knowledge.card["novelty"]["held_out_worn"]):
        log.warning(
            "this scene's shape is unlike the rooms that names were learned in (rho' %.3f; rooms "
            "have up to %.3f): do not rely on its labels",
            new,
            known,
        )
