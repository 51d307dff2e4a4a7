"""A splat that someone else trained, as a scene: as it is, or with what the 2D teacher says by a capture's photos."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.stages.command import publish

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.cameras import Cameras


def lift_ply(
    ply: Path, capture: Path, points: Path | None, features: Path | None, model: Path | None, out: Path
) -> dict[str, Any]:
    """Lift features to the Gaussians of a PLY, and export them.

    Args:
      ply:      a 3DGS PLY in the frame of the cameras.
      capture:  a `capture` artifact; points: a `points` artifact with its cameras, where the capture has no poses.
      features: a `features` artifact of this capture; None: the teacher is run.
      model:    .onnx of the teacher to run; None: the embedded one.
      out:      becomes a folder of artifacts by name, as a scene's: gaussians, lift, export, and what the teacher made.
    Returns: counts.
    Raises:  InputError on what cannot be read, DataFailure if no view sees a Gaussian.
    """
    from chebsplat.formats.features import Features
    from chebsplat.stages import export, lift
    from chebsplat.stages.page import foreign

    taken_over(ply, foreign(ply).parameters, cameras_of(capture, points), out)
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


def import_ply(ply: Path, out: Path) -> dict[str, Any]:
    """A PLY as a scene without semantics, of `gaussians` and `export` below `out`; one camera sees its middle half.

    Returns: counts. Raises: InputError on what cannot be read.
    """
    from chebsplat.stages import export
    from chebsplat.stages.page import foreign

    scene = foreign(ply)
    taken_over(ply, scene.parameters, scene.cameras, out)
    publish("export", export.run, out / "export", {"gaussians": out / "gaussians"})
    return {"gaussians": artifact.read_manifest(out / "export").facts["n_gaussians"]}


def taken_over(ply: Path, parameters: dict[str, np.ndarray], cameras: Cameras, out: Path) -> None:
    """Make the folder `out`, and in it `gaussians` of what a PLY holds."""
    from chebsplat.formats.gaussians import Gaussians
    from chebsplat.formats.manifest import Manifest

    out.mkdir(parents=True)
    given = {"path": ply.name, "sha256": artifact.sha256_file(ply)}
    manifest = Manifest(Gaussians.SCHEMA, artifact.digest(given), "train", facts={"source": given})
    with artifact.publish(out / "gaussians", manifest) as tmp:
        Gaussians(parameters, cameras, notes={"left_out": {"training": "the splat was given"}}).write(tmp)


def cameras_of(capture: Path, points: Path | None) -> Cameras:
    """The cameras of a capture, or of the points that were reconstructed from it. Raises InputError without poses."""
    from chebsplat.formats.cameras import Cameras
    from chebsplat.formats.capture import Capture
    from chebsplat.formats.points import Points

    held = Capture.read(capture)
    if points is not None:
        found = Points.read(points)
        return Cameras(found.names, found.Ks, found.cam_from_world, *held.size)
    if held.cam_from_world is None:
        raise InputError(f"{capture} has no poses; name the scene, whose sfm has them, or ingest a source with poses")
    return Cameras(held.names, held.Ks, held.cam_from_world, *held.size)


def taught(capture: Path, model: Path | None, out: Path) -> Path:
    """Features of a capture by an ONNX teacher, in the channels that a run would give a scene; below `out`."""
    from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
    from chebsplat.stages import channels, teacher

    used = str((model or EMBEDDED).absolute())
    config, inputs = out / "teacher.json", {"capture": capture}
    config.write_text(json.dumps({"teacher": {"kind": "onnx", "model": used}, "channels": {"model": used}}))
    if read_teacher(Path(used)).output == "features":
        publish("channels", channels.run, out / "channels", {}, config)
        inputs["channels"] = out / "channels"
    publish("teacher", teacher.run, out / "teacher", inputs, config)
    return out / "teacher"
