"""What hangs together: parts are connected by touching, numbered by size, and only crumbs are left
out.
"""

import numpy as np

from chebsplat.splats.parts import parts, substantial


def rows(start, count, step=0.1):
    return np.stack([start + step * np.arange(count), np.zeros(count), np.zeros(count)], 1)


def test_touching_gaussians_are_one_part_and_the_largest_is_the_first():
    means = np.concatenate([rows(0, 3), rows(10, 30), rows(20, 1)])
    # spheres of two standard deviations along the longest axis: two of them reach 0.12
    scales = np.tile([0.01, 0.03, 0.02], (len(means), 1))
    chosen = np.ones(len(means), bool)
    assert parts(means, scales, chosen).tolist() == [1] * 3 + [0] * 30 + [2]
    chosen[:3] = False
    assert parts(means, scales, chosen).tolist() == [-1] * 3 + [0] * 30 + [1]
    assert parts(means, scales / 2, np.ones(len(means), bool)).max() == len(means) - 1


def test_only_crumbs_are_left_out():
    means = np.concatenate([rows(0, 3), rows(10, 30), rows(20, 2)])
    scales, chosen = np.full((len(means), 3), 0.03), np.ones(len(means), bool)
    assert substantial(means, scales, chosen).sum() == 33
    chosen[5] = False
    assert not substantial(means, scales, chosen)[5]
    none = np.zeros(len(means), bool)
    assert not substantial(means, scales, none).any()
    none[3] = True
    assert substantial(means, scales, none).sum() == 1
