"""Parts of the report's page: names and colours of labels, the headline, classes, pictures of test views."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from chebsplat.formats.evaluation import Evaluation
    from chebsplat.formats.gaussians import Gaussians
    from chebsplat.stages.command import Job


def label_names(job: Job, figures: dict[str, Any]) -> dict[str, list[str]]:
    """Names of the labels in each label picture, their union `all` (the protocol's classes first), and its `colors`.

    Scene and teacher may use other words than the capture; a word they share has one colour.
    """
    from chebsplat.formats.artifact import read_manifest
    from chebsplat.formats.documents import read_document
    from chebsplat.formats.features import read_features
    from chebsplat.stages import figures as draw

    classes = (figures.get("segmentation") or {}).get("classes", [])
    names = {"labels": classes, "predicted": classes, "teacher": classes}
    if "scene" in job.inputs:
        path = job.inputs["scene"]
        names["predicted"] = list(read_document(path, read_manifest(path), "labels.json").values())
    if "features" in job.inputs:
        names["teacher"] = read_features(job.inputs["features"]).label_names
    names["all"] = list(dict.fromkeys([*classes, *names["predicted"], *names["teacher"]]))
    names["colors"] = ["#" + bytes(color).hex() for color in draw.palette(len(names["all"]))]
    return names


def tiles(figures: dict[str, Any], gaussians: Gaussians) -> list[tuple[str, str, str]]:
    """The headline: (value, what, aside)."""
    image, segmentation = figures["image"], figures.get("segmentation") or {}
    found = [(f"{image['psnr']:.1f} dB", "PSNR", f"SSIM {image['ssim']:.3f}")]
    if segmentation and segmentation["scene"]["miou"] is not None:
        of_teacher = segmentation.get("teacher", {}).get("miou")
        aside = "" if of_teacher is None else f"its 2D teacher: {of_teacher:.1%}"
        found.append((f"{segmentation['scene']['miou']:.1%}", "mIoU", aside))
        found.append((f"{segmentation['scene']['oa']:.1%}", "pixels right", "overall accuracy"))
    found.append((f"{figures['n_gaussians']:,}", "Gaussians", f"PLY {figures['bytes']['ply'] / 1e6:.1f} MB"))
    for name, value in list(figures["frames_per_second"].items())[:1]:
        found.append((f"{value:.0f}", "frames a second", name.replace("_", " ")))
    last = gaussians.trace[-1]
    return [*found, (f"{last['seconds']:.0f} s", "training", f"{last['step']:.0f} steps")]


def class_rows(figures: dict[str, Any], names: dict[str, list[str]]) -> list[tuple[str, str, float, float | None]]:
    """(class, colour, IoU, its teacher's IoU), best first; classes that occur nowhere are not listed."""
    segmentation = figures.get("segmentation") or {}
    of_teacher = segmentation.get("teacher", {}).get("iou", {})
    rows = [
        (name, color, segmentation["scene"]["iou"][name], of_teacher.get(name))
        for name, color in zip(segmentation.get("classes", []), names["colors"], strict=False)
    ]
    return sorted((row for row in rows if row[2] is not None), key=lambda row: -row[2])


def picture_rows(
    evaluation: Evaluation, names: dict[str, list[str]], count: int, out: Path
) -> tuple[list[dict[str, Any]], list[int]]:
    """Pictures of evenly spaced test views, and the labels (places in `all`) that occur in them; a PNG of the first."""
    import numpy as np

    from chebsplat.stages import figures as draw

    views, pictures = evaluation.figures["names"], evaluation.pictures
    per_view = evaluation.figures["image"]["per_view"]["psnr"]
    place = {name: k for k, name in enumerate(names["all"])}
    shared = {
        kind: np.array([*(place[name] for name in names[kind]), -1]) for kind in ("labels", "teacher", "predicted")
    }
    rows, sheet, seen = [], [], {-1}
    for k in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int)):
        truth, render = pictures["truth"][k], pictures["renders"][k]
        maps = {kind: shared[kind][pictures[kind][k]] for kind in shared if kind in pictures}
        seen |= {int(value) for labels in maps.values() for value in np.unique(labels)}
        images = [("truth", draw.data_uri(truth, photo=True)), ("renders", draw.data_uri(render, photo=True))]
        images.append(("error", draw.data_uri(draw.error_map(render, truth), photo=True)))
        colored = {kind: draw.colored(labels, len(names["all"])) for kind, labels in maps.items()}
        images += [(kind, draw.data_uri(image)) for kind, image in colored.items()]
        if {"labels", "predicted"} <= maps.keys():
            images.append(("wrong", draw.data_uri(draw.wrong_map(maps["predicted"], maps["labels"]))))
        rows.append({"name": views[k], "psnr": per_view[k], "images": images})
        sheet.append(np.concatenate([truth, render, *colored.values()], 1))
    draw.png(np.concatenate(sheet[:2], 0), out / "pictures.png")
    return rows, sorted(seen - {-1})
