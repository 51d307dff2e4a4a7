"""report: one self-contained HTML page with pictures, tables and error against run time, and the
figures as CSV.
"""

from __future__ import annotations

import csv
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.cameras import centers
from chebsplat.errors import DataFailure
from chebsplat.evaluation.metrics import psnr
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.evaluation import Evaluation, rests
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.manifest import Manifest, measured_on
from chebsplat.formats.photo_model import PhotoModel
from chebsplat.stages.pages import parts
from chebsplat.stages.pages import pictures as draw
from chebsplat.stages.pages.measures import course_of, row_of, stops
from chebsplat.stages.pages.parts import REPORT, rendered
from chebsplat.stages.pages.started import started
from chebsplat.stages.runtime.command import Job

N_PICTURES = 4  # test views in the report
LARGEST = 20_000_000  # bytes of the page
STAGE_OF = {
    "model": "pose",
    "capture": "ingest",
    "points": "sfm",
    "channels": "channels",
    "features": "teacher",
    "agreement": "agree",
    "descriptors": "describe",
    "encoding": "encode",
    "learned": "learn",
    "knowledge": "recall",
    "encoder": "onnx",
    "gaussians": "train",
    "lifted": "lift",
    "refined": "refine",
    "scene": "export",
    "evaluation": "evaluate",
}
BYTES = {
    "unpruned_ply": "plain 3DGS: every SH band, nothing else",
    "ply": "scene.ply: every SH band, label and SH degree",
    "ragged": "ragged arrays",
    "semantic": "semantic arrays, beside either",
    "spz": "scene.spz, lossy",
}
# of layouts that hold less than plain 3DGS a share is told
SMALLER = ("ragged", "spz")
FRAMES = {"color": "colour", "color_and_features": "colour and features"}


def run(job: Job) -> None:
    """One HTML page, and the figures as CSV, of what was measured and where it comes from.

    Reads `evaluation` and `gaussians`, and of `model`, `capture`, `points`, `channels`, `features`,
    `agreement`, `descriptors`, `encoding`, `lesson`, `knowledge`, `encoder`, `lifted`, `refined`
    and `scene` what there is. Writes `report`.
    """
    evaluation = Evaluation.read(job.inputs["evaluation"])
    gaussians = Gaussians.read(job.inputs["gaussians"])
    if not gaussians.trace:
        raise DataFailure(
            "the training left no trace of error against run time; train the scene again"
        )
    manifests = {role: read_manifest(job.inputs[role]) for role in STAGE_OF if role in job.inputs}
    if "knowledge" in manifests and manifests["knowledge"].stage != STAGE_OF["knowledge"]:
        del manifests["knowledge"]  # it ships, or was given: no stage of this scene has made it
    facts, figures = (
        {role: manifest.facts for role, manifest in manifests.items()},
        evaluation.figures,
    )
    left_out = absent_stages(job, gaussians) | figures["left_out"]
    for of_input in facts.values():
        left_out |= of_input.get("left_out", {})
    stages = [row_of(STAGE_OF[role], m, facts) for role, m in manifests.items()]
    course = course_of(stages, facts, gaussians.trace, psnr_of_one_color(evaluation))
    timed = {role: measured_on(manifests[role]) for role in ("evaluation", "gaussians")}
    versions: dict[str, str] = {}
    settings: dict[str, Any] = {}
    for manifest in manifests.values():
        versions |= manifest.versions
        settings |= manifest.config
    by_degree = facts["scene"]["by_degree"] if "scene" in facts else None
    rows = summary_rows(figures, by_degree, facts["gaussians"], timed) + refined_rows(
        facts.get("refined")
    )
    rows += agreement_rows(facts.get("agreement")) + clock_rows(manifests["gaussians"])
    write_table(job.out / "figures.csv", rows)
    write_table(
        job.out / "trace.csv",
        [list(gaussians.trace[0]), *(list(row.values()) for row in gaussians.trace)],
    )
    names = parts.label_names(job.inputs, figures)
    colors = {
        name: "#" + bytes(color).hex()
        for name, color in zip(names, draw.palette(len(names)), strict=True)
    }
    pictures, pixels = parts.picture_rows(evaluation, names, N_PICTURES, job.out)
    text = rendered(
        REPORT,
        name=figures["source"].get("name") or figures["source"].get("kind", "scene"),
        scene=shlex.quote(str(figures["source"].get("name") or "SCENE")),
        source=figures["source"],
        protocol=figures["protocol"],
        teacher=teacher_words(facts["features"]) if "features" in facts else None,
        doubt=facts.get("agreement", {}).get("doubt"),
        rows=rows[1:],
        tiles=parts.tiles(figures, gaussians),
        legend=parts.legend(pixels, names, colors),
        classes=parts.class_rows(figures, colors),
        beside=parts.beside_truth(evaluation, names, job.inputs),
        unmatched=(figures.get("segmentation") or {}).get("unmatched", {}),
        pictures=pictures,
        modes=parts.modes(pictures),
        curves=draw.curves(gaussians.trace, figures["image"]["psnr"]),
        course=draw.course(course, figures["image"]["psnr"]),
        stops=stops(course),
        meaning=course.words,
        stages=stages,
        total=sum(row.seconds for row in stages),
        left_out=sorted(left_out.items()),
        decided=decided_rows(facts["gaussians"]),
        started=started(job.inputs, facts),
        posed=posed(PhotoModel.read(job.inputs["model"])) if "model" in job.inputs else None,
        versions=sorted(versions.items()),
        code=next((m.code for m in manifests.values() if "commit" in m.code), None),
        settings=json.dumps(settings, indent=1, sort_keys=True),
    )
    if len(text) > LARGEST:
        raise DataFailure(f"the page would have {len(text) / 1e6:.0f} MB; lower ingest.max_side")
    (job.out / "report.html").write_text(text)
    job.facts |= {"page": "report.html", "psnr": figures["image"]["psnr"]}


def psnr_of_one_color(evaluation: Evaluation) -> float:
    """PSNR, dB, of some evaluated photos, if each pixel had their mean colour: what a scene shows
    before training.
    """
    truth = evaluation.pictures["truth"]
    photos = np.stack([truth[k] for k in range(0, len(truth), -(-len(truth) // N_PICTURES))])
    flat = np.broadcast_to(photos.mean((0, 1, 2)).round().astype(np.uint8), photos.shape)
    return min(psnr(flat, photos), 100.0)


def clock_rows(training: Manifest) -> list[list[str]]:
    """(figure, scene, teacher) of a training that the clock limits: how far it came depends on the
    machine.
    """
    seconds = training.config.get("train", {}).get("seconds")
    if seconds is None:
        return []
    what = (
        f"steps within {seconds:g} s by the clock (train.seconds, measured on "
        f"{measured_on(training)})"
    )
    return [[what, f"{training.facts['steps']:,}", ""]]


def posed(model: PhotoModel) -> dict[str, Any]:
    """Where photos that came alone were taken, in a sentence and a picture, and what is doubtful
    about it.
    """
    point, view = model.tracks.T
    counts = np.bincount(view, minlength=len(model.names))
    errors = np.bincount(view, model.errors[point], len(model.names)) / np.maximum(counts, 1)
    poses = model.cam_from_world
    picture = draw.cameras(centers(poses), -poses[:, 1, :3], model.points, errors)
    return {"sentence": " ".join(model.notes), "doubts": model.judged["doubts"], "picture": picture}


def decided_rows(facts: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Settings that the training's config left open: name, value, and what decided it."""
    words = {name: of["value"] for name, of in facts.get("decided", {}).items()}
    shown = {
        name: f"{value:.3g}" if isinstance(value, float) else str(value)
        for name, value in words.items()
    }
    return [(f"train.{name}", value, facts["decided"][name]["by"]) for name, value in shown.items()]


def teacher_words(facts: dict[str, Any]) -> tuple[str, str]:
    """(name, in a few words what it is) of the 2D teacher."""
    convention = facts["convention"]
    if facts["kind"] == "labels":
        return "noisy labels", (
            f"the source's own with {convention['confusion']:.0%} of the segments confused"
        )
    if facts["kind"] == "given":
        return "pseudo labels", (
            f"the source's own with a confidence by pixel, {facts['n_labels']} labels"
        )
    scales = "one scale" if convention["n_scales"] == 1 else f"{convention['n_scales']} scales"
    views = f"{scales}{' and flips' if convention['flips'] else ''}"
    gives = convention.get("scores") or convention["output"]
    return convention["teacher"], f"ONNX {gives} at {views}, {facts['n_labels']} labels"


def absent_stages(job: Job, gaussians: Gaussians) -> dict[str, str]:
    """Stages of which this scene has no artifact, and why."""
    reasons = {
        "features": "rendering only: the scene has no semantics"
        if "features" not in gaussians.parameters
        else "",
        "agreement": "the scene has no teacher, or its agreement was not measured",
        "lifted": "the scene has no teacher, or its features were not lifted",
        "refined": "the scene has no teacher, or its features were not refined",
    }
    absent = {role: why for role, why in reasons.items() if role not in job.inputs}
    return {
        f"stage {STAGE_OF[role]}": why or "its artifact was not given"
        for role, why in absent.items()
    }


def summary_rows(
    figures: dict[str, Any],
    by_degree: list[int] | None,
    trained: dict[str, Any],
    timed: dict[str, str],
) -> list[list[str]]:
    """Header, then (figure, scene, teacher). What was not measured says so.

    Args: by_degree: Gaussians by SH degree, None where unknown; trained: facts of the training;
      timed: the machines that `evaluation` and training (`gaussians`) were measured on.
    """

    def shown(value: float | None, form: str) -> str:
        return "not measured" if value is None else form.format(value)

    image = figures["image"]
    of = ", of undistorted photos" if "undistorted" in figures["source"] else ""
    rows = [
        ["figure", "scene", "2D teacher"],
        [f"PSNR, dB (8-bit, mean over views{of})", f"{image['psnr']:.2f}", ""],
        ["PSNR after a colour fit by view, dB", shown(image.get("psnr_fit"), "{:.2f}"), ""],
        *taken_rows(image.get("as_taken")),
        ["SSIM (window 11, σ 1.5)", f"{image['ssim']:.4f}", ""],
        ["LPIPS (vgg, images in [0, 1])", shown(figures["lpips"], "{:.3f}"), ""],
    ]
    segmentation = figures.get("segmentation") or {}
    names = {"miou": "mIoU", "macc": "mAcc", "oa": "OA", "boundary_miou": "mIoU in the boundary "
                                                                          "band",
             "rarest_miou": "mIoU of the five rarest classes", "point_miou": "mIoU of 3D points"}  # fmt: skip
    for key, name in names.items():
        if key in segmentation.get("scene", {}):
            teacher = segmentation.get("teacher")
            values = [segmentation["scene"][key], teacher[key] if teacher else None]
            of_truth = f" ({words})" if (words := rests(segmentation, key)) else ""
            rows.append(
                [
                    name + of_truth,
                    shown(values[0], "{:.1%}"),
                    shown(values[1], "{:.1%}") if teacher else "",
                ]
            )
    rows.append(["Gaussians", f"{figures['n_gaussians']:,}", ""])
    if by_degree is not None:
        rows.append(
            ["Gaussians of SH degree 0, 1, 2, 3", " / ".join(f"{n:,}" for n in by_degree), ""]
        )
    whole = figures["bytes"]["unpruned_ply"]
    for name, size in figures["bytes"].items():
        share = f" ({size / whole:.0%} of plain 3DGS)" if name in SMALLER else ""
        rows.append([f"bytes, {BYTES[name]}", f"{size:,}{share}", ""])
    on = f"measured on {timed['evaluation']}"
    rows += [
        [f"frames/s, {FRAMES[name]} ({on})", f"{v:.1f}", ""]
        for name, v in figures["frames_per_second"].items()
    ]
    if split := figures["milliseconds"]:
        threads = "one thread" if split["threads"] == 1 else f"{split['threads']} threads"
        under = f"{split['width']}x{split['height']}, {threads}, {split['device']}, {on}"
        parts = {"projection": "projection", "sh": "SH", "sort": "sort", "blend": "blend"}
        rows += [
            [f"ms a frame, {name} ({under})", f"{split[part]:.2f}", ""]
            for part, name in parts.items()
        ]
    on = f"measured on {timed['gaussians']}"
    rows += [
        [f"ms a training step, {part} ({on})", f"{v:.2f}", ""]
        for part, v in trained["milliseconds"].items()
    ]
    if peak := trained.get("peak_device_bytes"):
        rows.append(["bytes of the GPU's memory in training, at most", f"{peak:,}", ""])
    return rows


def taken_rows(taken: dict[str, Any] | None) -> list[list[str]]:
    """Figures on the test photos as they were taken; none where these are what was trained on."""
    if taken is None:
        return []
    size = "{}×{}".format(*taken["size"])
    return [
        [f"PSNR on the photos as taken, {size} pixels, dB", f"{taken['psnr']:.2f}", ""],
        ["SSIM on them", f"{taken['ssim']:.4f}", ""],
    ]


def refined_rows(facts: dict[str, Any] | None) -> list[list[str]]:
    """(figure, scene, teacher) of how the features were refined: what was chosen, and the
    agreements it rests on.
    """
    if facts is None:
        return []
    changed = {name: facts.get(f"changed_by_{name}") for name in ("smoothing", "knowledge")}
    words = {
        name: "" if share is None else f", {share:.1%} of the labels changed"
        for name, share in changed.items()
    }
    counts = f"counts as {facts['strength']:g} views" if facts["strength"] else "none"
    if (familiar := facts.get("familiar", 1.0)) < 1:
        counts += f"; the teacher is unsure of this scene, its views count for {familiar:.2f}"
    rows = [
        ["smoothing of features", ("on" if facts["smooth"] else "off") + words["smoothing"], ""],
        ["knowledge in features", counts + words["knowledge"], ""],
    ]
    for name, curve in facts["curve"].items():
        shown = " / ".join(f"{value:.4f}" for value in curve.values())
        rows.append([f"agreement of half the training views with the other, smoothing {name}, at "
                     "k = "
                     + " / ".join(curve), shown, ""])  # fmt: skip
    return rows


def agreement_rows(facts: dict[str, Any] | None) -> list[list[str]]:
    """(figure, scene, teacher) of how far views agree on what points are by their 2D teacher."""
    if facts is None:
        return []
    value, count = facts["agreement"], facts["n_points"]
    shown = "not measured" if value is None else f"{value:.2f}"
    return [
        [f"agreement of views on labels of {count:,} points (1: always, 0: by chance)", "", shown]
    ]


def write_table(path: Path, rows: list[list[Any]]) -> None:
    """Write rows as CSV."""
    with path.open("w", newline="") as handle:
        csv.writer(handle).writerows(rows)
