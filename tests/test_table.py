"""Finding the table without a camera pose: on boxes that are known, and on recorded views."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tabletop import GREY, HAMMER_SIZED, RED, TABLE, look, pose, recorded

from tog_drake.cameras import D435, L515
from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.errors import InputError
from tog_drake.stations.depth_noise import noisy_depth
from tog_drake.table import find_table

BOTTLE = ((0.48, -0.03, 0.0), (0.54, 0.03, 0.2), RED)


@settings(max_examples=8, deadline=None)
@given(st.floats(0.15, 0.8), st.floats(-0.3, 0.3), st.floats(0.35, 0.9))
def test_the_height_and_the_tilt_of_the_camera_are_found(back, aside, height):
    view = look([TABLE, HAMMER_SIZED], eye=(0.5 - back, aside, height), width=160, height=120)
    table = find_table(view)
    assert table.X_WC[2, 3] == pytest.approx(height, abs=0.002)
    # The camera sees the vertical, z of W, where it is.
    np.testing.assert_allclose(table.X_WC[2, :3], view.X_WC[2, :3], atol=0.005)
    assert table.noise < 0.001


def test_x_is_the_images_right_and_the_origin_is_below_what_is_in_the_middle():
    view = look([TABLE, BOTTLE])
    table = find_table(view)
    assert table.X_WC[0, 0] > 0.99  # x of C in W
    X_look_W = view.X_WC @ np.linalg.inv(table.X_WC)
    origin = X_look_W[:3, 3]
    assert abs(origin[2]) < 0.002
    assert np.linalg.norm(origin[:2] - [0.51, 0.0]) < 0.1


def test_the_workspace_holds_the_things_and_not_what_is_beside_the_table():
    desk = ((0.3, -0.3, -0.05), (0.8, 0.3, 0.0), GREY)
    floor = ((-3.0, -3.0, -0.8), (4.0, 3.0, -0.7), GREY)
    cupboard = ((1.2, -1.0, -0.7), (1.5, 1.0, 0.8), GREY)
    view = look([desk, floor, cupboard, BOTTLE], eye=(0.0, 0.0, 0.5))
    table = find_table(view)
    assert table.X_WC[2, 3] == pytest.approx(0.5, abs=0.003)  # the desk, not the floor
    view = replace(view, X_WC=table.X_WC)
    cloud = scene_cloud([view], table.workspace, CloudConfig())
    assert np.all(cloud.rgbs().T == RED)
    assert cloud.xyzs()[2].max() == pytest.approx(0.2, abs=0.003)


def test_the_floor_may_fill_more_of_the_image_than_the_desk():
    desk = ((0.35, -0.12, -0.05), (0.65, 0.12, 0.0), GREY)
    floor = ((-3.0, -3.0, -0.8), (4.0, 3.0, -0.6), GREY)
    view = look([desk, floor, BOTTLE], eye=(0.1, 0.0, 0.8))
    on_floor = np.mean(view.depth > 1.05)
    assert on_floor > 0.5
    assert find_table(view).X_WC[2, 3] == pytest.approx(0.8, abs=0.003)


def test_noise_is_measured_and_kept_out_of_the_workspace():
    view = look([TABLE, BOTTLE])
    noisy = view.depth + np.random.default_rng(0).normal(0, 0.002, view.depth.shape)
    table = find_table(replace(view, depth=noisy.astype(np.float32)))
    assert 0.001 < table.noise < 0.0025
    assert table.workspace.lower[2] > 2 * table.noise
    assert table.workspace.table_height == 0


@pytest.mark.parametrize("preset", [L515, D435])
def test_a_noisy_camera_finds_the_same_table(preset):
    view = look([TABLE, BOTTLE], width=640, height=480)
    rng = np.random.default_rng(0)
    depth = noisy_depth(view.depth, preset.depth_noise["640x480"], view.intrinsics.fx, rng)
    table, exact = find_table(replace(view, depth=depth)), find_table(view)
    assert table.X_WC[2, 3] == pytest.approx(exact.X_WC[2, 3], abs=0.001)
    assert np.degrees(np.arccos(table.X_WC[2, :3] @ exact.X_WC[2, :3])) < 0.3


def test_the_same_seed_gives_the_same_table():
    view = look([TABLE, BOTTLE])
    np.testing.assert_array_equal(find_table(view, 3).X_WC, find_table(view, 3).X_WC)


def test_without_a_plane_there_is_no_table():
    view = look([TABLE])
    depth = np.random.default_rng(0).uniform(0.3, 2.0, view.depth.shape).astype(np.float32)
    with pytest.raises(InputError, match=r"no table found.*--camera-pose"):
        find_table(replace(view, depth=depth))


def test_a_view_of_holes_has_no_table():
    view = look([TABLE])
    with pytest.raises(InputError, match="no table found: of the 0 pixels"):
        find_table(replace(view, depth=np.zeros_like(view.depth)))


def test_a_camera_held_head_down_needs_to_be_told_where_up_is():
    upright = look([TABLE, HAMMER_SIZED], eye=(0.0, 0.0, 0.25))
    turned = pose(np.array([0.0, 0.0, 0.25]), np.array([0.5, 0.0, 0.0]))
    turned[:3, :2] *= -1
    view = replace(upright, depth=upright.depth[::-1, ::-1], rgb=upright.rgb[::-1, ::-1])
    with pytest.raises(InputError, match="none faces up"):
        find_table(view)
    table = find_table(view, up=turned[2, :3])
    assert table.X_WC[2, 3] == pytest.approx(0.25, abs=0.003)


# Recorded views: height of the camera above the table [m], as read off the depth by hand, and the
# pixel (u, v) and a colour test for things that must be in the cloud.
FRAMES = {
    "red_mug_6dof": (0.30, {"mug": (355, 240), "handle": (262, 240)}),
    "ycb_table_1": (0.61, {"mug": (370, 230), "bottle": (480, 260), "can": (270, 235)}),
    "ycb_table_3": (0.61, {"drill": (450, 185), "block": (210, 300), "pen": (367, 305)}),
    "ycbvideo_4": (0.71, {"pitcher": (330, 200), "mustard": (390, 390), "can": (265, 410)}),
    "graspnet_clutter": (0.46, {"drill": (449, 543), "bottle": (392, 286), "toy": (624, 157)}),
}


@pytest.mark.parametrize("name", FRAMES)
def test_on_recorded_views_the_table_is_gone_and_the_things_are_there(shared_data, name, tmp_path):
    height, things = FRAMES[name]
    view = recorded(shared_data / "rgbd" / name, tmp_path)
    table = find_table(view)
    assert table.X_WC[2, 3] == pytest.approx(height, abs=0.03)
    view = replace(view, X_WC=table.X_WC)
    p_W = scene_cloud([view], table.workspace, CloudConfig()).xyzs().T.astype(float)
    assert np.mean(p_W[:, 2] < 0.012) < 0.25  # the feet of the things, hardly any table
    for thing, pixel in things.items():
        assert distance_to_ray(p_W, view, pixel) < 0.006, thing


def distance_to_ray(p_W, view, pixel):
    """How close [m] the nearest of the points is to the line of sight of a pixel."""
    k = view.intrinsics
    ray = view.X_WC[:3, :3] @ [(pixel[0] - k.cx) / k.fx, (pixel[1] - k.cy) / k.fy, 1]
    offset = p_W - view.X_WC[:3, 3]
    return np.linalg.norm(np.cross(offset, ray / np.linalg.norm(ray)), axis=1).min()
