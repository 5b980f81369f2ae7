"""Takes the noise out of a depth image, as much as there is of it, and leaves edges alone.

All of it happens in inverse depth, in which a plane is linear in the pixel, whatever its slant: an
average over neighbours on both sides does not bend it.
"""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

_EXACT = 1e-5  # [1/m] less noise than this is rounding
_MAX_INVERSE = 10.0  # [1/m] nearer than 0.1 m no depth camera sees


def inverse_depth_noise(depth: Image) -> float:
    """Returns the standard deviation of 1/depth, as neighbouring pixels on a plane show it.

    What neighbours have in common, as the errors of stereo cameras have, it does not see: no
    average over neighbours would remove it.

    Args:
        depth: (H, W) [m], 0 where there is none.

    Returns:
        [1/m]; times depth² it is the standard deviation of the depth [m]. 0 without any plane.
    """
    q = _inverse(depth[::4])
    lag = max(1, depth.shape[1] // 320)  # a finer image has the same noise on more pixels
    before, here, after = q[:, : -2 * lag : 4], q[:, lag:-lag:4], q[:, 2 * lag :: 4]
    seen = (before > 0) & (here > 0) & (after > 0)
    if not seen.any():
        return 0.0
    bend = (before - 2 * here + after)[seen]
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6))


def denoised(depth: Image, noise: float) -> Image:
    """Returns the depth averaged over about 11×11 pixels of the same surface.

    Two bilateral filters, the second with gaps between its pixels ("à trous"), which makes it wide
    at little cost. What differs by more than some standard deviations is another surface.

    Args:
        depth: (H, W) [m], 0 where there is none, and stays so.
        noise: what ``inverse_depth_noise`` says; an exact image comes back as it is.
    """
    import cv2

    if noise < _EXACT:
        return depth
    q = np.asarray(cv2.bilateralFilter(_inverse(depth), 5, 4 * noise, 2.0), np.float32)
    for row in (0, 1):
        for column in (0, 1):
            part = np.ascontiguousarray(q[row::2, column::2])
            q[row::2, column::2] = cv2.bilateralFilter(part, 5, 2 * noise, 2.0)
    with np.errstate(divide="ignore"):
        return np.where(depth > 0, 1 / q, np.float32(0)).astype(np.float32)


def _inverse(depth: Image) -> Image:
    """1/depth, 0 for holes and for what is too near to be true."""
    with np.errstate(divide="ignore"):
        q = np.float32(1) / depth
    q[q > _MAX_INVERSE] = 0
    return q
