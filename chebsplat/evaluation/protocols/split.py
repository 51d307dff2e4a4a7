"""Which views are test views: by their index among the names in natural order."""

from __future__ import annotations

import re
from typing import Any

import numpy as np


def natural(name: str) -> tuple[Any, ...]:
    """Sort key under which frame_2 precedes frame_10; equal numbers are told apart by their spelling."""
    parts = re.split(r"(\d+)", name)
    return tuple(int(part) if k % 2 else part for k, part in enumerate(parts)), name


def every(names: list[str], step: int, offset: int) -> np.ndarray:
    """bool [V]: names whose index in natural order is `offset` modulo `step`, whatever order they are given in.

    Choices: natural order, which is that of text where numbers are padded; of unpadded names text makes another split.
    """
    order = sorted(range(len(names)), key=lambda k: natural(names[k]))
    chosen = np.zeros(len(names), bool)
    chosen[order[offset % step :: step]] = True
    return chosen
