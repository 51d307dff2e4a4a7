"""Images from outside, read by Pillow: PNG, JPEG and HEIC, recognised by content, bounded in size.

Pillow would read forty more formats, whatever a file is called; one of its readers starts
Ghostscript.
"""

from __future__ import annotations

import math
import os
import struct
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.extras import extra
from chebsplat.formats.files import regular

FORMATS = ("PNG", "JPEG")
SUFFIXES = (".jpg", ".jpeg", ".png", ".heic", ".heif")
# ISO/IEC 23008-12
HEIC_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}
# of one image, and of all being decoded at once, at up to 12 bytes a pixel
MAX_PIXELS = 64_000_000
MAX_SIDE = 65_535  # JPEG's limit
INCOMPLETE = "the source is incomplete"
# Raised by Pillow on damaged pixels, and by struct and its parsers on damaged EXIF.
DAMAGE = (OSError, SyntaxError, ValueError, struct.error, EOFError, LookupError, TypeError,
          AttributeError, ArithmeticError)  # fmt: skip
SUBSECTION, ORIENTATION, FOCAL_35 = 0x8769, 0x0112, 0xA405  # EXIF tags
TURNS = {2: 0, 3: 3, 4: 1, 5: 5, 6: 4, 7: 6, 8: 2}  # orientation: Pillow's Transpose that undoes it
ON_ITS_SIDE = (5, 6, 7, 8)  # orientations that swap width and height


def is_image(name: str) -> bool:
    """True for the name of a PNG, JPEG or HEIC image; hidden files are none."""
    return os.path.splitext(name)[1].lower() in SUFFIXES and not name.startswith(".")


def images_below(folder: Path, remedy: str) -> list[Path]:
    """The images of a folder and those below it, sorted. Raises InputError where there is none."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"{folder} holds no .png or .jpg image; {remedy}")
    return files


def is_heic(path: Path) -> bool:
    """True for a HEIC image, by its first bytes. Raises InputError if it cannot be read."""
    regular(path, INCOMPLETE)
    with Path(path).open("rb") as handle:
        start = handle.read(12)
    return start[4:8] == b"ftyp" and start[8:] in HEIC_BRANDS


def require_heic(path: Path) -> None:
    """Raises InputError with the command that installs the reader of HEIC, if it is missing."""
    extra("pillow_heif", f"{path} is a HEIC photo, which", error=InputError)


@contextmanager
def opened(
    path: Path, remedy: str = INCOMPLETE, check: Callable[[Any], None] | None = None
) -> Iterator[Any]:
    """A decoded PIL image for a `with` block; `check` is called with it before it is decoded.

    Choices: threads decode at once what fits into MAX_PIXELS together, and a larger photo waits for
      the others, so that blocks must not be nested.
    Raises:  InputError if it is missing (with that remedy), damaged, too large or of another
      format.
    """
    with ExitStack() as pixels:

        def inspect(image: Any) -> None:
            if check is not None:
                check(image)
            pixels.enter_context(_BUDGET.hold(image.width * image.height))
            image.load()

        yield _opened(path, inspect, remedy)


def read_rgb(path: Path, remedy: str = INCOMPLETE) -> np.ndarray:
    """u8 [H, W, 3] as it is stored, whatever its mode. Raises InputError."""
    with opened(path, remedy) as image:
        return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


def header(path: Path, remedy: str = INCOMPLETE) -> tuple[tuple[int, int], float | None]:
    """(width, height) of the upright photo, and its 35 mm focal length or None; reads no pixel."""

    def inspect(image: Any) -> None:
        focal = _exif(image).get_ifd(SUBSECTION).get(FOCAL_35)
        usable = isinstance(focal, (int, float)) and math.isfinite(focal) and focal > 0
        sizes.append(seen_size(image))
        focals.append(float(focal) if usable else None)

    sizes: list[tuple[int, int]] = []
    focals: list[float | None] = []
    _opened(path, inspect, remedy)
    return sizes[0], focals[0]


def seen_size(image: Any) -> tuple[int, int]:
    """(width, height) of a PIL image once it is turned by its EXIF orientation."""
    width, height = image.size
    return (height, width) if _exif(image).get(ORIENTATION) in ON_ITS_SIDE else (width, height)


def turned(image: Any) -> Any:
    """A PIL image as its EXIF orientation says it is meant to be seen."""
    method = TURNS.get(_exif(image).get(ORIENTATION))
    return image if method is None else image.transpose(method)


def _exif(image: Any) -> Any:
    """EXIF before the pixels: Pillow's own `getexif` would decode a whole PNG for the rest."""
    from PIL import Image

    return Image.Image.getexif(image)


def _formats(path: Path) -> tuple[str, ...]:
    """Pillow's readers for a file: that of HEIC for such a file alone.

    Choices: the camera's own rotation of a HEIC is applied by its reader, which also clears the
      EXIF orientation that repeats it.
    """
    if not is_heic(path):
        return FORMATS
    require_heic(path)
    import pillow_heif

    pillow_heif.register_heif_opener(thumbnails=False)
    return ("HEIF",)


def _opened(path: Path, inspect: Callable[[Any], None], remedy: str) -> Any:
    from PIL import Image, UnidentifiedImageError

    regular(path, remedy)
    # Pillow's own limit is higher than ours
    warnings.simplefilter("error", Image.DecompressionBombWarning)
    try:
        with Path(path).open("rb") as handle:
            image = Image.open(handle, formats=_formats(path))
            if image.width * image.height > MAX_PIXELS or max(image.size) > MAX_SIDE:
                raise Image.DecompressionBombError(f"{image.width}x{image.height}")
            inspect(image)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(
            f"{path} is too large ({error}; {MAX_PIXELS // 10**6} megapixels and {MAX_SIDE} "
            "pixels a side are read); "
            "reduce it"
        ) from None
    except UnidentifiedImageError:
        raise InputError(
            f"{path} is no PNG, JPEG or HEIC image, whatever its name; convert it"
        ) from None
    except DAMAGE as error:
        raise InputError(f"{path} is not a readable image ({error}); copy it again") from None
    return image


class _PixelBudget:
    def __init__(self) -> None:
        self._free, self._changed = MAX_PIXELS, threading.Condition()

    @contextmanager
    def hold(self, n_pixels: int) -> Iterator[None]:
        with self._changed:
            self._changed.wait_for(lambda: self._free >= n_pixels)
            self._free -= n_pixels
        try:
            yield
        finally:
            with self._changed:
                self._free += n_pixels
                self._changed.notify_all()


_BUDGET = _PixelBudget()
