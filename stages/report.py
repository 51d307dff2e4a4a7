"""report: one self-contained HTML page of pictures, tables and error against run time; CSV, too."""

from __future__ import annotations

import csv
import json
import shlex
from pathlib import Path
from typing import Any, NamedTuple

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
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.command import Job

N_PICTURES = 4  # test views in the report
LARGEST = 20_000_000  # bytes of the page
STAGE_OF = {  # by role, in the order of the stages
    role: stage for stage in STAGES for role, of in STAGES["report"].roles.items() if of == stage
}
BYTES = {
    "unpruned_ply": "plain 3DGS: every SH band, nothing else",
    "ply": "scene.ply: every SH band, label and SH degree",
    "ragged": "ragged arrays",
    "semantic": "semantic arrays, beside either",
    "spz": "scene.spz, lossy",
}
# layouts whose share of plain 3DGS is reported
SMALLER = ("ragged", "spz")
FRAMES = {"color": "colour", "color_and_features": "colour and features"}


class Figure(NamedTuple):
    """A row of the table of figures.

    name: with the unit. scene, teacher: a number, several by what each is of, None where it was not
      measured, "" where there is none. form: of a number on the page; words: instead of it there.
    """

    name: str
    scene: Any
    teacher: Any = ""
    form: str = "{:,}"
    words: str = ""

    def on_page(self) -> tuple[str, str, str]:
        """Name, scene and teacher as people read them."""
        if isinstance(self.scene, dict):
            values = " / ".join(self.form.format(value) for value in self.scene.values())
            return f"{self.name} {' / '.join(map(str, self.scene))}", values, ""
        scene, teacher = (
            value if value == "" else "not measured" if value is None else self.form.format(value)
            for value in (self.scene, self.teacher)
        )
        return self.name, self.words or scene, teacher

    def in_table(self) -> list[list[Any]]:
        """Rows of a CSV, numbers as numbers and nothing where there is none."""
        if isinstance(self.scene, dict):
            return [[f"{self.name} {of}", value, ""] for of, value in self.scene.items()]
        return [[self.name, self.scene, self.teacher]]


def run(job: Job) -> None:
    """One HTML page, and the figures as CSV, of a scene's measurements and their origin.

    Reads `evaluation` and `gaussians`, and, where there are, `model`, `capture`, `points`,
    `channels`, `features`, `agreement`, `descriptors`, `encoding`, `lesson`, `knowledge`,
    `encoder`, `lifted`, `refined` and `scene`. Writes `report`.
    """
    evaluation = Evaluation.read(job.inputs["evaluation"])
    gaussians = Gaussians.read(job.inputs["gaussians"])
    if not gaussians.trace:
        raise DataFailure(
            "the training left no trace of error against run time; train the scene again"
        )
    manifests = {role: read_manifest(job.inputs[role]) for role in STAGE_OF if role in job.inputs}
    if "knowledge" in manifests and manifests["knowledge"].stage != STAGE_OF["knowledge"]:
        del manifests["knowledge"]  # it ships, or is the user's: no stage of this scene has made it
    facts = {role: manifest.facts for role, manifest in manifests.items()}
    figures = evaluation.figures
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
    table = [row for figure in rows for row in figure.in_table()]
    write_table(job.out / "figures.csv", [["figure", "scene", "2D teacher"], *table])
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
        rows=[figure.on_page() for figure in rows],
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
        posed=describe_poses(PhotoModel.read(job.inputs["model"]))
        if "model" in job.inputs
        else None,
        versions=sorted(versions.items()),
        code=next((m.code for m in manifests.values() if "commit" in m.code), None),
        settings=json.dumps(settings, indent=1, sort_keys=True),
    )
    if len(text) > LARGEST:
        raise DataFailure(f"the page would have {len(text) / 1e6:.0f} MB; lower ingest.max_side")
    (job.out / "report.html").write_text(text)
    job.facts |= {"page": "report.html", "psnr": figures["image"]["psnr"]}


def psnr_of_one_color(evaluation: Evaluation) -> float:
    """PSNR, dB, of some evaluated photos against their mean colour: that of an untrained scene."""
    truth = evaluation.pictures["truth"]
    photos = np.stack([truth[k] for k in range(0, len(truth), -(-len(truth) // N_PICTURES))])
    flat = np.broadcast_to(photos.mean((0, 1, 2)).round().astype(np.uint8), photos.shape)
    return min(psnr(flat, photos), 100.0)


def clock_rows(training: Manifest) -> list[Figure]:
    """Steps of a training by the clock, which depend on the machine."""
    seconds = training.config.get("train", {}).get("seconds")
    if seconds is None:
        return []
    what = (
        f"steps within {seconds:g} s by the clock (train.seconds, measured on "
        f"{measured_on(training)})"
    )
    return [Figure(what, training.facts["steps"])]


def describe_poses(model: PhotoModel) -> dict[str, Any]:
    """Poses of photos that came alone, in a sentence and a picture, and doubts about them."""
    point, view = model.tracks.T
    counts = np.bincount(view, minlength=len(model.names))
    errors = np.bincount(view, model.errors[point], len(model.names)) / np.maximum(counts, 1)
    poses = model.cam_from_world
    picture = draw.cameras(centers(poses), -poses[:, 1, :3], model.points, errors)
    return {"sentence": " ".join(model.notes), "doubts": model.judged["doubts"], "picture": picture}


def decided_rows(facts: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Settings that the training's config left open: name, value, and reason."""
    return [
        (f"train.{name}", f"{value:.3g}" if isinstance(value, float) else str(value), of["by"])
        for name, of in facts.get("decided", {}).items()
        for value in [of["value"]]
    ]


def teacher_words(facts: dict[str, Any]) -> tuple[str, str]:
    """(name, kind in a few words) of the 2D teacher."""
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
) -> list[Figure]:
    """Figures of the evaluation and the training.

    Args: by_degree: Gaussians by SH degree, None where unknown; trained: facts of the training;
      timed: the machines that `evaluation` and training (`gaussians`) were measured on.
    """
    image = figures["image"]
    of = ", of undistorted photos" if "undistorted" in figures["source"] else ""
    rows = [
        Figure(f"PSNR, dB (8-bit, mean over views{of})", image["psnr"], form="{:.2f}"),
        Figure("PSNR after a colour fit by view, dB", image.get("psnr_fit"), form="{:.2f}"),
        *shown_rows(image.get("psnr_as_shown")),
        *taken_rows(image.get("as_taken")),
        *covisible_rows(image.get("covisible")),
        Figure("SSIM (window 11, σ 1.5)", image["ssim"], form="{:.4f}"),
        Figure("LPIPS (vgg, images in [0, 1])", figures["lpips"], form="{:.3f}"),
    ]
    segmentation = figures.get("segmentation") or {}
    names = {
        "miou": "mIoU",
        "macc": "mAcc",
        "oa": "OA",
        "boundary_miou": "mIoU in the boundary band",
        "rarest_miou": "mIoU of the five rarest classes",
        "point_miou": "mIoU of 3D points",
    }
    for key, name in names.items():
        if key in segmentation.get("scene", {}):
            teacher = segmentation.get("teacher")
            of_truth = f" ({words})" if (words := rests(segmentation, key)) else ""
            rows.append(
                Figure(
                    f"{name}, %{of_truth}",
                    percent(segmentation["scene"][key]),
                    percent(teacher[key]) if teacher else "",
                    "{:.1f}",
                )
            )
    rows.append(Figure("Gaussians", figures["n_gaussians"]))
    if by_degree is not None:
        rows.append(Figure("Gaussians of SH degree", dict(enumerate(by_degree))))
    whole = figures["bytes"]["unpruned_ply"]
    for name, size in figures["bytes"].items():
        share = f"{size:,} ({size / whole:.0%} of plain 3DGS)" if name in SMALLER else ""
        rows.append(Figure(f"bytes, {BYTES[name]}", size, words=share))
    on = f"measured on {timed['evaluation']}"
    rows += [
        Figure(f"frames/s, {FRAMES[name]} ({on})", v, form="{:.1f}")
        for name, v in figures["frames_per_second"].items()
    ]
    if split := figures["milliseconds"]:
        threads = "one thread" if split["threads"] == 1 else f"{split['threads']} threads"
        under = f"{split['width']}x{split['height']}, {threads}, {split['device']}, {on}"
        parts = {"projection": "projection", "sh": "SH", "sort": "sort", "blend": "blend"}
        rows += [
            Figure(f"ms a frame, {name} ({under})", split[part], form="{:.2f}")
            for part, name in parts.items()
        ]
    on = f"measured on {timed['gaussians']}"
    rows += [
        Figure(f"ms a training step, {part} ({on})", v, form="{:.2f}")
        for part, v in trained["milliseconds"].items()
    ]
    if peak := trained.get("peak_device_bytes"):
        rows.append(Figure("bytes of the GPU's memory in training, at most", peak))
    return rows


def percent(share: float | None) -> float | None:
    """A share in hundredths; None where it was not measured."""
    return None if share is None else 100 * share


def shown_rows(psnr: float | None) -> list[Figure]:
    """PSNR without the exposures that are expected of photos; none where there are none."""
    if psnr is None:
        return []
    return [Figure("PSNR as shown, all views in one exposure, dB", psnr, form="{:.2f}")]


def taken_rows(figures: dict[str, Any] | None) -> list[Figure]:
    """Figures on the test photos as taken; none where these are the test views."""
    if figures is None:
        return []
    size = "{}×{}".format(*figures["size"])
    return [
        Figure(f"PSNR on the photos as taken, {size} pixels, dB", figures["psnr"], form="{:.2f}"),
        Figure("SSIM on them", figures["ssim"], form="{:.4f}"),
    ]


def covisible_rows(figures: dict[str, Any] | None) -> list[Figure]:
    """PSNR of co-visible test pixels; nothing where no depth tells of them."""
    if figures is None:
        return []
    of = f"co-visible pixels ({figures['share']:.0%} of those with depth), views pooled"
    return [Figure(f"PSNR of {of}, dB", figures["psnr"], form="{:.2f}")]


def refined_rows(facts: dict[str, Any] | None) -> list[Figure]:
    """Refined features: the choices, and labels that halves of the views reproduce."""
    if facts is None:
        return []
    counts = f"counts as {facts['strength']:g} views" if facts["strength"] else "none"
    if (familiar := facts.get("familiar", 1.0)) < 1:
        counts += f"; the teacher is unsure of this scene, its views count for {familiar:.2f}"
    smooth = bool(facts["smooth"])
    rows = [
        Figure("smoothing of features (1: on)", int(smooth), words="on" if smooth else "off"),
        Figure("knowledge in features, views that it counts as", facts["strength"], words=counts),
    ]
    rows += [
        Figure(f"labels changed by {name}, %", percent(share), form="{:.1f}")
        for name in ("smoothing", "knowledge")
        if (share := facts.get(f"changed_by_{name}")) is not None
    ]
    half = "labels of half the training views that the other half reproduces, %"
    return rows + [
        Figure(f"{half}, {name} knowledge", percent(share), form="{:.1f}")
        for name, share in facts.get("halves", {}).items()
    ]


def agreement_rows(facts: dict[str, Any] | None) -> list[Figure]:
    """The views' agreement on labels of points by their 2D teacher."""
    if facts is None:
        return []
    name = f"agreement of views on labels of {facts['n_points']:,} points (1: always, 0: by chance)"
    return [Figure(name, "", facts["agreement"], "{:.2f}")]


def write_table(path: Path, rows: list[list[Any]]) -> None:
    """Write rows as CSV."""
    with path.open("w", newline="") as handle:
        csv.writer(handle).writerows(rows)
