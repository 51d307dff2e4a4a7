"""Reader of COLMAP's models, binary and text: cameras, posed images and points.

pycolmap's own loops for ever over a file that is cut in the middle of a record, and fills all
memory at a name without an end.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.files import read_text, regular
from chebsplat.stages.sources import cameras, common
from chebsplat.stages.sources.texts import LONGEST

LARGEST = 512 << 20  # bytes of a file: a million images, or five million points
AGAIN = "copy it again"
SHORT = 0.01  # of a quaternion's length: error by few decimals


@dataclass(frozen=True)
class Image:
    """name: as COLMAP holds it; camera: its id; pose: cam_from_world [4, 4]."""

    name: str
    camera: int
    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class Cloud:
    """A model's points: means f64 [N, 3], colors u8 [N, 3], errors f64 [N] pixels; tracks i64
    [T, 2]: (point's row, position in the model's images).
    """

    means: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    tracks: np.ndarray


@dataclass(frozen=True, eq=False)
class Model:
    """origin: the cameras' file; cameras: (model, parameters, width, height) by id; images in the
    file's order; notes: on parts of the files that were not read.
    """

    origin: Path
    cameras: dict[int, tuple[str, tuple[float, ...], int, int]]
    images: list[Image]
    cloud: Cloud
    notes: tuple[str, ...] = ()


def size_of(place: Path) -> int:
    """Number of images that the files of a model state; 0 where they cannot be read."""
    try:
        if common.present(place / "images.bin"):
            regular(place / "images.bin")
            with (place / "images.bin").open("rb") as stream:
                return int.from_bytes(stream.read(8), "little")
        return sum(1 for _ in _text_images(place / "images.txt", []))
    except (InputError, ValueError, OSError):
        return 0


def read_model(place: Path) -> Model:
    """The model in a folder. Raises InputError naming the file that is cut or inconsistent."""
    end = "bin" if common.present(place / "cameras.bin") else "txt"
    paths = [place / f"{name}.{end}" for name in ("cameras", "images", "points3D")]
    for path in paths:
        regular(path, "a model has cameras, images and points3D")
    read: Any = (_text_cameras, _text_images, _text_points)
    if end == "bin":
        read = (_binary_cameras, _binary_images, _binary_points)
    parts: list[list[Any]] = []
    notes: list[str] = []
    for path, entries in zip(paths, read, strict=True):
        try:
            parts.append(list(entries(path, notes)))
        except (ValueError, IndexError, OverflowError, struct.error) as error:
            raise InputError(
                f"{path} is cut or no COLMAP model ({str(error)[:LONGEST]}); {AGAIN}"
            ) from None
    by_id = dict(parts[0])
    images = []
    for _, name, camera, quaternion, translation in parts[1]:
        if camera not in by_id:
            raise InputError(
                f"{paths[1]}: {name[:LONGEST]!r} is of camera {camera}, which is not "
                f"listed; {AGAIN}"
            )
        images.append(Image(name, camera, _pose(paths[1], name, quaternion, translation)))
    cameras.near(
        paths[1],
        np.array([image.pose[:3, 3] for image in images]).reshape(-1, 3),
        [i.name for i in images],
    )
    position = {key: row for row, (key, *_) in enumerate(parts[1])}
    return Model(paths[0], by_id, images, _cloud(paths[2], parts[2], position), tuple(notes))


def _cloud(path: Path, entries: list[Any], position: dict[int, int]) -> Cloud:
    """Points from (x, y, z, red, green, blue, error) and the ids of the images that see each.

    Choices: an image that is not listed is ignored: scripts that thin out a model leave its points
      as they are.
    """
    values = np.array([entry[0] for entry in entries], float).reshape(-1, 7)
    image_ids = [np.asarray(entry[1], np.int64) for entry in entries]
    ids = np.concatenate([*image_ids, np.zeros(0, np.int64)])
    row = np.repeat(np.arange(len(image_ids)), [*map(len, image_ids)])
    if (
        not np.isfinite(values[:, :6]).all()
        or ((values[:, 3:6] < 0) | (values[:, 3:6] > 255)).any()
    ):
        raise InputError(f"{path}: a point's place or colour is no such; {AGAIN}")
    views = np.array([position.get(key, -1) for key in ids.tolist()], np.int64)
    tracks = np.unique(np.stack([row, views], 1)[views >= 0], axis=0)
    return Cloud(values[:, :3], values[:, 3:6].astype(np.uint8), values[:, 6], tracks)


def _pose(path: Path, name: str, quaternion: Any, translation: Any) -> np.ndarray:
    """cam_from_world [4, 4] of a quaternion (w, x, y, z) and a translation.

    Choices: a unit quaternion is used as it is, as COLMAP does; one of few decimals is normalised.
    """
    q, t = np.array(quaternion, float), np.array(translation, float)
    off = abs(math.hypot(*q) - 1)
    if not (off < SHORT and np.isfinite(t).all()):
        raise InputError(
            f"{path}: the pose of {name[:LONGEST]!r} is no rotation and translation; {AGAIN}"
        )
    w, x, y, z = q if off < 1e-9 else q / math.hypot(*q)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - (2 * y * y + 2 * z * z), 2 * x * y - 2 * z * w, 2 * x * z + 2 * y * w],
        [2 * x * y + 2 * z * w, 1 - (2 * x * x + 2 * z * z), 2 * y * z - 2 * x * w],
        [2 * x * z - 2 * y * w, 2 * y * z + 2 * x * w, 1 - (2 * x * x + 2 * y * y)],
    ]
    pose[:3, 3] = t
    return pose


class _Bytes:
    """A binary file, read record by record; ValueError where a record would pass its end."""

    def __init__(self, path: Path):
        if regular(path).st_size > LARGEST:
            raise ValueError(f"more than {LARGEST >> 20} MiB")
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def skip(self, n_bytes: int) -> None:
        self.at += n_bytes
        if self.at > len(self.data):
            raise ValueError(f"it ends after {len(self.data)} bytes, in the middle of a record")

    def word(self) -> str:
        end = self.data.index(b"\0", self.at)  # raises ValueError
        text = self.data[self.at : end].decode(errors="surrogateescape")
        self.at = end + 1
        return text

    def count(self, least: int) -> range:
        """A range of the next count in the file, of records of at least so many bytes."""
        (n,) = self.take(_COUNT)
        if n * least > len(self.data) - self.at:
            raise ValueError(f"it counts {n} records in {len(self.data)} bytes")
        return range(n)

    def end(self, notes: list[str]) -> None:
        """Note bytes beyond the last record, which COLMAP ignores, too."""
        if rest := len(self.data) - self.at:
            notes.append(
                f"{rest} bytes follow the last record of {self.path.name} and are not read."
            )


_COUNT, _CAMERA, _IMAGE, _POINT = (
    struct.Struct(f"<{layout}") for layout in ("Q", "IiQQ", "I4d3dI", "Q3d3BdQ")
)


def _binary_cameras(
    path: Path, notes: list[str]
) -> Iterator[tuple[int, tuple[str, tuple[float, ...], int, int]]]:
    data = _Bytes(path)
    for _ in data.count(_CAMERA.size):
        key, kind, width, height = data.take(_CAMERA)
        if not 0 <= kind < len(cameras.MODELS):
            raise ValueError(f"camera {key} is of no known model ({kind})")
        name, n = list(cameras.MODELS.items())[kind]
        yield key, (name, data.take(struct.Struct(f"<{n}d")), width, height)
    data.end(notes)


def _binary_images(
    path: Path, notes: list[str]
) -> Iterator[tuple[int, str, int, tuple[float, ...], tuple[float, ...]]]:
    data = _Bytes(path)
    for _ in data.count(_IMAGE.size):
        values = data.take(_IMAGE)
        name = data.word()
        data.skip(24 * len(data.count(24)))  # its keypoints
        yield values[0], name, values[8], values[1:5], values[5:8]
    data.end(notes)


def _binary_points(path: Path, notes: list[str]) -> Iterator[tuple[tuple[float, ...], np.ndarray]]:
    data = _Bytes(path)
    for _ in data.count(_POINT.size):
        _, *values, length = data.take(_POINT)
        start = data.at
        data.skip(8 * length)
        yield tuple(values), np.frombuffer(data.data, "<u4", 2 * length, start)[::2]
    data.end(notes)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Stripped lines with their numbers, without comments."""
    for number, line in enumerate(read_text(path, AGAIN, largest=LARGEST // 8).splitlines(), 1):
        if not (bare := line.strip()).startswith("#"):
            yield number, bare


def _whole(word: str) -> int:
    """A whole number, which some write as 320.0. Raises ValueError."""
    value = float(word)
    if not value.is_integer():
        raise ValueError(f"{word[:LONGEST]} is no whole number")
    return int(value)


def _text_cameras(
    path: Path, notes: list[str]
) -> Iterator[tuple[int, tuple[str, tuple[float, ...], int, int]]]:
    for _, line in _lines(path):
        if words := line.split():
            yield (
                _whole(words[0]),
                (words[1], tuple(map(float, words[4:])), _whole(words[2]), _whole(words[3])),
            )


def _text_images(
    path: Path, notes: list[str]
) -> Iterator[tuple[int, str, int, list[float], list[float]]]:
    """Images, each followed by a line of its keypoints.

    Choices: the line after an image lists its keypoints if it is empty or of numbers alone, three
      each; scripts that thin out a model omit it, so a line that reads as an image is one. Anything
      else is an error.
    """
    follows = False
    for number, line in _lines(path):
        words, n = line.split(maxsplit=9), _numbers(line)
        if follows and n is not None and n % 3 == 0:
            follows = False
        elif words:
            try:
                values = [float(v) for v in words[1:8]]
                entry = _whole(words[0]), words[9], _whole(words[8]), values[:4], values[4:]
            except (ValueError, IndexError):
                entry = None
            if entry is None or (n is not None and abs(math.hypot(*values[:4]) - 1) > SHORT):
                raise ValueError(
                    f"line {number} is neither an image nor keypoints of three numbers each"
                )
            follows = True
            yield entry


def _numbers(line: str) -> int | None:
    """Number of numbers in a line; None where it holds anything else."""
    try:
        return len([float(word) for word in line.split()])
    except ValueError:
        return None


def _text_points(path: Path, notes: list[str]) -> Iterator[tuple[list[float], np.ndarray]]:
    for number, line in _lines(path):
        if words := line.split():
            if len(words) < 8 or len(words) % 2:
                raise ValueError(f"line {number} is a point of {len(words)} words")
            yield [float(v) for v in words[1:8]], np.array([int(v) for v in words[8::2]], np.uint32)
