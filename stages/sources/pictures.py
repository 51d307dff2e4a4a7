"""The images of a source: photos, the one-channel images that belong to them."""

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
    """An RGB image of (width, height) `size`, and where it is opaque (None: everywhere), as
    `opened` gives one.

    Choices: a model's own photos are turned by EXIF only if they fit its camera no other way, since
      COLMAP counts
      pixels as they are stored. What is transparent is empty: it lies before black, as what is
        rendered does; alpha
      under one half is transparent.
    """

    def check(image: Any) -> None:
        if image.mode not in EIGHT_BIT:
            raise InputError(f"{path} is no 8-bit photo (mode {image.mode}); convert it to 8 bits")
        found = seen_size(image) if upright or image.size != size else image.size
        if found != size:
            raise InputError(
                f"{path} is {_by(found)}, its camera {_by(size)}; restore the image or its camera"
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
    wanted: str = "",
) -> np.ndarray:
    """The pixels at `at` [2, H, W] of a one-channel image that belongs to a photo of (width,
    height) `size`, in any resolution of that photo's shape.

    Args: modes: PIL's, that are taken as they are; None: all, as grey values.
    Raises: InputError naming the file.
    """

    def check(image: Any) -> None:
        if modes is not None and image.mode not in modes:
            raise InputError(
                f"{path} has mode {image.mode}, not {wanted} in one channel; convert it"
            )
        same_shape(path, image.size, size)

    with opened(path, "add it, or take its folder away to do without", check) as image:
        grey = image if modes is not None or image.mode in DEEP else image.convert("L")
        return nearest(np.asarray(grey), at, size)


def fits(found: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether (width, height) are those of a photo, or have their shape."""
    return found == size or abs(found[0] * size[1] / (found[1] * size[0]) - 1) < SAME_SHAPE


def same_shape(path: Path, found: tuple[int, int], size: tuple[int, int]) -> None:
    """Raise InputError where what belongs to a photo has not its shape."""
    if not fits(found, size):
        raise InputError(f"{path} is {_by(found)}, its photo {_by(size)}; restore it")


def confidences(path: Path) -> np.ndarray:
    """The array `confidence` [h, w] of an .npz file, f32 in [0, 1]; nothing in it is unpickled.
    Raises InputError.
    """
    held = read_npz(path, ["confidence"], "copy it again", LARGEST).get("confidence")
    found = None if held is None else finite32(held)
    if (
        found is None
        or found.ndim != 2
        or not found.size
        or not ((found >= 0) & (found <= 1 + 1e-4)).all()
    ):
        raise InputError(f"{path}: `confidence` must be an image of values in 0...1; copy it again")
    return found.clip(0, 1)


def nearest(values: np.ndarray, at: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Those stored pixels [H, W] of `values` [h, w], or [h, w, C], that hold positions `at` [2, H,
    W] in a photo of (width, height).
    """
    height, width = values.shape[:2]
    column = np.clip(np.floor(at[0] * (width / size[0])).astype(int), 0, width - 1)
    row = np.clip(np.floor(at[1] * (height / size[1])).astype(int), 0, height - 1)
    return values[row, column]


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
