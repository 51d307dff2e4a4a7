"""Which views structure from motion matches with each other: all, those of near cameras, or those alike.

Views are counted 0...V-1 in the capture's order, which is that of their names. Pairs are int [P, 2], smaller index
first, each once and sorted.
"""

from __future__ import annotations

import numpy as np

from chebsplat.cameras import centers

FEW = 40  # views that are all matched with each other: 780 pairs, two to three minutes of a core
TURN = 30.0  # degrees between two viewing directions that weigh like the capture's median distance of two cameras
APART = 90.0  # degrees; views that face farther from each other share no feature that SIFT could match
IN_A_ROW = 5  # views on either side in the order of names
RATIO = 0.8  # Lowe's, of the distances of the nearest and the second nearest descriptor


def mode(wanted: str, n_views: int, posed: bool) -> str:
    """`exhaustive`, `posed` or `sequential`: the one that is wanted, and for `auto` the one that fits.

    Choices: given poses choose pairs at any number of views; without poses few views are all matched.
    """
    if wanted == "auto":
        return "posed" if posed else "exhaustive" if n_views <= FEW else "sequential"
    return wanted


def exhaustive(n_views: int) -> np.ndarray:
    """All pairs."""
    return np.stack(np.triu_indices(n_views, 1), 1)


def posed(cam_from_world: np.ndarray, n_neighbors: int) -> np.ndarray:
    """Each view with the `n_neighbors` that are nearest by position and viewing direction.

    Args:    cam_from_world: [V, 4, 4].
    Choices: distance over the capture's median distance, plus angle over TURN: no depth of the scene is needed. On 50
      photos with poses (fox) 10 neighbours are a quarter of the pairs and leave 98 % of the points; frusta at guessed
      depths choose no better.
    """
    return nearest(apart(cam_from_world), n_neighbors)


def apart(cam_from_world: np.ndarray) -> np.ndarray:
    """How far two views lie apart [V, V], in median distances and TURNs; infinite beyond APART and with itself."""
    eye, forward = centers(cam_from_world), cam_from_world[:, 2, :3]
    distance = np.linalg.norm(eye[:, None] - eye[None], axis=-1)
    angle = np.degrees(np.arccos(np.clip(forward @ forward.T, -1, 1)))
    usual = float(np.median(distance[np.triu_indices(len(eye), 1)])) or 1.0
    cost = np.where(angle > APART, np.inf, distance / usual + angle / TURN)
    np.fill_diagonal(cost, np.inf)
    return cost


def sequential(descriptors: list[np.ndarray], n_neighbors: int) -> np.ndarray:
    """Each view with IN_A_ROW before and after it, and with the `n_neighbors` most alike wherever they are.

    Args:    descriptors: per view [k, 128], of its largest features: those are seen from far and near.
    Choices: being alike is the number of matches between these few (mutual, by Lowe's ratio). That takes milliseconds
      a pair, needs no vocabulary, closes loops, and finds neighbours where names say nothing about the order. With 128
      features a view it chooses as well as given poses do: in a quarter of fox's pairs both keep 65 % of all inliers.
    """
    n = len(descriptors)
    alike = np.zeros((n, n))
    for i, j in exhaustive(n):
        alike[i, j] = alike[j, i] = n_matches(descriptors[i], descriptors[j])
    row = np.arange(n)
    near = np.abs(row[:, None] - row[None]) <= IN_A_ROW
    in_a_row = np.argwhere(np.triu(near, 1))
    return np.unique(np.concatenate([in_a_row, nearest(np.where(alike > 0, -alike, np.inf), n_neighbors)]), axis=0)


def nearest(cost: np.ndarray, count: int) -> np.ndarray:
    """Pairs of each view with the `count` of least finite cost [V, V]; a pair counts if either view chooses it."""
    cost = cost.copy()
    np.fill_diagonal(cost, np.inf)
    order = np.argsort(cost, 1, kind="stable")[:, :count]
    chosen = np.zeros(cost.shape, bool)
    np.put_along_axis(chosen, order, np.isfinite(np.take_along_axis(cost, order, 1)), 1)
    return np.argwhere(np.triu(chosen | chosen.T, 1))


def n_matches(first: np.ndarray, second: np.ndarray) -> int:
    """Mutual nearest neighbours by Lowe's ratio among descriptors f32 [n, 128] and [m, 128] of unit length."""
    if len(first) < 1 or len(second) < 2:
        return 0
    cosine = first @ second.T
    row, best = np.arange(len(first)), cosine.argmax(1)
    mutual = cosine.argmax(0)[best] == row
    top = cosine[row, best]
    cosine[row, best] = -1
    return int((mutual & (1 - top < RATIO**2 * (1 - cosine.max(1)))).sum())
