"""Which of the network's many grasps are kept: confident ones, spread over the scene."""

import numpy as np

from tog_drake.points import Rows
from tog_drake.proposers.contact_graspnet.sampling import farthest_points
from tog_drake.values import Array


def select(
    score: Array, contact: Array, *, first: float, second: float, spread: int, most: int
) -> Rows:
    """Returns the rows of the grasps to keep, ascending.

    Of those with a score above ``first``, ``spread`` whose contacts are far apart (farthest points,
    from the first of them on; all, where there are no more); then the best of all the others with
    a score above ``second``, until there are ``most``.

    Args:
        score: (N,).
        contact: (N, 3) [m].
    """
    good = np.flatnonzero(score > first)
    if len(good) > spread:
        good = good[farthest_points(contact[good].astype(np.float32), spread)]
    good = np.unique(good)  # contacts that are equal are picked again and again
    others = np.argsort(-score, kind="stable")  # best first
    others = others[~np.isin(others, good)][: max(0, most - len(good))]
    return np.union1d(good, others[score[others] > second])
