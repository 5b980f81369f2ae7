"""Clouds of simple things on a table at z = 0, and grasps on them, made without a renderer."""

import numpy as np
from pydrake.perception import BaseField, Fields, PointCloud

from tog_drake.values import Candidates, Grasps, Intrinsics, View

STEP = 0.003  # [m] between points
RED, BLUE, YELLOW, STEEL, WHITE = (
    (190, 25, 30),
    (30, 60, 190),
    (220, 180, 20),
    (120, 122, 125),
    (235, 235, 235),
)


def box(lower, upper):
    """Points (N, 3) on the top and the sides of a box."""
    axes = [np.arange(a, b + STEP / 2, STEP) for a, b in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = np.min(grid, axis=0), np.max(grid, axis=0)
    side = np.any((grid[:, :2] == low[:2]) | (grid[:, :2] == high[:2]), axis=1)
    return grid[side | (grid[:, 2] == high[2])]


def tube(radius, lower, upper, centre=(0.0, 0.0), *, top=False):
    """Points on an upright tube, with a lid where ``top``."""
    angle = np.arange(0, 2 * np.pi, STEP / radius)
    height = np.arange(lower, upper + STEP / 2, STEP)
    a, z = (x.ravel() for x in np.meshgrid(angle, height))
    wall = np.column_stack([radius * np.cos(a), radius * np.sin(a), z])
    if top:
        x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-radius, radius, STEP)] * 2))
        inside = np.hypot(x, y) < radius
        lid = np.column_stack([x, y, np.full_like(x, height[-1])])[inside]
        wall = np.vstack([wall, lid])
    return moved(wall, centre)


def hammer():
    """A T: a handle 22 × 2.4 cm along x, a head 3 × 10 cm at its end; returns points, is_head."""
    handle = box((-0.12, -0.012, 0.004), (0.10, 0.012, 0.024))
    head = box((0.10, -0.05, 0.004), (0.13, 0.05, 0.028))
    return np.vstack([handle, head]), np.repeat([False, True], [len(handle), len(head)])


def screwdriver():
    """A handle 10 × 3.2 cm along x and a shaft 10 × 0.8 cm; returns points, is_shaft."""
    handle = box((-0.10, -0.016, 0.004), (0.0, 0.016, 0.034))
    shaft = box((0.0, -0.004, 0.014), (0.10, 0.004, 0.022))
    return np.vstack([handle, shaft]), np.repeat([False, True], [len(handle), len(shaft)])


def mug(centre=(0.0, 0.0)):
    """A tube of 8 cm and a loop at +x; returns points, is_handle."""
    body = tube(0.04, 0.004, 0.09)
    angle = np.arange(-1.4, 1.4, 0.1)
    loop = [
        [0.035 + 0.03 * np.cos(a), y, 0.047 + 0.028 * np.sin(a)]
        for a in angle
        for y in np.arange(-0.006, 0.0061, STEP)
    ]
    points = moved(np.vstack([body, loop]), centre)
    return points, np.repeat([False, True], [len(body), len(loop)])


def bottle(centre=(0.0, 0.0)):
    """A tube of 7 cm, 15 cm high, with a cap of 3 cm on it; returns points, is_cap."""
    body, cap = tube(0.035, 0.004, 0.15, top=True), tube(0.014, 0.153, 0.185, top=True)
    points = moved(np.vstack([body, cap]), centre)
    return points, np.repeat([False, True], [len(body), len(cap)])


def moved(points, offset):
    return points + np.array([*offset, 0.0])


def turned(points, yaw, offset=(0.0, 0.0)):
    c, s = np.cos(yaw), np.sin(yaw)
    return moved(points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]), offset)


def cloud(*things):
    """A Drake cloud of (points, colour) pairs; a colour is one for all or one per point.

    Normals point away from the axis of each thing: enough for what reads them.
    """
    points = np.vstack([p for p, _ in things])
    rgb = np.vstack([np.broadcast_to(np.asarray(c, np.uint8), p.shape) for p, c in things])
    away = np.vstack([p - [*p[:, :2].mean(axis=0), p[:, 2].min() - 0.05] for p, _ in things])
    made = PointCloud(len(points), Fields(BaseField.kXYZs | BaseField.kNormals | BaseField.kRGBs))
    made.mutable_xyzs()[:] = points.T
    made.mutable_normals()[:] = (away / np.linalg.norm(away, axis=1, keepdims=True)).T
    made.mutable_rgbs()[:] = rgb.T
    return made


def candidates(points, *, every=40, score=None):
    """A grasp from above at every so many of the points, closing along y; all are candidates."""
    p = points[::every]
    count = len(p)
    X_WG = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (count, 1, 1))
    X_WG[:, :3, 3] = p
    score = np.linspace(0.9, 0.5, count) if score is None else score
    grasps = Grasps(X_WG, np.full(count, 0.02), np.asarray(score, dtype=float), p)
    return Candidates(grasps, np.arange(count), np.arange(count))


def view(height=0.8):
    """From straight above the origin; its picture is brown all over, so it tells no lamp."""
    X_WC = np.diag([1.0, -1.0, -1.0, 1.0])
    X_WC[2, 3] = height
    rgb = np.full((48, 64, 3), (150, 110, 80), np.uint8)
    depth = np.full((48, 64), height, np.float32)
    return View(rgb, depth, Intrinsics(64, 48, 60, 60, 31.5, 23.5), X_WC)
