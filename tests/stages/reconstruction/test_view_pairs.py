"""Pairs of views that are matched: near cameras, views in a row, views alike; each pair once, none
of no use.
"""

import numpy as np
import pytest

from chebsplat.stages.reconstruction.matching import (
    APART,
    FEW,
    IN_A_ROW,
    all_pairs,
    in_sequence,
    matching_mode,
    n_matches,
    nearest,
    nearest_by_pose,
)


def ring(n, outward=False):
    """cam_from_world [n, 4, 4] on a circle of radius 2, looking at its middle, or away from it."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    for k, angle in enumerate(np.arange(n) * 2 * np.pi / n):
        eye = 2 * np.array([np.cos(angle), np.sin(angle), 0.0])
        forward = eye / 2 * (1 if outward else -1)
        right = np.cross(forward, [0, 0, 1.0])
        poses[k, :3, :3] = np.stack([right, np.cross(forward, right), forward])
        poses[k, :3, 3] = -poses[k, :3, :3] @ eye
    return poses


def described(rng, n):
    found = rng.normal(size=(n, 128)).astype(np.float32)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize("outward", [True, False])
def test_each_camera_of_a_ring_is_paired_with_its_neighbours(outward):
    pairs = nearest_by_pose(ring(24, outward), 4)
    assert (pairs[:, 0] < pairs[:, 1]).all() and len(np.unique(pairs, axis=0)) == len(pairs) == 48
    gap = (pairs[:, 1] - pairs[:, 0]) % 24
    assert set(np.minimum(gap, 24 - gap)) == {1, 2}


def test_cameras_that_face_away_from_each_other_are_no_pair_however_near():
    poses = ring(9, outward=True)
    poses[:, :3, 3] = 0  # all at one place: only directions differ
    forward = poses[:, 2, :3]
    first, second = nearest_by_pose(poses, 8).T
    turned = np.degrees(np.arccos(np.clip((forward[first] * forward[second]).sum(1), -1, 1)))
    assert len(first) == 18 and turned.max() < APART  # 40 and 80 degrees


def test_a_loop_is_closed_by_what_views_show():
    """Views 0 and 29 share most features, as the others do with the next only."""
    rng = np.random.default_rng(0)
    places = [described(rng, 60) for _ in range(31)]
    places[30] = places[0]
    pairs = set(map(tuple, in_sequence([np.concatenate(places[k : k + 2]) for k in range(30)], 2)))
    assert (0, 29) in pairs and (0, 28) not in pairs
    assert {(k, j) for k in range(30) for j in range(k + 1, min(k + IN_A_ROW, 29) + 1)} <= pairs


def test_matches_are_mutual_and_clear():
    rng = np.random.default_rng(1)
    first = described(rng, 40)
    second = np.concatenate([first[:25], described(rng, 30)])
    assert n_matches(first, second) == n_matches(second, first) == 25
    assert n_matches(first[:1], np.concatenate([first[:1], first[:1]])) == 0  # two alike: not clear
    assert n_matches(first, first[:1]) == n_matches(first[:0], second) == 0


def test_nearest_never_pairs_what_has_no_finite_cost():
    cost = np.full((4, 4), np.inf)
    cost[0, 2] = 1
    assert nearest(cost, 3).tolist() == [[0, 2]]


def test_auto_follows_poses_and_count():
    assert matching_mode("auto", 1000, True) == "posed"
    assert (
        matching_mode("auto", FEW, False) == "exhaustive"
        and len(all_pairs(FEW)) == FEW * (FEW - 1) // 2
    )
    assert matching_mode("auto", FEW + 1, False) == "sequential"
    assert matching_mode("exhaustive", 1000, True) == "exhaustive"
