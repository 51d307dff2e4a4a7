"""Regions cover the scene in farthest-point order, and change only where the scene does."""

import itertools

import numpy as np
import pytest

from chebsplat.settings import DescribeSection
from chebsplat.shape.regions import covering, farthest_points, regions_of


def cloud(n=4000, seed=0):
    return np.random.default_rng(seed).random((n, 3)) * [5.0, 4.0, 0.5]


def test_centres_are_in_farthest_point_order():
    points = cloud(500)
    picked, reach = farthest_points(points, 60, 7)
    distance = np.full(500, np.inf)
    for before, after in itertools.pairwise(picked):
        distance = np.minimum(distance, np.linalg.norm(points - points[before], axis=1))
        assert distance[after] >= distance.max() * (1 - 1e-6)  # float32 inside
    distance = np.minimum(distance, np.linalg.norm(points - points[picked[-1]], axis=1))
    assert reach == pytest.approx(distance.max(), rel=1e-6)


def test_seed_decides_the_start():
    assert list(farthest_points(cloud(), 5, 3)[0]) == list(farthest_points(cloud(), 5, 3)[0])
    assert list(farthest_points(cloud(), 5, 3)[0]) != list(farthest_points(cloud(), 5, 4)[0])


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e30])
def test_units_and_a_far_origin_change_no_region(unit):
    grid = np.round(cloud() * 1024) / 1024  # sums with the offset are exact
    few = DescribeSection(n_regions=50, region_size=16)
    near, far = regions_of(grid, few), regions_of((grid + 2.0**22) * unit, few)
    assert np.array_equal(near.centers, far.centers)
    assert np.array_equal(near.members, far.members)
    assert far.radius == pytest.approx(near.radius * unit, rel=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3, 30])
def test_coincident_points_make_one_region(n):
    regions = regions_of(np.ones((n, 3)), DescribeSection(n_regions=8, region_size=4))
    assert len(regions.centers) == 1
    assert regions.radius > 0
    assert (regions.members >= 0).sum() == min(n, 4)


def test_duplicates_are_not_picked_twice():
    points = np.repeat(cloud(20), 5, axis=0)
    picked, reach = farthest_points(points, 60, 0)
    assert len(picked) == 20
    assert len(np.unique(points[picked], axis=0)) == 20
    assert reach == 0


@pytest.mark.parametrize("n", [0, 1, 9])
def test_more_regions_than_points_make_every_point_a_centre(n):
    regions = regions_of(cloud(n), DescribeSection(n_regions=20, region_size=4))
    assert sorted(regions.centers) == list(range(n))


def test_members_are_spread_over_the_ball():
    points = cloud(20_000)
    regions = regions_of(points, DescribeSection(n_regions=40, region_size=32))
    offsets = np.linalg.norm(points[regions.members] - points[regions.centers][:, None], axis=-1)
    offsets = np.where(regions.members >= 0, offsets, np.nan)
    assert np.median(np.nanmax(offsets, axis=1)) > 0.7 * regions.radius  # thinned: not a speck of nearest ones
    assert (regions.members >= 0).sum(1).min() > 4


def test_points_are_covered_by_the_nearest_regions_that_reach_them():
    points = cloud(600)
    regions = regions_of(points, DescribeSection(n_regions=40, region_size=16))
    found = covering(points, points[regions.centers], regions.radius, 3)
    distance = np.linalg.norm(points[:, None] - points[regions.centers], axis=-1)
    nearest = distance.argsort(1)[:, :3]
    within = np.take_along_axis(distance, nearest, 1) < regions.radius
    assert np.array_equal(found, np.where(within, nearest, -1))
    assert within[:, 0].all()


def test_a_point_that_moves_changes_only_the_regions_that_hold_it():
    points = cloud()
    first = regions_of(points, DescribeSection(n_regions=60, region_size=16))
    again = regions_of(points, DescribeSection(n_regions=60, region_size=16), earlier=first)
    assert np.array_equal(first.members, again.members)
    moved = int(np.setdiff1d(first.members[5], first.centers)[-1])
    points[moved] += 1e-3
    after = regions_of(points, DescribeSection(n_regions=60, region_size=16), earlier=first)
    assert np.array_equal(after.centers, first.centers)
    changed = np.flatnonzero((after.members != first.members).any(1))
    assert set(changed) <= set(np.flatnonzero((first.members == moved).any(1) | (after.members == moved).any(1)))


def test_a_removed_point_leaves_the_other_regions_as_they_are():
    points = cloud()
    first = regions_of(points, DescribeSection(n_regions=60, region_size=16))
    gone = int(np.setdiff1d(first.members[5], first.centers)[-1])
    ids = np.delete(np.arange(len(points)), gone)
    place = np.full(len(points), -1)
    place[ids] = np.arange(len(ids))
    held = first._replace(centers=place[first.centers])
    after = regions_of(points[ids], DescribeSection(n_regions=60, region_size=16), ids=ids, earlier=held)
    named = np.where(after.members >= 0, ids[after.members], -1)
    changed = np.flatnonzero((named != first.members).any(1))
    assert len(changed)
    assert set(changed) <= set(np.flatnonzero((first.members == gone).any(1)))


def test_centres_that_no_longer_cover_the_scene_are_sampled_anew():
    points = cloud()
    first = regions_of(points, DescribeSection(n_regions=60, region_size=16))
    grown = np.concatenate([points, [[50.0, 0, 0]]])
    after = regions_of(grown, DescribeSection(n_regions=60, region_size=16), earlier=first)
    assert len(grown) - 1 in after.centers
    assert np.array_equal(after.members, regions_of(grown, DescribeSection(n_regions=60, region_size=16)).members)
