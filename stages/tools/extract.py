"""Part of a finished scene as one 3DGS PLY: chosen by words, label, opacity and box."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError, DataFailure
from chebsplat.formats.scene import Scene
from chebsplat.splats.parts import substantial
from chebsplat.stages.tools.query import Query
from chebsplat.stages.tools.scene import OpenedScene, passing

CONVERT = "npx @playcanvas/splat-transform@2.7.1 scene.ply scene.compressed.ply"  # or scene.spz --spz-version 3


def extract(
    scene: OpenedScene,
    out: Path,
    labels: tuple[str, ...],
    min_opacity: float,
    box: tuple[float, ...] | None,
    query: Query | None = None,
) -> dict[str, int]:
    """Write the Gaussians that pass every filter, trimmed to the highest SH degree among them.

    Args:
      out:         the PLY to write; never overwritten.
      labels:      names to keep; all where there are none.
      min_opacity: activated, in [0, 1]; box: x0, y0, z0, x1, y1, z1 of centres, scene units.
      query:       what its cut selects, in the parts that hang together; None: all.
    Returns: how many Gaussians were kept, and how many each filter alone would leave out.
    Raises:  ConfigError on a filter that the scene cannot answer, DataFailure if nothing is left.
    """
    if out.suffix != ".ply" or out.name.endswith(".compressed.ply"):
        raise ConfigError(f"{out}: only a plain .ply is written; convert that, for instance: {CONVERT}")
    filters = passing(scene.exported, scene.source, labels, min_opacity, box)
    if query is not None:
        filters["query"] = asked_for(scene.exported, query)
    n = len(scene)
    left_out = {name: int(n - keep.sum()) for name, keep in filters.items()}
    kept = np.logical_and.reduce([np.ones(n, bool), *filters.values()])
    if not kept.any():
        why = ", ".join(f"{name} {number}" for name, number in left_out.items())
        raise DataFailure(f"no Gaussian of {n} is left ({why}); choose wider filters")
    scene.select(kept).to_ply(out)
    return {"kept": int(kept.sum()), "of": n} | {f"left out by {name}": number for name, number in left_out.items()}


def asked_for(scene: Scene, query: Query) -> np.ndarray:
    """Which Gaussians the query selects, bool [N], crumbs apart. Raises DataFailure where it is probably not here."""
    answer = query.answer(scene.parameters["features"])
    if answer.present is False or not answer.selected.any():
        raise DataFailure(f"{answer}; ask for something else, or name a label with --keep-label")
    return substantial(scene.parameters["means"], np.exp(scene.parameters["log_scales"]), answer.selected)


def corners(text: str | None) -> tuple[float, ...] | None:
    """Six numbers from "x0,y0,z0,x1,y1,z1". Raises ConfigError if they are no box."""
    if text is None:
        return None
    try:
        box = tuple(float(part) for part in text.split(","))
    except ValueError:
        box = ()
    if len(box) != 6 or not all(math.isfinite(v) for v in box) or any(box[k] >= box[k + 3] for k in range(3)):
        raise ConfigError(f"--box {text}: six numbers x0,y0,z0,x1,y1,z1 with x0 < x1 and so on are needed")
    return box
