"""Splats as viewers have them: PLY, SPZ, SOG, GLB; .splat and 3DGS' folder are read alone."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.files import atomic_path, regular
from chebsplat.formats.gltf import read_meanings, read_splat_glb, write_splat_glb
from chebsplat.formats.packed import C0, raw_parameters
from chebsplat.formats.ply import drop_unusable, read_ply, write_ply
from chebsplat.formats.semantics import Semantics, read_beside
from chebsplat.formats.sog import read_sog, write_sog
from chebsplat.formats.spz import LARGEST, REMEDY, read_spz, write_spz
from chebsplat.formats.world import HERE, World

READ = (".ply", ".spz", ".sog", ".glb", ".splat")
OTHERS = (".ksplat", ".sogs", ".lcc", ".rad")
WRITTEN = (".ply", ".spz", ".sog", ".glb")


def is_splat(name: str) -> bool:
    """True for a path that is named like a splat, or is a folder as 3DGS writes it."""
    return Path(name).suffix.lower() in READ + OTHERS or os.path.isdir(
        os.path.join(name, "point_cloud")
    )


def splat_file(path: Path) -> Path:
    """The file of a splat, or the last PLY of 3DGS' output folder. Raises InputError."""
    if os.path.isdir(path):
        iterations = [
            ply
            for ply in path.glob("point_cloud/iteration_*/point_cloud.ply")
            if _iteration(ply) >= 0
        ]
        if not iterations:
            raise InputError(
                f"{path} holds no point_cloud/iteration_*/point_cloud.ply; name the file of a splat"
            )
        return max(iterations, key=_iteration)
    if path.suffix.lower() in OTHERS:
        raise InputError(
            f"{path}: {path.suffix.lower()} is not read ({', '.join(READ)} are); {REMEDY}"
        )
    regular(path, "name the file of a splat")
    return path


def _iteration(ply: Path) -> int:
    number = ply.parent.name.removeprefix("iteration_")
    return int(number) if number.isdecimal() else -1


def read_splats(
    path: Path, world: World = HERE
) -> tuple[dict[str, np.ndarray], int, np.ndarray | None]:
    """Raw parameters, degree and labels, as `ply.read_ply`, of any splat that `splat_file` accepts.

    Args:   world: to bring the Gaussians into, from that of its source.
    Raises: InputError naming the file.
    """
    path = splat_file(Path(path))
    readers = {".spz": read_spz, ".sog": read_sog, ".glb": read_splat_glb, ".splat": _splat}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        return read_ply(path, world)
    if path.stat().st_size > LARGEST:
        raise InputError(f"{path} has more than the {LARGEST >> 20} MiB that are read; thin it out")
    parameters, degree = reader(path)
    parameters = drop_unusable(path, parameters)[0]
    moved = {
        "means": world.inward(parameters["means"]),
        "log_scales": parameters["log_scales"] - np.log(world.scale),
    }
    return (
        parameters | {name: values.astype(np.float32) for name, values in moved.items()},
        degree,
        None,
    )


def read_semantics(path: Path) -> Semantics | None:
    """Meanings of the Gaussians of a splat, in its order: of a GLB itself, or beside the file.

    None where nothing is told. Raises: InputError naming the file.
    """
    path = splat_file(Path(path))
    return (read_meanings if path.suffix.lower() == ".glb" else read_beside)(path)


def write_splats(
    path: Path,
    parameters: dict[str, np.ndarray],
    semantics: Semantics | None = None,
    world: World = HERE,
) -> None:
    """Write raw parameters with their `degrees` in the format that the file's name ends with, in
    the place of what is there, with what they mean; world: of the parameters, the file has its
    source's.

    Raises:  ConfigError on another ending than WRITTEN; DataFailure as `spz.write_spz`.
    Choices: bands above the highest degree in use are left out. PLY holds labels, GLB features as
      well, SPZ and SOG have both beside them (`formats.semantics`).
    """
    suffix, degree = path.suffix.lower(), int(parameters["degrees"].max())
    if suffix not in WRITTEN or path.name.endswith(".compressed.ply"):
        raise ConfigError(f"{path}: a splat is written as {', '.join(WRITTEN)}; name it so")
    with atomic_path(path) as temporary:
        if suffix in (".spz", ".sog"):
            write = write_spz if suffix == ".spz" else write_sog
            order = write(temporary, parameters, degree, world)
            if semantics is not None:  # first, so that no whole file lies there without them
                semantics.write(path, temporary, order)
        elif suffix == ".glb":
            write_splat_glb(temporary, parameters, degree, semantics, world)
        else:
            labels = None if semantics is None else semantics.labels[semantics.meanings]
            names = None if semantics is None else semantics.names
            write_ply(temporary, parameters, degree, labels, names, world)


def _splat(path: Path) -> tuple[dict[str, np.ndarray], int]:
    """Antimatter15's 32 bytes a Gaussian: centre, scales, RGBA, quaternion."""
    row = np.dtype(
        [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
    )
    data = path.read_bytes()
    if len(data) % row.itemsize:
        raise InputError(
            f"{path} is cut or no .splat: {len(data)} bytes are no multiple of 32; {REMEDY}"
        )
    rows = np.frombuffer(data, row)
    with np.errstate(divide="ignore", invalid="ignore"):  # scales of 0 and below
        log_scales = np.log(rows["scales"])
    return raw_parameters(
        rows["means"],
        log_scales,
        (rows["quats"].astype(np.float32) - 128) / 128,
        rows["rgba"][:, 3],
        (rows["rgba"][:, :3] / 255 - 0.5) / C0,
        np.zeros((len(rows), 0, 3)),
    ), 0
