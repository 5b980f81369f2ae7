"""How well two fingers hold what is between them: facing surfaces, contact, and confidence.

Everything here is about K grips at once and the E points between their fingers, in the axes of G:
x along the pads' width, y the closing direction, z the approach.
"""

import numpy as np
from numpy.typing import NDArray

from tog_drake.points import Rows
from tog_drake.proposers.profile import SLAB
from tog_drake.values import Array

EDGE = 0.005  # [m] a finger touches what is this close to the end of the stretch
MIN_FACING = 0.60  # cosine; a surface turned farther from its finger lets it slip at any friction
SIDE = 0.55  # cosine; less is the rounded edge of a top: neighbours' normals are mixed there
UNSEEN = 0.75  # cosine for a side that was not seen but whose outline runs along the pad


def middle_rows(x: Array, z: Array, touched: NDArray[np.bool_], grip: Rows, count: int) -> Rows:
    """Which of the points that a pad touches is nearest to the pad's middle, for each of K grips.

    Args:
        x, z: (E,) [m] the points between the fingers, in G.
        touched: (E,) those at one pad, at least one for each grip.
        grip: (E,) 0 .. K−1, ascending: which grip each belongs to.

    Returns:
        (K,) rows of the E points.
    """
    row = np.flatnonzero(touched)
    order = row[np.lexsort((x[row] ** 2 + z[row] ** 2, grip[row]))]
    return np.asarray(order[np.searchsorted(grip[order], np.arange(count))])


def facing_of(
    x: Array, y: Array, towards: Array, grip: Rows, end: Array
) -> tuple[Array, NDArray[np.bool_], Array]:
    """How well the surface at the finger on the side of larger y faces it.

    Where that surface was seen, its normals say so. Where it was not, only its outline is known,
    which ought to run along the pad.

    Args:
        x, y: (E,) [m] the points between the fingers.
        towards: (E,) cosine between their normals and the direction to the finger.
        grip: (E,) 0 .. K−1, which grip each belongs to.
        end: (K,) [m] the largest y of each grip.

    Returns:
        (K,) cosine; (K,) whether it was seen; (K,) the share of the pad's width along which there
        is something to hold.
    """
    count, bins = len(end), 5
    at_end = y > end[grip] - EDGE
    seen = at_end & (towards > SIDE)
    number = np.bincount(grip[seen], minlength=count)
    by_normals = np.bincount(grip[seen], towards[seen], minlength=count) / np.maximum(number, 1)
    enough = number >= 0.25 * np.bincount(grip[at_end], minlength=count)

    column = np.clip((x / SLAB + 1) / 2 * bins, 0, bins - 1).astype(np.int64)
    outline = np.full(count * bins, -np.inf, dtype=y.dtype)
    np.maximum.at(outline, grip * bins + column, y)
    held = np.isfinite(outline).reshape(count, bins)
    slope = _slope(np.where(held, outline.reshape(count, bins), 0), held)
    by_outline = UNSEEN / np.sqrt(1 + slope**2)
    return np.where(enough, by_normals, by_outline), enough, held.mean(axis=1)


def _slope(y: Array, valid: NDArray[np.bool_]) -> Array:
    """The slope (K,) of the line through the valid ones of B points across the slab, (K, B)."""
    weight = valid / valid.sum(axis=1, keepdims=True)
    x = np.arange(y.shape[1]) * (2 * SLAB / y.shape[1])
    x = x - (weight * x).sum(axis=1, keepdims=True)
    spread = (weight * x**2).sum(axis=1)
    return np.asarray((weight * x * y).sum(axis=1) / np.maximum(spread, 1e-9))


def confidence(
    *,
    facing: Array,
    seen: NDArray[np.bool_],
    depth: Array,
    tilt: Array,
    covered: Array,
    lever: Array,
    spare: Array,
) -> Array:
    """Confidence in [0, 1] (K,), from what told good grasps from bad ones in simulated lifts.

    Args:
        facing: (2, K) cosine of the surface at each finger.
        seen: (2, K) whether that surface was seen. If not, it counts less the more the approach is
            tilted: an outline seen from above may, from the side, be the corner of a block.
        depth: (K,) [m] of the fingertips below the top of what is gripped.
        tilt: (K,) [rad] of the approach from the vertical.
        covered: (K,) share of the pad that holds something.
        lever: (K,) [m] horizontally from where the centre of mass may be.
        spare: (K,) [m] by which it could be wider.
    """
    facing = np.where(seen, facing, facing * np.cos(tilt))
    return np.asarray(
        0.30 * np.clip((facing - MIN_FACING) / (1 - MIN_FACING), 0, 1).mean(axis=0)
        + 0.20 * np.minimum(depth / 0.025, 1)
        + 0.10 * np.maximum(1 - (tilt / np.radians(75)) ** 2, 0)
        + 0.10 * covered
        + 0.25 * np.exp(-((lever / 0.06) ** 2))
        + 0.05 * np.clip(spare / 0.02, 0, 1)
    )
