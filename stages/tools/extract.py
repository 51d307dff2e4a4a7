"""Part of a finished scene as one splat, selected by words, label, opacity and box."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chebsplat.errors import ConfigError, DataFailure
from chebsplat.formats.scene import Scene
from chebsplat.splats.parts import substantial
from chebsplat.stages.tools.query import Query
from chebsplat.stages.tools.scene import OpenedScene, filter_masks


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
      out:         the splat to write, as of `OpenedScene.export`.
      labels:      names to keep; all where there are none.
      min_opacity: activated, in [0, 1]; box: x0, y0, z0, x1, y1, z1 of centres, scene units.
      query:       selects the connected parts above its cut; None: all.
    Returns: number of Gaussians written, and of those that each filter alone leaves out.
    Raises:  ConfigError on a filter that the scene cannot answer, DataFailure if nothing is left.
    """
    filters = filter_masks(scene.exported, scene.source, labels, min_opacity, box)
    if query is not None:
        filters["query"] = select_by_query(scene.exported, query)
    n = len(scene)
    part = scene.part(filters)
    part.export(out)
    left_out = {f"left out by {name}": int(n - keep.sum()) for name, keep in filters.items()}
    return {"kept": len(part), "of": n} | left_out


def select_by_query(scene: Scene, query: Query) -> np.ndarray:
    """Mask [N] of the Gaussians above the query's cut, without small isolated groups. Raises
    DataFailure where the scene probably has none.
    """
    answer = query.answer(scene.parameters["features"])
    if answer.present is False or not answer.selected.any():
        raise DataFailure(f"{answer}; ask for something else, or name a label with --keep-label")
    return substantial(
        scene.parameters["means"], np.exp(scene.parameters["log_scales"]), answer.selected
    )


def corners(text: str | None) -> tuple[float, ...] | None:
    """Numbers separated by commas. Raises ConfigError if they are none."""
    try:
        return None if text is None else tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--box {text}: six numbers x0,y0,z0,x1,y1,z1 are needed") from None
