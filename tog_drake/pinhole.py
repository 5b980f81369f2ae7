"""Pixels to points and back: the pinhole model of ``Intrinsics``, in plain numpy.

Pixel centres lie at whole numbers, as in Drake: the image of width w covers u from −0.5 to w − 0.5,
and a camera that looks straight ahead has cx = w/2 − 0.5.
"""

import numpy as np
from numpy.typing import NDArray

from tog_drake.values import Array, Intrinsics, View


def unproject(view: View) -> Array:
    """Returns the point in W that each pixel shows.

    Returns:
        (H, W, 3) [m]; NaN where the depth image has a hole.
    """
    camera = view.intrinsics
    depth = np.where(view.depth > 0, view.depth, np.nan).astype(np.float64)
    x = (np.arange(camera.width) - camera.cx) / camera.fx  # (W,)
    y = (np.arange(camera.height) - camera.cy) / camera.fy  # (H,)
    p_W = np.empty((3, camera.height, camera.width))  # a coordinate at a time is fastest
    for i, (R, p) in enumerate(zip(view.X_WC[:3, :3], view.X_WC[:3, 3], strict=True)):
        np.add(R[0] * x, (R[1] * y + R[2])[:, None], out=p_W[i])
        p_W[i] *= depth
        p_W[i] += p
    return np.moveaxis(p_W, 0, -1)


def unproject_pixels(view: View, pixel: NDArray[np.int64]) -> Array:
    """Returns the points in W that the pixels v · width + u show, none a hole: (N, 3) [m]."""
    camera = view.intrinsics
    v, u = np.divmod(pixel, camera.width)
    depth = view.depth.ravel()[pixel].astype(np.float64)
    p_C = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    p_C *= depth
    return np.asarray((view.X_WC[:3, :3] @ p_C).T + view.X_WC[:3, 3])


def project(p_W: Array, intrinsics: Intrinsics, X_WC: Array) -> Array:
    """Returns the pixel (u, v) at which the camera sees each point.

    Args:
        p_W: (N, 3) [m] points in W.
        intrinsics: the camera.
        X_WC: (4, 4) the camera's pose.

    Returns:
        (N, 2) [pixel], also outside the image; NaN for points that are not in front of the camera.
    """
    p_C = (np.asarray(p_W, dtype=np.float64) - X_WC[:3, 3]) @ X_WC[:3, :3]
    z = np.where(p_C[:, 2] > 0, p_C[:, 2], np.nan)
    u = intrinsics.fx * p_C[:, 0] / z + intrinsics.cx
    v = intrinsics.fy * p_C[:, 1] / z + intrinsics.cy
    return np.column_stack([u, v])
