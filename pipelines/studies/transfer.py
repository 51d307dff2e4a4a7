"""What knowledge from earlier scenes gains: sections that the page of a study of sequences has besides."""

from __future__ import annotations

import numpy as np

from chebsplat.pipelines.studies.results import FIGURES, Row, compare, counted, groups, pairs
from chebsplat.pipelines.studies.study import Study
from chebsplat.pipelines.studies.tables import Section, difference_text

PLACE = ("sequence", "place", "scene", "seed")  # what runs of other variants or budgets share
SHOWN = {figure.key: figure for figure in FIGURES}


def sections(study: Study, rows: list[Row]) -> list[Section]:
    """Sections of the page, without those that have no row."""
    parts = [
        Section(
            f"What is gained over {study.baseline}",
            "Paired differences with the last budget. Worst scene: the lowest mean difference of "
            "mIoU of any scene, in points.",
            end_table(study, rows),
        ),
        Section(
            "The first scenes again, with the last basis",
            "mIoU with the last budget of scenes that come again at the end of their sequence, and so "
            "start from knowledge of all scenes, themselves among them: against "
            f"{study.baseline}, and against their first visit.",
            return_table(study, rows),
        ),
        Section(
            "Variants against each other",
            "Paired differences, the first from the second variant.",
            pair_table(study, rows),
        ),
    ]
    return [section for section in parts if len(section.table) > 1]


def end_table(study: Study, rows: list[Row]) -> list[list[str]]:
    """Header, then a row a sequence and variant, and a variant's over all sequences."""
    table = [["variant", "sequence", "condition", "pairs of runs", "mIoU", "worst scene", "PSNR"]]
    last = list(study.budgets.settings())[-1]
    rows = [row for row in counted(rows) if row["budget"] == last]
    names = list(dict.fromkeys(row["sequence"] for row in rows))
    for sequence in [*names, ""] if len(names) > 1 else names:
        some = [row for row in rows if sequence in ("", row["sequence"])]
        of = groups(some, "condition", "variant")
        for line in compare(some, study.baseline):
            if "miou" not in line.differences:
                continue
            mine, base = (of[line.condition, name] for name in (line.variant, study.baseline))
            gain, psnr = (difference_text(line.differences[key], SHOWN[key]) for key in ("miou", "psnr"))
            n = str(line.differences["miou"].n_pairs)
            worst = worst_scene(pairs(mine, base, "miou"))
            name = sequence or "all"
            table.append([line.variant, name, line.condition, n, gain, worst, psnr])
    return table


def worst_scene(found: list[tuple[str, float, float]]) -> str:
    """The lowest mean difference of any scene, in points, and which scene it is."""
    gains: dict[str, list[float]] = {}
    for scene, mine, base in found:
        gains.setdefault(scene, []).append(100 * (mine - base))
    scene = min(gains, key=lambda name: float(np.mean(gains[name])))
    return f"{np.mean(gains[scene]):+.1f} {scene}"


def return_table(study: Study, rows: list[Row]) -> list[list[str]]:
    """Header, then a row a variant and scene that comes again."""
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
    return table


def pair_table(study: Study, rows: list[Row]) -> list[list[str]]:
    """Header, then a row a pair of `study.pairs`, condition and budget."""
    keys = ("miou", "boundary_miou", "psnr")
    table = [["pair", "condition", "budget", "pairs of runs", *(SHOWN[key].heading for key in keys)]]
    for first, second in study.pairs:
        for line in compare(rows, second):
            if line.variant == first and "miou" in line.differences:
                cells = [difference_text(line.differences[k], SHOWN[k]) if k in line.differences else "-" for k in keys]
                n = line.differences["miou"].n_pairs
                table.append([f"{first} − {second}", line.condition, line.budget, str(n), *cells])
    return table
