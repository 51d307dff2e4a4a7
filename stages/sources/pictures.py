"""Images of a source: photos, and one-channel images that belong to them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.errors import InputError
from chebsplat.formats.images import opened, seen_size, turned
from chebsplat.formats.tensors import finite32, read_npz
from chebsplat.stages.sources.cameras import SAME_SHAPE

EIGHT_BIT = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr"}  # PIL's modes of photos
DEEP = {"I", "I;16", "I;16B"}  # 16-bit
GREY = DEEP | {"L", "P"}
LARGEST = 16 << 20  # bytes of a view's confidences: 4 million in single precision


@contextmanager
def open_photo(
    path: Path, size: tuple[int, int], upright: bool
) -> Iterator[tuple[Any, np.ndarray | None]]:
    """An RGB image of (width, height) `size`, and the mask of opaque pixels (None: all).

    Choices: a model's own photos are turned by EXIF only if they fit its camera no other way, since
      COLMAP counts pixels as they are stored. Alpha under one half is transparent, and empty; all
      photos are composed over black, as renders are.
    """

    def check(image: Any) -> None:
        if image.mode not in EIGHT_BIT:
            raise InputError(f"{path} is no 8-bit photo (mode {image.mode}); convert it to 8 bits")
        actual = seen_size(image) if upright or image.size != size else image.size
        if actual != size:
            raise InputError(
                f"{path} is {_by(actual)}, its camera {_by(size)}; restore the image or its camera"
            )

    with opened(path, check=check) as image:
        if upright or image.size != size:
            image = turned(image)
        if "A" not in image.mode and "transparency" not in image.info:
            yield (image if image.mode == "RGB" else image.convert("RGB")), None
            return
        image = image if image.mode == "RGBA" else image.convert("RGBA")
        alpha = image.getchannel("A")
        black = Image.new("RGB", image.size)
        black.paste(image, mask=alpha)
        opaque = np.asarray(alpha) >= 128
        yield black, None if opaque.all() else opaque


def companion(
    path: Path,
    size: tuple[int, int],
    at: np.ndarray,
    modes: set[str] | None = None,
    meaning: str = "",
) -> np.ndarray:
    """The pixels at `at` [2, H, W] of a one-channel image that belongs to a photo of (width,
    height) `size`, in any resolution of that photo's shape.

    Args: modes: PIL's, that are read as they are; None: all, as grey values; meaning: of the modes,
      for messages.
    Raises: InputError naming the file.
    """

    def check(image: Any) -> None:
        if modes is not None and image.mode not in modes:
            raise InputError(
                f"{path} has mode {image.mode}, not {meaning} in one channel; convert it"
            )
        same_shape(path, image.size, size)

    with opened(path, "add it, or take its folder away to do without", check) as image:
        grey = image if modes is not None or image.mode in DEEP else image.convert("L")
        return nearest(np.asarray(grey), at, size)


def fits(own: tuple[int, int], size: tuple[int, int]) -> bool:
    """True where (width, height) `own` has the shape of a photo's `size`."""
    return own == size or abs(own[0] * size[1] / (own[1] * size[0]) - 1) < SAME_SHAPE


def same_shape(path: Path, own: tuple[int, int], size: tuple[int, int]) -> None:
    """Raise InputError where an image has not the shape of the photo that it belongs to."""
    if not fits(own, size):
        raise InputError(f"{path} is {_by(own)}, its photo {_by(size)}; restore it")


def confidences(path: Path) -> np.ndarray:
    """The array `confidence` [h, w] of an .npz file, f32 in [0, 1]. Raises InputError."""
    stored = read_npz(path, ["confidence"], "copy it again", LARGEST).get("confidence")
    values = None if stored is None else finite32(stored)
    if (
        values is None
        or values.ndim != 2
        or not values.size
        or not ((values >= 0) & (values <= 1 + 1e-4)).all()
    ):
        raise InputError(f"{path}: `confidence` must be an image of values in 0...1; copy it again")
    return values.clip(0, 1)


def nearest(values: np.ndarray, at: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixels [H, W] of `values` [h, w] or [h, w, C] at positions [2, H, W] in a photo of `size`."""
    height, width = values.shape[:2]
    column = np.clip(np.floor(at[0] * (width / size[0])).astype(int), 0, width - 1)
    row = np.clip(np.floor(at[1] * (height / size[1])).astype(int), 0, height - 1)
    return values[row, column]


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
