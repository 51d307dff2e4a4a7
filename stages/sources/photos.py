"""The photos source: a folder of images and nothing else. Poses come from structure from motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.stages.sources import common
from chebsplat.stages.sources.common import Camera, Frame, Listing

FOCAL_35MM, GUESS = 0xA405, 1.2


def read(folder: Path, settings: Any) -> dict[str, Any]:
    """The fields of a capture, without poses."""
    return common.assemble(_listing(folder), settings)


def probe(folder: Path) -> dict[str, bool]:
    return {"poses": False, "depth": False, "labels": False}


def files(folder: Path) -> list[Path]:
    return _images(folder)


def _images(folder: Path) -> list[Path]:
    found = [path for path in folder.iterdir() if path.suffix.lower() in common.IMAGE_TYPES]
    if not found:
        raise InputError(f"{folder} holds no .jpg or .png image; correct source.path")
    return sorted(found, key=lambda path: common.natural(path.name))


def _listing(folder: Path) -> Listing:
    frames, guessed = [], 0
    for path in _images(folder):
        image = common.open_image(path, upright=True)
        focal = image.getexif().get_ifd(0x8769).get(FOCAL_35MM)
        width, height = image.size
        guessed += not focal
        pixels = float(focal) / 36.0 * max(width, height) if focal else GUESS * max(width, height)
        frames.append(Frame(path.stem, path, Camera("SIMPLE_PINHOLE", [pixels, width / 2, height / 2], width, height)))
    notes = (
        [f"{guessed} photos have no focal length; {GUESS} times the longer side is the first guess."] if guessed else []
    )
    return Listing("photos", frames, notes=notes, upright=True)
