"""Several views become one cloud, on views of boxes that are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tabletop import GREY, HAMMER_SIZED, RED, TABLE, look

from tog_drake.cameras import D435, L515
from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.errors import NoGrasp, NoImage
from tog_drake.stations.depth_noise import noisy_depth
from tog_drake.values import Workspace

EYES = [(0.25, 0.0, 0.45), *((0.5 + x, y, 0.4) for x in (-0.15, 0.15) for y in (-0.15, 0.15))]
BOX = ((0.46, -0.03, 0.0), (0.54, 0.03, 0.05), RED)
WALL = ((0.44, -0.002, 0.0), (0.56, 0.002, 0.08), RED)  # 4 mm thick


def looks(boxes, eyes=EYES, width=320, height=240):
    return [look(boxes, eye=eye, width=width, height=height) for eye in eyes]


def fused(views, **config):
    return scene_cloud(views, Workspace(), CloudConfig(**config))


def points(cloud):
    return cloud.xyzs().T.astype(float)


def normals(cloud):
    return cloud.normals().T.astype(float)


def thickness(cloud):
    """Of the surface about each point, those within 6 mm that face the same way: (N,) [m]."""
    p_W, normal = points(cloud), normals(cloud)
    found = []
    for i, row in enumerate(cKDTree(p_W).query_ball_point(p_W, 0.006)):
        near = p_W[[j for j in row if normal[j] @ normal[i] > 0.9]]
        if len(near) >= 6:
            found.append(np.sqrt(max(np.linalg.eigvalsh(np.cov(near.T, bias=True))[0], 0)))
    return np.array(found)


def distance_to_surface(p_W, box):
    lower, upper = np.array(box[0]), np.array(box[1])
    outside = np.linalg.norm(p_W - np.clip(p_W, lower, upper), axis=1)
    inside = np.minimum(p_W - lower, upper - p_W).min(axis=1)
    return np.where(outside > 0, outside, np.abs(inside))


def test_all_sides_are_there_that_some_camera_sees_and_their_normals_point_outwards():
    cloud = fused(looks([TABLE, BOX]))
    p_W, normal = points(cloud), normals(cloud)
    assert distance_to_surface(p_W, BOX).max() < 0.001
    for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, 1)):
        face = BOX[(side + 1) // 2][axis]
        inner = np.abs(p_W[:, axis] - face) < 0.0005
        others = [i for i in range(3) if i != axis]
        inner &= np.all(p_W[:, others] > np.array(BOX[0])[others] + 0.009, axis=1)
        inner &= np.all(p_W[:, others] < np.array(BOX[1])[others] - 0.009, axis=1)
        assert inner.sum() > 20, (axis, side)
        assert (side * normal[inner, axis]).min() > 0.98, (axis, side)


def test_a_view_fused_with_itself_is_the_cloud_of_that_view():
    view = look([TABLE, BOX])
    one, twice = fused([view]), fused([view, view])
    np.testing.assert_allclose(points(twice), points(one), atol=1e-6)
    np.testing.assert_allclose(normals(twice), normals(one), atol=1e-5)
    np.testing.assert_array_equal(twice.rgbs(), one.rgbs())


def test_the_order_of_the_views_does_not_matter():
    views = looks([TABLE, HAMMER_SIZED])
    a, b = fused(views), fused(views[::-1])
    assert a.size() == b.size()
    assert cKDTree(points(a)).query(points(b))[0].max() < 1e-4


def test_both_sides_of_a_thin_wall_stay_two_that_face_away_from_each_other():
    cloud = fused(looks([TABLE, WALL], eyes=[(0.5, -0.3, 0.3), (0.5, 0.3, 0.3)]))
    p_W, normal = points(cloud), normals(cloud)
    middle = (np.abs(p_W[:, 0] - 0.5) < 0.04) & (p_W[:, 2] > 0.015) & (p_W[:, 2] < 0.065)
    for side in (-1, 1):
        mine = middle & (np.abs(p_W[:, 1] - side * 0.002) < 0.0005)
        assert mine.sum() > 100
        assert np.mean(side * normal[mine, 1] > 0.9) > 0.99


@pytest.mark.parametrize("box", [BOX, HAMMER_SIZED, WALL])
def test_of_exact_views_the_fused_surface_is_as_thin_as_that_of_one_view(box):
    views = looks([TABLE, box])
    one, all_of_them = thickness(fused(views[:1])), thickness(fused(views))
    assert np.median(all_of_them) <= np.median(one) + 0.00005
    assert np.percentile(all_of_them, 90) <= np.percentile(one, 90) + 0.0002


@pytest.mark.parametrize("preset", [L515, D435])
@pytest.mark.parametrize("box", [BOX, HAMMER_SIZED])
def test_of_noisy_views_too_and_it_is_where_it_ought_to_be(box, preset):
    rng = np.random.default_rng(0)
    exact = looks([TABLE, box], width=640, height=480)
    noise, focal = preset.depth_noise["640x480"], exact[0].intrinsics.fx
    views = [replace(v, depth=noisy_depth(v.depth, noise, focal, rng)) for v in exact]
    one, all_of_them = fused(views[:1]), fused(views)
    assert np.median(thickness(all_of_them)) <= np.median(thickness(one))
    off = [np.median(distance_to_surface(points(c), box)) for c in (one, all_of_them)]
    assert off[1] <= off[0] + 0.0001
    seen = points(fused(exact))
    assert np.mean(cKDTree(points(all_of_them)).query(seen)[0] < 0.005) > 0.95


def test_views_that_are_off_make_the_surface_thick():
    views = looks([TABLE, HAMMER_SIZED])
    X_WC = views[1].X_WC.copy()
    X_WC[2, 3] += 0.006
    off = [views[0], replace(views[1], X_WC=X_WC), *views[2:]]
    assert np.median(thickness(fused(off))) > 2 * np.median(thickness(fused(views)))


def test_a_thing_that_one_of_the_cameras_does_not_show_is_there():
    beside = ((0.5, 0.15, 0.0), (0.55, 0.20, 0.05), RED)
    views = [look([TABLE, HAMMER_SIZED]), look([TABLE, HAMMER_SIZED, beside])]
    assert points(fused(views))[:, 1].max() > 0.19
    nothing = look([TABLE])
    assert fused([nothing, views[0]]).size() == fused([views[0]]).size()


def test_specks_of_several_views_that_make_up_a_thing_are_none():
    halves = [
        ((0.5, 0, 0.0), (0.506, 0.004, 0.02), RED),
        ((0.5, 0.004, 0), (0.506, 0.008, 0.02), RED),
    ]
    views = [look([TABLE, half]) for half in halves]
    size = max(fused([view], min_cluster_points=1).size() for view in views)
    with pytest.raises(NoGrasp):
        fused(views[:1], min_cluster_points=size + 3)
    assert fused(views, min_cluster_points=size + 3).size() > size


def test_the_robot_is_left_out_of_every_view():
    views = looks([TABLE, HAMMER_SIZED])
    far_end = (np.array([[0.58, 0.0, 0.02]]), np.array([0.05]))
    cloud = scene_cloud(views, Workspace(), CloudConfig(robot_padding=0.01), [far_end] * len(views))
    assert np.linalg.norm(points(cloud) - far_end[0][0], axis=1).min() > 0.058


def test_empty_tables_are_no_grasp_and_a_dead_camera_is_an_input_error():
    empty = look([TABLE])
    with pytest.raises(NoGrasp, match="no object in view: 0 of 153600 pixels"):
        fused([empty, empty])
    dead = replace(empty, depth=np.zeros_like(empty.depth))
    with pytest.raises(NoImage, match="all 76800 pixels of the depth image are holes"):
        fused([look([TABLE, ((0.5, 0, 0), (0.55, 0.05, 0.05), GREY)]), dead])
