import numpy as np
import pytest

from jaxprt.decompose.clustering import bisect


@pytest.fixture
def random():
    return np.random.default_rng(7)


def partition(member):
    """Clusters as sets, in no order."""
    return {frozenset(row.tolist()) for row in member}


@pytest.mark.parametrize("count", [1, 2, 7, 64, 101])
def test_every_point_is_in_one_cluster_and_sizes_differ_by_at_most_one(random, count):
    point = random.normal(size=(count, 6))
    for clusters in {1, 2, 3, count // 2, count - 1, count} & set(range(1, count + 1)):
        member = bisect(point, clusters=clusters)
        assert member.shape == (clusters, -(-count // clusters))
        own = [np.unique(row) for row in member]
        np.testing.assert_array_equal(np.sort(np.concatenate(own)), np.arange(count))
        assert {len(each) for each in own} <= {count // clusters, -(-count // clusters)}


def test_smaller_clusters_repeat_their_last_point(random):
    for row in bisect(random.normal(size=(11, 2)), clusters=4):
        assert len(np.unique(row)) == 3 - (row[1] == row[2])
        assert row[0] != row[1]


def test_blobs_far_apart_are_told_apart(random):
    corner = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3) * [100, 10, 1]
    blob = random.permutation(np.repeat(np.arange(8), 12))
    member = bisect(corner[blob] + 0.05 * random.normal(size=(96, 3)), clusters=8)
    assert partition(member) == {frozenset(np.flatnonzero(blob == each).tolist()) for each in range(8)}


@pytest.mark.parametrize("clusters", [3, 5, 6])
def test_points_on_a_line_are_cut_into_runs(random, clusters):
    order = random.permutation(31)
    place = np.sort(random.normal(size=31))[order]
    member = bisect(place[:, None] * np.array([[2.0, -1, 0.5]]) + 3, clusters=clusters)
    runs = np.array_split(np.argsort(place), clusters)
    lengths = sorted(map(len, runs))
    assert sorted(len(np.unique(row)) for row in member) == lengths
    for row in member:
        number = np.sort(order[np.unique(row)])
        assert number[-1] - number[0] == len(number) - 1


def test_clusters_do_not_depend_on_place_size_direction_or_order_of_the_points(random):
    # Six points each, so that it does not matter which end of an axis a cut starts from.
    point = random.normal(size=(48, 4)) * [8, 4, 2, 1]
    expected = partition(bisect(point, clusters=8))
    turn, _ = np.linalg.qr(random.normal(size=(4, 4)))
    for moved in (point + 1000, 1e-9 * point, 1e9 * point, -point, point @ turn):
        assert partition(bisect(moved, clusters=8)) == expected
    order = random.permutation(48)
    assert partition(order[bisect(point[order], clusters=8)]) == expected


@pytest.mark.parametrize("clusters", [0, -1, 6])
def test_an_impossible_number_of_clusters_is_refused(clusters):
    with pytest.raises(ValueError, match=f"clusters must be between 1 and the 5 points, got {clusters}"):
        bisect(np.zeros((5, 3)), clusters=clusters)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused(value):
    point = np.zeros((5, 3))
    point[[1, 3], [0, 2]] = value
    with pytest.raises(ValueError, match="points must be finite, got 2 that are not"):
        bisect(point, clusters=2)


def test_rounding_does_not_decide_the_clusters_of_a_symmetric_grid(random):
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1).reshape(-1, 3)
    expected = bisect(grid, clusters=8)
    for _ in range(3):
        np.testing.assert_array_equal(bisect(grid * (1 + 1e-7 * random.normal(size=grid.shape)), clusters=8), expected)
