"""What the hand would meet, while it closes and on its way up, besides the thing that it holds."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tog_drake.hand_boxes import hand_boxes, points_inside
from tog_drake.values import Array

_GAP = 0.012  # [m] things whose points are nearer to each other than this are taken for one
_TOLERANCE = 0.002  # [m] by which points may enter the hand's boxes: depth noise
_STRAY = 2  # points that may be inside nevertheless: flying pixels


def first_met(
    X_WG: Array, width: float, opening: float, p_WContact: Array, points: Array
) -> int | None:
    """Returns the first pose of a lift at which the hand meets something; None if there is none.

    What is held goes up with the hand: all points that a chain of near points links to the contact
    do not count. So a neighbour that touches the held thing does not, either.

    Args:
        X_WG: (L, 4, 4) on its way up, so close that nothing slips between two; at the first the
            hand closes.
        width, opening: of the closed hand and of the open one [m].
        p_WContact: (3,) where the grasp meets the observed surface.
        points: (M, 3) [m] of the cloud, in W.
    """
    lower, upper = hand_boxes(np.full(len(X_WG), width))
    before = hand_boxes(np.array([opening]))  # what a finger sweeps as it closes is a box, too
    lower[:1], upper[:1] = np.minimum(lower[:1], before[0]), np.maximum(upper[:1], before[1])
    lower, upper = lower + _TOLERANCE, upper - _TOLERANCE
    # Most lifts meet nothing at all, and what is held need not be told from the rest.
    if len(points) and (points_inside(X_WG, lower, upper, points) > _STRAY).any():
        others = points[~_linked(points, p_WContact)]
        met = points_inside(X_WG, lower, upper, others) > _STRAY
        return int(np.argmax(met)) if met.any() else None
    return None


def _linked(points: Array, p: Array) -> NDArray[np.bool_]:
    """Tells which points (M,) belong to the thing that the point p (3,) lies on."""
    tree = cKDTree(points)
    pairs = tree.query_pairs(_GAP, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    _, thing = connected_components(links, directed=False)
    return np.asarray(thing == thing[tree.query(p)[1]])
