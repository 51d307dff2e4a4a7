"""report: one self-contained HTML page with pictures, tables and error against run time, and the figures as CSV."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, Any

from chebsplat.errors import DataFailure
from chebsplat.stages.command import Job, command

if TYPE_CHECKING:
    from pathlib import Path

    from chebsplat.formats.evaluation import Evaluation
    from chebsplat.formats.gaussians import Gaussians

STAGE_OF = {
    "capture": "ingest",
    "points": "sfm",
    "features": "teacher",
    "descriptors": "describe",
    "gaussians": "train",
    "scene": "export",
    "encoder": "onnx",
    "basis": "cks",
    "evaluation": "evaluate",
}


def run(job: Job) -> None:
    import jinja2

    from chebsplat.formats.artifact import read_manifest
    from chebsplat.formats.evaluation import read_evaluation
    from chebsplat.formats.gaussians import read_gaussians
    from chebsplat.stages import figures as draw
    from chebsplat.stages.page import PAGE

    evaluation = read_evaluation(job.inputs["evaluation"])
    gaussians = read_gaussians(job.inputs["gaussians"])
    if not gaussians.trace:
        raise DataFailure("the training left no trace of error against run time; train the scene again")
    manifests = {role: read_manifest(job.inputs[role]) for role in STAGE_OF if role in job.inputs}
    figures = evaluation.figures
    left_out = absent_stages(job, gaussians) | figures["left_out"]
    for manifest in manifests.values():
        left_out |= manifest.facts.get("left_out", {})
    stages = [(STAGE_OF[role], m.seconds, m.key, m.device, m.threads) for role, m in manifests.items()]
    versions: dict[str, str] = {}
    for manifest in manifests.values():
        versions |= manifest.versions
    rows = summary_rows(figures)
    write_table(job.out / "figures.csv", rows)
    write_table(job.out / "trace.csv", [list(gaussians.trace[0]), *(list(row.values()) for row in gaussians.trace)])
    pictures = picture_rows(evaluation, job.config.report.n_pictures, job.out)
    segmentation = figures.get("segmentation") or {}
    classes = segmentation.get("classes", [])
    legend = [
        (label, "#" + bytes(color).hex()) for label, color in zip(classes, draw.palette(len(classes)), strict=True)
    ]
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(PAGE)
    text = page.render(
        name=figures["source"].get("name") or figures["source"].get("kind", "scene"),
        source=figures["source"],
        protocol=figures["protocol"],
        rows=rows[1:],
        segmentation=segmentation,
        legend=legend,
        pictures=pictures,
        curve=draw.curve(gaussians.trace),
        stages=stages,
        total=sum(seconds for _, seconds, *_ in stages),
        left_out=sorted(left_out.items()),
        versions=sorted(versions.items()),
    )
    (job.out / "report.html").write_text(text)
    job.facts |= {"page": "report.html", "psnr": figures["image"]["psnr"]}
    if "descriptors" in manifests:
        known = manifests["descriptors"].facts
        names = ("spectrum", "n_cuts", "n_cuts_in_clusters", "n_in_float64")
        job.facts["descriptors"] = {name: known[name] for name in names if name in known}


def absent_stages(job: Job, gaussians: Gaussians) -> dict[str, str]:
    """Stages of which this scene has no artifact, and why."""
    encoder = gaussians.notes.get("encoder")
    unneeded = "no shape encoder is trained"
    reasons = {
        "features": "rendering only: the scene has no semantics" if "features" not in gaussians.parameters else "",
        "descriptors": unneeded if encoder is None else "the encoder's tokens hold no descriptor",
        "encoder": unneeded if encoder is None else "",
        "basis": "no sequence is named",
    }
    absent = {role: why for role, why in reasons.items() if role not in job.inputs}
    return {f"stage {STAGE_OF[role]}": why or "its artifact was not given" for role, why in absent.items()}


def summary_rows(figures: dict[str, Any]) -> list[list[str]]:
    """Header, then (figure, scene, teacher). What was not measured says so."""

    def shown(value: float | None, form: str) -> str:
        return "not measured" if value is None else form.format(value)

    image = figures["image"]
    rows = [
        ["figure", "scene", "2D teacher"],
        ["PSNR, dB (8-bit, mean over views)", f"{image['psnr']:.2f}", ""],
        ["SSIM (window 11, σ 1.5)", f"{image['ssim']:.4f}", ""],
        ["LPIPS (vgg, images in [0, 1])", shown(figures["lpips"], "{:.3f}"), ""],
    ]
    segmentation = figures.get("segmentation") or {}
    names = {"miou": "mIoU", "macc": "mAcc", "oa": "OA", "boundary_miou": "mIoU in the boundary band"}
    for key, name in names.items():
        if segmentation:
            teacher = segmentation.get("teacher")
            values = [segmentation["scene"][key], teacher[key] if teacher else None]
            rows.append([name, shown(values[0], "{:.1%}"), shown(values[1], "{:.1%}") if teacher else ""])
    rows.append(["Gaussians", f"{figures['n_gaussians']:,}", ""])
    rows += [[f"bytes, {name}", f"{size:,}", ""] for name, size in figures["bytes"].items()]
    rows += [[f"frames/s, {n.replace('_', ' ')}", f"{v:.1f}", ""] for n, v in figures["frames_per_second"].items()]
    split = figures["milliseconds"]
    under = f"{split['width']}x{split['height']}, {split['threads']} threads, {split['device']}"
    parts = ("projection", "sh", "sort", "blend")
    rows += [[f"ms a frame, {part} ({under})", f"{split[part]:.2f}", ""] for part in parts]
    return rows


def write_table(path: Path, rows: list[list[Any]]) -> None:
    with path.open("w", newline="") as handle:
        csv.writer(handle).writerows(rows)


def picture_rows(evaluation: Evaluation, count: int, out: Path) -> list[dict[str, Any]]:
    """Ground truth, render, label and predicted-label pictures of evenly spaced test views; a PNG of the first."""
    import numpy as np

    from chebsplat.stages import figures as draw

    names, pictures = evaluation.figures["names"], evaluation.pictures
    per_view = evaluation.figures["image"]["per_view"]["psnr"]
    classes = (evaluation.figures.get("segmentation") or {}).get("classes", [])
    maps = [p for name, p in pictures.items() if name not in ("truth", "renders")]
    n_labels = max([len(classes), 1, *(int(np.max(p[:], initial=0)) + 1 for p in maps)])
    rows, sheet = [], []
    for k in np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int)):
        images = []
        for name in ("truth", "renders", "labels", "teacher", "predicted"):
            if name in pictures:
                picture = pictures[name][k]
                images.append((name, picture if picture.ndim == 3 else draw.colored(picture, n_labels)))
        rows.append({"name": names[k], "psnr": per_view[k], "images": [(n, draw.data_uri(i)) for n, i in images]})
        sheet.append(np.concatenate([image for _, image in images], 1))
    draw.png(np.concatenate(sheet[:2], 0), out / "pictures.png")
    return rows


main = command("report", run)
