"""Is a proposer right about its frames? Whoever proposes, its grasps must hold something.

A grasp with the wrong axis, offset or camera frame is a number like any other; beside the cloud it
is not. Here every grasp is asked what its fingers would do to the points that the camera saw.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.perception import PointCloud

from tog_drake.drawing import Image, draw_grasps
from tog_drake.hand_boxes import hand_boxes, points_inside
from tog_drake.panda import FINGERTIP_Z, PAD_WIDTH, PALM_Z, arrival_opening
from tog_drake.values import Array, Grasps, View

TOLERANCE = 0.006  # [m] of the contacts: widths in steps of 8 mm, points every 3 mm, noise
FEWEST = 4  # points between the fingers; fewer hold nothing
STRAY = 3  # points that the open hand may meet
FACING = np.cos(np.radians(35))  # of a surface to the finger that presses on it
AT_END = 0.004  # [m] points this close to the outermost one are the surface that a finger meets

PROBLEMS = {
    "": "holds something by two sides",
    "skewed": "its pose is no rigid transform, or mirrored",
    "empty": "there is nothing between the fingers",
    "blocked": "the open hand stands in what was seen",
    "width": "what is between the fingers is wider or narrower than it says, or not in the middle",
    "slanted": "a finger meets a surface that does not face it",
    "contact": "the contact point is not where a pad touches",
}
"""What can be wrong with a grasp, in the order in which it is asked for."""


def check_grasps(grasps: Grasps, cloud: PointCloud) -> list[str]:
    """Returns the first of ``PROBLEMS`` that each grasp has, N of them; "" for those without.

    The hand's two fingers are alike: a grasp that is turned by 180° about its approach has the
    same verdict. One that is turned by 90° has it on round things alone.

    A single view does not show all that is held. The far end of it may be missing where a face to
    the near finger is seen; what is seen may be far above the tips; and of a thing that is seen
    from above alone, its edges must do.

    Args:
        cloud: in W, of the things on the table, with normals.
    """
    p_W = cloud.xyzs().T.astype(np.float64)
    normal = cloud.normals().T.astype(np.float64)
    blocked = points_inside(grasps.X_WG, *hand_boxes(arrival_opening(grasps.width)), p_W) > STRAY
    return [
        _problem(grasps.take(np.array([i])), p_W, normal, bool(blocked[i]))
        for i in range(len(grasps))
    ]


def holds_nothing(X_WG: Array, width: Array, cloud: PointCloud) -> NDArray[np.bool_]:
    """Returns which of N grasps are "empty" in the sense of ``PROBLEMS``, (N,).

    Args:
        X_WG: (N, 4, 4).
        width: (N,) [m].
        cloud: in W, of the things on the table, with normals.
    """
    p_W = cloud.xyzs().T.astype(np.float64)
    nowhere = np.zeros_like(p_W)  # normals do not matter
    held = [
        len(_Held.between_fingers((p_W - X[:3, 3]) @ X[:3, :3], nowhere, w).y)
        for X, w in zip(X_WG, width, strict=True)
    ]
    return np.array(held, np.int64) < FEWEST


def _problem(grasp: Grasps, p_W: Array, normal: Array, blocked: bool) -> str:
    X, width = grasp.X_WG[0], float(grasp.width[0])
    R = X[:3, :3]
    if not np.allclose(R.T @ R, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
        return "skewed"
    held = _Held.between_fingers((p_W - X[:3, 3]) @ R, normal @ R, width)
    if len(held.y) < FEWEST:
        return "empty"
    if blocked:
        return "blocked"
    ends = [held.end(side) for side in (1.0, -1.0)]
    if not all(end.reach < width / 2 + TOLERANCE for end in ends):
        return "width"
    seen = [end.reach > width / 2 - TOLERANCE for end in ends]
    near = [end.face > FACING for end, is_seen in zip(ends, seen, strict=True) if is_seen]
    if not (all(seen) or any(near)):
        return "width"
    if not all(end.faces for end, is_seen in zip(ends, seen, strict=True) if is_seen):
        return "slanted"
    x, y, z = (grasp.p_WContact[0] - X[:3, 3]) @ R
    on_pad = abs(x) < PAD_WIDTH / 2 + TOLERANCE and abs(abs(y) - width / 2) < TOLERANCE
    return "" if on_pad and PALM_Z < z < FINGERTIP_Z + TOLERANCE else "contact"


@dataclass(frozen=True)
class _End:
    """Where what is held ends on the side of one finger."""

    reach: float  # [m] from the middle of the hand
    face: float  # best cosine between a normal there and the direction to the finger
    edge: float  # cosine between the outline's normal and that direction

    @property
    def faces(self) -> bool:
        """Whether a surface or, of one that is seen from above alone, its edge faces the finger."""
        return bool(max(self.face, self.edge) > FACING)


@dataclass(frozen=True)
class _Held:
    """The points that closing fingers would meet, in G's axes."""

    x: Array  # (M,) [m]
    y: Array  # (M,) [m]
    towards_y: Array  # (M,) cosine between the normal and y_G

    @staticmethod
    def between_fingers(p_G: Array, normal_G: Array, width: float) -> "_Held":
        reach = float(arrival_opening(np.array(width))) / 2
        box = (np.abs(p_G[:, 0]) < PAD_WIDTH / 2) & (np.abs(p_G[:, 1]) < reach)
        box &= (p_G[:, 2] > PALM_Z) & (p_G[:, 2] < FINGERTIP_Z)
        return _Held(p_G[box, 0], p_G[box, 1], normal_G[box, 1])

    def end(self, side: float) -> _End:
        """The end towards the finger at ``side`` (1 or −1) of y."""
        y = side * self.y
        reach = float(y.max())
        face = float((side * self.towards_y)[y > reach - AT_END].max())
        return _End(reach, face, self._edge(y))

    def _edge(self, y: Array) -> float:
        """How squarely the outline faces: the outermost points along the pad, on a straight line.

        A pad that is not filled shows no line; its edge may be anything.
        """
        strip = np.floor((self.x / PAD_WIDTH + 0.5) * 4).astype(int)
        filled = np.unique(strip)
        if len(filled) < 3:
            return 1.0
        outermost = [y[strip == i].max() for i in filled]
        slope = np.polyfit(filled * PAD_WIDTH / 4, outermost, 1)[0]
        return float(1 / np.hypot(1, slope))


def turned(grasps: Grasps, degrees: float) -> Grasps:
    """Returns the same grasps with the hand turned about its approach."""
    angle = np.radians(degrees)
    X_GT = np.eye(4)
    X_GT[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return replace(grasps, X_WG=grasps.X_WG @ X_GT)


def check_image(view: View, grasps: Grasps, problems: list[str], most: int = 40) -> Image:
    """Draws the grasps on the view, for a person: those that hold in green, the others in red.

    Of more than ``most`` every so many are drawn, from the best to the worst.
    """
    if len(grasps) > most:
        rows = np.linspace(0, len(grasps) - 1, most).astype(np.int64)
        return check_image(view, grasps.take(rows), [problems[i] for i in rows], most)
    colors = np.where(np.array([[p == ""] for p in problems]), (30, 185, 60), (230, 25, 35))
    return draw_grasps(view, grasps, colors.reshape(-1, 3), thickness=1.5, contacts=True)
