"""What every source on disk shares: frames, cameras and poses as a listing, and the files behind them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.evaluation.protocols.split import natural

IMAGE_TYPES = (".jpg", ".jpeg", ".png")
PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}  # model: number of parameters
DISTORTED = {"SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}
ROTATION_TOLERANCE = 1e-2  # of RᵀR − I: rows written with three decimals pass, a scale of 1 % does not


@dataclass(frozen=True)
class Camera:
    """A COLMAP camera: model, its parameters in pixels with pixel centres at half integers, and the image's size."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        p = self.params
        return (p[0], p[1], p[2], p[3]) if self.model in ("PINHOLE", "OPENCV") else (p[0], p[0], p[1], p[2])


@dataclass
class Frame:
    """One photo and what belongs to it. pose: cam_from_world [4, 4], OpenCV axes, nan if unusable; None if unknown."""

    name: str
    image: Path
    camera: Camera
    pose: np.ndarray | None = None
    depth: Path | None = None
    labels: Path | None = None
    mask: Path | None = None
    objects: Path | None = None  # ids of objects, as large as the labels
    pseudo_labels: Path | None = None  # what a 2D network took the photo for
    confidence: Path | None = None  # .npz whose `confidence` [h, w] says how sure it was


@dataclass
class Listing:
    """All frames of a source.

    label_names:  by raw id. class_names: all classes in order; None: those that occur.
    corrections:  object id -> raw id of the label that its pixels take instead.
    pseudo_names: by id in the pseudo labels; 0 is none.
    any_label_size: label images may have another resolution than their photos.
    depth_scale:  stored units in one scene unit; no_depth: stored values that mean "unknown".
    depth_camera: a pinhole camera of the depth images, at the photo's place; None: the photo's own.
    """

    kind: str
    frames: list[Frame]
    label_names: dict[int, str] | None = None
    class_names: tuple[str, ...] | None = None
    corrections: dict[int, int] = field(default_factory=dict)
    pseudo_names: dict[int, str] | None = None
    any_label_size: bool = False
    depth_scale: float = 1000.0
    no_depth: tuple[int, ...] = (0,)
    depth_camera: Camera | None = None
    notes: list[str] = field(default_factory=list)
    upright: bool = False  # turn every image by its EXIF orientation; otherwise only where its camera asks for it

    def has(self, what: str) -> bool:
        """Whether every frame has a "pose", "depth", "labels" and so on."""
        return bool(self.frames) and all(getattr(frame, what) is not None for frame in self.frames)


def camera_of(origin: Path, model: str, params: Any, width: Any, height: Any) -> Camera:
    """A camera that can be used. Raises InputError naming the file that describes it."""
    if model not in PINHOLES and model not in DISTORTED:
        raise InputError(
            f"{origin}: camera model {model} is not supported ({', '.join([*PINHOLES, *DISTORTED])} are); "
            "undistort the images first, for example with `colmap image_undistorter`"
        )
    try:
        camera = Camera(model, tuple(float(v) for v in params), int(width), int(height))
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{origin}: camera size or parameters are no numbers ({error}); restore the file") from None
    usable = len(camera.params) == (PINHOLES | DISTORTED)[model] and all(map(math.isfinite, camera.params))
    if not usable or min(camera.width, camera.height) < 1 or min(camera.pinhole[:2]) <= 0:
        raise InputError(
            f"{origin}: camera {model} {camera.width}x{camera.height} {camera.params} is not usable; restore the file"
        )
    return camera


def cam_from_world(origin: Path, world_from_cam: np.ndarray, names: list[str]) -> np.ndarray:
    """Inverse [V, 4, 4] of rigid camera-to-world matrices [V, 4, 4]; nan where one holds inf or nan.

    Raises:  InputError naming the first frame whose matrix is scaled, mirrored, sheared or projective.
    Choices: the rounding of a text file is removed by taking the nearest rotation (SVD).
    """
    usable = np.isfinite(world_from_cam).all((1, 2))
    rotations = np.where(usable[:, None, None], world_from_cam[:, :3, :3], np.eye(3))
    error = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max((1, 2))
    last = np.abs(world_from_cam[:, 3] - [0, 0, 0, 1]).max(1, where=usable[:, None], initial=0)
    rigid = (error < ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0) & (last < ROTATION_TOLERANCE)
    if not rigid.all():
        raise InputError(
            f"{origin}: the pose of {names[int(np.argmin(rigid))]} is not a rotation and a translation; "
            "write poses without scale, shear or mirroring"
        )
    left, _, right = np.linalg.svd(rotations)
    inverse = (left @ right).transpose(0, 2, 1)
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = inverse
    poses[usable, :3, 3] = -np.einsum("vij,vj->vi", inverse, np.nan_to_num(world_from_cam[:, :3, 3]))[usable]
    poses[~usable] = np.nan
    return poses


def stem(name: str) -> str:
    """A relative POSIX path without the suffix of an image; other dots are part of the name."""
    base, end = os.path.splitext(name)
    return base if end.lower() in IMAGE_TYPES else name


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises InputError."""
    try:
        document = json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; the source is incomplete") from None
    except ValueError as error:
        raise InputError(f"{path} does not parse ({error}); restore the file") from None
    if not isinstance(document, dict):
        raise InputError(f"{path} holds a {type(document).__name__}, not an object; restore the file")
    return document


def read_matrix(path: Path) -> np.ndarray:
    """A 4x4 matrix in a text file of 3 or 4 rows, as float64; a 3x3 matrix or 3x4 rows are completed. InputError."""
    try:
        rows = [[float(v) for v in line.split()] for line in path.read_text().splitlines() if line.strip()]
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; the source is incomplete") from None
    except ValueError as error:
        raise InputError(f"{path} does not hold numbers ({error}); restore the file") from None
    if len(rows) not in (3, 4) or {len(row) for row in rows} not in ({3}, {4}):
        raise InputError(f"{path} does not hold a 3x3 or 4x4 matrix; restore the file")
    matrix = np.eye(4)
    matrix[: len(rows), : len(rows[0])] = rows
    return matrix


def nearest_file(folder: Path, name: str) -> Path | None:
    """A file that many scenes share: in the scene's folder or in one of the two above it."""
    places = (folder, *folder.absolute().parents[:2])
    return next((place / name for place in places if (place / name).is_file()), None)


def detect(folder: Path) -> str:
    """The kind of source a folder is. Raises InputError naming what was looked for."""
    if (folder / "transforms.json").is_file():
        return "transforms"
    if any((folder / part).exists() for part in ("traj.txt", "Sequence_1", "results")):
        return "replica"
    if all((folder / part).is_dir() for part in ("color", "pose", "intrinsic")):
        return "scannet"
    if (folder / "sparse").is_dir():
        return "colmap"
    if any(path.is_file() for place in ("", "seq-*/") for path in folder.glob(f"{place}frame-*.color.*")):
        return "seven_scenes"
    if folder.is_dir() and any(is_image(path.name) for path in folder.iterdir()):
        return "photos"
    hint = f"; {folder / 'images'} may be meant" if (folder / "images").is_dir() else ""
    raise InputError(
        f"{folder} is no source: it holds neither transforms.json, traj.txt, results/, Sequence_1/, "
        f"color/ with pose/ and intrinsic/, frame-*.color.jpg or .png, sparse/0/cameras.bin or .txt, "
        f"nor a .jpg or .png photo{hint}"
    )


def is_image(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in IMAGE_TYPES and not name.startswith(".")


def names_below(folder: Path) -> Iterator[str]:
    """Relative POSIX paths of the images below a folder, in no order; none if it does not exist."""
    for place, _, names in os.walk(folder):
        inner = os.path.relpath(place, folder).replace(os.sep, "/")
        for name in names:
            if is_image(name):
                yield name if inner == "." else f"{inner}/{name}"


def images_in(folder: Path) -> list[str]:
    """As `names_below`, in natural order. Raises InputError if there are none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is missing; the source needs its images there")
    found = sorted(names_below(folder), key=natural)
    if not found:
        raise InputError(f"{folder} holds no .jpg or .png image; correct source.path")
    return found


def open_image(path: Path, remedy: str = "the source is incomplete") -> Any:
    """A decoded PIL image. Raises InputError if it is missing (with that remedy) or damaged."""
    return _opened(path, lambda image: image.load(), remedy)


def header(path: Path) -> tuple[tuple[int, int], float | None]:
    """(width, height) as the photo is meant to be seen, and its 35 mm focal length if it says so; decodes no pixel."""

    def look(image: Any) -> None:
        found["size"], found["exif"] = image.size, image.getexif()

    found: dict[str, Any] = {}
    _opened(path, look, "the source is incomplete")
    exif = found["exif"]
    size = found["size"][::-1] if exif.get(0x0112, 1) in (5, 6, 7, 8) else found["size"]
    focal = exif.get_ifd(0x8769).get(0xA405)
    usable = isinstance(focal, (int, float)) and math.isfinite(focal) and focal > 0
    return size, float(focal) if usable else None


def _opened(path: Path, look: Any, remedy: str) -> Any:
    from PIL import Image

    try:
        with path.open("rb") as handle:
            image = Image.open(handle)
            look(image)
    except FileNotFoundError:
        raise InputError(f"{path} is missing; {remedy}") from None
    except Image.DecompressionBombError as error:
        raise InputError(f"{path} is too large ({error}); reduce it") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path} is not a readable image ({error}); copy it again") from None
    return image
