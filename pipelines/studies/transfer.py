"""What knowledge from earlier scenes gains: sections that the page of a study of sequences has besides."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chebsplat.evaluation.statistics import paired_difference
from chebsplat.pipelines.studies.results import FIGURES, Figure, Row, compare, counted, groups
from chebsplat.pipelines.studies.study import Study
from chebsplat.pipelines.studies.tables import Section, difference_text

PICTURE = "transfer.png"
PLACE = ("sequence", "place", "scene", "seed")  # what a run shares with the run of another variant or budget
SHOWN = {figure.key: figure for figure in FIGURES}
X = {"steps": "steps", "train_seconds": "seconds"}


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


def complete(rows: list[Row], study: Study, condition: str) -> dict[str, dict[tuple, dict[str, Row]]]:
    """Rows by variant, place and budget, of the places where every variant has done every budget."""
    done = [row for row in counted(rows) if row["condition"] == condition and row["miou"] is not None]
    curves: dict[str, dict[tuple, dict[str, Row]]] = {
        name: {place: {row["budget"]: row for row in some} for place, some in groups(of, *PLACE).items()}
        for (name,), of in groups(done, "variant").items()
    }
    n_budgets = len(study.budgets.settings())
    whole = [{p for p, by in curves.get(name, {}).items() if len(by) == n_budgets} for name in study.variants]
    kept = set.intersection(*whole)
    return {name: {p: by for p, by in curves.get(name, {}).items() if p in kept} for name in study.variants}


def mean_curve(places: dict[tuple, dict[str, Row]], x: str, y: str) -> list[tuple[float, float]]:
    """(mean x, mean y) by budget."""
    budgets = next(iter(places.values()))
    return [tuple(float(np.mean([by[b][k] for by in places.values()])) for k in (x, y)) for b in budgets]  # type: ignore[misc]


def sections(out: Path, study: Study, rows: list[Row]) -> list[Section]:
    """All sections; writes their picture into `out`. None before every variant has done one scene with all budgets."""
    curves = {name: complete(rows, study, name) for name in study.conditions}
    curves = {name: some for name, some in curves.items() if some[study.baseline]}
    if not curves:
        return []
    out.mkdir(parents=True, exist_ok=True)
    draw(out / PICTURE, study, curves)
    parts = [
        Section(
            f"Steps to reach what {study.baseline} ends with",
            f"Where the line through the budgets' mean mIoU first reaches the mean with which {study.baseline} ends, "
            f"as a share of its steps (seconds); '≤': with the smallest budget already. Median: of the same for every "
            f"run against its own {study.baseline}. Worst scene: the lowest mean difference of mIoU of any scene. "
            f"Only scenes that every variant has finished with every budget.",
            [row for condition, some in curves.items() for row in reach_table(study, condition, some)],
            PICTURE,
        )
    ]
    if again := return_table(study, rows):
        note = (
            f"mIoU with the last budget of scenes that come again at the end of their sequence, and so start from "
            f"knowledge of all scenes, themselves among them: against {study.baseline}, and against their first visit."
        )
        parts.append(Section("The first scenes again, with the last basis", note, again))
    if pairs := pair_table(study, rows):
        parts.append(
            Section("Variants against each other", "Paired differences, the first from the second variant.", pairs)
        )
    return parts


def reach_table(study: Study, condition: str, curves: dict[str, dict[tuple, dict[str, Row]]]) -> list[list[str]]:
    """Header, then a row a variant and sequence, and one over all sequences."""
    header = ["variant", "sequence", "runs", "steps", "seconds", "runs that reach it", "median", "mIoU at the end",
              "worst scene", "PSNR at the end"]  # fmt: skip
    if condition:
        header = ["condition", *header]
    table, last = [header], list(study.budgets.settings())[-1]
    sequences = list(dict.fromkeys(place[0] for place in curves[study.baseline]))
    for variant in (name for name in study.variants if name != study.baseline):
        for sequence in [*sequences, ""] if len(sequences) > 1 else [""]:
            mine, base = (
                {p: by for p, by in curves[name].items() if sequence in ("", p[0])}
                for name in (variant, study.baseline)
            )
            cells = [variant, sequence or "all", str(len(mine))]
            for x in X:
                whole, target = mean_curve(base, x, "miou")[-1]
                cells.append(reach(mean_curve(mine, x, "miou"), target).share(whole))
            cells += runs_that_reach(mine, base, last)
            scenes = [place[2] for place in mine]  # orders and seeds of one scene are not independent
            for key in ("miou", "psnr"):
                values, others = ([of[p][last][key] for p in mine] for of in (mine, base))
                cells.append(difference_text(paired_difference(values, others, scenes), SHOWN[key]))
                if key == "miou":
                    cells.append(worst_scene(scenes, values, others))
            table.append([condition, *cells] if condition else cells)
    return table


def runs_that_reach(mine: dict[tuple, dict[str, Row]], base: dict[tuple, dict[str, Row]], last: str) -> list[str]:
    """How many runs get to the mIoU that their baseline ends with; the median share of its steps."""
    shares = []
    for place, by in mine.items():
        end = base[place][last]
        reached = reach([(row["steps"], row["miou"]) for row in by.values()], end["miou"])
        shares.append(np.inf if reached.bound == ">" else reached.x / end["steps"])
    middle = float(np.median(shares))
    return [
        f"{sum(np.isfinite(shares))} of {len(shares)}",
        f"{100 * middle:.0f} %" if np.isfinite(middle) else "> 100 %",
    ]


def worst_scene(scenes: list[str], mine: list[float], base: list[float]) -> str:
    """The lowest mean difference of any scene, over orders and seeds, in points, and which scene it is."""
    by_scene: dict[str, list[float]] = {}
    for scene, a, b in zip(scenes, mine, base, strict=True):
        by_scene.setdefault(scene, []).append(100 * (a - b))
    scene = min(by_scene, key=lambda name: float(np.mean(by_scene[name])))
    return f"{np.mean(by_scene[scene]):+.1f} {scene}"


def return_table(study: Study, rows: list[Row]) -> list[list[str]]:
    """Header, then a row a variant and scene that comes again; empty if none has been done."""
    last = list(study.budgets.settings())[-1]
    done = [row for row in rows if row["budget"] == last and row["miou"] is not None]
    where = {(row["condition"], row["variant"], *(row[k] for k in PLACE)): row["miou"] for row in done}
    visits = groups([row for row in done if row["visit"] == 1], "condition", "variant", "sequence", "scene", "seed")
    first = {place: some[0]["miou"] for place, some in visits.items()}
    again = [row for row in done if row["visit"] > 1 and row["variant"] != study.baseline]
    table = [["variant", "sequence", "scene", "runs", "mIoU, %", f"− {study.baseline}", "− first visit"]]
    for (variant, sequence, scene), some in groups(again, "variant", "sequence", "scene").items():
        cells = [f"{100 * np.mean([row['miou'] for row in some]):.1f}"]
        for other in (
            [where.get((r["condition"], study.baseline, *(r[k] for k in PLACE))) for r in some],
            [first.get((r["condition"], variant, sequence, scene, r["seed"])) for r in some],
        ):
            gains = [100 * (row["miou"] - value) for row, value in zip(some, other, strict=True) if value is not None]
            cells.append(f"{np.mean(gains):+.1f}" if gains else "-")
        table.append([variant, sequence, scene, str(len(some)), *cells])
    return table if len(table) > 1 else []


def pair_table(study: Study, rows: list[Row]) -> list[list[str]]:
    """Header, then a row a pair of `study.pairs`, condition and budget; empty if there is none."""
    keys = ("miou", "boundary_miou", "psnr")
    table = [["pair", "condition", "budget", "pairs of runs", *(SHOWN[key].heading for key in keys)]]
    for first, second in study.pairs:
        for line in compare(rows, second):
            if line.variant == first and "miou" in line.differences:
                cells = [difference_text(line.differences[k], SHOWN[k]) if k in line.differences else "-" for k in keys]
                n = line.differences["miou"].n_pairs
                table.append([f"{first} − {second}", line.condition, line.budget, str(n), *cells])
    return table if len(table) > 1 else []


def draw(path: Path, study: Study, curves: dict[str, dict[str, dict[tuple, dict[str, Row]]]]) -> None:
    """Mean test mIoU and PSNR over steps and over seconds, as PNG; dashed: where the baseline ends."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels: list[tuple[str, Figure]] = [(x, SHOWN[y]) for y in ("miou", "psnr") for x in X]
    shape = (len(curves), len(panels))
    figure, axes = plt.subplots(*shape, figsize=(15, 3.6 * len(curves)), layout="constrained", squeeze=False)
    for line, (condition, some) in zip(axes, curves.items(), strict=True):
        for axis, (x, shown) in zip(line, panels, strict=True):
            for k, (variant, places) in enumerate(some.items()):
                points = np.array(mean_curve(places, x, shown.key))
                axis.plot(points[:, 0], shown.scale * points[:, 1], color=f"C{k % 10}", marker="o", label=variant)
                if variant == study.baseline:
                    axis.axhline(shown.scale * points[-1, 1], color=f"C{k % 10}", linestyle="--", linewidth=0.8)
            axis.set_title(f"test {shown.heading}", fontsize=10)
            axis.set_xlabel(f"{X[x]} of whole trainings")
            axis.grid(alpha=0.3)
        line[0].set_ylabel(condition)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9)
    figure.savefig(path, dpi=130)
    plt.close(figure)
