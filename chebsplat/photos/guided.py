"""Epipolar lines of known poses: matches along them, and distances of free matches to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from chebsplat.kernels.jit import body, kernel
from chebsplat.kernels.threads import in_parts

BAND = 1.5  # pixels that a match may miss by, as Sampson measures it
# pixels: features are stored by strips of columns, and within a strip by rows of as many
STRIP = 16.0
RATIO = 0.7  # Lowe's, of the distances of the nearest and the second nearest descriptor by the line
ALIKE = 0.9  # least cosine of two descriptors


def along_lines(
    pixels: Sequence[np.ndarray],
    descriptors: Sequence[np.ndarray],
    pairs: np.ndarray,
    F: np.ndarray,
) -> list[np.ndarray]:
    """Matches i64 [M, 2] of each pair: features of its first view, in order, and of its second.

    Args:    pixels: of each view f32 [n, 2]; descriptors: uint8 [n, D]; pairs i64 [P, 2]; F f64 [P,
      3, 3]: of each.
    Choices: mutual nearest descriptors within BAND, by Lowe's ratio among those that lie there: the
      line leaves a hundredth of the features, so this is faster than a search of all of them, and
      finds what repeats elsewhere, too. Chance finds a match among so few more easily: RATIO and
      ALIKE are stricter than usual, and leave a tenth of such (of fox's matches, with lines moved
      by 12 pixels across). Where F is 0, as for two views from one place, no feature has a line.
    """
    strips = [_by_strips(at) for at in pixels]
    start = np.cumsum([0, *map(len, pixels)])
    joined = np.concatenate(
        [some[order] for some, (order, _, _) in zip(descriptors, strips, strict=True)]
    )
    length = np.empty(len(joined), np.float32)
    in_parts(_measure, len(joined), joined, length)
    partner = np.empty((len(pairs), int(np.diff(start).max(initial=0))), np.int32)
    in_parts(
        _along_lines,
        len(pairs),
        np.concatenate(
            [at[order] for at, (order, _, _) in zip(pixels, strips, strict=True)]
        ).astype(np.float32),
        joined,
        length,
        start,
        np.concatenate([first for _, first, _ in strips]),
        np.cumsum([0, *(len(first) for _, first, _ in strips)]),
        np.array([rows for _, _, rows in strips]),
        np.asarray(pairs, np.int64),
        np.asarray(F, np.float64),
        BAND,
        RATIO,
        ALIKE,
        partner,
    )
    by_pair = []
    for (a, b), row in zip(pairs, partner, strict=True):
        first = np.flatnonzero(row >= 0)
        matches = np.stack([strips[a][0][first], strips[b][0][row[first]]], 1)
        by_pair.append(matches[np.argsort(matches[:, 0])])
    return by_pair


def _by_strips(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Order of a view's features by cells, first of each cell [C + 1], cells in a strip."""
    place = np.floor(np.maximum(pixels, 0) / STRIP).astype(np.int64).reshape(-1, 2)
    strips, rows = place.max(0, initial=0) + 1
    cell = place[:, 0] * rows + place[:, 1]
    order = np.argsort(cell, kind="stable")
    return order, np.searchsorted(cell[order], np.arange(strips * rows + 1)), int(rows)


@kernel
def _measure(begin, end, descriptors, length):
    for k in range(begin, end):
        length[k] = np.sqrt(np.float32(max(_product(descriptors[k], descriptors[k]), 1)))


@kernel
def _along_lines(
    begin, end, pixels, descriptors, length, start, first, cells, rows, pairs, F, band, ratio,
    alike, partner,
):  # fmt: skip
    for pair in range(begin, end):
        a, b = pairs[pair]
        _match(
            pixels[start[a] : start[a + 1]], descriptors[start[a] : start[a + 1]],
            length[start[a] : start[a + 1]],
            pixels[start[b] : start[b + 1]], descriptors[start[b] : start[b + 1]],
            length[start[b] : start[b + 1]],
            first[cells[b] : cells[b + 1]], rows[b], F[pair], band, ratio, alike, partner[pair],
        )  # fmt: skip


@body
def _match(
    pixels,
    descriptors,
    length,
    others,
    theirs,
    their_length,
    first,
    rows,
    F,
    band,
    ratio,
    alike,
    partner,
):
    """`partner` [N]: of each feature the other view's that is its match, -1: none."""
    partner[:] = -1
    strips = (len(first) - 1) // rows
    candidate, closest = np.full(len(others), -1, np.int32), np.full(len(others), -1, np.float32)
    for k in range(len(pixels)):
        x, y = np.float64(pixels[k, 0]), np.float64(pixels[k, 1])
        u, v = F[0, 0] * x + F[0, 1] * y + F[0, 2], F[1, 0] * x + F[1, 1] * y + F[1, 2]
        w, size = F[2, 0] * x + F[2, 1] * y + F[2, 2], np.hypot(u, v)
        if size == 0:
            continue
        down = v if abs(v) > 1e-9 * size else 1e-9 * size  # of an upright line, which no row limits
        reach = 2 * band * size / abs(down)
        best, second, nearest = np.float32(-1), np.float32(-1), -1
        for strip in range(strips):
            left, right = -(u * strip * STRIP + w) / down, -(u * (strip + 1) * STRIP + w) / down
            top = (min(left, right) - reach) / STRIP
            bottom = (max(left, right) + reach) / STRIP
            if not (top < rows and bottom >= 0):
                continue
            low, high = int(max(top, 0)), int(min(bottom, rows - 1))
            for other in range(first[strip * rows + low], first[strip * rows + high + 1]):
                p, q = np.float64(others[other, 0]), np.float64(others[other, 1])
                miss = u * p + v * q + w
                back_u, back_v = (
                    F[0, 0] * p + F[1, 0] * q + F[2, 0],
                    F[0, 1] * p + F[1, 1] * q + F[2, 1],
                )
                if miss * miss > band * band * (u * u + v * v + back_u * back_u + back_v * back_v):
                    continue
                cosine = _product(descriptors[k], theirs[other]) / (length[k] * their_length[other])
                if cosine > closest[other]:
                    closest[other], candidate[other] = cosine, k
                if cosine > best:
                    second, best, nearest = best, cosine, other
                elif cosine > second:
                    second = cosine
        if best > alike and 1 - best < ratio * ratio * (1 - second):
            partner[k] = nearest
    for k in range(len(pixels)):
        if partner[k] >= 0 and candidate[partner[k]] != k:
            partner[k] = -1


@body
def _product(one, other):
    total = np.int32(0)
    for k in range(len(one)):
        total += np.int32(one[k]) * np.int32(other[k])
    return total


def fundamental(
    K: np.ndarray, pose: np.ndarray, K_other: np.ndarray, pose_other: np.ndarray
) -> np.ndarray:
    """F [3, 3] of two views, K [3, 3] and cam_from_world [4, 4]: x'ᵀ F x = 0 of one point."""
    between = pose_other @ np.linalg.inv(pose)
    x, y, z = between[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ between[:3, :3]
    return np.asarray(np.linalg.inv(K_other).T @ essential @ np.linalg.inv(K))


def sampson_distance(F: np.ndarray, pixels: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Pixels by which matches miss, to first order: |x'ᵀ F x| / √(‖(F x)₁₂‖² + ‖(Fᵀ x')₁₂‖²).

    Args:    F: [3, 3]; pixels, others: [N, 2] in the first and the second view.
    Returns: [N]; nan where F is zero, as for two views from one place.
    """
    x, y = (np.column_stack([at, np.ones(len(at))]) for at in (pixels, others))
    lines, back = x @ F.T, y @ F
    size = np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs((y * lines).sum(1)) / size)
