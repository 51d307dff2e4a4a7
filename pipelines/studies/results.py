"""Results of a study: one row a run, read from the artifacts, and the comparison of variants."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.evaluation import protocols
from chebsplat.evaluation.statistics import Difference, Summary, paired_difference, summarize
from chebsplat.formats import artifact
from chebsplat.formats.evaluation import read_figures
from chebsplat.formats.gaussians import read_trace
from chebsplat.formats.manifest import measured_on
from chebsplat.pipelines.studies.study import Run

Row = dict[str, Any]


@dataclass(frozen=True)
class Figure:
    """A column: its key in a row, heading, format, and whether variants compare by ratio."""

    key: str
    heading: str
    digits: int
    scale: float = 1.0
    ratio: bool = False
    timed: str = ""  # the column with the machine that it was measured on


FIGURES = (
    Figure("miou", "mIoU, %", 1, 100),
    Figure("miou_gain", "mIoU − its 2D teacher's, points", 1, 100),
    Figure("macc", "mAcc, %", 1, 100),
    Figure("oa", "OA, %", 1, 100),
    Figure("boundary_miou", "boundary mIoU, %", 1, 100),
    Figure("rarest_miou", "mIoU of the five rarest classes, %", 1, 100),
    Figure("point_miou", "mIoU of 3D points, %", 1, 100),
    Figure("psnr", "PSNR, dB", 2),
    Figure("psnr_fit", "PSNR after a colour fit, dB", 2),
    Figure("psnr_as_taken", "PSNR on photos as taken, dB", 2),
    Figure("psnr_covisible", "PSNR of co-visible pixels, dB", 2),
    Figure("covisible", "co-visible pixels, of those with depth, %", 1, 100),
    Figure("ssim", "SSIM", 4),
    Figure("lpips", "LPIPS", 3),
    Figure("n_gaussians", "Gaussians", 0, 1, True),
    Figure("sh_kept", "SH coefficients kept, %", 1, 100),
    Figure("bytes_ply", "PLY, MB", 2, 1e-6, True),
    Figure("bytes_ragged", "ragged, MB", 2, 1e-6, True),
    Figure("frames_per_second", "frames/s", 1, 1, True, "rendered_on"),
    Figure("train_seconds", "training, s", 1, 1, True, "trained_on"),
)
OF_TEACHER = ("miou", "boundary_miou", "point_miou")  # figures of the teacher on single photos, too
OTHERS = (
    *(f"{key}_teacher" for key in OF_TEACHER), "classes", "pixels", "protocol", "resolution",
    "split", "held_in_psnr", "steps", "clock", "device", "trained_on", "rendered_on", "train_key",
    "evaluate_key",
)  # fmt: skip
IDENTITY = ("condition", "variant", "budget", "scene", "seed", "state")
# figures that a protocol may compute over all scenes
POOLED = ("miou", "miou_gain", "macc", "oa")
COLUMNS = (*IDENTITY, *(figure.key for figure in FIGURES), *OTHERS)


def row_of(run: Run, failed: dict[str, tuple[int, str, Path]]) -> Row:
    """One run's figures; None where not measured. `state` is `done`, or why there are none.

    Beside the COLUMNS it holds `segmentation`, all the protocol's figures of the scene and of its
    teacher, and `left_out`.

    Args: failed: of `Outcome`. Raises: InputError naming a damaged artifact.
    """
    row: Row = dict.fromkeys(COLUMNS) | {name: getattr(run, name) for name in IDENTITY[:-1]}
    row |= {"protocol": run.protocol, "segmentation": {}, "left_out": {}}
    targets = run.plan.targets
    row |= {"train_key": targets["train"].name, "evaluate_key": targets["evaluate"].name}
    if not targets["evaluate"].joinpath("artifact.json").is_file():
        broken = [(step.stage, failed[step.key]) for step in run.steps if step.key in failed]
        if not broken:
            return row | {"state": "not run yet"}
        stage, (code, message, _) = broken[0]
        return row | {"state": f"{stage} failed with exit code {code}: {message}"}
    evaluation, train, scene = (
        artifact.read_manifest(targets[stage]) for stage in ("evaluate", "train", "export")
    )
    figures = read_figures(targets["evaluate"], evaluation)
    trace = read_trace(targets["train"], train)
    segmentation = figures.get("segmentation") or {}
    row |= segmentation_columns(segmentation.get("scene", {}), segmentation.get("teacher", {}))
    counts = scene.facts["by_degree"]
    n_coefficients = sum(n * (degree + 1) ** 2 for degree, n in enumerate(counts))
    return row | {
        "state": "done",
        "segmentation": segmentation,
        **segmentation.get("counted", {}).get("miou", {}),
        "left_out": figures["left_out"],
        "psnr": figures["image"]["psnr"],
        "psnr_fit": figures["image"].get("psnr_fit"),
        "psnr_as_taken": figures["image"].get("as_taken", {}).get("psnr"),
        "psnr_covisible": figures["image"].get("covisible", {}).get("psnr"),
        "covisible": figures["image"].get("covisible", {}).get("share"),
        "ssim": figures["image"]["ssim"],
        "lpips": figures["image"].get("lpips"),
        **{key: figures["protocol"][key] for key in ("resolution", "split")},
        "n_gaussians": figures["n_gaussians"],
        "sh_kept": n_coefficients / (16 * sum(counts)),
        "bytes_ply": figures["bytes"]["ply"],
        "bytes_ragged": figures["bytes"]["ragged"],
        "frames_per_second": figures["frames_per_second"].get("color"),
        "train_seconds": trace[-1]["seconds"],
        "held_in_psnr": trace[-1]["psnr"],
        "steps": int(trace[-1]["step"]),
        "clock": train.config["train"]["seconds"],
        "device": train.device,
        "trained_on": measured_on(train),
        "rendered_on": measured_on(evaluation),
    }


def on_one_machine(rows: list[Row]) -> tuple[list[Row], list[str]]:
    """Rows with timings of the machine with most finished runs, and sentences on the rest.

    Choices: of equally many, the first. A training that ended by the clock of another machine
      (`clock`) has other figures altogether: it has no part in the comparison, and its `state` says
      why.
    """
    compared, sentences = [dict(row) for row in rows], []
    finished = [row for row in compared if row["state"] == "done"]
    for figure in FIGURES:
        if figure.timed and finished:
            (machine, n_here), *others = Counter(
                row[figure.timed] for row in finished
            ).most_common()
            if others:
                left = "; ".join(f"{n} on {name}" for name, n in others)
                sentences.append(
                    f"'{figure.heading}' is of the {n_here} runs on {machine} alone; not "
                    f"compared: {left}"
                )
            for row in finished:
                if row[figure.timed] != machine:
                    row[figure.key] = None
    for row in finished:
        if row["clock"] and row["train_seconds"] is None:
            row["state"] = (
                f"its {row['clock']:g} s are of another machine ({row['trained_on']}): not compared"
            )
    return compared, sentences


def segmentation_columns(scene: dict[str, Any], teacher: dict[str, Any]) -> Row:
    """Columns from a protocol's figures of a scene and of its teacher; None where not measured."""
    row: Row = {
        key: scene.get(key)
        for key in ("miou", "macc", "oa", "boundary_miou", "rarest_miou", "point_miou")
    }
    if row["miou"] is not None and teacher.get("miou") is not None:
        row |= {f"{key}_teacher": teacher.get(key) for key in OF_TEACHER}
        row["miou_gain"] = row["miou"] - teacher["miou"]
    return row


def over_scenes(rows: list[Row]) -> list[Row]:
    """One row a seed, its POOLED figures computed over all its scenes as the protocol defines.

    Args: rows: finished ones of one protocol. The rows themselves, where it has no rule for several
      scenes.
    """
    rule = getattr(protocols.load(rows[0]["protocol"]), "over_scenes", None) if rows else None
    if rule is None:
        return rows
    pooled = []
    for members in groups([row for row in rows if row["segmentation"]], "seed").values():
        sides = [
            [row["segmentation"].get(side) for row in members] for side in ("scene", "teacher")
        ]
        scene, teacher = ({} if None in of_side else rule(of_side) for of_side in sides)
        name = "+".join(sorted(row["scene"] for row in members))
        pooled.append(
            dict.fromkeys(POOLED)
            | members[0]
            | {"scene": name}
            | segmentation_columns(scene, teacher)
        )
    return pooled


def traces(runs: list[Run], rows: list[Row]) -> list[tuple[Row, list[dict[str, float]]]]:
    """Row and trace of every finished run, without those that `on_one_machine` leaves out."""
    traced = []
    for run, row in zip(runs, rows, strict=True):
        if row["state"] == "done" and row["train_seconds"] is not None:
            path = run.plan.targets["train"]
            traced.append((row, read_trace(path, artifact.read_manifest(path))))
    return traced


@dataclass(frozen=True)
class Line:
    """A line of the table: one variant under one condition and budget."""

    condition: str
    budget: str
    variant: str
    n_done: int
    n_runs: int
    summaries: dict[str, Summary]
    differences: dict[str, Difference]  # against the baseline; empty for the baseline itself


def groups(rows: list[Row], *names: str) -> dict[tuple, list[Row]]:
    """Rows by the values of these columns, in order of appearance."""
    members: dict[tuple, list[Row]] = {}
    for row in rows:
        members.setdefault(tuple(row[name] for name in names), []).append(row)
    return members


def compare(rows: list[Row], baseline: str) -> list[Line]:
    """Mean ± spread over scenes and seeds, and paired differences against the baseline.

    Choices: a difference uses pairs of which both runs finished; the line counts its runs. A figure
      that a protocol computes over all scenes is one value a seed, and needs all scenes.
    """
    by_line = groups(rows, "condition", "budget", "variant")
    lines = []
    for (condition, budget, variant), members in by_line.items():
        finished = [row for row in members if row["state"] == "done"]
        against = [
            row for row in by_line.get((condition, budget, baseline), []) if row["state"] == "done"
        ]
        together = over_scenes(finished), over_scenes(against)
        summaries, differences = {}, {}
        for figure in FIGURES:
            mine, theirs = together if figure.key in POOLED else (finished, against)
            values = [row[figure.key] for row in mine if row[figure.key] is not None]
            if values:
                summaries[figure.key] = summarize(values)
            paired = pairs(mine, theirs, figure.key) if variant != baseline else []
            if paired:
                scenes, own, other = zip(*paired, strict=True)
                difference = paired_difference(own, other, list(scenes), figure.ratio)
                differences[figure.key] = difference
        lines.append(
            Line(condition, budget, variant, len(finished), len(members), summaries, differences)
        )
    return lines


def pairs(rows: list[Row], against: list[Row], key: str) -> list[tuple[str, float, float]]:
    """(scene, value, the baseline's) of the same scene and seed."""

    def place(row: Row) -> tuple:
        return row["scene"], row["seed"]

    other = {place(row): row[key] for row in against if row[key] is not None}
    return [
        (row["scene"], row[key], other[place(row)])
        for row in rows
        if row[key] is not None and place(row) in other
    ]
