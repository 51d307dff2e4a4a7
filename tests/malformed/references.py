"""Images that are no scene's: the reference folder of `channels`, and the photo that a teacher is checked with."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from chebsplat.formats.teacher_model import EMBEDDED
from malformed.case import Asked, Case, stage
from malformed.edits import NO_FILES, Edit, Row, cut, declared_png, no_files, picture, put, remove
from malformed.photos import EPS

KIND = "reference images"
PHOTO = "photos/b.jpg"


def rows() -> Iterator[Row]:
    yield from no_files(PHOTO, kinds=NO_FILES)
    for what, content in {"nothing": b"", "text": b"a sofa", "an EPS": EPS, "zeros": bytes(999),
                          "a PNG of 10,000 million pixels": declared_png(100_000, 100_000)}.items():  # fmt: skip
        yield f"{PHOTO} holds {what}", "b.jpg", put(PHOTO, content)
    for form in ("TIFF", "GIF", "WEBP", "BMP"):
        yield f"{PHOTO} is a {form}", "b.jpg", picture(PHOTO, (64, 48), form=form)
    yield f"{PHOTO} is cut", "b.jpg", cut(PHOTO, 300)
    yield f"{PHOTO} is missing", "photos", remove(PHOTO)


def _case(name: str, named: str, edit: Edit, reduced: bool) -> Case:
    def build(folder: Path) -> Asked:
        picture(PHOTO, (64, 48), form="JPEG")(folder)
        edit(folder)
        if reduced:
            return stage("channels", folder, {"channels": {"reference": str(folder / "photos")}}, named)
        return Asked(["check-teacher", EMBEDDED, "--photo", folder / PHOTO], named)

    return Case(KIND, f"{name}, in {'channels' if reduced else 'check-teacher'}", build)


def cases() -> Iterator[Case]:
    yield from (_case(*row, reduced=False) for row in rows())
    yield from (_case(*row, reduced=True) for row in rows())
