"""Labels of a capture with depth by volumes in a file, instead of a map for each view.

The file is JSON: `frame`, 3 rows of 4 that bring a point of the source's world into the room, z up;
`margin`, in its unit; `volumes`, each with a `name`, a convex `polygon` of [x, y] and a `height` of
[bottom, top]. Other keys are ignored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.cameras import unproject
from chebsplat.errors import ConfigError, InputError
from chebsplat.labels.volumes import Volume, holder, prism
from chebsplat.stages.sources import labels, texts


def give(fields: dict[str, Any], path: Path) -> None:
    """Give the fields of a capture labels by the volumes that hold its pixels' points, -1 where
    none does or depth is unknown.

    Raises: ConfigError where the source has no depth with poses, InputError naming the file.
    """
    if fields.get("depth") is None or fields.get("cam_from_world") is None:
        raise ConfigError(
            "ingest.volumes needs depth with poses, which this source lacks; leave it away"
        )
    frame, margin, names, volumes = read(path)
    raw = np.full(fields["depth"].shape, -1, np.int32)
    for view, depth in enumerate(fields["depth"]):
        pixels = np.argwhere(np.isfinite(depth))
        points = unproject(depth, fields["Ks"][view], fields["cam_from_world"][view], pixels)
        raw[view][tuple(pixels.T)] = holder(points @ frame[:, :3].T + frame[:, 3], volumes, margin)
    fields["labels"], fields["class_names"], notes = labels.indexed(
        raw, dict(enumerate(names)), None
    )
    fields["source"]["labels"] = (
        f"Labels are of the {len(volumes)} volumes of {path.name}, by depth."
    )
    fields["source"]["notes"] += notes


def read(path: Path) -> tuple[np.ndarray, float, list[str], list[Volume]]:
    """Frame [3, 4], margin, and the names and volumes of a file. Raises InputError."""
    document, where = texts.read_json(path), "its frame and margin"
    try:
        frame, margin = numbers(document["frame"], (3, 4)), abs(texts.number(document["margin"]))
        names: list[str] = []
        volumes: list[Volume] = []
        for entry in document["volumes"]:
            where = f"volume {len(volumes)}"
            names.append(str(entry["name"]))
            bottom, top = map(texts.number, entry["height"])
            volumes.append(prism(numbers(entry["polygon"], (-1, 2)), bottom, top))
    except (KeyError, TypeError, ValueError) as error:
        reason = str(error)[: texts.LONGEST]
        raise InputError(f"{path}: {where}: {reason}; correct it (docs/usage.md)") from None
    return frame, margin, names, volumes


def numbers(rows: Any, shape: tuple[int, int]) -> np.ndarray:
    """Rows of numbers as an array of this shape. Raises ValueError or TypeError."""
    return np.array([[texts.number(value) for value in row] for row in rows]).reshape(shape)
