"""What the camera could not see of the space that the fingers enter.

Behind what is seen there may be anything: the rest of a thick thing of which one face shows, or
another thing. A finger that goes there may well meet it.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tog_drake.panda import FINGER_THICKNESS, FINGERTIP_Z, PAD_WIDTH
from tog_drake.pinhole import project
from tog_drake.values import Array, Grasps, View

MarkState = Literal["shown", "dashed", "dropped"]
"""How a grasp is marked in a picture: as usual, as hidden, or not at all."""

_BEHIND = 0.006  # [m] less behind a surface is not hidden: depth noise
_ALONG = np.linspace(-0.03, FINGERTIP_Z - 0.001, 7)  # [m] z_G of the samples: the fingers' ends


def hidden_share(X_WG: Array, opening: Array, views: Sequence[View]) -> Array:
    """Returns how much of a finger's end is hidden by what the cameras saw, (N,) from 0 to 1.

    Of the two fingers, the one that is hidden more counts. With several views a place is hidden if
    none of them sees it. A view in which it is out of the image or in a hole of the depth image
    tells nothing; where none tells anything, the place counts as seen.

    Args:
        X_WG: (N, 4, 4).
        opening: (N,) [m] between the pads.
        views: what the cameras saw; without any, nothing is hidden.
    """
    x = np.linspace(-0.5, 0.5, 3) * PAD_WIDTH
    outwards = np.linspace(0, 1, 3) * FINGER_THICKNESS
    grid = np.stack(np.meshgrid(x, outwards, _ALONG, indexing="ij"), axis=-1).reshape(-1, 3)
    finger = np.stack([grid * [1, side, 1] for side in (-1, 1)])  # (2, S, 3) of a closed hand
    p_G = np.broadcast_to(finger, (len(X_WG), *finger.shape)).copy()
    p_G[..., 1] += np.array([-0.5, 0.5])[:, None] * opening[:, None, None]
    p_W = np.einsum("nij,nfsj->nfsi", X_WG[:, :3, :3], p_G) + X_WG[:, None, None, :3, 3]
    hidden = _hidden(p_W.reshape(-1, 3), views)
    return np.asarray(hidden.reshape(p_G.shape[:3]).mean(axis=2).max(axis=1))


def _hidden(p_W: Array, views: Sequence[View]) -> NDArray[np.bool_]:
    """Which points (N, 3) lie behind what a view shows, and are seen in none."""
    behind = np.full(len(p_W), np.nan)  # in the view in which it is least
    for view in views:
        behind = np.fmin(behind, _behind(p_W, view))
    return np.asarray(behind > _BEHIND)


def visible(p_W: Array, view: View) -> NDArray[np.bool_]:
    """Returns which points (N, 3) [m] on surfaces the view shows, (N,).

    They lie in the image and not behind what its depth shows there. Where that has a hole, they
    count as seen: colour has none.
    """
    return np.asarray(_in_image(p_W, view) & ~(_behind(p_W, view) > _BEHIND))


def _in_image(p_W: Array, view: View) -> NDArray[np.bool_]:
    """Which points (N, 3) project into the image."""
    size = np.array([view.intrinsics.width, view.intrinsics.height])
    pixel = project(p_W, view.intrinsics, view.X_WC)
    return np.asarray(np.all((pixel >= -0.5) & (pixel < size - 0.5), axis=1))  # False where NaN


def shown_in(grasps: Grasps, view: View) -> NDArray[np.bool_]:
    """Returns which grasps the view shows, (N,): those of which it sees one of both contacts."""
    return visible(grasps.p_WContact, view) | visible(grasps.p_WOtherContact, view)


def mark_states(grasps: Grasps, view: View, *, dots: bool) -> tuple[MarkState, ...]:
    """Returns how the mark of each grasp is drawn, as the view's own depth has it.

    It is "shown" where the view sees a contact, "dashed" where contacts lie in the image, but only
    behind what is seen there, be it a thing or the arm, and "dropped" where none is in the image.

    Args:
        dots: whether the marks are dots at ``p_WContact``, so that only that contact counts.
    """
    contacts = [grasps.p_WContact] if dots else [grasps.p_WContact, grasps.p_WOtherContact]
    seen = np.any([visible(p_W, view) for p_W in contacts], axis=0)
    inside = np.any([_in_image(p_W, view) for p_W in contacts], axis=0)
    return tuple(
        "shown" if s else "dashed" if i else "dropped" for s, i in zip(seen, inside, strict=True)
    )


def _behind(p_W: Array, view: View) -> Array:
    """How far each point (N, 3) lies behind what is seen in its pixel, (N,) [m]; NaN if unknown."""
    pixel = np.rint(project(p_W, view.intrinsics, view.X_WC))
    height, width = view.depth.shape
    inside = np.all((pixel >= 0) & (pixel < [width, height]), axis=1)  # False where NaN
    column, row = pixel[inside].astype(np.int64).T
    depth = view.depth[row, column]
    z = (p_W[inside] - view.X_WC[:3, 3]) @ view.X_WC[:3, 2]
    behind = np.full(len(p_W), np.nan)
    behind[inside] = np.where(depth > 0, z - depth, np.nan)
    return behind
