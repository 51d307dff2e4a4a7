"""The photos source: a folder of images and nothing else. Poses come from structure from motion."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats.images import header, is_image
from chebsplat.stages.sources import assembly, cameras, common
from chebsplat.stages.sources.common import Frame, Listing

GUESS = 1.2  # focal length in longer sides, where EXIF says nothing
FILM = 36.0  # mm, the longer side of the frame that 35 mm equivalents refer to


def read(folder: Path, settings: Any, class_names: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The fields of a capture, without poses. `class_names` is of no use here: photos have no labels.

    Choices: structure from motion works on the views that are made here, so that what a lens bends is undone before.
    """
    listing = _listing(folder)
    if settings.lens == "estimated":
        from chebsplat.stages.sources.lens import with_lens

        used, notes = assembly.chosen(listing, settings)
        listing.frames, note = with_lens(used, listing.upright)
        listing.notes = [*notes, *([note] if note else [])]
    return assembly.assemble(listing, settings, class_names)


def probe(folder: Path) -> dict[str, bool]:
    """What a folder of photos brings beside them: nothing."""
    return {"poses": False, "depth": False, "labels": False}


def files(folder: Path) -> list[Path]:
    """The photos; subfolders are not searched. Raises InputError if there are none."""
    try:
        names = [name for name in os.listdir(folder) if is_image(name)]
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; correct source.path") from None
    if not names:
        raise InputError(f"{folder} holds no .jpg, .png or .heic image; correct source.path")
    return sorted(folder / name for name in common.printable(folder, names))


def _listing(folder: Path) -> Listing:
    frames, guessed = [], 0
    for path in files(folder):
        (width, height), focal = header(path)
        guessed += focal is None
        pixels = max(width, height) * (GUESS if focal is None else focal / FILM)
        camera = cameras.camera_of(path, "SIMPLE_PINHOLE", (pixels, width / 2, height / 2), width, height)
        frames.append(Frame(path.stem, path, camera))
    notes = []
    if guessed:
        notes.append(
            f"{guessed} of {len(frames)} photos have no focal length; {GUESS} times the longer side is the first guess."
        )
    return Listing("photos", frames, notes=notes, upright=True)
