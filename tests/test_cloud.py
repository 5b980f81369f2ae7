"""What of a view becomes the cloud, on views of boxes that are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from scipy.spatial import cKDTree
from tabletop import GREY, HAMMER_SIZED, RED, TABLE, look

from tog_drake.cameras import D435, L515
from tog_drake.cloud import CloudConfig, SceneCloud, scene_cloud
from tog_drake.errors import NoGrasp, NoImage
from tog_drake.stations.depth_noise import noisy_depth
from tog_drake.values import CameraView, Workspace


def points(cloud):
    return cloud.xyzs().T.astype(float)


@pytest.fixture(scope="module")
def view():
    return look([TABLE, HAMMER_SIZED])


def test_only_the_box_is_left_with_its_shape_and_colour(view):
    cloud = scene_cloud([view], Workspace(), CloudConfig())
    p_W = points(cloud)
    lower, upper, color = HAMMER_SIZED
    assert np.all(p_W > np.array(lower) - 0.001)
    assert np.all(p_W < np.array(upper) + 0.001)
    np.testing.assert_allclose(p_W.max(axis=0)[1:], upper[1:], atol=0.003)
    assert p_W[:, 2].min() > CloudConfig().table_clearance
    assert np.all(np.array(color) == cloud.rgbs().T)


def test_there_is_one_point_per_voxel(view):
    config = CloudConfig(voxel=0.0053)  # no face of the box between two voxels, where to round
    cell = np.floor(points(scene_cloud([view], Workspace(), config)) / config.voxel)
    assert len(np.unique(cell, axis=0)) == len(cell)


def test_normals_are_unit_and_face_the_camera_and_are_up_on_top(view):
    cloud = scene_cloud([view], Workspace(), CloudConfig())
    p_W, normal = points(cloud), cloud.normals().T.astype(float)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert np.all(np.einsum("ni,ni->n", normal, view.X_WC[:3, 3] - p_W) > 0)
    inner = (p_W[:, 2] > 0.0295) & (p_W[:, 0] > 0.42) & (np.abs(p_W[:, 1]) < 0.005)
    assert inner.sum() > 30
    np.testing.assert_allclose(normal[inner], np.tile([0, 0, 1], (inner.sum(), 1)), atol=0.02)


def test_the_crop_is_the_workspace():
    beside = ((0.5, 0.1, 0.0), (0.55, 0.15, 0.05), RED)
    view = look([TABLE, HAMMER_SIZED, beside])
    cropped = Workspace(lower=[0.25, 0.05, -0.05], upper=[0.8, 0.4, 0.4])
    p_W = points(scene_cloud([view], cropped, CloudConfig()))
    assert p_W[:, 1].min() > 0.05
    both = points(scene_cloud([view], Workspace(), CloudConfig()))
    assert both[:, 1].min() < 0.0


def test_the_table_is_where_the_workspace_says(view):
    raised = Workspace(table_height=0.02)
    p_W = points(scene_cloud([view], raised, CloudConfig()))
    assert p_W[:, 2].min() > 0.024


def test_the_robots_own_points_are_left_out(view):
    far_end = (np.array([[0.58, 0.0, 0.02]]), np.array([0.05]))
    config = CloudConfig(robot_padding=0.01)
    p_W = points(scene_cloud([view], Workspace(), config, robots=[far_end]))
    distance = np.linalg.norm(p_W - far_end[0][0], axis=1)
    assert distance.min() >= 0.06
    assert distance.min() < 0.07


def test_a_speck_is_dropped_and_so_is_a_bump_of_the_table():
    speck = ((0.5, 0.10, 0.03), (0.503, 0.103, 0.033), RED)
    bump = ((0.45, -0.15, 0.0), (0.49, -0.10, 0.006), GREY)
    with_both = scene_cloud([look([TABLE, HAMMER_SIZED, speck, bump])], Workspace(), CloudConfig())
    assert np.all(np.abs(points(with_both)[:, 1]) < 0.02)


def test_pixels_that_fly_between_a_box_and_the_table_are_dropped():
    view = look([TABLE, ((0.45, -0.05, 0.0), (0.55, 0.05, 0.15), RED)])
    clean = points(scene_cloud([view], Workspace(), CloudConfig()))
    blurred = view.depth.copy()
    blurred[:, 1:-1] = (view.depth[:, :-2] + view.depth[:, 1:-1] + view.depth[:, 2:]) / 3
    view = replace(view, depth=blurred)
    kept = points(scene_cloud([view], Workspace(), CloudConfig()))
    unfiltered = points(scene_cloud([view], Workspace(), CloudConfig(max_slope=1e9)))
    outside = [np.sum(np.abs(p[:, 1]) > 0.055) for p in (clean, kept, unfiltered)]
    assert outside[0] == 0
    assert outside[1] < 0.2 * outside[2]


def test_points_come_in_an_order_that_the_image_does_not_decide(view):
    mirrored_twice = replace(view, depth=view.depth.copy(), rgb=view.rgb.copy())
    a, b = (scene_cloud([v], Workspace(), CloudConfig()) for v in (view, mirrored_twice))
    np.testing.assert_array_equal(a.xyzs(), b.xyzs())
    height = np.floor(points(a)[:, 2] / CloudConfig().voxel)
    assert np.all(np.diff(height) >= 0)


def test_all_holes_are_an_input_error(view):
    with pytest.raises(NoImage, match="all 76800 pixels of the depth image are holes"):
        scene_cloud([replace(view, depth=np.zeros_like(view.depth))], Workspace(), CloudConfig())


def test_an_empty_table_is_no_grasp_and_the_message_counts():
    with pytest.raises(NoGrasp, match="no object in view: 0 of 76800 pixels"):
        scene_cloud([look([TABLE])], Workspace(), CloudConfig())


def test_a_view_of_the_robot_alone_is_no_grasp(view):
    everything = (np.array([[0.5, 0.0, 0.0]]), np.array([1.0]))
    with pytest.raises(NoGrasp, match="without the robot they are 0 points"):
        scene_cloud([view], Workspace(), CloudConfig(), robots=[everything])


def test_the_stage_places_the_robot_by_the_measured_position(view):
    asked = []

    def spheres(q):
        asked.append(q.copy())
        return np.array([[0.58, 0.0, 0.02]]), np.array([0.05])

    stage = SceneCloud(CloudConfig(), Workspace(), robot_spheres=spheres)
    context = stage.CreateDefaultContext()
    stage.GetInputPort("view").FixValue(context, Value(view))
    stage.GetInputPort("panda.position_measured").FixValue(context, np.arange(7.0))
    cloud = stage.GetOutputPort("cloud").Eval(context)
    assert asked[0].tolist() == list(range(7))
    assert cloud.size() < scene_cloud([view], Workspace(), CloudConfig()).size()
    context.SetTime(3.0)
    stage.GetOutputPort("cloud").Eval(context)
    assert len(asked) == 1


def test_of_an_earlier_view_the_robot_is_cut_where_it_was_then(view):
    def spheres(q):
        return np.array([[q[0], 0.0, 0.02]]), np.array([0.05])

    stage = SceneCloud(CloudConfig(fuse=True), Workspace(), robot_spheres=spheres)
    context = stage.CreateDefaultContext()
    now, then = np.zeros(7), np.full(7, 0.58)
    views = (CameraView("wrist", view), CameraView("wrist#1", view, then))
    stage.GetInputPort("views").FixValue(context, Value(views))
    stage.GetInputPort("panda.position_measured").FixValue(context, now)
    both = points(stage.GetOutputPort("cloud").Eval(context))
    stage.GetInputPort("views").FixValue(context, Value(views[1:]))
    earlier = points(stage.GetOutputPort("cloud").Eval(context))
    at_end = np.array([[0.58, 0.0, 0.02]])
    assert np.linalg.norm(both - at_end, axis=1).min() < 0.02
    assert np.linalg.norm(earlier - at_end, axis=1).min() > 0.05


def test_without_a_robot_the_stage_has_one_input(view):
    stage = SceneCloud(CloudConfig(), Workspace())
    assert stage.num_input_ports() == 1
    context = stage.CreateDefaultContext()
    stage.GetInputPort("view").FixValue(context, Value(view))
    assert stage.GetOutputPort("cloud").Eval(context).size() > 300


def measured(view, preset, seed=0):
    """The same view through a noisy camera."""
    noise, focal = preset.depth_noise["640x480"], view.intrinsics.fx
    depth = noisy_depth(view.depth, noise, focal, np.random.default_rng(seed))
    return replace(view, depth=depth)


def distance_to_box(p_W, box):
    lower, upper = np.array(box[0]), np.array(box[1])
    return np.linalg.norm(p_W - np.clip(p_W, lower, upper), axis=1)


@pytest.mark.parametrize("preset", [L515, D435])
def test_through_a_noisy_camera_the_box_is_there_and_hardly_anything_else(preset):
    view = look([TABLE, HAMMER_SIZED], width=640, height=480)
    exact = points(scene_cloud([view], Workspace(), CloudConfig()))
    cloud = scene_cloud([measured(view, preset)], Workspace(), CloudConfig())
    p_W = points(cloud)
    assert np.mean(distance_to_box(p_W, HAMMER_SIZED) > 0.005) < 0.01
    assert np.mean(cKDTree(p_W).query(exact)[0] < 0.005) > 0.9
    top = (p_W[:, 2] > 0.025) & (p_W[:, 0] > 0.42) & (p_W[:, 0] < 0.58) & (abs(p_W[:, 1]) < 0.008)
    assert np.median(cloud.normals()[2, top]) > 0.97


@pytest.mark.parametrize("preset", [L515, D435])
def test_a_spatula_stands_out_of_a_noisy_table(preset):
    flat = ((0.42, -0.03, 0.0), (0.54, 0.03, 0.008), RED)
    view = look([TABLE, flat], width=640, height=480)
    p_W = points(scene_cloud([measured(view, preset)], Workspace(), CloudConfig()))
    assert np.mean(distance_to_box(p_W, flat) > 0.005) < 0.03
    np.testing.assert_allclose(np.ptp(p_W[:, :2], axis=0), [0.12, 0.06], atol=0.012)


def test_what_counts_as_table_grows_with_the_noise_of_the_table():
    view = look([TABLE, HAMMER_SIZED], width=640, height=480)
    rng = np.random.default_rng(0)
    coarse = np.kron(rng.normal(0, 0.004, (60, 80)), np.ones((8, 8)))  # no filter averages it out
    noisy = replace(view, depth=(view.depth + coarse).astype(np.float32))
    lowest = [
        points(scene_cloud([v], Workspace(), CloudConfig()))[:, 2].min() for v in (view, noisy)
    ]
    assert lowest[0] < 0.006
    assert 0.007 < lowest[1] < 0.015


def test_an_empty_table_is_no_grasp_through_a_noisy_camera_too():
    empty = look([TABLE], width=640, height=480)
    for preset in (L515, D435):
        for seed in range(3):
            with pytest.raises(NoGrasp, match="no object in view"):
                scene_cloud([measured(empty, preset, seed)], Workspace(), CloudConfig())
