"""ScanNet's two layouts: poses, intrinsics, splits, tables of labels, points and confidences that are none."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import layouts
import numpy as np
from source_folders import image

from malformed.case import Case
from malformed.clouds import CLOUDS
from malformed.edits import Row, cut, ingested, keys, no_files, planned, put, swollen
from malformed.tables import EYE, INTRINSICS, POSES, gone, matrix_rows

SG, PL = "ScanNet (SG)", "ScanNet (PL)"
TABLE, POINTS, SPLIT = "scannetv2-labels.modified.tsv", "points3d.ply", "splits.json"
CONFIDENCE = "m2f_probabilities/20.npz"
SIZE = (20, 16)
IDS = ("0", "10", "20", "30")


def _write(source: Path, labels: str) -> None:
    for name in IDS:
        image(source / f"color/{name}.png", SIZE)
        image(source / labels / f"{name}.png", SIZE, 2, "L")
        put(f"pose/{name}.txt", EYE)(source)
    put("intrinsic/intrinsic_color.txt", "20 0 9.5 0\n0 20 7.5 0\n0 0 1 0\n0 0 0 1\n")(source)


def write_sg(source: Path) -> None:
    _write(source, "label-filt")
    layouts.write_table(source / TABLE, "cocomapid", layouts.COCO_IDS)
    put(POINTS, CLOUDS["whole"])(source)


def write_pl(source: Path) -> None:
    _write(source, "rs_semantics")
    keys(SPLIT, train=["0", "10", "20"], test=["30"])(source)
    for name in IDS:
        image(source / f"m2f_semantics/{name}.png", SIZE, 2, "L")
        put(f"m2f_probabilities/{name}.npz", npz(np.ones((6, 8), np.float32)))(source)


def npz(array: np.ndarray, name: str = "confidence", pickled: bool = False) -> bytes:
    held = io.BytesIO()
    np.savez_compressed(held, allow_pickle=pickled, **{name: array})
    return held.getvalue()


def declared(shape: tuple[int, ...], descr: str = "<f4", n_bytes: int = 1 << 16) -> bytes:
    """An .npz whose one array declares more than it holds."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": descr, "fortran_order": False, "shape": shape})
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("confidence.npy", header.getvalue() + bytes(n_bytes))
    return held.getvalue()


def sg_rows() -> Iterator[Row]:
    yield from matrix_rows("pose/20.txt", POSES)
    yield from matrix_rows("intrinsic/intrinsic_color.txt", INTRINSICS)
    for what, content in CLOUDS.items():
        if what != "whole":
            yield f"points3d.ply: {what}", POINTS, put(POINTS, content)
    yield from no_files(POINTS, TABLE)
    head = "id\traw_category\tcocomapid\n"
    for what, text in {"nothing": "", "binary": bytes(range(256)), "no header": "1\twall\t1\n",
                       "a field of 200 KB": f"{head}1\t{'a' * 200_000}\t1\n",
                       "an open quote": f'{head}1\t"{"a" * 200_000}', "a header alone": head,
                       "commas": head.replace("\t", ",") + "1,wall,1\n", "short rows": f"{head}1\n",
                       "a negative id": f"{head}-1\twall\t1\n", "a negative class": f"{head}1\twall\t-1\n",
                       "a class too many": f"{head}1\twall\t21\n", "a class of nan": f"{head}1\twall\tnan\n",
                       "a word for an id": f"{head}one\twall\t1\n", "no class": f"{head}1\twall\t\n",
                       "an id of 5000 digits": f"{head}{'9' * 5000}\twall\t1\n", "UTF-16": head.encode("utf-16"),
                       "only other ids": f"{head}9\twall\t1\n"}.items():  # fmt: skip
        yield f"the table holds {what}", "label" if "other ids" in what else TABLE, put(TABLE, text)
    yield "the table has a terabyte of zeros", TABLE, swollen(TABLE, 10**12)
    for place in ("pose/20.txt", "intrinsic/intrinsic_color.txt", "label-filt/20.png", TABLE, POINTS):
        yield gone(place)


def pl_rows() -> Iterator[Row]:
    bomb = np.zeros((4000, 8000), np.float32)
    for what, content in {
        "nothing": b"", "no zip": b"confidence", "another name": npz(np.ones((6, 8)), "probability"),
        "one dimension": npz(np.ones(48, np.float32)), "another type": npz(np.full((6, 8), "a")),
        "pickled objects": npz(np.full((6, 8), {}), pickled=True), "no pixel": npz(np.ones((0, 8), np.float32)),
        "nan": npz(np.full((6, 8), np.nan)), "inf": npz(np.full((6, 8), np.inf)), "7": npz(np.full((6, 8), 7.0)),
        "-1": npz(np.full((6, 8), -1.0)), "complex numbers": npz(np.ones((6, 8), complex)),
        "32 million zeros": npz(bomb), "terabytes that it declares": declared((10**6, 10**6)),
        "400 million that it declares": declared((20_000, 20_000)), "a negative shape": declared((-6, 8)),
        "a shape beyond 2^64": declared((2**62, 2**62)), "an object type": declared((6, 8), "|O"),
    }.items():  # fmt: skip
        yield f"a confidence: {what}", "20.npz", put(CONFIDENCE, content)
    yield "a confidence is cut", "20.npz", cut(CONFIDENCE, 40)
    yield gone(CONFIDENCE)
    yield from no_files(CONFIDENCE, SPLIT)
    for content in ("", "[]", "null", "{}", b"\xff\xfe", "[" * 50_000, '{"train": {}}'):
        yield f"splits.json = {content[:14]!r}", SPLIT, put(SPLIT, content)
    for side in ("train", "test"):
        for value in (None, "30", 30, {"30": 1}, [30], [None], [["30"]]):
            yield f"{side} = {value!r}", SPLIT, keys(SPLIT, **{side: value})
    yield "both sides", SPLIT, keys(SPLIT, train=["30"])
    yield "names that no view has", "ingest.min_views", keys(SPLIT, train=["x"], test=["y"])


def cases() -> Iterator[Case]:
    yield from ingested(SG, write_sg, sg_rows(), "scannet")
    yield from ingested(PL, write_pl, pl_rows(), "scannet")
    yield from planned(SG, write_sg, list(no_files("pose/20.txt")))
