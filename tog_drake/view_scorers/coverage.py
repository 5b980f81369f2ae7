"""How much of the target and of the candidates a view shows: depth alone, no model.

What there is to see of the target is found in all views together: the points that the cloud has of
it, and the views' own points that are connected to these. So a handle that one camera cannot see
counts against it, if another one can.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.perception import PointCloud
from scipy.spatial import cKDTree

from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.errors import NoGrasp
from tog_drake.pinhole import project
from tog_drake.points import clusters, neighbors
from tog_drake.selectors.targets import target_or_all
from tog_drake.values import Array, CameraView, Candidates, View, Workspace
from tog_drake.view_selection import Scores
from tog_drake.visibility import shown_in, visible

Mask = NDArray[np.bool_]

_SPACING = 0.005  # [m] between the points of the target
_GAP = 0.012  # [m] points farther apart than this are not connected
_NEIGHBORS = 12
_CELL = 8  # [pixel] of the squares that measure how large the target appears


@dataclass
class Coverage:
    """Shows the view that sees most of the target and of the candidates: `!Coverage {}`."""


class CoverageScorer:
    """Scores views by what of the target and of the candidates they see.

    A view's score is the geometric mean of three shares, each from 0 to 1, so that a view that is
    poor in one of them is not saved by the others and nothing needs a weight:

    - seen: of the target's surface, as far as any camera sees it, how much this one sees: inside
      the image (not truncated) and not behind what its depth shows (not occluded);
    - large: the square root of the area in the image that this takes, of the largest in any view:
      a length, as details are told apart by their length in pixels;
    - shown: of the K candidates, those n of which it sees one of both contacts; with one more in
      either number, so that where no view shows a candidate the target decides: (1 + n) / (1 + K).
    """

    def __init__(self, workspace: Workspace):
        self._workspace = workspace
        self._config = CloudConfig(voxel=_SPACING)

    def score(
        self,
        views: Sequence[CameraView],
        cloud: PointCloud,
        candidates: Candidates,
        target: str,
        task: str,
    ) -> Scores:
        """Returns the score of each view; 0 for one that sees nothing of the target."""
        points = np.asarray(cloud.xyzs().T, np.float64)
        image, table_height = views[0].view.rgb, self._workspace.table_height
        meant = target_or_all(cloud, target, image, table_height)
        surface = self._grown(points, meant.mask, views)
        grasps = candidates.grasps.take(candidates.index)
        sees = [visible(surface, v.view) for v in views]
        share = np.array([s.mean() for s in sees])
        area = np.array([_area(surface[s], v.view) for s, v in zip(sees, views, strict=True)])
        shown = np.array([shown_in(grasps, v.view).sum() for v in views])
        large = np.sqrt(area / max(area.max(), 1.0))
        values = np.cbrt(share * large * (1 + shown) / (1 + len(grasps)))
        compared = [
            f"{views[i].camera} sees {share[i]:.0%} of it and {shown[i]} of {len(grasps)} "
            "candidates"
            for i in dict.fromkeys([int(np.argmax(values)), 0])
        ]
        return Scores(tuple(values.tolist()), f"{meant.how}; {', '.join(compared)}.")

    def _grown(self, points: Array, mask: Mask, views: Sequence[CameraView]) -> Array:
        """What all views together see of the target, (M, 3) [m] about evenly spaced in W.

        A view's point is the target's if it is connected to a point of it, and no point of another
        thing is nearer.
        """
        with_depth = [v.view for v in views if np.any(v.view.depth > 0)]
        try:
            fused = scene_cloud(with_depth, self._workspace, self._config)
        except NoGrasp:  # what there is, is too small for this spacing
            return points[mask]
        pool = np.asarray(fused.xyzs().T, np.float64)
        near = cKDTree(points[mask]).query(pool)[0]
        if not mask.all():
            keep = near <= cKDTree(points[~mask]).query(pool)[0]
            pool, near = pool[keep], near[keep]
        label = clusters(neighbors(pool, _NEIGHBORS), _GAP)
        return pool[np.isin(label, label[near < _GAP])]


def _area(p_W: Array, view: View) -> float:
    """The area in the image [pixel²] that points (N, 3) in sight take."""
    cell = np.floor(project(p_W, view.intrinsics, view.X_WC) / _CELL)
    return float(_CELL**2 * len(np.unique(cell, axis=0)))
