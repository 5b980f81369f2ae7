"""Views to test on: of boxes, by casting a ray per pixel, and recorded ones."""

import json

import numpy as np

from tog_drake.saved_view import load_view
from tog_drake.values import Intrinsics, View

GREY, RED = (128, 128, 128), (200, 0, 0)
TABLE = ((-1.0, -1.0, -0.5), (2.0, 1.0, 0.0), GREY)  # lower corner, upper corner, colour
HAMMER_SIZED = ((0.40, -0.015, 0.0), (0.60, 0.015, 0.03), RED)


def look(boxes, *, eye=(0.25, 0.0, 0.45), target=(0.5, 0.0, 0.0), width=320, height=240) -> View:
    """Returns what a camera at ``eye`` sees of ``boxes`` (lower, upper, colour); it is upright."""
    camera = Intrinsics(width, height, width, width, width / 2 - 0.5, height / 2 - 0.5)
    X_WC = pose(np.array(eye), np.array(target))
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    ray = ray @ X_WC[:3, :3].T  # one metre deep
    depth = np.full(u.shape, np.inf)
    rgb = np.zeros((*u.shape, 3), np.uint8)
    for lower, upper, color in boxes:
        with np.errstate(divide="ignore"):
            near, far = (lower - X_WC[:3, 3]) / ray, (upper - X_WC[:3, 3]) / ray
        enter = np.minimum(near, far).max(axis=-1)
        leave = np.maximum(near, far).min(axis=-1)
        hit = (enter < leave) & (enter > 0) & (enter < depth)
        depth[hit] = enter[hit]
        rgb[hit] = color
    return View(rgb, np.where(np.isfinite(depth), depth, 0).astype(np.float32), camera, X_WC)


def pose(eye, target):
    """The pose X_WC (4, 4) of an upright camera that looks from ``eye`` at ``target``."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0, 0, 1.0])
    x = x / np.linalg.norm(x)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    X_WC[:3, 3] = eye
    return X_WC


def recorded(folder, tmp_path) -> View:
    """Returns a recorded view of the shared data: colour, depth and intrinsics, no pose."""
    info = json.loads((folder / "info.json").read_text())
    camera = tmp_path / "camera.json"
    size = {"width": info["width"], "height": info["height"]}
    camera.write_text(json.dumps({**info["intrinsics"], **size}))
    return load_view(
        rgb=folder / "color.png",
        depth=folder / "depth.png",
        intrinsics=camera,
        units_per_metre=info["depth_units_per_metre"],
    )
