"""The surface of a scanned object, and the part that each place on it belongs to. Ground truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import BodyIndex
from scipy.spatial import cKDTree

from tog_drake.assets.surface import read_core, surface_points
from tog_drake.panda import PAD_WIDTH, arrival_opening
from tog_drake.regions import Region, region_of
from tog_drake.values import Array, Grasps

UNLABELLED = "unlabelled"  # the one part of an object that has no labels
Shares = dict[tuple[str, str], float]
"""By (model instance, part)."""

_PRESSED = 0.002  # [m] a pad is pressed against what is this close to the first that it meets.
# Of 1-5 mm it agrees best with the simulated forces: on lifts of the 29 by 0.08 of a part's share.


@dataclass(frozen=True)
class LabelledSurface:
    """The surface of a scanned object, whose regions say what part a place on it belongs to."""

    body: BodyIndex  # the frame of its points
    parts: tuple[tuple[str, str], ...]  # (model instance, part) of each region, then unlabelled
    regions: tuple[Region, ...]
    tree: cKDTree  # of points on it [m]
    part: NDArray[np.int64]  # row of ``parts`` for each of these

    def shares(self, p_O: Array, weight: Array) -> Shares:
        """Returns the weight (N,) of the points (N, 3) that lie on each part."""
        shares: Shares = {}
        for i, w in zip(region_of(self.regions, p_O), weight, strict=True):
            shares[self.parts[i]] = shares.get(self.parts[i], 0.0) + float(w)
        return shares

    def pressed(self, X_WO: Array, grasps: Grasps, beside: float = 0.0) -> list[Shares]:
        """Returns the parts that each grasp's pads would press, half a share for each pad.

        The pads close from the opening at which the hand arrives; what they press are the points
        within 2 mm of the first that each meets. Empty where a pad meets nothing.

        Args:
            X_WO: pose of the object, (4, 4).
            grasps: N of them.
            beside: [m] by which the pads are taken to be larger on every side.
        """
        half = arrival_opening(grasps.width) / 2
        X_GO = np.linalg.inv(grasps.X_WG) @ X_WO
        origin = np.linalg.inv(X_GO)[:, :3, 3]
        near = self.tree.query_ball_point(
            origin, np.hypot(half, PAD_WIDTH + 2 * beside), return_sorted=True
        )
        return [
            self._pressed(np.array(rows, np.int64), X, limit, PAD_WIDTH / 2 + beside)
            for rows, X, limit in zip(near, X_GO, half, strict=True)
        ]

    def _pressed(self, row: NDArray[np.int64], X_GO: Array, half: float, pad: float) -> Shares:
        x, y, z = X_GO[:3, :3] @ self.tree.data[row].T + X_GO[:3, 3:]
        between = (np.abs(x) < pad) & (np.abs(z) < pad) & (np.abs(y) < half)
        if not between.any():
            return {}
        shares: Shares = {}
        y, row = y[between], row[between]
        for depth in (y.max() - y, y - y.min()):
            part, count = np.unique(self.part[row[depth < _PRESSED]], return_counts=True)
            for i, share in zip(part, count / count.sum() / 2, strict=True):
                shares[self.parts[i]] = shares.get(self.parts[i], 0.0) + float(share)
        return shares


def labelled_surface(
    model: str, core: Path, regions: tuple[Region, ...], body: BodyIndex
) -> LabelledSurface:
    """Returns the surface of a model instance, read from the file of its core."""
    points = surface_points(*read_core(core))
    names = [*(region.part for region in regions), UNLABELLED]  # the last is that of row -1
    row = region_of(regions, points) % len(names)
    return LabelledSurface(
        body, tuple((model, name) for name in names), regions, cKDTree(points), row
    )
