"""What the network is shown: the points of the whole scene, or of a cube around each thing.

All points are in C, the frame of the camera (x right, y down, z forward).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tog_drake.pinhole import unproject_pixels
from tog_drake.points import Rows, clusters, neighbors
from tog_drake.values import Array, View

POINTS = 20000  # the network is shown so many, whatever the camera saw
CUBE = (0.2, 0.6)  # [m] least and greatest side of a local region
OUTLIER = 0.4  # [m] a point of a thing that is this far (L1) from its median is none of it
GAP = 0.010  # [m] points of the cloud farther apart are not connected, as in ``CloudConfig``
ON_THING = 0.004  # [m] a pixel's point this close to a point of the cloud lies on the same thing
"""Points of the cloud are means over cubes of 3 mm of denoised depth, so that no pixel's point is
equal to one of them. Within 4 mm of one lie 99 to 100 % of the points that a wrist camera sees of
things and none of the table's; with the noise of an L515 95 to 97 %, and of the table, at the
things' feet, as many as 1 to 5 % of these (0.53 to 0.66 m away; Spoon, Tools, Kitchen)."""


def scene_points(view: View, z_range: Sequence[float]) -> Array:
    """Returns the point that each pixel shows, row by row, (N, 3) [m].

    Args:
        view: its pose is not used.
        z_range: [m] nearest and farthest z; what is not strictly in between is left out.
    """
    near, far = z_range
    depth = view.depth.ravel()
    pixel = np.flatnonzero((depth > max(near, 0.0)) & (depth < far))
    return unproject_pixels(replace(view, X_WC=np.eye(4)), pixel)


def things_of(points: Array) -> Rows:
    """Returns which thing each point of a thinned cloud is on, (N,) 0 .. number of things − 1."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    return clusters(neighbors(points, 8), GAP)


def local_region(scene: Array, thing: Array) -> Array:
    """Returns the points of the scene in a cube about a thing: twice its size, so that what is
    beside and below it is seen too.

    Args:
        scene: (N, 3) [m].
        thing: (M, 3) [m] the points on it, M ≥ 1.
    """
    far = np.abs(thing - np.median(thing, axis=0)).sum(axis=1)
    thing = thing[far < OUTLIER] if (far < OUTLIER).any() else thing
    low, high = thing.min(axis=0), thing.max(axis=0)
    side = np.clip(2 * (high - low).max(), *CUBE)
    inside: Array = scene[(np.abs(scene - (low + high) / 2) < side / 2).all(axis=1)]
    return inside


def with_count(points: Array, count: int, rng: np.random.Generator) -> Array:
    """Returns ``count`` of N ≥ 1 points (N, 3): a random choice of more, in random order, or all
    of fewer and then copies of random ones."""
    if len(points) > count:
        return points[rng.choice(len(points), count, replace=False)]
    copies = rng.integers(len(points), size=count - len(points))
    return np.concatenate([points, points[copies]])
