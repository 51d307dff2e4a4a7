"""Queries at the suggested cut: precision and recall by class in unseen rooms, absent words.

Rooms are trained as they come (--settings), none of which a calibration has seen. A Gaussian is of
the class of the nearest point of the true surface, within 10 cm; the few beyond do not count.
Precision is over queries that select anything. Words that no room has are `measured` of
teachers/words.toml.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import shared
from chebsplat.cameras import unproject
from chebsplat.formats.capture import Capture
from chebsplat.formats.scene import Scene
from chebsplat.formats.teacher_model import EMBEDDED
from chebsplat.labels.calibration import relevancy
from chebsplat.pipelines.work import store
from chebsplat.stages.tools.query import CANONICAL, understood
from chebsplat.synthetic import CLASS_NAMES

SCENES = "office0,office1,room0,shuffled0,shuffled1"
SETTINGS = "train.steps=1000,evaluate.timing_repeats=0"
BARS = {"precision": 0.75, "recall": 0.6, "refused": 0.85}
NEAR = 0.1  # metres
LEAST = 20  # Gaussians of a class, of which a room has it


def classes_of(scene: Scene, capture: Path) -> np.ndarray:
    """True class of each Gaussian, i64 [N], -1 where no surface is near."""
    views = Capture.read(capture)
    assert views.depth is not None and views.labels is not None and views.cam_from_world is not None
    points, classes = [], []
    for depth, labels, K, pose in zip(
        views.depth, views.labels, views.Ks, views.cam_from_world, strict=True
    ):
        pixels = np.argwhere(np.isfinite(depth) & (depth > 0))[::7]
        points.append(unproject(depth, K, pose, pixels))
        classes.append(labels[pixels[:, 0], pixels[:, 1]])
    distance, nearest = cKDTree(np.concatenate(points)).query(scene.parameters["means"])
    return np.where(distance <= NEAR, np.concatenate(classes)[nearest], -1).astype(np.int64)


def counts(selected: np.ndarray, truth: np.ndarray, has_truth: np.ndarray) -> tuple[int, int, int]:
    """Numbers of Gaussians selected rightly, selected, and truly of the class."""
    selected = selected & has_truth
    return int((selected & truth).sum()), int(selected.sum()), int(truth.sum())


def row(room: str, name: str, rows: list[tuple[int, int, int]]) -> dict[str, Any]:
    """Precision and recall, pooled and as means of queries."""
    right, selected, positives = np.array(rows).sum(0)
    each = [(r / c if c else np.nan, r / w) for r, c, w in rows]
    return {
        "room": room,
        "scores": name,
        "queries": len(rows),
        "precision": right / max(selected, 1),
        "recall": right / positives,
        "mean_precision": float(np.nanmean([p for p, _ in each])),
        "mean_recall": float(np.mean([r for _, r in each])),
    }


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("query", __doc__)
    parser.add_argument(
        "--scenes", default=SCENES, help="names of scenes with exact labels, with commas"
    )
    parser.add_argument("--settings", default=SETTINGS, help="as set= takes them")
    parser.add_argument(
        "--folders", type=Path, nargs="*", help="of links of finished scenes, instead"
    )
    options = parser.parse_args(arguments)
    folders = options.folders
    if not folders:
        runs = [(scene, options.settings) for scene in options.scenes.split(",")]
        folders = [store.work() / plan.title for plan in shared.finished(runs, "export")]
    absent = tomllib.loads(EMBEDDED.with_name("words.toml").read_text())["absent"]["measured"]
    table: list[dict[str, Any]] = []
    pooled: dict[str, list[tuple[int, int, int]]] = {"calibrated": [], "relevancy above 0.5": []}
    refused, detected = [], []
    for folder in folders:
        scene = Scene.read(folder / "export")
        features, classes = scene.parameters["features"], classes_of(scene, folder / "ingest")
        here: dict[str, list[tuple[int, int, int]]] = {name: [] for name in pooled}
        for k, word in enumerate(CLASS_NAMES):
            truth = classes == k
            if truth.sum() < LEAST:
                continue
            answer = understood(folder / "teacher", word, []).answer(features)
            plain = understood(folder / "teacher", word, list(CANONICAL))
            scores = {
                "calibrated": answer.selected,
                "relevancy above 0.5": relevancy(features, plain.embedding, plain.against) > 0.5,
            }
            for name, selected in scores.items():
                here[name].append(counts(selected, truth, classes >= 0))
            detected.append(bool(answer.present))
        lacking = [
            bool(understood(folder / "teacher", word, []).answer(features).present)
            for word in absent
        ]
        refused += [not there for there in lacking]
        table += [row(folder.name.partition("@")[0], name, rows) for name, rows in here.items()]
        for name, rows in here.items():
            pooled[name] += rows
    total = [row("all", name, rows) for name, rows in pooled.items()]
    total[0] |= {"present_found": float(np.mean(detected)), "refused": float(np.mean(refused))}
    table += total
    shared.write_csv(options.out / "query.csv", table)
    for line in table:
        cells = (
            f"{key} {value:.3f}" if isinstance(value, float) else str(value)
            for key, value in line.items()
        )
        print("  ".join(cells))
    print(f"{len(folders)} rooms, {len(absent)} absent words, {shared.processor()}")
    bars: list[shared.Bar] = [(name, total[0][name], ">=", bar) for name, bar in BARS.items()]
    return int(not all(shared.judged(bars)))
