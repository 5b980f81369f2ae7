"""The distance to a cloud: close to the truth, and never beyond it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tog_drake.distance_field import DistanceField


def test_one_point_is_seen_from_every_side_at_its_distance():
    field = DistanceField(np.array([[0.5, 0.0, 0.1]]), voxel=0.01)
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        distance = field.distance(np.array([0.5, 0.0, 0.1]) + 0.08 * direction)
        assert 0.08 - 0.0115 - 0.0087 <= distance <= 0.08


def test_an_empty_cloud_is_free_space():
    field = DistanceField(np.zeros((0, 3)), reach=0.25)
    assert field.distance(np.zeros((4, 5, 3))).shape == (4, 5)
    assert np.all(field.distance(np.zeros((4, 5, 3))) == 0.25)


def test_distances_are_clipped_at_reach():
    field = DistanceField(np.zeros((1, 3)), reach=0.2)
    assert field.distance(np.array([5.0, 0.0, 0.0])) == 0.2


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), voxel=st.floats(0.004, 0.03), count=st.integers(1, 400))
def test_distance_never_exceeds_the_truth_and_stays_near_it(seed, voxel, count):
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.35, -0.15, 0.0], [0.65, 0.15, 0.1], (count, 3))
    p = rng.uniform([0.2, -0.3, -0.25], [0.8, 0.3, 0.35], (300, 3))
    true = cKDTree(points).query(p)[0]
    answer = DistanceField(points, voxel=voxel, reach=10.0).distance(p)
    assert np.all(answer <= true + 1e-6)
    near = true < 0.1  # beyond, the look-up outside the table may fall further short
    assert np.all(answer[near] >= true[near] - 3 * voxel)


def test_points_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="finite"):
        DistanceField(np.array([[0.0, np.nan, 0.0]]))
