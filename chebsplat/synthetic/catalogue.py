"""Modelled furniture of Sweet Home 3D's libraries (.sh3f): true sizes, names, OBJ meshes.

Debian's package `sweethome3d-furniture` has 820 pieces under free licences; nothing of it lies in
this project.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from chebsplat.errors import InputError

FOLDER = Path("/usr/share/sweethome3d/furniture")
GREY = (0.6, 0.6, 0.6)
CM = 0.01


@dataclass(frozen=True)
class Piece:
    """A model in a library's archive: name, category, size [3] in metres (width, depth, height);
    elevation, metres above the floor; top, height of the surface that carries things, None where
    none does; rotation of the model [9], by rows, before its size is measured.
    """

    archive: Path
    model: str
    name: str
    category: str
    size: tuple[float, float, float]
    elevation: float
    top: float | None
    rotation: tuple[float, ...] | None


class Mesh(NamedTuple):
    """Vertices f32 [N, 3] in metres, back at y = 0, bottom at z = 0; triangles of each colour."""

    vertices: np.ndarray
    parts: list[tuple[tuple[float, float, float], np.ndarray]]


def read_catalogue(folder: Path = FOLDER) -> list[Piece]:
    """All pieces of the libraries in a folder.

    Raises: InputError where it has none.
    """
    libraries = sorted(folder.glob("*.sh3f"))
    if not libraries:
        raise InputError(f"{folder} has no .sh3f library: apt install sweethome3d-furniture")
    return [piece for library in libraries for piece in pieces_of(library)]


@contextmanager
def opened(library: Path) -> Iterator[zipfile.ZipFile]:
    """A library's files within the block. Raises InputError where one of them cannot be read."""
    try:
        with zipfile.ZipFile(library) as files:
            yield files
    except (zipfile.BadZipFile, KeyError, zlib.error) as error:
        raise InputError(
            f"{library} is damaged ({error}); apt install --reinstall sweethome3d-furniture"
        ) from error


def pieces_of(library: Path) -> list[Piece]:
    """All pieces of one library."""
    with opened(library) as files:
        text = files.read("PluginFurnitureCatalog.properties").decode("latin-1")
    entries: dict[int, dict[str, str]] = defaultdict(dict)
    for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, flags=re.MULTILINE):
        entries[int(number)][key] = value.strip()
    return [piece_of(library, entry) for _, entry in sorted(entries.items())]


def piece_of(library: Path, entry: dict[str, str]) -> Piece:
    """A piece by its properties in the library's list, which are in centimetres."""
    width, depth, height = (float(entry[side]) * CM for side in ("width", "depth", "height"))
    drop = float(entry.get("dropOnTopElevation", entry["height"])) * CM
    rotation = entry.get("modelRotation")
    return Piece(
        library,
        entry["model"].lstrip("/"),
        entry["name"],
        entry["category"],
        (width, depth, height),
        float(entry.get("elevation", 0)) * CM,
        drop if drop > 0 else None,
        tuple(map(float, rotation.split())) if rotation else None,
    )


@lru_cache(maxsize=256)
def read_mesh(piece: Piece) -> Mesh:
    """The piece in its true size. Colours are those of its materials, linear.

    Raises: InputError naming a library whose file of the piece cannot be read.
    Choices: textures do not count: shape is what such rooms teach.
    """
    with opened(piece.archive) as files:
        lines = files.read(piece.model).decode("latin-1").splitlines()
        folder = PurePosixPath(piece.model).parent
        colors: dict[str, tuple[float, float, float]] = {}
        for line in lines:
            if line.startswith("mtllib"):
                name = str(folder / line.split(maxsplit=1)[1].strip())
                if name in files.namelist():  # one piece of 820 names a file that is not there
                    colors |= colors_of(files.read(name).decode("latin-1"))
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    faces: dict[tuple[float, float, float], list[tuple[int, int, int]]] = defaultdict(list)
    color, count = GREY, 0
    for line in lines:
        if line.startswith("v "):
            count += 1
        elif line.startswith("usemtl"):
            color = colors.get(line.split(maxsplit=1)[1].strip(), GREY)
        elif line.startswith("f "):
            corners = [int(corner.split("/", 1)[0]) for corner in line.split()[1:]]
            rows = [corner - 1 if corner > 0 else count + corner for corner in corners]
            faces[color].extend((rows[0], b, c) for b, c in pairwise(rows[1:]))
    if piece.rotation is not None:
        vertices = vertices @ np.reshape(piece.rotation, (3, 3)).T
    used = np.unique(np.concatenate([np.ravel(part) for part in faces.values()]))
    new_rows = np.zeros(len(vertices), int)
    new_rows[used] = np.arange(len(used))
    x, y, z = vertices[used].T  # y up, z to the front
    upright = np.stack([-x, z, y], 1)
    low, high = upright.min(0), upright.max(0)
    upright = (upright - low) * (np.array(piece.size) / np.maximum(high - low, 1e-9))
    upright[:, 0] -= piece.size[0] / 2
    return Mesh(
        upright.astype(np.float32),
        [(color, new_rows[np.array(part)]) for color, part in faces.items()],
    )


def colors_of(text: str) -> dict[str, tuple[float, float, float]]:
    """Linear diffuse colours of an MTL file's materials."""
    colors = {}
    for block in re.split(r"^newmtl", text, flags=re.MULTILINE)[1:]:
        diffuse = re.search(r"^\s*Kd\s+(.*)$", block, re.MULTILINE)
        r, g, b = (float(v) ** 2.2 for v in diffuse[1].split()[:3]) if diffuse else GREY
        colors[block.splitlines()[0].strip()] = (round(r, 2), round(g, 2), round(b, 2))
    return colors
