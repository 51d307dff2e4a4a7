"""Parts of the report's page: names and colours of labels, headline, classes, pictures."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from chebsplat.errors import InputError
from chebsplat.evaluation.metrics import confusion
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation, rests
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.scene import read_label_names
from chebsplat.labels.names import rows_of

IN_LEGEND = 30  # labels; an open vocabulary has hundreds
CAPTIONS = {
    "truth": "photo",
    "renders": "render",
    "labels": "true labels",
    "teacher": "2D teacher's labels",
    "predicted": "scene's labels",
    "error": "colour error",
    "wrong": "wrong labels",
}
SHARED = Path(__file__).parent
REPORT = SHARED / "report.html"


def side(caption: str, base: str, over: str | None = None) -> dict[str, str | None]:
    """One side of the slider: a picture and its overlay, by their keys."""
    return {"caption": caption, "base": base, "over": over}


def modes(pictures: list[dict[str, Any]]) -> list[list[Any]]:
    """Comparisons that the slider of a report offers, by the pictures that there are."""
    there = {key for key, _, _ in pictures[0]["images"]}
    errors = side("colour error, 4 times", "error")
    wrong = side("render, wrong labels in red", "renders", "wrong")
    compared: list[list[Any]] = [
        ["photo | render", side("photo", "truth"), side("render", "renders")],
        [
            "true labels | scene",
            side("true labels", "truth", "labels"),
            side("scene's labels", "renders", "predicted"),
        ],
        [
            "2D teacher | scene",
            side("2D teacher's labels", "truth", "teacher"),
            side("scene's labels", "renders", "predicted"),
        ],
        ["errors", errors, wrong if "wrong" in there else side("render", "renders")],
    ]
    return [
        mode
        for mode in compared
        if {s[key] for s in mode[1:] for key in ("base", "over")} <= there | {None}
    ]


def label_names(inputs: dict[str, Path], figures: dict[str, Any]) -> list[str]:
    """Names of the labels in the pictures: the capture's classes, else the scene's labels."""
    classes = Capture.read(inputs["capture"]).class_names if "capture" in inputs else None
    classes = classes or (figures.get("segmentation") or {}).get("classes")
    if classes is None and "scene" in inputs:
        path = inputs["scene"]
        classes = read_label_names(path, read_manifest(path))
    return classes or []


def tiles(figures: dict[str, Any], gaussians: Gaussians) -> list[tuple[str, str, str]]:
    """The headline: (value, name, detail)."""
    image, segmentation = figures["image"], figures.get("segmentation") or {}
    tiles = [(f"{image['psnr']:.1f} dB", "PSNR", f"SSIM {image['ssim']:.3f}")]
    if segmentation and segmentation["scene"]["miou"] is not None:
        of_teacher = segmentation.get("teacher", {}).get("miou")
        details = [
            rests(segmentation),
            "" if of_teacher is None else f"its 2D teacher: {of_teacher:.1%}",
        ]
        tiles.append(
            (f"{segmentation['scene']['miou']:.1%}", "mIoU", "; ".join(filter(None, details)))
        )
    if segmentation and segmentation["scene"].get("oa") is not None:
        tiles.append((f"{segmentation['scene']['oa']:.1%}", "pixels right", "overall accuracy"))
    tiles.append(
        (f"{figures['n_gaussians']:,}", "Gaussians", f"PLY {figures['bytes']['ply'] / 1e6:.1f} MB")
    )
    for name, value in list(figures["frames_per_second"].items())[:1]:
        tiles.append(
            (
                f"{value:.0f}",
                "frames a second",
                "colour alone" if name == "color" else "colour and features",
            )
        )
    last = gaussians.trace[-1]
    return [*tiles, (f"{last['seconds']:.0f} s", "training", f"{last['step']:.0f} steps")]


def class_rows(
    figures: dict[str, Any], colors: dict[str, str]
) -> list[tuple[str, str, float, float | None]]:
    """(class, colour, IoU, its teacher's IoU) of the classes that occur, best first."""
    segmentation = figures.get("segmentation") or {}
    of_teacher = segmentation.get("teacher", {}).get("iou", {})
    of_scene = segmentation.get("scene", {}).get("iou", {})
    rows = [
        (name, colors.get(name, "#999"), iou, of_teacher.get(name))
        for name, iou in of_scene.items()
        if iou is not None
    ]
    return sorted(rows, key=lambda row: -row[2])


def beside_truth(
    evaluation: Evaluation, names: list[str], inputs: dict[str, Path]
) -> list[dict[str, Any]]:
    """Rows of the confusion matrix, of the most frequent true classes, at most IN_LEGEND: `name`;
    the scene's `label` of that name, or None; `share` of the labelled pixels; `taken`: (name, share
    of its pixels) predicted as each class of the rows, and as anything else.
    """
    pictures = evaluation.pictures
    if not {"labels", "predicted"} <= pictures.keys():
        return []
    n = len(names)
    matrix = np.zeros((n, n + 1), int)
    for view in range(len(pictures["labels"])):
        labels = pictures["predicted"][view]
        matrix += confusion(np.where(labels < 0, n, labels), pictures["labels"][view], n + 1)[:-1]
    pixels = matrix.sum(1)
    classes = [int(k) for k in np.argsort(-pixels, kind="stable")[:IN_LEGEND] if pixels[k]]
    labels_of_scene = (
        read_label_names(inputs["scene"], read_manifest(inputs["scene"]))
        if "scene" in inputs
        else names
    )
    rows = dict(zip(classes, rows_of([names[k] for k in classes], labels_of_scene), strict=True))
    table = []
    for k in classes:
        shares = matrix[k, classes] / pixels[k]
        predictions = [
            *zip([names[other] for other in classes], shares, strict=True),
            ("anything else", 1 - shares.sum()),
        ]
        label = labels_of_scene[rows[k]] if rows[k] >= 0 else None
        table.append(
            {
                "name": names[k],
                "label": label,
                "share": pixels[k] / pixels.sum(),
                "taken": predictions,
            }
        )
    return table


def legend(pixels: Counter[int], names: list[str], colors: dict[str, str]) -> list[tuple[str, str]]:
    """(name, colour) of the labels of most pixels, in their order, and the number of the others."""
    labels = sorted(label for label, _ in pixels.most_common(IN_LEGEND))
    more = len(pixels) - len(labels)
    return [(names[k], colors[names[k]]) for k in labels] + (
        [(f"and {more} more", "transparent")] if more else []
    )


def picture_rows(
    evaluation: Evaluation, names: list[str], count: int, out: Path
) -> tuple[list[dict[str, Any]], Counter[int]]:
    """Pictures (key, URI, caption) of some views, and pixels of each label; writes pictures.png.

    Raises: InputError if a picture holds a label that has no name.
    """
    from chebsplat.stages.pages import pictures as draw

    views, pictures = evaluation.figures["names"], evaluation.pictures
    if not views or not {"truth", "renders"} <= pictures.keys():
        raise InputError("the evaluation holds no pictures of views; evaluate again")
    per_view = evaluation.figures["image"]["per_view"]["psnr"]
    rows, sheet = [], []
    pixels: Counter[int] = Counter()
    for k in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int)):
        truth, render = pictures["truth"][k], pictures["renders"][k]
        maps = {
            kind: pictures[kind][k]
            for kind in ("labels", "teacher", "predicted")
            if kind in pictures
        }
        for labels in maps.values():
            pixels.update(counted(labels))
        if max(pixels, default=-1) >= len(names):
            raise InputError(
                f"label {max(pixels)} in the pictures has no name; pass "
                "--in-capture, or evaluate again"
            )
        images = [
            ("truth", draw.data_uri(truth, photo=True)),
            ("renders", draw.data_uri(render, photo=True)),
        ]
        images.append(("error", draw.data_uri(draw.error_map(render, truth), photo=True)))
        colored = {kind: draw.colored(labels, len(names)) for kind, labels in maps.items()}
        images += [(kind, draw.data_uri(image)) for kind, image in colored.items()]
        if {"labels", "predicted"} <= maps.keys():
            images.append(
                ("wrong", draw.data_uri(draw.wrong_map(maps["predicted"], maps["labels"])))
            )
        captions = CAPTIONS | {"renders": f"render, {per_view[k]:.1f} dB"}
        named = [(key, uri, captions[key]) for key, uri in images]
        rows.append({"name": f"{views[k]}, {per_view[k]:.1f} dB", "images": named})
        sheet.append(np.concatenate([truth, render, *colored.values()], 1))
    draw.png(np.concatenate(sheet[:2], 0), out / "pictures.png")
    return rows, pixels


def counted(labels: np.ndarray) -> dict[int, int]:
    """Pixels of each label of a map; -1 is none."""
    present, counts = np.unique(labels[labels >= 0], return_counts=True)
    return dict(zip(present.tolist(), counts.tolist(), strict=True))


def rendered(template: Path, narrow: int = 700, **values: Any) -> str:
    """The page of a template. Raises jinja2's UndefinedError where a value is missing."""
    loader = jinja2.FileSystemLoader([template.parent, SHARED])
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template(template.name).render(narrow=narrow, **values)
