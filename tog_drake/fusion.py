"""One surface of what several cameras saw: each place once, however many saw it.

Each view becomes points with normals by itself, as if there were no other. Of these, those of a
cube that face the same way become one. The two sides of a thin wall, of which each camera saw one,
stay two.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tog_drake.points import facing_numbers, group_means, neighbors
from tog_drake.values import Array

EXACT = 2e-4  # [m] a table whose points scatter less is seen without noise
_LAYER_NEIGHBORS = 32  # about 4 mm around where five cameras see the same
_LAYERS = 4.0  # standard deviations between two measurements of the same surface, at most
_SAME_SIDE = 0.7  # cosine between the normals of neighbours on one surface


@dataclass(frozen=True)
class Surface:
    """N points of the things on the table, and maybe specks and bumps of the table."""

    p_W: Array  # (N, 3) [m]
    rgb: Array  # (N, 3) 0 to 255
    noise: Array  # (N,) [m] standard deviation of a table's points at that distance
    normal: Array  # (N, 3) unit, towards the camera
    pixels: int  # that showed something there


def fused(seen: Sequence[Surface], voxel: float) -> Surface:
    """One surface of several: in each cube the mean of the points that face the same way.

    A point counts the more the less noisy it is, as the inverse of its variance.
    """
    p_W, rgb, normal = (
        np.concatenate([getattr(surface, name) for surface in seen])
        for name in ("p_W", "rgb", "normal")
    )
    noise = np.concatenate([surface.noise for surface in seen])
    p_W = _drawn_together(p_W, normal, noise)
    number = facing_numbers(p_W, normal, voxel)
    weight = 1 / (noise**2 + EXACT**2)
    mean = group_means(number, np.column_stack([p_W, rgb, normal, noise]), weight)
    p_W, rgb, normal, noise = mean[:, :3], mean[:, 3:6], mean[:, 6:9], mean[:, 9]
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-9)[:, None]
    return Surface(p_W, rgb, noise, normal, sum(surface.pixels for surface in seen))


def _drawn_together(p_W: Array, normal: Array, noise: Array) -> Array:
    """Moves noisy points (N, 3) along their normals to the middle of their neighbours.

    What two cameras measure of one surface differs by their noise, and would lie in two layers.
    """
    noisy = noise > EXACT
    if not noisy.any():
        return p_W
    distance, row = neighbors(p_W, _LAYER_NEIGHBORS)
    above = np.einsum("nki,ni->nk", p_W[row] - p_W[:, None], normal)
    same = np.isfinite(distance) & (np.einsum("nki,ni->nk", normal[row], normal) > _SAME_SIDE)
    same &= np.abs(above) < _LAYERS * noise[:, None]
    weight = same / (noise[row] ** 2 + EXACT**2)
    step = (weight * above).sum(axis=1) / weight.sum(axis=1)  # a point is its own neighbour
    return p_W + np.where(noisy, step, 0)[:, None] * normal
