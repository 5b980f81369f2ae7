"""Spheres that cover a robot's collision geometry, and where they are for many configurations."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, Shape, Sphere

from tog_drake.values import Array

MARGIN = 0.013  # [m] by which spheres may stand out of a box or out of a cylinder's side


@dataclass(frozen=True)
class SphereCover:
    """S spheres, each fixed to a link of the arm; those on fingers slide with the opening."""

    radius: Array  # (S,) [m]
    body: tuple[str, ...]  # (S,) name of the body that each covers
    link: Array  # (S,) int, ascending: the frame of ``panda.link_frames`` that each is fixed to
    centre: Array  # (S, 3) [m] in that frame, at opening 0
    slide: Array  # (S, 3) [-] change of the centre with the opening

    def centres(self, X_WL: Array, opening: float) -> Array:
        """Returns the centres in W, (..., S, 3) [m].

        Args:
            X_WL: (..., 8, 4, 4) the link frames in W, L0 first.
            opening: distance between the finger pads [m].
        """
        centres = np.empty((*X_WL.shape[:-3], len(self.radius), 3))
        p_L = self.centre + opening * self.slide
        first = np.searchsorted(self.link, np.arange(X_WL.shape[-3] + 1))
        for link, (start, end) in enumerate(pairwise(first)):
            R_WL, p_WL = X_WL[..., link, :3, :3], X_WL[..., link, :3, 3]
            turned = p_L[start:end] @ np.swapaxes(R_WL, -1, -2)
            centres[..., start:end, :] = turned + p_WL[..., np.newaxis, :]
        return centres


def cover_shape(shape: Shape, margin: float = MARGIN) -> tuple[Array, float]:
    """Returns spheres of one radius that cover a shape.

    A sphere is itself. A box gets a grid of spheres that stand out of its faces by ``margin`` at
    most; a capsule or cylinder a row along its axis that stands out of its side by ``margin`` at
    most (and, at a cylinder's flat ends, by up to its radius).

    Returns:
        Centres (K, 3) in the shape's frame [m] and their radius [m].

    Raises:
        TypeError: any other shape.
    """
    if isinstance(shape, Sphere):
        return np.zeros((1, 3)), shape.radius()
    if isinstance(shape, Box):
        return _cover_box(np.asarray(shape.size()), margin)
    if isinstance(shape, Capsule | Cylinder):
        length, radius = shape.length(), shape.radius()
        half_step = np.sqrt((radius + margin) ** 2 - radius**2)
        count = max(1, int(np.ceil(length / (2 * half_step))))
        # A capsule's round ends need a sphere at each end, a cylinder's flat ones do not.
        fractions = (
            np.linspace(-0.5, 0.5, count + 1)
            if isinstance(shape, Capsule)
            else (np.arange(count) + 0.5) / count - 0.5
        )
        centres = np.outer(fractions * length, [0.0, 0.0, 1.0])
        return centres, float(np.hypot(radius, length / (2 * count)))
    raise TypeError(
        f"a {type(shape).__name__} cannot be covered by spheres: describe the robot's collision "
        "geometry by spheres, boxes, capsules and cylinders"
    )


def _cover_box(size: Array, margin: float) -> tuple[Array, float]:
    """Splits the largest edge of the grid's cells until their circumscribed spheres fit."""
    count = np.ones(3, dtype=int)
    half = size / 2
    while np.linalg.norm(half) - half.min() > margin:
        count[np.argmax(half)] += 1
        half = size / (2 * count)
    axes = [(np.arange(n) + 0.5) * 2 * h - s / 2 for n, h, s in zip(count, half, size, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return centres, float(np.linalg.norm(half))
