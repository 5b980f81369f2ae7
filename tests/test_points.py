"""Thinning, neighbours, normals and clusters of sets of points."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.points import clusters, group_means, neighbors, surface_normals, voxel_numbers


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.5))
def test_points_share_a_number_exactly_when_they_share_a_cube(seed, voxel):
    points = np.random.default_rng(seed).uniform(-1, 1, (50, 3))
    number = voxel_numbers(points, voxel)
    cell = np.floor(points / voxel)
    same_cell = np.all(cell[:, None] == cell, axis=-1)
    np.testing.assert_array_equal(number[:, None] == number, same_cell)
    assert sorted(set(number)) == list(range(number.max() + 1))


def test_cubes_are_numbered_by_place_whatever_the_order_of_the_points():
    points = np.array([[0.5, 0.5, 1.5], [1.5, 0.5, 0.5], [0.5, 1.5, 0.5], [0.5, 0.5, 0.5]])
    assert voxel_numbers(points, 1.0).tolist() == [3, 1, 2, 0]  # z, then y, then x
    assert voxel_numbers(points[::-1], 1.0).tolist() == [0, 2, 1, 3]


def test_no_points_have_no_numbers():
    assert voxel_numbers(np.zeros((0, 3)), 0.1).shape == (0,)


def test_the_mean_of_a_group_is_that_of_its_rows():
    means = group_means(np.array([1, 0, 1]), np.array([[1.0, 4.0], [2.0, 5.0], [3.0, 6.0]]))
    assert means.tolist() == [[2.0, 5.0], [2.0, 5.0]]


def test_fewer_points_than_neighbours_are_filled_up_with_infinity():
    distance, row = neighbors(np.array([[0.0, 0, 0], [1.0, 0, 0]]), 4)
    assert distance.tolist() == [[0, 1, np.inf, np.inf]] * 2
    assert row[:, :2].tolist() == [[0, 1], [1, 0]]


def test_clusters_are_connected_by_steps_shorter_than_the_gap():
    chain = np.column_stack([np.arange(10) * 0.009, np.zeros((10, 2))])
    far = chain + np.array([0.2, 0, 0])
    label = clusters(neighbors(np.concatenate([chain, far]), 4), 0.010)
    assert len(set(label[:10])) == 1
    assert len(set(label[10:])) == 1
    assert label[0] != label[10]
    assert len(set(clusters(neighbors(chain, 4), 0.008))) == 10


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_normal_of_a_plane_is_its_own_and_looks_at_the_eye(seed):
    rng = np.random.default_rng(seed)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.column_stack([rng.uniform(-0.05, 0.05, (200, 2)), np.zeros(200)])
    points = flat @ R.T
    eye = points.mean(axis=0) + 0.3 * R[:, 2]
    normal = surface_normals(points, neighbors(points, 16), 0.1, eye)
    np.testing.assert_allclose(normal, np.tile(R[:, 2], (200, 1)), atol=1e-6)


def test_points_beyond_the_distance_do_not_bend_a_normal():
    x, y = (v.ravel() for v in np.meshgrid(np.arange(5) * 0.001, np.arange(5) * 0.001))
    plane = np.column_stack([x, y, np.zeros(25)])
    wall = np.column_stack([np.full(25, 0.012), y, 0.002 + x])
    points = np.concatenate([plane, wall])
    normal = surface_normals(points, neighbors(points, 40), 0.006, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(normal[:25], np.tile([0, 0, 1], (25, 1)), atol=1e-6)
