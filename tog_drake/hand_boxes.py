"""Where the boxes of the hand are, for many grasps at once: above the table, and what is in them.

Points between the fingers are in no box: they are what is to be grasped.
"""

import numpy as np
from numpy.typing import NDArray

from tog_drake.panda import gripper_boxes
from tog_drake.values import Array

_CHUNK = 16  # grasps at a time, so that the arrays stay in the cache


def hand_boxes(opening: Array, retreat: float = 0.0) -> tuple[Array, Array]:
    """Returns the boxes that the hand sweeps on its last way to each grasp, in G.

    The hand comes along z_G, so what a box sweeps is a box again.

    Args:
        opening: (N,) [m] between the pads.
        retreat: length of the way [m].

    Returns:
        Lower and upper corners, each (N, 4, 3) [m], in the order of ``gripper_boxes``.
    """
    boxes = np.array([gripper_boxes(float(o)) for o in opening]).reshape(-1, 2, 4, 3)
    lower, upper = boxes[:, 0], boxes[:, 1]
    lower[..., 2] -= retreat
    return lower, upper


def lowest_corner(X_WG: Array, lower: Array, upper: Array) -> Array:
    """Returns the least z in W over all corners of the boxes of each grasp, (N,) [m]."""
    down = X_WG[:, None, 2, :3]
    corner = np.minimum(down * lower, down * upper).sum(axis=-1)
    return np.asarray(corner.min(axis=-1) + X_WG[:, 2, 3])


def points_inside(X_WG: Array, lower: Array, upper: Array, points: Array) -> NDArray[np.int64]:
    """Returns how many points are inside the boxes of each grasp, (N,).

    Args:
        X_WG: (N, 4, 4).
        lower, upper: (N, B, 3) [m] corners of the boxes in G.
        points: (P, 3) [m] in W.
    """
    lower, upper = lower.astype(np.float32), upper.astype(np.float32)
    p_W = np.ascontiguousarray(points.T, dtype=np.float32)
    count = np.zeros(len(X_WG), dtype=np.int64)
    for first in range(0, len(X_WG), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        R_GW = np.swapaxes(X_WG[chunk, :3, :3], -1, -2)
        p_G0 = R_GW @ X_WG[chunk, :3, 3:]
        p_G = R_GW.astype(np.float32) @ p_W - p_G0.astype(np.float32)  # (n, 3, P)
        inside = np.zeros((len(p_G), p_W.shape[1]), dtype=bool)
        for box in range(lower.shape[1]):
            within = np.ones_like(inside)
            for axis in range(3):
                within &= p_G[:, axis] > lower[chunk, box, axis, None]
                within &= p_G[:, axis] < upper[chunk, box, axis, None]
            inside |= within
        count[chunk] = inside.sum(axis=1)
    return count


def points_swept(
    X_WG: Array, lower: Array, upper: Array, rise: float, points: Array
) -> NDArray[np.bool_]:
    """Tells which points the boxes of each grasp meet when they are lifted, (N, P).

    A point meets a rising box while it is between the two faces of each of its three pairs: the
    rises at which it is are intersected (the slab method for rays and boxes).

    Args:
        X_WG: (N, 4, 4).
        lower, upper: (N, B, 3) [m] corners of the boxes in G.
        rise: how far along z_W [m].
        points: (P, 3) [m] in W.
    """
    met = np.zeros((len(X_WG), len(points)), dtype=bool)
    for i, X in enumerate(X_WG):
        up = X[2, :3]  # of W, in G
        up = np.where(np.abs(up) < 1e-6, 1e-6, up)
        p_G = (points - X[:3, 3]) @ X[:3, :3]
        one, other = (p_G - lower[i][:, None]) / up, (p_G - upper[i][:, None]) / up  # (B, P, 3)
        enter = np.minimum(one, other).max(axis=-1)
        leave = np.maximum(one, other).min(axis=-1)
        met[i] = np.any((enter < leave) & (leave > 0) & (enter < rise), axis=0)
    return met
