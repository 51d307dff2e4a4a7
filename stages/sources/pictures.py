"""The images of a source: photos, and the one-channel images that belong to them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.stages.sources.common import open_image

if TYPE_CHECKING:
    from pathlib import Path

EIGHT_BIT = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr"}  # PIL's modes of photos
DEEP = {"I", "I;16", "I;16B"}  # 16-bit
GREY = DEEP | {"L", "P"}
SAME_SHAPE = 0.02  # difference in aspect ratio that still counts as another resolution of the same picture


def open_photo(path: Path, size: tuple[int, int], upright: bool) -> tuple[Any, np.ndarray | None]:
    """An RGB image of (width, height) `size`, and where it is opaque (None: everywhere).

    Choices: a model's own photos are turned by EXIF only if they fit its camera no other way, since COLMAP counts
      pixels as they are stored; alpha under one half is transparent.
    """
    from PIL import ImageOps

    image = open_image(path)
    if image.mode not in EIGHT_BIT:
        raise InputError(f"{path} is no 8-bit photo (mode {image.mode}); convert it to 8 bits")
    if upright or image.size != size:
        image = ImageOps.exif_transpose(image)
    if image.size != size:
        raise InputError(f"{path} is {_by(image.size)}, its camera {_by(size)}; restore the image or its camera")
    if "A" not in image.mode and "transparency" not in image.info:
        return image.convert("RGB"), None
    opaque = np.asarray(image.convert("RGBA"))[..., 3] >= 128
    return image.convert("RGBA").convert("RGB"), None if opaque.all() else opaque


def companion(
    path: Path, size: tuple[int, int], modes: set[str] | None = None, wanted: str = "", any_size: bool = False
) -> np.ndarray:
    """A one-channel image [h, w] that belongs to a photo of (width, height) `size`; without `modes`, as grey values.

    Args: any_size: it may have another resolution, but must have the photo's shape.
    Raises: InputError naming the file.
    """
    image = open_image(path, "add it, or take its folder away to do without")
    if modes is not None and image.mode not in modes:
        raise InputError(f"{path} has mode {image.mode}, not {wanted} in one channel; convert it")
    alike = abs(image.width * size[1] / (image.height * size[0]) - 1) < SAME_SHAPE
    if image.size != size and not (any_size and alike):
        raise InputError(f"{path} is {_by(image.size)}, its photo {_by(size)}; restore it")
    return np.asarray(image if modes is not None or image.mode in DEEP else image.convert("L"))


def confidences(path: Path) -> np.ndarray:
    """The array `confidence` [h, w] of an .npz file, f32 in [0, 1]; nothing in it is unpickled. Raises InputError."""
    import zipfile
    import zlib

    try:
        with np.load(path, allow_pickle=False) as parts:
            found = np.asarray(parts["confidence"], np.float32)
    except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} holds no readable array `confidence` ({error}); copy it again") from None
    if found.ndim != 2 or not ((found >= 0) & (found <= 1 + 1e-4)).all():
        raise InputError(f"{path}: `confidence` must be an image of values in 0...1; copy it again")
    return found.clip(0, 1)


def nearest(values: np.ndarray, at: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The stored pixels [H, W] of `values` [h, w] that hold positions `at` [2, H, W] in a photo of (width, height)."""
    height, width = values.shape
    column = np.clip(np.floor(at[0] * (width / size[0])).astype(int), 0, width - 1)
    row = np.clip(np.floor(at[1] * (height / size[1])).astype(int), 0, height - 1)
    return values[row, column]


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
