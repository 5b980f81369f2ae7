"""What a real depth camera makes of exact depth: noise, flying pixels, holes, steps.

A model of what is seen, not of how the sensors work: errors that grow with range and are alike in
neighbouring pixels; at depth edges a ragged outline, values between fore- and background, and
holes; no depth where a surface is seen at a grazing angle, and for a stereo camera none beside a
near thing, where only one of its two imagers looks. Displacing edges and disturbing disparity are
as in Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM" (2014).
Materials are not modelled: glass, mirrors and black rubber are seen like paper.
"""

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import ImageDepth32F
from scipy.special import ndtr

from tog_drake.cameras import DepthNoise

Image = NDArray[np.float32]
Pixels = NDArray[np.int64]

_EDGE_SLOPE = 4.0  # depth change per width: what is steeper than 76° is the edge of something


class DepthSensor(LeafSystem):
    """Makes an exact depth image into what a camera would have measured.

    .. pydrake_system::

        name: DepthSensor
        input_ports:
        - exact_depth_image
        output_ports:
        - depth_image

    The same scenario gives the same image at the same time, whatever else runs; a later image has
    other noise.

    Args:
        noise: what to add.
        focal: [pixel] focal length.
        seed: of the scenario.
        camera: its name, so that two cameras differ.
    """

    def __init__(self, noise: DepthNoise, *, focal: float, seed: int, camera: str):
        super().__init__()
        self._noise = noise
        self._focal = focal
        self._seed = [seed, *camera.encode()]
        self._exact = self.DeclareAbstractInputPort("exact_depth_image", Value(ImageDepth32F()))
        self.DeclareAbstractOutputPort(
            "depth_image",
            alloc=lambda: Value(ImageDepth32F()),
            calc=self._CalcDepth,
            prerequisites_of_calc={self._exact.ticket(), self.time_ticket()},
        )

    def _CalcDepth(self, context: Context, output: Value) -> None:
        exact = self._exact.Eval(context).data[..., 0]
        rng = np.random.default_rng([*self._seed, round(context.get_time() * 1e9)])
        image = ImageDepth32F(exact.shape[1], exact.shape[0])
        image.mutable_data[..., 0] = noisy_depth(exact, self._noise, self._focal, rng)
        output.set_value(image)


def noisy_depth(exact: Image, noise: DepthNoise, focal: float, rng: np.random.Generator) -> Image:
    """Returns what the camera measures.

    Args:
        exact: (H, W) [m]; 0 and inf are no depth, and stay as they are.
        noise: see ``DepthNoise``.
        focal: [pixel] focal length, of an image whose principal point is its middle.
        rng: draws the noise.

    Returns:
        (H, W) [m], 0 where a hole was made.
    """
    valid = np.isfinite(exact) & (exact > 0)
    depth = np.ascontiguousarray(np.where(valid, exact, 0), np.float32)
    blur = noise.correlation * focal
    near, far = _neighborhood(depth, 1)
    spread = np.where(valid, far - near, np.float32(0))
    luck = _smooth_normal(depth.shape, max(blur, 3.0), rng)  # lost pixels lie together
    hole = _grazing(depth, spread, noise.incidence, focal, luck)
    # The pixels of a 3×3 neighbourhood are two apart at most.
    edge = spread > depth * np.float32(2 * _EDGE_SLOPE / focal)
    if edge.any():
        hole = np.append(hole, _blur_edges(depth, edge, noise, focal, luck, rng))
    if noise.baseline > 0:
        hole = np.append(hole, _shadow(depth, noise.baseline * focal))
    s0, s1, s2 = (np.float32(s) for s in noise.sigma)
    error = _smooth_normal(depth.shape, blur, rng)
    error *= s0 + depth * (s1 + depth * s2)
    depth += error
    depth *= np.float32(1 / noise.quantum)
    np.rint(depth, out=depth)
    depth *= np.float32(noise.quantum)
    depth.ravel()[hole] = 0
    return np.where(valid, np.maximum(depth, 0), exact)


def _neighborhood(depth: Image, radius: int) -> tuple[Image, Image]:
    """The least and the largest depth within ``radius`` pixels of each; holes do not count."""
    import cv2

    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    near = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), window)
    return np.asarray(near, np.float32), np.asarray(cv2.dilate(depth, window), np.float32)


def _blur_edges(
    depth: Image,
    edge: NDArray[np.bool_],
    noise: DepthNoise,
    focal: float,
    luck: Image,
    rng: np.random.Generator,
) -> Pixels:
    """Displaces and mixes the depth beside edges in place; returns the pixels that got lost."""
    import cv2

    reach = max(1, round(noise.edge_width * focal))
    window = np.ones((2 * reach - 1, 2 * reach - 1), np.uint8)
    beside = cv2.dilate(edge.astype(np.uint8), window) > 0
    pixel = np.flatnonzero(beside & (depth > 0))
    near, far = (image.ravel()[pixel] for image in _neighborhood(depth, reach))
    if noise.raggedness > 0:
        height, width = depth.shape
        row, column = np.divmod(pixel, width)
        for index, size in ((row, height), (column, width)):
            field = _smooth_normal(depth.shape, noise.correlation * focal, rng).ravel()[pixel]
            index += np.rint(field * noise.raggedness * focal).astype(np.int64)
            np.clip(index, 0, size - 1, out=index)
        found = depth[row, column]
        depth.ravel()[pixel] = np.where(found > 0, found, depth.ravel()[pixel])
    flying, share = rng.random((2, len(pixel)), dtype=np.float32)
    mixed = flying < noise.flying
    depth.ravel()[pixel[mixed]] = (near + share * (far - near))[mixed]
    lost: Pixels = pixel[ndtr(luck.ravel()[pixel]) > 1 - noise.edge_holes]
    return lost


def _grazing(
    depth: Image, spread: Image, incidence: tuple[float, float], focal: float, luck: Image
) -> Pixels:
    """Which pixels look along a surface rather than at it, and get no answer.

    With z_u and z_v the change of depth per pixel, the normal of p = z r(u, v) is along
    (f z_u, f z_v, −z − u z_u − v z_v), u and v from the principal point, and n · r = −z.
    """
    height, width = depth.shape
    middle = np.array([width / 2 - 0.5, height / 2 - 0.5])
    # Only what is steep in the image can be: the ray at a corner departs from z by ``corner``.
    corner = np.arctan(np.hypot(*middle) / focal)
    steep = np.float32(2 * np.tan(max(incidence[0] - corner, 0.0)) / focal)
    pixel = np.flatnonzero(spread > depth * steep)
    row, column = np.divmod(pixel, width)
    inner = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
    pixel = pixel[inner]
    u, v = column[inner] - middle[0], row[inner] - middle[1]
    z = depth.ravel()[pixel].astype(np.float64)
    z_u, z_v = _slope(depth, pixel, 1), _slope(depth, pixel, width)
    along = np.sqrt(focal**2 * (z_u**2 + z_v**2) + (z + u * z_u + v * z_v) ** 2)  # |n|
    angle = np.arccos(np.minimum(z / (along * np.sqrt(1 + (u * u + v * v) / focal**2)), 1.0))
    share = (angle - incidence[0]) / (incidence[1] - incidence[0])  # that gets lost
    lost: Pixels = pixel[ndtr(luck.ravel()[pixel]) < share]
    return lost


def _slope(depth: Image, pixel: Pixels, beside: int) -> NDArray[np.float64]:
    """The change of depth towards the pixel ``beside``, the gentler of before and after.

    So the last pixel before an edge has the slope of its own surface.
    """
    flat = depth.ravel()
    before = flat[pixel] - flat[pixel - beside]
    after = flat[pixel + beside] - flat[pixel]
    return np.where(np.abs(before) < np.abs(after), before, after).astype(np.float64)


def _shadow(depth: Image, baseline_focal: float) -> Pixels:
    """Which pixels the second imager, to the right, does not see: something near is before them.

    What is at u is at u − f b / z in its image. The order of what both see is the same in both.
    """
    with np.errstate(divide="ignore"):
        other = np.float32(baseline_focal) / depth[:, ::-1]
    np.subtract(np.arange(depth.shape[1], dtype=np.float32)[::-1], other, out=other)
    other[other == -np.inf] = np.inf  # a hole hides nothing
    least = np.minimum.accumulate(other, axis=1)
    row, column = np.nonzero(other[:, 1:] > least[:, :-1])
    hidden: Pixels = row * depth.shape[1] + depth.shape[1] - 2 - column
    return hidden


def _smooth_normal(shape: tuple[int, int], blur: float, rng: np.random.Generator) -> Image:
    """Gaussian noise of variance 1 whose neighbours are alike: white noise, blurred.

    Args:
        shape: of the image.
        blur: [pixel] standard deviation of the Gaussian that blurs it.
        rng: draws it.
    """
    import cv2

    step = max(1, int(blur / 1.5))  # drawn on a coarser grid, where the blur allows
    size = [-(-n // step) for n in shape]
    white = rng.standard_normal(size, dtype=np.float32)
    taps = np.asarray(cv2.getGaussianKernel(2 * int(np.ceil(2.5 * blur / step)) + 1, blur / step))
    kernel = taps / np.linalg.norm(taps)  # so that the variance stays 1
    coarse = cv2.sepFilter2D(white, -1, kernel, kernel)
    if step == 1:
        return np.asarray(coarse, np.float32)
    fine = cv2.resize(coarse, (size[1] * step, size[0] * step), interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine[: shape[0], : shape[1]], np.float32)
