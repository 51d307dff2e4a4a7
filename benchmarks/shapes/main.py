"""How well a linear and a kNN classifier tell eight simple shapes from each descriptor, as trained and under shift.

Trained on clean regions (noise .02), tested on those and on shifted ones; `mixed` is trained and tested on a mixture.
Every seed draws new training and test regions; nothing is chosen by their test split. Mean ± deviation over seeds.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np
import torch

import chebsplat
from benchmarks import shared
from benchmarks.shapes import classifiers, samples
from benchmarks.shapes.features import BOTH, FEATURES, POOLING, pooled

CLEAN = samples.Condition()
SHIFTS = {
    "as trained": CLEAN,
    "noise .05": CLEAN._replace(noise=0.05),
    "noise .10": CLEAN._replace(noise=0.10),
    "n 40": CLEAN._replace(n=40),
    "ghosts 10 %": CLEAN._replace(ghosts=0.1),
    "frames .3": CLEAN._replace(frame_noise=0.3),
}
CONDITIONS = (*SHIFTS, "mixed")
KINDS = ("linear", "knn")
BARS = [  # linear classifier: ours over what, where, by how many points
    ("isotropic", "as trained", 30),
    ("isotropic", "mixed", 30),
    ("isotropic", "noise .10", 30),
    ("no rotations", "as trained", 12),
    ("no rotations", "mixed", 12),
    ("no rotations", "noise .10", 12),
    ("FPFH, Gaussian normals", "noise .10", 20),
    ("FPFH, Gaussian normals, whole region", "noise .10", 20),
]


def measure(seed: int, names: Sequence[str], pooling: str, n_train: int, n_test: int) -> list[dict[str, object]]:
    """One row per feature, classifier and condition."""
    rng = np.random.default_rng(seed)
    training = {"clean": samples.sample(CLEAN, n_train, rng), "mixed": samples.mixed(n_train, rng)}
    tests = {name: samples.sample(condition, n_test, rng) for name, condition in SHIFTS.items()}
    tests["mixed"] = samples.mixed(n_test, rng)
    vectors: dict[str, dict] = {}
    rows: list[dict[str, object]] = []
    for name in names:
        began = time.perf_counter()
        parts = {("train", k): v for k, v in training.items()} | {("test", k): v for k, v in tests.items()}
        if name == BOTH:
            made = {k: np.concatenate([vectors[part][k] for part in ("ours", "Gaussian moments")], 1) for k in parts}
        else:
            made = {k: pooled(FEATURES[name](v), pooling) for k, v in parts.items()}
        vectors[name] = made
        ms = 1e3 * (time.perf_counter() - began) / sum(len(v.labels) for v in parts.values())
        for kind in KINDS:
            fitted = {k: classifiers.fit(kind, made["train", k], v.labels, np.random.default_rng(seed))
                      for k, v in training.items()}  # fmt: skip
            for condition, regions in tests.items():
                classifier = fitted["mixed" if condition == "mixed" else "clean"]
                score = classifiers.accuracy(classifier, made["test", condition], regions.labels)
                rows.append({"feature": name, "classifier": kind, "condition": condition, "seed": seed,
                             "accuracy": score, "size": made["test", condition].shape[1], "ms": ms})  # fmt: skip
    return rows


def table(rows: list[dict[str, object]], names: Sequence[str]) -> dict[tuple[str, str, str], np.ndarray]:
    """Accuracy by feature, classifier and condition: one entry per seed."""
    return {(n, k, c): np.array([r["accuracy"] for r in rows if (r["feature"], r["classifier"], r["condition"]) ==
                                 (n, k, c)]) for n in names for k in KINDS for c in CONDITIONS}  # fmt: skip


def show(rows: list[dict[str, object]], names: Sequence[str]) -> None:
    scores = table(rows, names)
    for kind in KINDS:
        print(f"\n{kind:<38}{'size':>5}{'ms':>7} " + "".join(f"{c:>13}" for c in CONDITIONS))
        for name in names:
            first = next(r for r in rows if r["feature"] == name)
            cells = [f"{scores[name, kind, c].mean():5.1f} ± {scores[name, kind, c].std():3.1f}" for c in CONDITIONS]
            print(f"{name:<38}{first['size']:>5}{first['ms']:>7.2f} " + "".join(f"{cell:>13}" for cell in cells))
    print("\nlinear, ours over")
    for name, condition, bar in BARS:
        if name in names and "ours" in names:
            gain = scores["ours", "linear", condition] - scores[name, "linear", condition]
            verdict = "met" if gain.mean() >= bar else "missed"
            print(f"{name:<38}{condition:<12}{gain.mean():6.1f} ± {gain.std():.1f} points, bar {bar}: {verdict}")


def draw(rows: list[dict[str, object]], names: Sequence[str], file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    scores, width = table(rows, names), 0.85 / len(names)
    figure, panels = plt.subplots(2, 1, figsize=(15, 9), sharex=True, layout="constrained")
    colors = plt.get_cmap("tab20")(np.linspace(0, 1, 20))
    for panel, kind in zip(panels, KINDS, strict=True):
        for i, name in enumerate(names):
            found = [scores[name, kind, c] for c in CONDITIONS]
            where = np.arange(len(CONDITIONS)) + (i - (len(names) - 1) / 2) * width
            spread = [f.std() for f in found]
            panel.bar(where, [f.mean() for f in found], width, yerr=spread, color=colors[i % 20], label=name)
        panel.axhline(100 / len(samples.SHAPES), color="black", lw=0.8, ls=":")
        panel.set(ylabel=f"{kind}: right, %", ylim=(0, 101), xticks=np.arange(len(CONDITIONS)), xticklabels=CONDITIONS)
        panel.grid(axis="y", alpha=0.3)
        panel.set_axisbelow(True)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"{len(samples.SHAPES)} shapes told apart by a descriptor's features; dotted: chance")
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("shapes", __doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--train", type=int, default=60, help="training regions of each shape")
    parser.add_argument("--test", type=int, default=20, help="test regions of each shape and condition")
    parser.add_argument("--pooling", choices=list(POOLING), default="mean and deviation")
    parser.add_argument("--features", nargs="+", choices=[*FEATURES, BOTH], default=[*FEATURES, BOTH], metavar="NAME")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # matrices this small wait longer for threads than they compute
    print(f"{platform.machine()} CPU, {os.cpu_count()} cores; torch 1 thread, numba {numba.get_num_threads()}")
    print(f"chebsplat {chebsplat.__version__}, torch {torch.__version__}, numpy {np.__version__}")
    print(f"{len(samples.SHAPES)} shapes, {options.train} + {options.test} regions each, {options.seeds} seeds")
    print(f"pooling: {options.pooling} over a region's Gaussians; ms per region, pooling included")
    began, rows = time.perf_counter(), []
    for seed in range(options.seeds):
        rows += measure(seed, options.features, options.pooling, options.train, options.test)
    show(rows, options.features)
    shared.write_csv(options.out / "shapes.csv", rows)
    draw(rows, options.features, options.out / "shapes.png")
    print(f"\n{time.perf_counter() - began:.0f} s; {options.out}/shapes.csv, {options.out}/shapes.png")
    return 0
