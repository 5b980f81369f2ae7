"""A simulated camera on a simulated hand looks at a ChArUco board: images and true poses."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tog_drake.hardware.calibration import Board
from tog_drake.panda import forward_kinematics
from tog_drake.pinhole import project
from tog_drake.scenario import LOOK_POSTURE
from tog_drake.values import Intrinsics

CAMERA = Intrinsics(640, 480, 609.4, 609.4, 319.0, 239.0)
BOARD = Board()
_FINE = 3  # pixels of the rendering in one of the image: edges are as a lens makes them
_DOT = 0.0005  # [m] of a pixel of the printed board


def pose(rpy, p):
    X = np.eye(4)
    X[:3, :3] = Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
    X[:3, 3] = p
    return X


MOUNT = pose([2.0, -1.5, 91.0], [0.066, 0.004, 0.033])  # X_HC, as no drawing has it
BOARD_POSE = pose([180, 0, -90], [0.62, 0.14, 0.0])  # X_L0T: flat on the table, z down


def postures(n, seed=0, spread=0.4, joints=range(7), around=LOOK_POSTURE):
    """(n, 7) [rad] around a posture, from which all of the board is seen."""
    rng = np.random.default_rng(seed)
    size = np.array([BOARD.columns, BOARD.rows]) * BOARD.square
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    p_W = np.column_stack([corners, np.zeros(4)]) @ BOARD_POSE[:3, :3].T + BOARD_POSE[:3, 3]
    found = []
    moving = list(joints)
    for _ in range(10_000):
        q = np.array(around)
        q[moving] += rng.uniform(-spread, spread, len(moving))
        pixel = project(p_W, CAMERA, forward_kinematics(q) @ MOUNT)
        inside = (pixel > 8) & (pixel < [CAMERA.width - 8, CAMERA.height - 8])
        if inside.all():
            found.append(q)
        if len(found) == n:
            return np.array(found)
    raise AssertionError("the board is not seen from there")


def image(q, noise=2.0, seed=0):
    """(480, 640, 3): what the camera sees, the board on a grey table."""
    dots = round(BOARD.square / _DOT)
    print_ = BOARD.made().generateImage((BOARD.columns * dots, BOARD.rows * dots))
    X_CT = np.linalg.inv(forward_kinematics(q) @ MOUNT) @ BOARD_POSE
    f = _FINE
    K = np.array(
        [
            [f * CAMERA.fx, 0, f * CAMERA.cx + (f - 1) / 2],
            [0, f * CAMERA.fy, f * CAMERA.cy + (f - 1) / 2],
            [0, 0, 1],
        ]
    )
    to_metres = np.array([[_DOT, 0, _DOT / 2], [0, _DOT, _DOT / 2], [0, 0, 1]])
    H = K @ X_CT[:3, [0, 1, 3]] @ to_metres
    size = (f * CAMERA.width, f * CAMERA.height)
    fine = cv2.warpPerspective(print_, H, size, flags=cv2.INTER_AREA, borderValue=128)
    gray = cv2.resize(fine, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    rng = np.random.default_rng(seed)
    noisy = gray[..., None] + rng.normal(0, noise, (*gray.shape, 3))
    return np.clip(noisy, 0, 255).astype(np.uint8)
