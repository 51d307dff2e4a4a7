"""The images beside photos, depth, labels and masks: what is no such image, and what does not fit its photo."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from source_folders import image, write_colmap

from malformed.case import Case
from malformed.edits import NO_FILES, Row, all_of, cut, declared_png, ingested, no_files, picture, planned, put, remove

KIND = "companion images"
MODES = {"depth": "I;16", "semantic": "L", "masks": "L"}
WRONG = {"depth": ("L", "RGB", "1", "P"), "semantic": ("RGB", "LA", "1"), "masks": ()}


def write(source: Path) -> None:
    write_colmap(source)
    for name in "abc":
        image(source / f"masks/{name}.png", mode="L", value=255)


def rows() -> Iterator[Row]:
    for place, mode in MODES.items():
        path = f"{place}/b.png"
        yield f"{place}: nothing", path, put(path, b"")
        yield f"{place}: text", path, put(path, "depth")
        yield f"{place}: a TIFF", path, picture(path, mode=mode, form="TIFF")
        yield f"{place}: a GIF", path, picture(path, mode="L", form="GIF")
        yield f"{place}: an EPS", path, picture(path, mode="L", form="EPS")
        yield f"{place}: cut", path, cut(path, 30)
        yield f"{place}: too small", path, picture(path, (4, 3), mode)
        yield f"{place}: turned", path, picture(path, (6, 8), mode)
        yield f"{place}: 10,000 million pixels", path, put(path, declared_png(100_000, 100_000, 0))
        yield from ((f"{place}: mode {wrong}", path, picture(path, mode=wrong)) for wrong in WRONG[place])
        yield from no_files(path, kinds=NO_FILES)
    yield "depth as 32-bit floats", "depth/b.png", picture("depth/b.png", mode="F", form="TIFF")
    yield "depth as negative numbers", "depth/b.png", picture("depth/b.png", mode="I", form="TIFF")
    yield "one depth image is missing", "depth/b.png", remove("depth/b.png")
    yield "one label image is missing", "semantic/b.png", remove("semantic/b.png")
    yield "all masks are zero", "masks/a.png", all_of(*(picture(f"masks/{n}.png", mode="L") for n in "abc"))
    everything = all_of(*(picture(f"images/{n}.png", mode="RGBA") for n in "abc"), remove("masks"))
    yield "all photos are transparent", "images/a.png", everything
    yield "no label has a name", "label", put("labels.json", '{"3": "sofa"}')


def cases() -> Iterator[Case]:
    yield from ingested(KIND, write, rows())
    yield from planned(KIND, write, [*no_files("masks/b.png"), *no_files("depth/b.png")])
