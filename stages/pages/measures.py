"""Cost and error of the stages: a table of which facts are errors, and a scene's course."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from chebsplat.formats.manifest import Manifest, measured_on

PERCENT, PIXELS, DECIBELS, LEVELS, NUMBER = (
    "{:.2%}",
    "{:.2f} px",
    "{:.2f} dB",
    "{:g} of 255",
    "{:.3g}",
)


@dataclass(frozen=True)
class Measure:
    """A figure of a stage: `fact` of the manifest of `role`, an input of the report, in the format
    `form`, with its unit; lower: less is better.
    """

    role: str
    fact: str
    words: str
    form: str
    lower: bool = False


RIGHT = "pixels of training views with the true label"
HALVES = "labels of half the training views that the other half reproduces"
MEASURES: dict[str, tuple[Measure, ...]] = {  # by stage: its error is the first that was measured
    "pose": (
        Measure("model", "reprojection_error_px", "points off their photos", PIXELS, lower=True),
        Measure("model", "registered", "photos that are registered", PERCENT),
    ),
    "ingest": (
        Measure("capture", "variance_kept", "variance of the photos that views keep", PERCENT),
    ),
    "sfm": (
        Measure("points", "reprojection_error_px", "points off their photos", PIXELS, lower=True),
        Measure("points", "depth_error", "points off other views' depth", PERCENT, lower=True),
        Measure("points", "covered", "cells of the photos that hold a point", PERCENT),
        Measure("points", "swept", "pixels of the photos whose depth a sweep found", PERCENT),
    ),
    "channels": (Measure("channels", "relative_error", "of features lost", NUMBER, lower=True),),
    "teacher": (
        Measure("features", "right", RIGHT, PERCENT),
        Measure(
            "features",
            "mirrored_alike",
            "pixels with the same label in the mirrored photo",
            PERCENT,
        ),
        Measure("agreement", "agreement", "agreement of views on points", NUMBER),
    ),
    "agree": (Measure("agreement", "agreement", "agreement of views on points", NUMBER),),
    "describe": (
        Measure(
            "descriptors",
            "truncation",
            "of distances, cut off at their degree",
            PERCENT,
            lower=True,
        ),
    ),
    "encode": (
        Measure("encoding", "rounding", "of features lost by half precision", PERCENT, lower=True),
    ),
    "learn": (
        Measure(
            "learned",
            "unexplained",
            "of what views mean, not foretold by shape",
            PERCENT,
            lower=True,
        ),
    ),
    "recall": (
        Measure(
            "knowledge", "unexplained", "of what rooms mean, not in the map", PERCENT, lower=True
        ),
    ),
    "onnx": (Measure("encoder", "largest_difference", "from torch", NUMBER, lower=True),),
    "train": (
        Measure("gaussians", "psnr", "PSNR on watched training views", DECIBELS),
        Measure("gaussians", "right", RIGHT, PERCENT),
    ),
    "lift": (
        Measure("lifted", "labels_agree", HALVES, PERCENT),
        Measure("lifted", "right", RIGHT, PERCENT),
    ),
    "refine": (
        Measure("refined", "labels_agree", HALVES, PERCENT),
        Measure("refined", "gain", "more than lifting alone", PERCENT),
        Measure("refined", "right", RIGHT, PERCENT),
    ),
    "export": (
        Measure(
            "evaluation", "layout_error", "between a view's pictures by layout", LEVELS, lower=True
        ),
    ),
    "evaluate": (Measure("evaluation", "psnr", "test PSNR", DECIBELS),),
}


class Row(NamedTuple):
    """A stage in the report's table: seconds, figures in words, the machine they are of, its load,
    and the most memory that a process of the stage has had.
    """

    stage: str
    seconds: float
    key: str
    figures: list[str]
    machine: str
    load: str
    memory: str


def figures_of(stage: str, facts: Mapping[str, dict[str, Any]]) -> list[str]:
    """Figures of a stage in words, its error first; an arrow points to better values.

    Args: facts: of the report's inputs, by role.
    """
    values = [(of, facts.get(of.role, {}).get(of.fact)) for of in MEASURES[stage]]
    return [
        f"{of.form.format(value)} {'↓' if of.lower else '↑'} {of.words}"
        for of, value in values
        if value is not None
    ]


def row_of(stage: str, manifest: Manifest, facts: Mapping[str, dict[str, Any]]) -> Row:
    """The row of a stage whose artifact this is."""
    processes = manifest.processes
    machine, load, memory = measured_on(manifest), "", ""
    if processes:
        cores = dict.fromkeys(str(process["cores"]) for process in processes)
        loads = [value for process in processes for value in process["load"]]
        machine += f" of {' and '.join(cores)} cores"
        load = f"{min(loads):.1f} to {max(loads):.1f}"
        # absent in artifacts of earlier versions
        if most := max(process.get("megabytes", 0) for process in processes):
            memory = f"{most / 1000:.1f} GB"
    if len(processes) > 1:
        machine += f", in {len(processes)} processes"
    return Row(
        stage, manifest.seconds, manifest.key, figures_of(stage, facts), machine, load, memory
    )


class Course(NamedTuple):
    """Error of a scene against time. Seconds count from the start, stage after stage.

    spans:    (stage, begin, end) in order; training: begin and end of this one.
    plain:    PSNR of photos of one colour, that of a scene before training.
    colors:   (seconds, PSNR) in the course of training.
    meanings: (stage, seconds, value) after each stage that made features; words: the value's name.
    """

    spans: list[tuple[str, float, float]]
    training: tuple[float, float]
    plain: float
    colors: list[tuple[float, float]]
    meanings: list[tuple[str, float, float]]
    words: str


def course_of(
    rows: Sequence[Row],
    facts: Mapping[str, dict[str, Any]],
    trace: list[dict[str, float]],
    plain: float,
) -> Course:
    """The course of a scene.

    Args: rows: of its stages, in their order; trace: of its training; plain: see `Course`.
    Choices: a training's seconds, of its steps alone, are spread over those of its stage.
    """
    ends = list(itertools.accumulate(row.seconds for row in rows))
    spans = [(row.stage, end - row.seconds, end) for row, end in zip(rows, ends, strict=True)]
    begin, end = next((begin, end) for stage, begin, end in spans if stage == "train")
    factor = (end - begin) / max(trace[-1]["seconds"], 1e-9)
    colors = [(begin + factor * entry["seconds"], entry["psnr"]) for entry in trace]
    colors.append((ends[-1], trace[-1]["psnr"]))
    for fact, words in (("right", RIGHT), ("labels_agree", HALVES)):
        roles = [
            (stage, end, of.role)
            for stage, _, end in spans
            for of in MEASURES[stage]
            if of.fact == fact
        ]
        values = [(stage, end, facts.get(role, {}).get(fact)) for stage, end, role in roles]
        if meanings := [(stage, end, value) for stage, end, value in values if value is not None]:
            return Course(spans, (begin, end), plain, colors, meanings, words)
    return Course(spans, (begin, end), plain, colors, [], "")


def stops(course: Course) -> list[tuple[str, float, float, float | None]]:
    """(stopped after, seconds, PSNR, meaning) at earlier ends and at the last; within training only
    where its trace begins early enough.
    """
    begin, end = course.training
    seconds, values = zip(*course.colors, strict=True)
    ends = [("before training", begin)]
    for words, share in (("a quarter of the training", 0.25), ("half of the training", 0.5)):
        when = begin + share * (end - begin)
        if when >= seconds[0]:
            ends.append((words, when))
    ends += [(stage, end) for stage, _, end in course.spans if stage in ("train", "lift", "refine")]
    rows = []
    for words, when in ends:
        color = float(np.interp(when, seconds, values)) if when > begin else course.plain
        meanings = [value for _, second, value in course.meanings if second <= when + 1e-9]
        rows.append((words, when, color, meanings[-1] if meanings else None))
    return rows
