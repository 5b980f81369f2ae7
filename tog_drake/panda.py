"""The Franka Panda: frames, limits, gripper geometry and forward kinematics.

Frames
------
- L0: the base link; W and L0 coincide unless the scenario mounts the arm elsewhere.
- H: the hand body, 0.107 m beyond the frame of joint 7 and turned by −45° about z.
- G: the grasp frame, between the finger pads::

            ┌───────────────┐          y_G: closing direction (as in the Franka hand)
            │     palm H    │          z_G: approach, from the palm to the object
            └─┬──┬─────┬──┬─┘          x_G: y_G × z_G
              │  │     │  │
              │  │  ●──┼──┼─▶ y_G      origin G at H's z = 0.1034 m, the middle of the pads;
              └──┘  │  └──┘            the fingers end 9.5 mm beyond it.
                    ▼ z_G

Sources: DH table and limits from Franka Robotics' published "Robot and interface specifications"
(FCI documentation, Panda); hand dimensions from its published drawings.
"""

import numpy as np

from tog_drake.values import Array

# Modified (Craig) DH parameters a, d [m], α [rad] of joints 1..7.
DH_A = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])
DH_D = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])
DH_ALPHA = np.array([0.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0]) * np.pi / 2
FLANGE_Z = 0.107  # [m] flange beyond joint 7's frame
HAND_YAW = -np.pi / 4  # [rad] hand about the flange's z
GRASP_Z = 0.1034  # [m] G beyond H along z

# Position, velocity, acceleration and jerk limits of the joints (rad, s).
Q_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
Q_UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
V_MAX = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
A_MAX = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
J_MAX = np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0])

# The hand.
MAX_OPENING = 0.08  # [m] between the pads
PAD_WIDTH = 0.0185  # [m] along x_G
FINGERTIP_Z = 0.0095  # [m] the fingers end here, along z_G
FINGER_THICKNESS = 0.0152  # [m] along y_G, outwards from the pad's face
PALM_Z = -0.0375  # [m] the palm's lower face, along z_G

JOINT_NAMES = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGER_JOINT_NAMES = ("panda_finger_joint1", "panda_finger_joint2")
FINGER_BODIES = ("panda_leftfinger", "panda_rightfinger")

OPENING_MARGIN = 0.04  # [m] the hand arrives open this much wider than the grasp, if it can

X_HG = np.eye(4)
X_HG[2, 3] = GRASP_Z


def arrival_opening(width: Array, *, fully: bool = False) -> Array:
    """Returns how far the hand opens [m] to arrive at grasps of ``width`` (...) [m].

    ``fully`` is for a hand that cannot go to a width without grasping what is there.
    """
    opening: Array = np.minimum(width + (MAX_OPENING if fully else OPENING_MARGIN), MAX_OPENING)
    return opening


def grasps_apart(X_WG: Array, X_WG_other: Array) -> tuple[Array, Array]:
    """Returns how far grasps X_WG (..., 4, 4) are from others, in place [m] and turn [rad], (...).

    Half a turn about z_G changes nothing for a hand with two fingers, so the turn is the smaller
    one of the two ways to hold it.
    """
    place = np.linalg.norm(X_WG[..., :3, 3] - X_WG_other[..., :3, 3], axis=-1)
    # Of R = X_WG[:3, :3].T @ X_WG_other[:3, :3], the diagonal; cos θ = (tr R − 1) / 2.
    x, y, z = np.moveaxis((X_WG[..., :3, :3] * X_WG_other[..., :3, :3]).sum(axis=-2), -1, 0)
    cos = (z + np.abs(x + y) - 1) / 2
    return place, np.arccos(np.clip(cos, -1.0, 1.0))


def gripper_boxes(opening: float) -> tuple[Array, Array]:
    """Returns the axis-aligned boxes that bound the hand, in G.

    Args:
        opening: distance between the pads [m].

    Returns:
        Lower and upper corners, each (4, 3) [m]: finger at −y, finger at +y, palm, and the
        housing above the palm up to the flange.
    """
    half = opening / 2
    top = PALM_Z
    lower = np.array(
        [
            [-0.011, -half - FINGER_THICKNESS, top],
            [-0.011, half, top],
            [-0.032, -0.102, -GRASP_Z],
            [-0.050, -0.050, -GRASP_Z - 0.107],
        ]
    )
    upper = np.array(
        [
            [0.011, -half, FINGERTIP_Z],
            [0.011, half + FINGER_THICKNESS, FINGERTIP_Z],
            [0.032, 0.102, PALM_Z],
            [0.050, 0.050, -GRASP_Z],
        ]
    )
    return lower, upper


def forward_kinematics(q: Array) -> Array:
    """Returns the pose of the hand body H in the arm's base frame L0, from the DH table.

    Args:
        q: (..., 7) joint angles [rad].

    Returns:
        X_L0H, (..., 4, 4).
    """
    X_L0H: Array = link_frames(q)[..., 8, :, :]
    return X_L0H


def link_frames(q: Array) -> Array:
    """Returns the frames of the DH table in the arm's base frame L0.

    Args:
        q: (..., 7) joint angles [rad].

    Returns:
        (..., 9, 4, 4): X_L0L0 (the identity), X_L0L1 ... X_L0L7, X_L0H.
    """
    X = np.zeros((*q.shape[:-1], 9, 4, 4))
    X[..., 3, 3] = 1.0
    X[..., 0, :3, :3] = np.eye(3)
    c, s = np.cos(q)[..., np.newaxis], np.sin(q)[..., np.newaxis]
    # Craig's link transform is RotX(α) TransX(a) RotZ(θ) TransZ(d). The frames' axes x, y, z and
    # origin p, each (..., 3), are turned and moved in that order; this is many times faster
    # than products of stacked 4 × 4 matrices.
    x, y, z, p = np.moveaxis(X[..., 0, :3, :], -1, 0)
    for i in range(7):
        ca, sa = np.cos(DH_ALPHA[i]), np.sin(DH_ALPHA[i])
        y, z = ca * y + sa * z, ca * z - sa * y
        p = p + DH_A[i] * x + DH_D[i] * z
        x, y = c[..., i, :] * x + s[..., i, :] * y, c[..., i, :] * y - s[..., i, :] * x
        X[..., i + 1, :3, :] = np.stack([x, y, z, p], axis=-1)
    cy, sy = np.cos(HAND_YAW), np.sin(HAND_YAW)
    X[..., 8, :3, :] = np.stack([cy * x + sy * y, cy * y - sy * x, z, p + FLANGE_Z * z], axis=-1)
    return X
