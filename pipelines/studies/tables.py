"""Tables of a study's page: means and differences by variant, each scene, missing and left out."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chebsplat.evaluation.statistics import Difference, Summary, summarize
from chebsplat.pipelines.studies.results import FIGURES, Figure, Line, Row, groups, on_one_machine
from chebsplat.pipelines.studies.study import Study

COSTS = (
    "n_gaussians",
    "sh_kept",
    "bytes_ply",
    "bytes_ragged",
    "frames_per_second",
    "train_seconds",
)
BY_SCENE = ("miou", "miou_gain", "psnr", "n_gaussians", "train_seconds")
SHOWN = [figure for figure in FIGURES if figure.key in ("miou", "psnr")]


@dataclass(frozen=True)
class Section:
    """A part of the page; `table` begins with its header."""

    heading: str
    note: str
    table: list[list[str]]


def number(value: float, figure: Figure) -> str:
    """A value in its figure's scale and digits."""
    return f"{value * figure.scale:,.{figure.digits}f}"


def mean_text(summary: Summary, figure: Figure) -> str:
    """`mean ± spread`; no spread for a single run."""
    spread = "" if math.isnan(summary.spread) else f" ± {number(summary.spread, figure)}"
    return number(summary.mean, figure) + spread


def difference_text(difference: Difference, figure: Figure) -> str:
    """`+2.1 [1.0, 3.2]`, or `×0.48 [0.40, 0.55]`; no interval where there is one unit."""

    def format_value(value: float) -> str:
        return f"{value:.2f}" if figure.ratio else number(value, figure)

    interval = (
        ""
        if math.isnan(difference.low)
        else (f" [{format_value(difference.low)}, {format_value(difference.high)}]")
    )
    sign = "×" if figure.ratio else "+" if difference.mean >= 0 else ""
    return sign + format_value(difference.mean) + interval


def shown_figures(lines: list[Line]) -> list[Figure]:
    """Figures that at least one run has."""
    return [figure for figure in FIGURES if any(figure.key in line.summaries for line in lines)]


def labels(lines: list[Line]) -> list[str]:
    """Columns that identify a line; a single condition or the scenes' own budget is not one."""
    return [
        name
        for name in ("condition", "budget", "variant")
        if any(getattr(line, name) for line in lines)
    ]


def table_row(line: Line, lines: list[Line]) -> list[tuple[str, str, bool]]:
    """Cells of one of `lines`: (mean ± spread, paired difference, interval excludes no effect)."""
    texts = [*(getattr(line, name) for name in labels(lines)), f"{line.n_done} of {line.n_runs}"]
    cells = [(text, "", False) for text in texts]
    for figure in shown_figures(lines):
        summary, difference = line.summaries.get(figure.key), line.differences.get(figure.key)
        mean = "-" if summary is None else mean_text(summary, figure)
        change = "" if difference is None else difference_text(difference, figure)
        cells.append((mean, change, difference is not None and difference.excluded))
    return cells


def tables(lines: list[Line], baseline: str) -> list[tuple[list[str], list[tuple[bool, list]]]]:
    """(header, rows) of the comparison, in two tables that fit a screen: quality, and cost.

    A row: whether it is the baseline's, and its cells as of `table_row`.
    """
    fixed, figures = [*labels(lines), "runs"], shown_figures(lines)
    parts = [
        [k for k, figure in enumerate(figures) if (figure.key in COSTS) == costs]
        for costs in (False, True)
    ]
    halves = []
    for part in filter(None, parts):
        columns = [*range(len(fixed)), *(len(fixed) + k for k in part)]
        rows = [
            (line.variant == baseline, [table_row(line, lines)[k] for k in columns])
            for line in lines
        ]
        halves.append(([*fixed, *(figures[k].heading for k in part)], rows))
    return halves


def scene_table(rows: list[Row]) -> list[list[str]]:
    """Header and rows: each scene apart, mean ± spread over seeds."""
    finished = [row for row in rows if row["state"] == "done"]
    figures = [
        figure
        for figure in FIGURES
        if figure.key in BY_SCENE and any(row[figure.key] is not None for row in finished)
    ]
    names = [
        name
        for name in ("scene", "condition", "budget", "variant")
        if any(row[name] for row in finished)
    ]
    table = [[*names, *(figure.heading for figure in figures)]]
    for where, members in sorted(groups(finished, *names).items(), key=lambda item: item[0][0]):
        cells = list(where)
        for figure in figures:
            values = [row[figure.key] for row in members if row[figure.key] is not None]
            cells.append(mean_text(summarize(values), figure) if values else "-")
        table.append(cells)
    return table


def missing(rows: list[Row]) -> list[tuple[str, str]]:
    """(run, why) of every run without figures."""
    keys = ("scene", "condition", "variant", "budget")
    return [
        (", ".join(str(row[k]) for k in keys if row[k]) + f", seed {row['seed']}", row["state"])
        for row in rows
        if row["state"] != "done"
    ]


def left_out(rows: list[Row]) -> list[tuple[str, str, str]]:
    """(what, why, by which variants) of all that finished runs left out."""
    finished = [row for row in rows if row["state"] == "done"]
    every = list(dict.fromkeys(row["variant"] for row in finished))
    variants: dict[tuple[str, str], dict[str, None]] = {}
    for row in finished:
        for entry in row["left_out"].items():
            variants.setdefault(entry, {})[row["variant"]] = None
    return sorted(
        (*entry, "all" if len(by) == len(every) else ", ".join(by))
        for entry, by in variants.items()
    )


@dataclass(frozen=True)
class Reach:
    """The place where a curve reaches a value: `x`, `≤` its first point, or `>` its last."""

    x: float
    bound: str = ""

    def share(self, whole: float) -> str:
        return f"{self.bound}{' ' if self.bound else ''}{100 * self.x / whole:.0f} %"


def reach(points: Sequence[tuple[float, float]], target: float) -> Reach:
    """The x at which the line through (x, y), in order of x, first reaches `target`."""
    points = sorted(points)
    if points[0][1] >= target:
        return Reach(points[0][0], "≤" if len(points) > 1 else "")
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        if y1 >= target:
            return Reach(x0 + (x1 - x0) * (target - y0) / (y1 - y0))
    return Reach(points[-1][0], ">")


def sections(study: Study, rows: list[Row]) -> list[Section]:
    """One section; none without two budgets, or before a scene has the baseline's last one."""
    budgets = list(study.budgets.settings())
    timed = [row for row in on_one_machine(rows)[0] if row["train_seconds"] is not None]
    finished = [row for row in timed if row["state"] == "done"]
    table = []
    for (condition, scene), some in groups(finished, "condition", "scene").items():
        by = {name: groups(of, "budget") for (name,), of in groups(some, "variant").items()}
        end = by.get(study.baseline, {}).get((budgets[-1],))
        if end is None:
            continue
        for name in (name for name in by if name != study.baseline):
            cells = [*([condition] if condition else []), scene, name]
            for figure in SHOWN:
                cells += reach_cells(end, list(by[name].values()), figure)
            table.append(cells)
    if len(budgets) < 2 or not table:
        return []
    header = [*(["condition"] if len(table[0]) > 2 + 3 * len(SHOWN) else []), "scene", "variant"]
    for figure in SHOWN:
        header += [
            f"{figure.heading} of {study.baseline} at the end",
            "its seconds",
            "seconds to reach it",
        ]
    note = (
        f"Where the line through the budgets' means first reaches what {study.baseline} ends with "
        f"({budgets[-1]}), in seconds of training and as a share of its seconds; '≤': with the "
        "smallest budget already. Means over seeds."
    )
    return [Section(f"Seconds to what {study.baseline} ends with", note, [header, *table])]


def reach_cells(end: list[Row], budgets: list[list[Row]], figure: Figure) -> list[str]:
    """A figure of the baseline's last budget, its seconds, and a variant's seconds to reach it."""
    if any(row[figure.key] is None for some in (end, *budgets) for row in some):
        return ["-", "-", "-"]

    def mean(some: list[Row], key: str) -> float:
        return float(np.mean([row[key] for row in some]))

    target, whole = mean(end, figure.key), mean(end, "train_seconds")
    crossing = reach(
        [(mean(some, "train_seconds"), mean(some, figure.key)) for some in budgets], target
    )
    return [
        number(target, figure),
        f"{whole:.0f}",
        f"{crossing.bound}{crossing.x:.0f} ({crossing.share(whole)})",
    ]
