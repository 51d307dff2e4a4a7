"""Pictures of a study: one view of every scene rendered and labelled by each variant; class IoU."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.formats.evaluation import Evaluation
from chebsplat.pipelines.studies.results import Row
from chebsplat.pipelines.studies.study import Run, Study
from chebsplat.stages.pages import pictures as draw
from chebsplat.stages.pages.parts import class_rows, counted, label_names, legend, side

LONGEST = 480  # side of a picture, pixels


def gallery(study: Study, runs: list[Run], rows: list[Row]) -> dict[str, Any]:
    """Values of the page's slider and bars: `pictures`, `modes`, `legend`, `classes`, `shown`.

    Choices: of every scene the middle one of its evaluated views, under the first condition, the
      last budget and the first seed; every run's class IoU under that condition and budget counts.
      Classes of one name have one colour.
    """
    condition, budget = next(iter(study.conditions)), list(study.budgets.settings())[-1]
    of_interest = [
        (run, row)
        for run, row in zip(runs, rows, strict=True)
        if (run.condition, run.budget, row["state"]) == (condition, budget, "done")
    ]
    scenes: dict[str, dict[str, Run]] = {}
    for run, _ in of_interest:
        if run.seed == study.seeds[0]:
            scenes.setdefault(run.scene, {})[run.variant] = run
    names = {where: _names(some) for where, some in scenes.items()}
    union = list(dict.fromkeys(name for own in names.values() for name in own))
    pictures: list[dict[str, Any]] = []
    pixels: Counter[int] = Counter()
    for where, some in scenes.items():
        table = np.array([*(union.index(name) for name in names[where]), -1])
        evaluations = {
            variant: Evaluation.read(run.plan.targets["evaluate"]) for variant, run in some.items()
        }
        images, counts = _images(evaluations, table, len(union))
        pictures.append({"name": where, "images": images})
        pixels.update(counts)
    variants = [v for v in study.variants if v != study.baseline]
    compared = variants[0] if variants else study.baseline
    there = {key for row in pictures for key, _, _ in row["images"]}
    colors = {
        name: "#" + bytes(c).hex() for name, c in zip(union, draw.palette(len(union)), strict=True)
    }
    parts = (condition, budget, f"seed {study.seeds[0]}")
    return {
        "pictures": pictures,
        "modes": [mode for mode in _modes(study.baseline, variants) if _keys(mode) <= there],
        "legend": legend(pixels, union, colors),
        "classes": _classes(of_interest, compared, study.baseline, colors),
        "compared": compared,
        "shown": ", ".join(part for part in parts if part),
    }


def _names(runs: dict[str, Run]) -> list[str]:
    """Names of the labels in a scene's pictures; none where a variant has no labels."""
    for run in runs.values():
        evaluation = Evaluation.read(run.plan.targets["evaluate"])
        if "predicted" in evaluation.pictures:
            inputs = {
                role: run.plan.targets[stage]
                for role, stage in (("capture", "ingest"), ("scene", "export"))
            }
            return label_names(inputs, evaluation.figures)
    return []


def _images(
    evaluations: dict[str, Evaluation], table: np.ndarray, n: int
) -> tuple[list[tuple[str, str, str]], Counter[int]]:
    """(key, URI, caption) of pictures, and pixels by label. table: to the union's labels."""
    first = next(iter(evaluations.values()))
    view = len(first.figures["names"]) // 2
    pixels: Counter[int] = Counter()
    images = [("truth", draw.data_uri(_small(first.pictures["truth"][view]), photo=True), "photo")]

    def labels(key: str, stack: Any, caption: str) -> None:
        label_ids = table[_small(stack[view])]
        pixels.update(counted(label_ids))
        images.append((key, draw.data_uri(draw.colored(label_ids, n)), caption))

    if "labels" in first.pictures:
        labels("labels", first.pictures["labels"], "true labels")
    for variant, evaluation in evaluations.items():
        psnr = evaluation.figures["image"]["per_view"]["psnr"][view]
        render = _small(evaluation.pictures["renders"][view])
        images.append(
            (f"render of {variant}", draw.data_uri(render, photo=True), f"{variant}, {psnr:.1f} dB")
        )
        if "predicted" in evaluation.pictures:
            labels(f"labels of {variant}", evaluation.pictures["predicted"], f"{variant}'s labels")
    return images, pixels


def _small(image: np.ndarray) -> np.ndarray:
    """An image reduced by a whole factor to at most LONGEST: mean colours, every k-th label."""
    step = -(-max(image.shape[:2]) // LONGEST)
    return (
        np.asarray(Image.fromarray(image).reduce(step))
        if image.ndim == 3
        else image[::step, ::step]
    )


def _modes(baseline: str, variants: list[str]) -> list[list[Any]]:
    """Pairs to compare: photo and truth with the first variant, the baseline with the others."""

    def of(variant: str, what: bool) -> dict[str, str | None]:
        return side(variant, f"render of {variant}", f"labels of {variant}" if what else None)

    first = (variants or [baseline])[0]
    modes = [[f"photo | {first}", side("photo", "truth"), of(first, False)]]
    modes.append(
        [f"true labels | {first}", side("true labels", "truth", "labels"), of(first, True)]
    )
    if variants:
        modes.append([f"photo | {baseline}", side("photo", "truth"), of(baseline, False)])
    for what, suffix in ((False, ""), (True, ", labels")):
        modes += [[f"{baseline} | {v}{suffix}", of(baseline, what), of(v, what)] for v in variants]
    return modes


def _keys(mode: list[Any]) -> set[str]:
    return {s[key] for s in mode[1:] for key in ("base", "over") if s[key]}


def _classes(
    of_interest: list[tuple[Run, Row]], variant: str, baseline: str, colors: dict[str, str]
) -> list[tuple]:
    """(class, colour, the variant's mean IoU over scenes and seeds, the baseline's), best first."""

    def means(selected: str) -> dict[str, float]:
        values_of: dict[str, list[float]] = {}
        for run, row in of_interest:
            for name, value in row["segmentation"].get("scene", {}).get("iou", {}).items():
                if run.variant == selected and value is not None:
                    values_of.setdefault(name, []).append(value)
        return {name: float(np.mean(values)) for name, values in values_of.items()}

    other = means(baseline) if baseline != variant else {}
    sides = {"scene": {"iou": means(variant)}, "teacher": {"iou": other}}
    return class_rows({"segmentation": sides}, colors)
