"""Shared by protocols: the rule of their views; their input, which is evaluated views one by one
and the names of labels and classes; and ways to compare labels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from chebsplat.errors import DataFailure
from chebsplat.evaluation.metrics import IGNORE
from chebsplat.labels.names import lacking, rows_of


@dataclass(frozen=True)
class Rule:
    """The views that a protocol tests, and their truth.

    side: pixels of a view's longest side, unless `ingest.max_side` says another.
    test_every, test_offset: a view is a test view if its index among the names, modulo the one, is
      the other; adjustable: a config may change these two, which are recorded.
    own_split: a source's own split goes first. on_training: the training views are evaluated, and
      none is held out.
    truth: labels of the capture, or the teacher's own.
    """

    side: int = 640
    test_every: int = 8
    test_offset: int = 0
    adjustable: bool = False
    own_split: bool = False
    on_training: bool = False
    truth: Literal["labels", "teacher"] = "labels"


@dataclass
class EvaluatedView:
    """One evaluated view of H x W pixels.

    features: f32 [H, W, C] as rendered; labels: i16 [H, W] their label among the task's `names`.
    teacher:  f32 [h, w, C] and teacher_labels i16 [H, W], None without a teacher.
    truth:    i16 [H, W] index into the task's `classes`, IGNORE where unknown; None without labels.
    surface:  f64 [H, W, 3] where in the world its pixels lie, nan where unknown; None without
      depth.
    """

    name: str
    features: np.ndarray
    labels: np.ndarray
    teacher: np.ndarray | None = None
    teacher_labels: np.ndarray | None = None
    truth: np.ndarray | None = None
    surface: np.ndarray | None = None


@dataclass
class Task:
    """names, embeddings [L, C] of the labels that features are decoded to; classes of the truth;
    boundary: pixels.

    at: points [M, 3] of the world -> features [M, C] of the scene there and their weights [M], 0
      where it has nothing.
    """

    names: list[str]
    embeddings: np.ndarray
    classes: list[str] = field(default_factory=list)
    boundary: int = 5
    at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None


class MapsByName(Mapping[str, np.ndarray]):
    """Rows of a stack by view name, read on access: views are joined on names, not on position."""

    def __init__(self, names: list[str], stack: Any, what: str):
        self.rows, self.stack, self.what = (
            {name: row for row, name in enumerate(names)},
            stack,
            what,
        )

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.rows:
            raise DataFailure(f"view {name} has no {self.what}; make them of the same capture")
        return np.asarray(self.stack[self.rows[name]])

    def __iter__(self) -> Iterator[str]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)


def counted(pixels: np.ndarray) -> dict[str, int]:
    """Basis of a mean over classes: how many `classes` the truth has, and its `pixels`, of [L]."""
    return {"classes": int((pixels > 0).sum()), "pixels": int(pixels.sum())}


def mean_over(values: np.ndarray, pixels: np.ndarray) -> float | None:
    """Mean of the figures of classes that are not nan; None where the truth has fewer than two by
    `pixels`: of one class alone any scene that knows no other has 100 %.
    """
    if counted(pixels)["classes"] < 2 or np.isnan(values).all():
        return None
    return float(np.nanmean(values))


def translated(
    labels: np.ndarray, names: list[str], classes: list[str], unknown: int
) -> np.ndarray:
    """Labels among `names` as indices into `classes`, IGNORE kept; `unknown` if a name is none."""
    table = np.array([*(unknown if row < 0 else row for row in rows_of(names, classes)), IGNORE])
    result: np.ndarray = table[labels]
    return result


def predicted(labels: np.ndarray, names: list[str], classes: list[str], unknown: int) -> np.ndarray:
    """`translated` of a prediction: IGNORE becomes `unknown` too, which counts as wrong."""
    return np.where(labels == IGNORE, unknown, translated(labels, names, classes, unknown))


def required(
    names: list[str], classes: tuple[str, ...], protocol: str, also: tuple[str, ...] = ()
) -> None:
    """Raise DataFailure unless `names` are `classes` in any order, and maybe some of `also`."""
    if absent := lacking(classes, names):
        raise DataFailure(
            f"{protocol} asks for its {len(classes)} classes; the teacher has no "
            f"{', '.join(absent)}"
        )
    if foreign := lacking(names, (*classes, *also)):
        raise DataFailure(
            f"{protocol} knows no {', '.join(foreign)}; give the teacher the "
            "protocol's classes alone"
        )


def resized(labels: np.ndarray, size: tuple[int, int], centred: bool = False) -> np.ndarray:
    """Labels [h, w] at size (H, W) by the nearest pixel.

    Choices: the pixel that holds the corner of the new one, as torch does it; `centred`: its
      centre, as PIL does.
    """
    rows, columns = (
        np.minimum((2 * np.arange(n) + centred) * m // (2 * n), m - 1)
        for n, m in zip(size, labels.shape, strict=True)
    )
    nearest: np.ndarray = labels[rows[:, None], columns]
    return nearest


def bilinear(features: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Features [h, w, C] at size (H, W); corner pixels keep their centres ("align_corners")."""
    for axis, n in enumerate(size):
        m = features.shape[axis]
        at = np.linspace(0, m - 1, n)
        low = np.minimum(at.astype(int), max(m - 2, 0))
        share = (
            (at - low)
            .astype(np.float32)
            .reshape([-1 if k == axis else 1 for k in range(features.ndim)])
        )
        below, above = (
            np.take(features, low, axis),
            np.take(features, np.minimum(low + 1, m - 1), axis),
        )
        features = below * (1 - share) + above * share
    return features
