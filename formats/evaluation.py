"""`evaluation/1`: figures per view and per class, rendered pictures, timings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.arrays import StoredArray, has_array, open_array, write_array
from chebsplat.formats.documents import Count, NotRequired, TypedDict, read_document, write_document
from chebsplat.formats.manifest import Manifest, remedy_of
from chebsplat.formats.names import check_names

SCHEMA = "chebsplat.evaluation/1"
PICTURES = {"truth": "uint8", "renders": "uint8", "labels": "int16", "predicted": "int16", "teacher": "int16"}


Share = Annotated[float, Ge(0), Le(1)]


class Image(TypedDict):
    psnr: float
    psnr_fit: NotRequired[float]
    ssim: float
    per_view: dict[str, list[float]]


class Measured(TypedDict):
    """Of a scene or its teacher; a protocol measures some of them."""

    miou: NotRequired[Share | None]
    macc: NotRequired[Share | None]
    oa: NotRequired[Share | None]
    boundary_miou: NotRequired[Share | None]
    rarest_miou: NotRequired[Share | None]
    point_miou: NotRequired[Share | None]
    iou: NotRequired[dict[str, Share | None]]


class Segmentation(TypedDict, total=False):
    classes: list[str]
    scene: Measured
    teacher: Measured


class Figures(TypedDict):
    """What every reader of figures.json relies on."""

    names: list[str]
    image: Image
    image_aligned: NotRequired[Image]
    n_gaussians: Count
    bytes: dict[str, Count]
    frames_per_second: dict[str, float]
    left_out: dict[str, str]
    source: NotRequired[dict[str, Any]]
    protocol: NotRequired[dict[str, Any]]
    milliseconds: NotRequired[dict[str, float | str]]
    lpips: NotRequired[float | None]
    segmentation: NotRequired[Segmentation]


@dataclass
class Evaluation:
    """figures: everything measured, JSON-able, `None` where it was not measured (never 0).
    pictures: by name in PICTURES, one entry a test view: `truth`, `renders` u8 [V,H,W,3]; label maps i16 [V,H,W].
    """

    figures: dict[str, Any]
    pictures: dict[str, np.ndarray | StoredArray] = field(default_factory=dict)


def write_evaluation(out: Path, evaluation: Evaluation) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a figure that is nan or infinite."""
    write_document(out / "figures.json", evaluation.figures)
    for name, data in evaluation.pictures.items():
        dimensions = ("view", "row", "column", "channel")[: data.ndim]  # type: ignore[union-attr]
        write_array(out / name, np.asarray(data).astype(PICTURES[name], copy=False), dimensions)


def read_evaluation(path: Path) -> Evaluation:
    """Figures at `path`; pictures stay on disk until indexed.

    Raises: InputError naming the damaged file and the remedy.
    """
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    pictures: dict[str, np.ndarray | StoredArray] = {}
    for name, dtype in PICTURES.items():
        if has_array(manifest, name):
            shape = (None, None, None, 3) if dtype == "uint8" else (None, None, None)
            pictures[name] = open_array(path, manifest, name, shape, dtype, (-1, np.iinfo(dtype).max))
    figures, remedy = read_figures(path, manifest), remedy_of(path)
    shapes = {data.shape[:3] for data in pictures.values()}
    if len(shapes) > 1 or (shapes and shapes.pop()[0] != len(figures["names"])):
        raise InputError(f"{path}: its pictures are not of {len(figures['names'])} views of one size; {remedy}")
    return Evaluation(figures, pictures)


def read_figures(path: Path, manifest: Manifest) -> dict[str, Any]:
    """The figures alone. Raises InputError naming file and remedy."""
    figures: dict[str, Any] = read_document(path, manifest, "figures.json", Figures)
    file, remedy = path / "figures.json", remedy_of(path)
    check_names(figures["names"], "names", file, remedy)
    for image in (figures["image"], figures.get("image_aligned", {"per_view": {}})):
        for name, values in image["per_view"].items():
            if len(values) != len(figures["names"]):
                raise InputError(f"{file}: {len(values)} {name} of {len(figures['names'])} views; {remedy}")
    return figures
