"""The boxes of the hand: how low they reach and what is inside them."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tog_drake.hand_boxes import disturbs_others, hand_boxes, lowest_corner, points_inside
from tog_drake.panda import FINGERTIP_Z, gripper_boxes
from tog_drake.values import Grasps


def straight_down(p):
    X_WG = np.diag([1.0, -1.0, -1.0, 1.0])
    X_WG[:3, 3] = p
    return X_WG[None]


def random_grasps(count, seed):
    rng = np.random.default_rng(seed)
    X_WG = np.tile(np.eye(4), (count, 1, 1))
    X_WG[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    X_WG[:, :3, 3] = rng.uniform(-0.2, 0.2, (count, 3))
    return X_WG, rng


def test_a_hand_pointing_down_reaches_as_low_as_its_fingertips():
    boxes = hand_boxes(np.array([0.08]))
    z = lowest_corner(straight_down([0.5, 0.0, 0.1]), *boxes)
    np.testing.assert_allclose(z, 0.1 - FINGERTIP_Z)


def test_a_hand_pointing_up_reaches_lower_when_it_starts_farther_away():
    X_WG = np.eye(4)[None]
    near, far = (lowest_corner(X_WG, *hand_boxes(np.array([0.08]), d)) for d in (0.0, 0.1))
    np.testing.assert_allclose(near - far, 0.1)


def test_points_between_the_fingers_are_in_no_box_and_those_in_a_finger_are():
    X_WG, boxes = straight_down([0.5, 0.0, 0.1]), hand_boxes(np.array([0.06]), 0.1)
    between = np.array([[0.5, 0.025, 0.1], [0.5, -0.025, 0.095]])
    in_finger = np.array([[0.5, 0.035, 0.1], [0.5, -0.035, 0.1]])
    in_sweep = np.array([[0.5, 0.035, 0.1 + 0.13]])
    assert points_inside(X_WG, *boxes, between).tolist() == [0]
    assert points_inside(X_WG, *boxes, np.vstack([between, in_finger, in_sweep])).tolist() == [3]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), opening=st.floats(0.0, 0.08), retreat=st.floats(0.0, 0.2))
def test_sampled_points_of_the_moving_hand_are_inside_and_above_the_lowest_corner(
    seed, opening, retreat
):
    X_WG, rng = random_grasps(20, seed)
    lower, upper = hand_boxes(np.full(20, opening), retreat)
    box_lower, box_upper = gripper_boxes(opening)
    inner = rng.uniform(0.01, 0.99, (20, 4, 3))
    p_G = box_lower + inner * (box_upper - box_lower)
    p_G[..., 2] -= retreat * rng.uniform(0, 1, (20, 1))
    p_W = np.einsum("nij,nbj->nbi", X_WG[:, :3, :3], p_G) + X_WG[:, None, :3, 3]
    for i in range(20):
        assert points_inside(X_WG[i : i + 1], lower[i : i + 1], upper[i : i + 1], p_W[i]) == [4]
    assert np.all(p_W[..., 2].min(axis=1) >= lowest_corner(X_WG, lower, upper))


def test_one_grasp_does_not_depend_on_the_others():
    X_WG, rng = random_grasps(50, seed=3)
    points = rng.uniform(-0.3, 0.3, (2000, 3))
    lower, upper = hand_boxes(np.full(50, 0.08), 0.1)
    together = points_inside(X_WG, lower, upper, points)
    alone = [points_inside(X_WG[i : i + 1], lower[:1], upper[:1], points)[0] for i in range(50)]
    assert together.tolist() == alone
    assert together.max() > 0
    assert points_inside(X_WG, lower, upper, np.zeros((0, 3))).tolist() == [0] * 50


def block(lower, upper, step=0.004):
    axes = [np.arange(a, b, step) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


OPENING = np.array([0.08])  # [m]


def test_a_hand_that_leans_is_lifted_into_what_overhangs_it_unless_it_holds_that():
    lean = np.radians(60)
    c, s = np.cos(lean), np.sin(lean)
    X_WG = np.eye(4)
    X_WG[:3, :3] = np.column_stack([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.diag([1, -1, -1])
    X_WG[:3, 3] = [0.5, 0.0, 0.05]
    held = block([0.49, -0.014, 0.0], [0.51, 0.014, 0.3])  # a post, higher than the hand
    x, y, z = X_WG[:3, 3] - 0.1 * X_WG[:3, 2]  # in the palm
    beam = block([x - 0.02, y - 0.05, z + 0.13], [x + 0.02, y + 0.05, z + 0.14])
    far = beam + np.array([0.0, 0.3, 0.0])
    grasp = Grasps(X_WG[None], np.array([0.028]), np.ones(1), X_WG[None, :3, 3])
    for others, rise, expected in ((beam, 0.2, True), (beam, 0.02, False), (far, 0.2, False)):
        points = np.vstack([held, others])
        assert disturbs_others(grasp, OPENING, points, rise, 0.002)[0] == expected
    assert not disturbs_others(grasp, OPENING, held, 0.2, 0.002)[0]


def test_fingers_that_would_close_on_a_neighbour_disturb_it():
    X_WG = straight_down([0.5, 0.0, 0.02])
    held = block([0.45, -0.02, 0.0], [0.55, 0.02, 0.03])
    grasp = Grasps(X_WG, np.array([0.04]), np.ones(1), X_WG[:, :3, 3] + [0.0, 0.02, 0.0])
    # A rim between the finger's open and its closed place, and one outside.
    for y, expected in ((0.036, True), (0.062, False)):
        rim = block([0.49, y, 0.02], [0.56, y + 0.003, 0.024])
        assert disturbs_others(grasp, OPENING, np.vstack([held, rim]), 0.1, 0.002)[0] == expected
