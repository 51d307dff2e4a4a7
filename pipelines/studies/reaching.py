"""How soon a variant is as good as its baseline is at the end: a section of the page of a study of several budgets."""

from __future__ import annotations

import numpy as np

from chebsplat.pipelines.studies.results import FIGURES, Figure, Row, groups
from chebsplat.pipelines.studies.study import Study
from chebsplat.pipelines.studies.tables import Section, number
from chebsplat.pipelines.studies.transfer import reach

SHOWN = [figure for figure in FIGURES if figure.key in ("miou", "psnr")]


def sections(study: Study, rows: list[Row]) -> list[Section]:
    """One section; none without two budgets, or before a scene has the baseline's last one."""
    budgets = list(study.budgets.settings())
    done = [row for row in rows if row["state"] == "done"]
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
        "seconds of training and as a share of its seconds; '≤': with the smallest budget already. Means over seeds."
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
