"""Profiles: what a hand would meet on its way down, and where between its fingers an object ends.

A profile says how far along the approach z the first surface lies, for bins of the closing
direction y, about an anchor on the surface (y = z = 0)::

      y ──▶   .  .  ▄▄█████▄▄  .  .  █     first surface in each bin
              ◀room▶           ◀room▶
    z ▼ tip ──────────────────────────     only what is above the fingertips counts
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tog_drake.panda import PAD_WIDTH
from tog_drake.points import Rows
from tog_drake.values import Array

SLAB = PAD_WIDTH / 2 + 0.001  # [m] half the width of what a finger may touch, along x
REACH = 0.10  # [m] half the span of a profile: half the palm is about as long
_NOWHERE = 1000  # bins: farther than any


@dataclass(frozen=True)
class Stretch:
    """What lies between the fingers, for H hands."""

    low: Array  # (H,) [m] where it ends towards −y, to within a bin
    high: Array  # (H,) [m] where it ends towards +y
    room: Array  # (H,) [m] free beyond its ends, on the side that has less
    top: Array  # (H,) [m] z of its first surface
    found: NDArray[np.bool_]  # (H,) False if the fingertips do not get as deep as the anchor


def profiles(attempt: Rows, y: Array, z: Array, count: int, width: float) -> Array:
    """Returns the profiles of ``count`` hands, (H, B) [m], inf where nothing is met.

    Args:
        attempt: (E,) 0 .. H−1, which hand each point belongs to.
        y, z: (E,) [m] of the points, about the anchor. The middle bin is centred on it.
        width: [m] of a bin.
    """
    half = int(REACH / width)
    column = np.rint(y / width).astype(np.int64) + half
    inside = (column >= 0) & (column <= 2 * half)
    profile = np.full(count * (2 * half + 1), np.inf, dtype=z.dtype)  # `at` is slow if they differ
    np.minimum.at(profile, attempt[inside] * (2 * half + 1) + column[inside], z[inside])
    return profile.reshape(count, -1)


def walk_outwards(
    profile: Array, tip: Array, *, width: float, max_gap: float, clearance: float
) -> Stretch:
    """Returns the stretch around the anchor that has a gap on both sides.

    Args:
        profile: (H, B) [m].
        tip: (H,) [m] z of the fingertips.
        width: [m] of a bin.
        max_gap: [m] an empty part up to this long does not end a stretch.
        clearance: [m] there is no room where a surface is less than this below the fingertips.
    """
    middle = profile.shape[1] // 2
    occupied = profile < tip[:, None]
    blocked = profile < tip[:, None] + clearance
    gap = round(max_gap / width) + 1
    right, free_right = _end(occupied[:, middle:], blocked[:, middle:], gap)
    left, free_left = _end(occupied[:, middle::-1], blocked[:, middle::-1], gap)
    column = np.arange(profile.shape[1]) - middle
    within = (column >= -left[:, None]) & (column <= right[:, None])
    return Stretch(
        low=np.asarray(-(left + 0.5) * width),
        high=np.asarray((right + 0.5) * width),
        room=np.minimum(free_left, free_right) * width,
        top=np.min(np.where(within, profile, np.inf), axis=1),
        found=occupied[:, middle],
    )


def _end(
    occupied: NDArray[np.bool_], blocked: NDArray[np.bool_], gap: int
) -> tuple[Rows, NDArray[np.int64]]:
    """The last column before ``gap`` empty ones, and how many free ones come after it, (H,)."""
    columns = occupied.shape[1]
    # count[j] of the columns before j are occupied; the pad makes columns beyond the end empty.
    count = np.cumsum(np.pad(occupied, ((0, 0), (1, gap))), axis=1, dtype=np.int32)
    last = occupied & (count[:, gap + 1 :] == count[:, 1 : columns + 1])
    end = np.argmax(last, axis=1)
    beyond = blocked & (np.arange(columns) > end[:, None])
    first = np.where(beyond.any(axis=1), np.argmax(beyond, axis=1), _NOWHERE)
    return end, first - end - 1
