"""Summaries of finished scenes and of runs under way, in a few lines, without torch."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document
from chebsplat.formats.manifest import measured_on
from chebsplat.formats.names import few
from chebsplat.pipelines.work import store

RUNS, FAILED, WAITS, LEFT, DONE = "runs", "failed", "waits", "not begun", "done"
LINES = 5  # of a failed step's log
NEARLY_ALL = 0.95  # of the test pixels with depth: co-visible PSNR tells no more then


def figures(evaluation: Path) -> Any:
    """The figures of an evaluation; None where missing or damaged (see `chebsplat verify`)."""
    try:
        return read_document(evaluation, artifact.read_manifest(evaluation), "figures.json")
    except InputError:
        return None


def number(figures: Any, *keys: str) -> float | None:
    """A figure by its keys; None if it was not measured."""
    for key in keys:
        figures = figures.get(key) if isinstance(figures, dict) else None
    return figures if isinstance(figures, int | float) and math.isfinite(figures) else None


def text(form: str, value: float | None) -> str:
    """A value in a format, empty for None."""
    return "" if value is None else form.format(value)


def quality(figures: Any) -> tuple[str, str, str]:
    """(test PSNR, mIoU, its 2D teacher's mIoU); empty where they were not measured."""
    shares = (number(figures, "segmentation", whose, "miou") for whose in ("scene", "teacher"))
    miou, teacher = (text("{:.1%}", share) for share in shares)
    return text("{:.1f} dB", number(figures, "image", "psnr")), miou, teacher


def table(evaluation: Path) -> list[tuple[str, str, str]]:
    """(name, value, remark) of each figure of an evaluated scene; unmeasured ones are absent."""
    # imports zarr, which the list of scenes does not need
    from chebsplat.formats.evaluation import rests

    measured = figures(evaluation)
    machine = f", measured on {measured_on(artifact.read_manifest(evaluation))}" if measured else ""
    psnr, miou, teacher = quality(measured)
    size = {
        name: text("{:.1f} MB", scaled(number(measured, "bytes", name)))
        for name in ("ply", "spz", "ragged")
    }
    others = ", ".join(f"{name} {value}" for name, value in size.items() if value and name != "ply")
    segmentation = (measured or {}).get("segmentation") or {}
    beside = [rests(segmentation), f"its 2D teacher {teacher}" if teacher else ""]
    if segmentation and not miou:
        miou, beside = "none", [measured["left_out"].get("mIoU", "")]
    rows = [
        ("test PSNR", psnr, text("SSIM {:.3f}", number(measured, "image", "ssim"))),
        ("co-visible PSNR", *covisible(measured)),
        (
            "as taken",
            text("{:.1f} dB", number(measured, "image", "as_taken", "psnr")),
            as_taken(measured),
        ),
        ("mIoU", miou, "; ".join(filter(None, beside))),
        *((what, str(len(names)), few(names)) for what, names in unmatched_names(segmentation)),
        ("Gaussians", text("{:,}", number(measured, "n_gaussians")), ""),
        ("PLY", size["ply"], others),
        (
            "frames/s",
            text("{:.0f}", number(measured, "frames_per_second", "color")),
            f"colour alone{machine}",
        ),
    ]
    return [row for row in rows if row[1]]


def covisible(figures: Any) -> tuple[str, str]:
    """PSNR of the test pixels whose surface a training photo shows, and their share of those with
    depth; empty where these are nearly all, or there is no depth.
    """
    shown = (figures or {}).get("image", {}).get("covisible")
    if not shown or shown["share"] > NEARLY_ALL:
        return "", ""
    return f"{shown['psnr']:.1f} dB", f"{shown['share']:.0%} of the pixels with depth"


def as_taken(figures: Any) -> str:
    """SSIM and size of test photos at their original size; empty where that is the trained one."""
    original = (figures or {}).get("image", {}).get("as_taken")
    return (
        "SSIM {:.3f}, {}×{} pixels".format(original["ssim"], *original["size"]) if original else ""
    )


def unmatched_names(segmentation: Any) -> list[tuple[str, list[str]]]:
    """Classes of the truth, and labels of the scene, without a counterpart in the other."""
    words = {"truth": "true classes without a label", "scene": "labels that are no class"}
    unmatched = segmentation.get("unmatched", {})
    return [(what, unmatched[side]) for side, what in words.items() if side in unmatched]


def doubts(artifacts: dict[str, Path]) -> list[str]:
    """Sentences on doubtful poses or a doubtful teacher of a scene, from its artifacts by stage."""
    sentences: list[str] = []
    for stage in {"pose", "agree"} & artifacts.keys():
        facts = artifact.read_manifest(artifacts[stage]).facts
        sentences += facts.get("doubts") or filter(None, [facts.get("doubt")])
    return sentences


def scaled(size: float | None) -> float | None:
    """Bytes as MB."""
    return None if size is None else size / 1e6


def readable(path: Path) -> str:
    """A path as a user who stands here would type it."""
    here = Path.cwd()
    return os.path.relpath(path, here) if path.is_relative_to(here) else str(path)


def align_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines, every column as wide as its widest cell."""
    if not rows:
        return []
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def show_rows(rows: Sequence[Sequence[str]]) -> None:
    """Print rows in aligned columns."""
    for line in align_columns(rows):
        print(line)


@dataclass(frozen=True)
class State:
    """A step of a run: its state, a remark, and the end of its log where it failed."""

    stage: str
    key: str
    what: str
    words: str = ""
    log: tuple[str, ...] = ()


def state_of(folder: Path, step: dict[str, Any]) -> State:
    """The state of a step. folder: of the run's plan."""
    stage, key, file = step["stage"], step["key"], folder / f"{step['stage']}-{step['key']}"
    if store.is_fresh(Path(step["path"])):
        return State(stage, key, DONE)
    if machine := store.holder(store.lease(folder.parents[1], file.name)):
        return State(stage, key, RUNS, f"{seconds(file.with_suffix('.exit'))} s on {machine}")
    log, is_over = file.with_suffix(".log"), store.holder(store.run_lease(folder)) is None
    if code := int(file.with_suffix(".exit").read_text()):
        return State(stage, key, FAILED, f"exit code {code}", last_lines(log))
    if log.is_file() and is_over:
        return State(stage, key, FAILED, "killed before it could report", last_lines(log))
    return State(stage, key, LEFT if is_over else WAITS)


def seconds(file: Path) -> int:
    """Seconds since a file was written, which its step or run does as it begins."""
    return max(int(store.age(file)), 0)


def last_lines(log: Path) -> tuple[str, ...]:
    """The end of a log, and its path."""
    try:
        lines = log.read_text(errors="replace").strip().splitlines()[-LINES:]
    except OSError:
        lines = []
    return (*lines, str(log))


def runs() -> Iterator[tuple[str, list[State]]]:
    """Every run in `work` as a title, with the states of its steps."""
    for plan in sorted(store.work().glob(".plans/*/plan.json")):
        try:
            steps = json.loads(plan.read_text())["steps"]
            states = [state_of(plan.parent, step) for step in steps]
        except FileNotFoundError:  # the run has just ended
            continue
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            yield f"{plan} is damaged; remove {plan.parent} if no run is under way", []
            continue
        machine = store.holder(store.run_lease(plan.parent))
        since = f" on {machine}, {seconds(plan)} s" if machine else ", over"
        yield f"run {plan.parent.name}{since}", states


def lines() -> Iterator[str]:
    """The status of all runs, line by line."""
    for title, states in runs():
        count = Counter(state.what for state in states)
        yield f"{title}: " + ", ".join(
            f"{count[what]} {what}" for what in (DONE, RUNS, WAITS, LEFT, FAILED) if count[what]
        )
        for state in states:
            if state.what in (RUNS, FAILED):
                yield f"  {state.what:6s}  {state.stage:9s} {state.key}  {state.words}"
                yield from (f"    {line}" for line in state.log)
        for what in (WAITS, LEFT):
            if stages := Counter(state.stage for state in states if state.what == what):
                yield f"  {what}: " + ", ".join(f"{n} {stage}" for stage, n in stages.items())
