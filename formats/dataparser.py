"""nerfstudio's dataparser_transforms.json: the similarity it applied to a splat's cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.files import parse_json

NAME = "dataparser_transforms.json"
ABOVE = 3  # parent folders of a splat that are searched


def beside(ply: Path) -> Path | None:
    """The file that belongs to a splat: in its folder, or the nearest above."""
    places = (ply.absolute().parent, *ply.absolute().parent.parents[:ABOVE])
    return next((place / NAME for place in places if (place / NAME).is_file()), None)


def read_dataparser(path: Path) -> tuple[float, np.ndarray, np.ndarray]:
    """scale, rotation [3, 3], shift [3]: x' = scale (rotation x + shift). Raises InputError."""
    document = parse_json(path)
    try:
        matrix, scale = np.array(document["transform"], float), float(document["scale"])
    except (KeyError, TypeError, ValueError):
        matrix, scale = np.zeros(0), 0.0
    rotation = matrix[:3, :3] if matrix.shape in ((3, 4), (4, 4)) else np.zeros((3, 3))
    if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and 0 < scale < np.inf):
        raise InputError(
            f"{path} holds no `transform` of 3x4 and `scale`; remove it, or copy it "
            "again from nerfstudio"
        )
    return scale, rotation, matrix[:3, 3]
