"""Where the boxes of the hand are, for many grasps at once: above the table, and what is in them.

Points between the fingers are in no box: they are what is to be grasped.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tog_drake.panda import gripper_boxes
from tog_drake.points import clusters, group_means, neighbors, voxel_numbers
from tog_drake.values import Array, Grasps

_COARSE = 0.005  # [m] resolution at which other things are looked at during a lift
_SPECK = 4  # such points; a smaller cluster is no thing
_HAND_RADIUS = 0.16  # [m] of a ball about a point 0.08 m above the pads that holds all boxes
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


def disturbs_others(
    grasps: Grasps, opening: Array, points: Array, rise: float, clearance: float
) -> NDArray[np.bool_]:
    """Tells which hands would close on or rise into other things than what they hold, (N,).

    Things are the clusters of the points; things that touch count as one.

    Args:
        grasps: N of them.
        opening: (N,) [m] between the pads before they close.
        points: (P, 3) [m] in W, what the camera saw.
        rise: how far the hand is lifted [m].
        clearance: kept between the hand's boxes and the points [m].
    """
    met = np.zeros(len(grasps), dtype=bool)
    if len(points) == 0:
        return met
    points = group_means(voxel_numbers(points, _COARSE), points)
    thing = clusters(neighbors(points, 8), 2 * _COARSE)
    if thing.max() == 0:
        return met
    held = thing[cKDTree(points).query(grasps.p_WContact)[1]]
    closed, opened = hand_boxes(grasps.width), hand_boxes(opening)
    lower, upper = np.minimum(closed[0], opened[0]), np.maximum(closed[1], opened[1])
    middle = grasps.X_WG[:, :2, 3] - 0.08 * grasps.X_WG[:, :2, 2]
    near = ((points[:, :2] - middle[:, None]) ** 2).sum(axis=-1) < _HAND_RADIUS**2
    near &= (thing != held[:, None]) & (np.bincount(thing)[thing] >= _SPECK)
    for i in np.flatnonzero(near.any(axis=1)):
        X, others = grasps.X_WG[i], points[near[i]]
        met[i] = _meets_rising(X, lower[i] - clearance, upper[i] + clearance, rise, others)
    return met


def _meets_rising(X_WG: Array, lower: Array, upper: Array, rise: float, points: Array) -> bool:
    """Whether boxes (B, 3) in G meet one of the points (P, 3) while they rise along z_W.

    A point meets a rising box while it is between the faces of each of its three pairs: the rises
    at which it is are intersected (the slab method for rays and boxes).
    """
    up = X_WG[2, :3]  # in G
    up = np.where(np.abs(up) < 1e-6, 1e-6, up)
    p_G = (points - X_WG[:3, 3]) @ X_WG[:3, :3]
    one, other = (p_G - lower[:, None]) / up, (p_G - upper[:, None]) / up  # (B, P, 3)
    enter, leave = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    return bool(np.any((enter < leave) & (leave > 0) & (enter < rise)))
