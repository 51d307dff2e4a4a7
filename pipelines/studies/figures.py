"""The picture of a study: error against run time, or against a setting."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from chebsplat.evaluation.statistics import summarize
from chebsplat.pipelines.studies.results import Row, groups

MARKERS = "osD^vP*X<>"
Traces = list[tuple[Row, list[dict[str, float]]]]


def escape_name(name: str) -> str:
    """A name escaped for matplotlib: no mathematics, and never hidden from the legend."""
    return (" " if name.startswith("_") else "") + name.replace("$", r"\$")


def draw(
    path: Path, rows: list[Row], traces: Traces, settings: dict[str, float] | None, label: str
) -> None:
    """Write the picture as PNG.

    Args: settings: the value of the horizontal axis by condition; None: run time. label: of that
      axis.
    """
    matplotlib.use("Agg")

    finished = [row for row in rows if row["state"] == "done"]
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    style = {
        name: {
            "color": f"C{k % 10}",
            "marker": MARKERS[k % len(MARKERS)],
            "label": escape_name(name),
        }
        for k, name in enumerate(variants)
    }
    conditions = (
        [""]
        if settings is not None
        else list(dict.fromkeys(row["condition"] for row in rows)) or [""]
    )
    height = 3.4 * len(conditions) + 0.3 * -(-len(variants) // 5)
    color_only = (
        settings is None and bool(finished) and all(row["miou"] is None for row in finished)
    )
    scenes = list(dict.fromkeys(row["scene"] for row in finished))
    n, width = (len(scenes), max(3.2 * len(scenes), 5)) if color_only else (3, 12)
    figure, axes = plt.subplots(
        len(conditions), n, figsize=(width, height), layout="constrained", squeeze=False
    )
    for line, condition in zip(axes, conditions, strict=True):
        members = [row for row in finished if row["condition"] == condition]
        followed = [(row, trace) for row, trace in traces if row["condition"] == condition]
        if settings is not None:
            _over_setting(line, finished, settings, style, label)
        elif color_only:
            for axis, scene in zip(line, scenes, strict=True):
                _of_scene(axis, scene, members, followed, style)
            line[0].set_ylabel(f"PSNR, dB {escape_name(condition)}".strip())
        else:
            _over_time(line, members, followed, style)
            line[0].set_ylabel(escape_name(condition))
        for axis in line:
            axis.grid(alpha=0.3)
    handles = {
        text: handle
        for axis in axes.flat
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)
    }  # fmt: skip
    if handles:
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=9
        )
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _mean_line(
    axis: Any, points: list[tuple[Any, list[float], list[float]]], style: dict[str, Any]
) -> None:
    """A line through means, spreads as bars. points: (order, x values, y values)."""
    if not points:
        return
    points = sorted(points, key=lambda point: float(np.mean(point[1])))
    summaries = [summarize(values) for _, _, values in points]
    bars = [0.0 if np.isnan(s.spread) else s.spread for s in summaries]
    x = [float(np.mean(xs)) for _, xs, _ in points]
    axis.errorbar(
        x, [s.mean for s in summaries], bars, markersize=5, capsize=2, elinewidth=0.8, **style
    )


def _over_time(
    line: Any, rows: list[Row], traces: Traces, style: dict[str, dict[str, Any]]
) -> None:
    """Test PSNR and mIoU over training seconds, a point a budget; held-in PSNR of the longest."""
    titles = (("psnr", "test PSNR, dB", 1), ("miou", "test mIoU, %", 100))
    for axis, (key, title, scale) in zip(line, titles, strict=False):
        _over_budgets(axis, rows, key, scale, style)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("training seconds of whole runs")
    _longest(line[2], traces, style)
    line[2].set_title("PSNR on watched training views, dB; a line a run", fontsize=10)
    line[2].set_xlabel("training seconds")


def _of_scene(
    axis: Any, scene: str, rows: list[Row], traces: Traces, style: dict[str, dict[str, Any]]
) -> None:
    """A scene without semantics: test PSNR by budget, training views' PSNR as thin lines."""
    _over_budgets(axis, [row for row in rows if row["scene"] == scene], "psnr", 1, style)
    _longest(axis, [(row, trace) for row, trace in traces if row["scene"] == scene], style)
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.set_title(escape_name(scene), fontsize=10)
    axis.set_xlabel("training seconds (thin: views trained on)", fontsize=9)


def _over_budgets(
    axis: Any, rows: list[Row], key: str, scale: float, style: dict[str, dict[str, Any]]
) -> None:
    """A line a variant through the means of a figure, a point a budget."""
    measured = [row for row in rows if row[key] is not None and row["train_seconds"] is not None]
    for (variant,), members in groups(measured, "variant").items():
        budgets = groups(members, "budget")
        points = [
            (name, [row["train_seconds"] for row in some], [scale * row[key] for row in some])
            for name, some in budgets.items()
        ]
        _mean_line(axis, points, style[variant])


def _longest(axis: Any, traces: Traces, style: dict[str, dict[str, Any]]) -> None:
    """PSNR of the watched training views along the longest trainings of each variant."""
    longest: dict[str, int] = {}
    for row, _ in traces:
        longest[row["variant"]] = max(longest.get(row["variant"], 0), row["steps"])
    for row, trace in traces:
        if row["steps"] == longest[row["variant"]]:
            seconds, values = ([entry[name] for entry in trace] for name in ("seconds", "psnr"))
            axis.plot(
                seconds, values, color=style[row["variant"]]["color"], linewidth=0.7, alpha=0.7
            )


def _over_setting(
    line: Any, rows: list[Row], settings: dict[str, float], style: dict[str, Any], label: str
) -> None:
    """mIoU of the scene and of its teacher, their difference, and PSNR, over a setting."""
    titles = (
        ("miou", "test mIoU, %", 100),
        ("miou_gain", "mIoU − its 2D teacher's, points", 100),
        ("psnr", "test PSNR, dB", 1),
    )
    for axis, (key, title, scale) in zip(line, titles, strict=True):
        for (variant,), members in groups(
            [row for row in rows if row[key] is not None], "variant"
        ).items():
            at = groups(members, "condition")
            points = [
                (name, [settings[name]], [scale * row[key] for row in some])
                for (name,), some in at.items()
            ]
            _mean_line(axis, points, style[variant])
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(label)
    by_condition = groups([row for row in rows if row["miou_teacher"] is not None], "condition")
    points = [
        (name, [settings[name]], [100 * row["miou_teacher"] for row in some])
        for (name,), some in by_condition.items()
    ]
    _mean_line(
        line[0],
        points,
        {"color": "0.4", "linestyle": "--", "marker": ".", "label": "its 2D teacher"},
    )
    line[1].axhline(0, color="0.4", linewidth=0.8)
