"""Replica as two groups have rendered it: NICE-SLAM (results/, traj.txt) and Semantic-NeRF (Sequence_1/)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.stages.sources import common
from chebsplat.stages.sources.common import Camera, Frame, Listing


def read(folder: Path, settings: Any) -> dict[str, Any]:
    """The fields of a capture."""
    return common.assemble(_listing(folder), settings)


def probe(folder: Path) -> dict[str, bool]:
    semantic = (folder / "Sequence_1/semantic_class").is_dir()
    return {"poses": True, "depth": True, "labels": semantic}


def files(folder: Path) -> list[Path]:
    extra = [p for p in (folder / "traj.txt", folder / "Sequence_1/traj_w_c.txt", *_parameter_files(folder),
                         *_class_files(folder)) if p.is_file()]  # fmt: skip
    return sorted([*extra, *_listing(folder).files()])


def _parameter_files(folder: Path) -> list[Path]:
    return [folder / "cam_params.json", folder.parent / "cam_params.json"]


def _class_files(folder: Path) -> list[Path]:
    places = (folder, folder / "habitat", folder / "Sequence_1", folder.parent)
    return [place / "info_semantic.json" for place in places]


def _listing(folder: Path) -> Listing:
    if (folder / "results").is_dir():
        return _nice_slam(folder)
    if (folder / "Sequence_1").is_dir():
        return _semantic_nerf(folder)
    raise InputError(
        f"{folder} holds neither results/ (NICE-SLAM) nor Sequence_1/ (Semantic-NeRF); correct source.path"
    )


def _trajectory(path: Path, count: int) -> np.ndarray:
    """cam_from_world [V, 4, 4] of rows of 16 camera-to-world entries."""
    try:
        rows = np.loadtxt(path, ndmin=2)
    except FileNotFoundError:
        raise InputError(f"{path} is missing; the source is incomplete") from None
    except ValueError as error:
        raise InputError(f"{path} does not parse ({error}); restore the file") from None
    if rows.size != 16 * count:
        raise InputError(f"{path} has {rows.size / 16:g} poses for {count} images; restore the file")
    matrices = rows.reshape(count, 4, 4)
    usable = np.isfinite(matrices).all((1, 2))
    poses = np.full((count, 4, 4), np.nan)
    poses[usable] = np.linalg.inv(matrices[usable])
    return poses


def _nice_slam(folder: Path) -> Listing:
    files_ = [path for path in _parameter_files(folder) if path.is_file()]
    if not files_:
        raise InputError(f"{folder / 'cam_params.json'} is missing, here and one level up; the source is incomplete")
    try:
        values = common.read_json(files_[0])["camera"]
        size = (int(values["w"]), int(values["h"]))
        # Their principal point counts from the centre of the first pixel.
        params = [values["fx"], values["fy"], values["cx"] + 0.5, values["cy"] + 0.5]
        scale = float(values["scale"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{files_[0]} lacks {error}; restore the file") from None
    images = [p for p in common.images_in(folder / "results") if p.stem.startswith("frame")]
    poses = _trajectory(folder / "traj.txt", len(images))
    camera = Camera("PINHOLE", [float(v) for v in params], *size)
    frames = [
        Frame(path.stem, path, camera, pose, common.beside(folder / "results", path.stem.replace("frame", "depth")))
        for path, pose in zip(images, poses, strict=True)
    ]
    return Listing("replica", frames, depth_scale=scale, notes=["NICE-SLAM layout."])


def _semantic_nerf(folder: Path) -> Listing:
    sequence = folder / "Sequence_1"
    images = common.images_in(sequence / "rgb")
    poses = _trajectory(sequence / "traj_w_c.txt", len(images))
    width, height = common.open_image(images[0]).size
    camera = Camera("PINHOLE", [width / 2, width / 2, width / 2, height / 2], width, height)
    frames = []
    for path, pose in zip(images, poses, strict=True):
        number = path.stem.rsplit("_", 1)[-1]
        frames.append(
            Frame(
                f"frame{int(number):06d}",
                path,
                camera,
                pose,
                common.beside(sequence / "depth", f"depth_{number}"),
                common.beside(sequence / "semantic_class", f"semantic_class_{number}"),
            )
        )
    return Listing("replica", frames, _class_names(folder), notes=["Semantic-NeRF layout."])


def _class_names(folder: Path) -> dict[int, str] | None:
    for path in _class_files(folder):
        if path.is_file():
            try:
                return {int(entry["id"]): str(entry["name"]) for entry in common.read_json(path)["classes"]}
            except (KeyError, TypeError, ValueError) as error:
                raise InputError(f"{path} lacks classes with id and name ({error}); restore the file") from None
    return None
