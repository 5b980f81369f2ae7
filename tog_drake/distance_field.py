"""How far a point is from the nearest observed surface point, answered by table look-up.

A robot of some eighty spheres, at thousands of configurations, against ten thousand cloud points:
the Euclidean distance transform of the voxelised cloud answers in about 0.1 µs a sphere.
"""

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from tog_drake.values import Array

_MARGIN = 1.15  # [voxel] what is subtracted to be conservative; derived in ``DistanceField``
_BORDER = 0.10  # [m] free space around the cloud that the table covers


class DistanceField:
    """The distance to a point cloud, never over-estimated.

    Every point is moved to the centre of its voxel, by √3/2 = 0.87 voxel at most; linear
    interpolation between voxel centres exceeds the distance to such a centre by 0.26 voxel at most
    (the cone |p|, worst inside the cell at its apex). Their sum, 1.15 voxel, is subtracted. The
    result is therefore at most the true distance, and typically one voxel less.

    Args:
        points: (N, 3) [m], finite, in any frame; N = 0 is free space.
        voxel: edge of a voxel [m].
        reach: distances are clipped here [m].

    Raises:
        ValueError: points that are not (N, 3) or not finite.
    """

    def __init__(self, points: Array, voxel: float = 0.01, reach: float = 0.3):
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"points must be finite and of shape (N, 3), got {points.shape}")
        self.voxel = voxel
        self.reach = reach
        self._table: Array | None = None
        if len(points) == 0:
            return
        border = int(np.ceil(min(_BORDER, reach) / voxel))
        index = np.floor(points / voxel).astype(np.int64)
        first = index.min(axis=0) - border
        free = np.ones(index.max(axis=0) + border + 1 - first, dtype=bool)
        free[tuple((index - first).T)] = False
        self._first_centre = (first + 0.5) * voxel
        self._table = distance_transform_edt(free, sampling=voxel).astype(np.float32)

    def distance(self, p: Array) -> Array:
        """Returns the distance from p to the nearest observed point, clipped at ``reach``.

        Args:
            p: (..., 3) [m] in the frame of the points.

        Returns:
            (...) [m], at most the true distance; negative (by 1.15 voxel at most) close to a point.
        """
        if self._table is None:
            return np.full(p.shape[:-1], self.reach)
        u = (p.reshape(-1, 3) - self._first_centre) / self.voxel
        inside = np.clip(u, 0, np.array(self._table.shape) - 1)
        table = map_coordinates(self._table, inside.T, order=1, mode="nearest", prefilter=False)
        # Beyond the table: the table is convex and holds the whole cloud, so the way from p to
        # any of its points is at least the hypotenuse of p→(closest cell)→point.
        outside = np.linalg.norm(u - inside, axis=-1) * self.voxel
        distance = np.minimum(np.hypot(outside, table) - _MARGIN * self.voxel, self.reach)
        return np.asarray(distance).reshape(p.shape[:-1])
