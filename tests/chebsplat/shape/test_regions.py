"""Regions cover the scene in farthest-point order, whatever its unit, origin and density."""

import itertools

import numpy as np
import pytest

from chebsplat.settings import DescribeSection
from chebsplat.shape.regions import farthest_points, regions_of


def cloud(n=4000, seed=0):
    return np.random.default_rng(seed).random((n, 3)) * [5.0, 4.0, 0.5]


@pytest.mark.parametrize(
    "points",
    [cloud(500), cloud(20_000) ** 9, np.indices((9, 9, 9)).reshape(3, -1).T, cloud(129)],
    ids=["even", "dense in a corner", "of equal distances", "one more than a block"],
)
def test_centres_are_in_farthest_point_order(points):
    points = points.astype(float)
    picked, reach = farthest_points(points, 60, 7)
    assert picked[0] == 7 and len(set(picked)) == 60
    distance = np.full(len(points), np.inf)
    for before, after in itertools.pairwise(picked):
        distance = np.minimum(distance, np.linalg.norm(points - points[before], axis=1))
        assert distance[after] >= distance.max() * (1 - 1e-6)  # float32 inside
    distance = np.minimum(distance, np.linalg.norm(points - points[picked[-1]], axis=1))
    assert reach == pytest.approx(distance.max(), rel=1e-6)


def test_the_seed_decides_the_first_centre_and_the_thinning():
    every = DescribeSection(n_regions=4000, region_size=16)  # each point, which has 15 neighbours
    one, other = (regions_of(cloud(), every.model_copy(update={"seed": k})) for k in (0, 1))
    assert one.centers[0] != other.centers[0]
    assert len(np.setxor1d(one.members[:, 1:], other.members[:, 1:])) > 50


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
    # thinned: not a speck of nearest ones
    assert np.median(np.nanmax(offsets, axis=1)) > 0.7 * regions.radius
    assert (regions.members >= 0).sum(1).min() > 4


def test_non_finite_points_are_refused():
    with pytest.raises(ValueError, match="finite"):
        regions_of(np.full((3, 3), np.nan), DescribeSection(n_regions=2, region_size=4))
