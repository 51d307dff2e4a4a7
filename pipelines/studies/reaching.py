"""How soon a variant is as good as its baseline is at the end: a section of the page of a study of several budgets."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chebsplat.pipelines.studies.results import FIGURES, Figure, Row, counted, groups
from chebsplat.pipelines.studies.study import Study
from chebsplat.pipelines.studies.tables import Section, number

SHOWN = [figure for figure in FIGURES if figure.key in ("miou", "psnr")]


@dataclass(frozen=True)
class Reach:
    """Where a curve gets to a value: at `x`, before (`≤`) its first point, or not (`>`) up to its last."""

    x: float
    bound: str = ""

    def share(self, whole: float) -> str:
        return f"{self.bound}{' ' if self.bound else ''}{100 * self.x / whole:.0f} %"


def reach(points: Sequence[tuple[float, float]], target: float) -> Reach:
    """Where the line through (x, y), in order of x, first gets to `target`."""
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
    done = [row for row in counted(rows) if row["state"] == "done"]
    table = []
    for (condition, scene), some in groups(done, "condition", "scene").items():
        by = {name: groups(of, "budget") for (name,), of in groups(some, "variant").items()}
        end = by.get(study.baseline, {}).get((budgets[-1],))
        if end is None:
            continue
        for name in (name for name in by if name != study.baseline):
            cells = [*([condition] if condition else []), scene, name]
            for figure in SHOWN:
                cells += reached(end, list(by[name].values()), figure)
            table.append(cells)
    if len(budgets) < 2 or not table:
        return []
    header = [*(["condition"] if len(table[0]) > 2 + 3 * len(SHOWN) else []), "scene", "variant"]
    for figure in SHOWN:
        header += [f"{figure.heading} of {study.baseline} at the end", "its seconds", "seconds to reach it"]
    note = (
        f"Where the line through the budgets' means first reaches what {study.baseline} ends with ({budgets[-1]}), in "
        "seconds of training and as a share of its seconds; '≤': with the smallest budget already. "
        "Means over seeds and orders."
    )
    return [Section(f"Seconds to what {study.baseline} ends with", note, [header, *table])]


def reached(end: list[Row], budgets: list[list[Row]], figure: Figure) -> list[str]:
    """A figure of the baseline's last runs, their seconds, and the seconds and share in which others get there."""
    if any(row[figure.key] is None for some in (end, *budgets) for row in some):
        return ["-", "-", "-"]

    def mean(some: list[Row], key: str) -> float:
        return float(np.mean([row[key] for row in some]))

    target, whole = mean(end, figure.key), mean(end, "train_seconds")
    found = reach([(mean(some, "train_seconds"), mean(some, figure.key)) for some in budgets], target)
    return [number(target, figure), f"{whole:.0f}", f"{found.bound}{found.x:.0f} ({found.share(whole)})"]
