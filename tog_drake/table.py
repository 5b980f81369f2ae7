"""Finds the table in a view whose camera pose nobody knows.

The table is the plane that things stand on, which need not be the largest plane: behind a small
desk there may be a lot of floor. Planes are found one after the other by RANSAC with hypotheses of
one point and its normal, and the one with most standing on it near the image's centre wins.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tog_drake.errors import InputError
from tog_drake.pinhole import unproject
from tog_drake.values import Array, View, Workspace

COLUMNS = 128  # the search looks at about this many pixels per row
HYPOTHESES = 200  # planes tried per round
ROUNDS = 5  # planes taken out, the largest first
MIN_SUPPORT = 0.04  # a table fills at least this share of the pixels with depth
MAX_OBJECT_HEIGHT = 0.40  # [m] what is higher above a plane does not stand on it
MAX_HIDDEN = 0.06  # [m] table hidden by a thing: from its points' feet to table that is seen
MIN_ALIGNMENT = np.cos(np.radians(25))  # of the plane's normal and those of its points
MAX_SLANT = np.cos(np.radians(20))  # of the table's normal and up, where up is known

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Table:
    """A table and the world that it defines.

    W lies on the table top: z up, x the image's right, y away from the camera; its origin is below
    the middle of what the central half of the image shows on the table.
    """

    X_WC: Array  # (4, 4)
    workspace: Workspace  # the space above the table that is seen, and above its noise
    noise: float  # [m] standard deviation of the table's own points about the plane


@dataclass(frozen=True)
class _Samples:
    """A thinned view: the points that have a normal, in C."""

    point: Array  # (N, 3) [m]
    normal: Array  # (N, 3)
    tolerance: Array  # (N,) [m] how far a point of a plane may be off it: depth noise grows as z²
    centrality: Array  # (N,) weight in (0, 1], largest at the image's centre


@dataclass(frozen=True)
class _Plane:
    """normal · p + offset = 0 in C; the normal points to the camera, so offset > 0."""

    normal: Array  # (3,)
    offset: float  # [m] height of the camera
    inlier: Mask  # (N,) of the samples

    def height(self, p_C: Array) -> Array:
        return np.asarray(p_C @ self.normal + self.offset)


def find_table(view: View, seed: int = 0, up: Array | None = None) -> Table:
    """Returns the table that things stand on.

    Args:
        view: its ``X_WC`` is not used.
        seed: of the random hypotheses.
        up: (3,) unit vector in C, where it is known; else the camera is taken to be held upright,
            or to look down.

    Raises:
        InputError: no plane has enough support and faces up.
    """
    samples = _sample(view)
    planes = _planes(samples, np.random.default_rng(seed))
    level = [plane for plane in planes if _faces_up(plane, up)]
    if not level:
        raise InputError(
            f"no table found: of the {np.count_nonzero(view.depth > 0)} pixels with depth "
            f"{len(planes)} planes take {MIN_SUPPORT:.0%} or more each, and none faces up; show "
            "more of the table, hold the camera upright or, if it was not, pass --camera-pose"
        )
    plane = max(level, key=lambda p: _standing(p, samples))
    return _table(plane, samples)


def _sample(view: View) -> _Samples:
    """Points on a coarse grid, with normals from the differences to their grid neighbours."""
    step = max(1, view.intrinsics.width // COLUMNS)
    p = unproject(replace(view, X_WC=np.eye(4)))[::step, ::step]  # in C
    reach = 2
    middle = slice(reach, -reach)
    right = p[middle, 2 * reach :] - p[middle, : -2 * reach]
    down = p[2 * reach :, middle] - p[: -2 * reach, middle]
    normal = np.cross(down, right)  # x right, y down: towards the camera
    p = p[middle, middle]
    rows, columns = p.shape[:2]
    v, u = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    centrality = np.exp(-2 * (u**2 + v**2))
    length = np.linalg.norm(normal, axis=-1)
    valid = np.isfinite(p[..., 2]) & np.isfinite(length) & (length > 0)
    p, normal = p[valid], normal[valid] / length[valid][:, None]
    tolerance = 0.005 + 0.004 * p[:, 2] ** 2  # about four standard deviations of a depth camera
    return _Samples(p, normal, tolerance, centrality[valid])


def _planes(samples: _Samples, rng: np.random.Generator) -> list[_Plane]:
    """The planes with enough support, the largest first."""
    planes: list[_Plane] = []
    left = np.ones(len(samples.point), dtype=bool)
    for _ in range(ROUNDS):
        if np.count_nonzero(left) < MIN_SUPPORT * len(left) + 3:
            break
        plane = _largest_plane(samples, left, rng)
        left &= np.abs(plane.height(samples.point)) > 2 * samples.tolerance
        if np.count_nonzero(plane.inlier) >= MIN_SUPPORT * len(left):
            planes.append(plane)
    return planes


def _largest_plane(samples: _Samples, left: Mask, rng: np.random.Generator) -> _Plane:
    """The plane with most of the points ``left``, refined by least squares."""
    pick = rng.choice(np.flatnonzero(left), HYPOTHESES)
    offset = -np.sum(samples.normal[pick] * samples.point[pick], axis=1)
    near = np.abs(samples.point @ samples.normal[pick].T + offset) < samples.tolerance[:, None]
    near &= samples.normal @ samples.normal[pick].T > MIN_ALIGNMENT
    best = np.argmax(np.count_nonzero(near[left], axis=0))
    inlier = near[:, best] & left
    for _ in range(3):
        mean = samples.point[inlier].mean(axis=0)
        spread = samples.point[inlier] - mean
        normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
        normal = -normal * np.sign(normal @ mean)
        plane = _Plane(normal, float(-normal @ mean), inlier)
        refined = left & (np.abs(plane.height(samples.point)) < samples.tolerance)
        refined &= samples.normal @ normal > MIN_ALIGNMENT
        if np.count_nonzero(refined) < 3:
            break
        inlier = refined
    return plane


def _faces_up(plane: _Plane, up: Array | None) -> bool:
    """Whether it could be a table: level, or at least not edge-on or seen from below."""
    if up is not None:
        return bool(plane.normal @ up > MAX_SLANT)
    return bool(plane.normal[2] < -0.2 and plane.normal[1] < 0.5)


def _above(plane: _Plane, samples: _Samples) -> Mask:
    """Which samples stand on the plane: above it, over or close to where it is seen."""
    height = plane.height(samples.point)
    above = (height > 2 * samples.tolerance) & (height < MAX_OBJECT_HEIGHT)
    foot = samples.point - height[:, None] * plane.normal
    distance, _ = cKDTree(foot[plane.inlier]).query(foot[above], distance_upper_bound=MAX_HIDDEN)
    above[above] = np.isfinite(distance)
    return above


def _standing(plane: _Plane, samples: _Samples) -> float:
    """How much stands on the plane near the image's centre; an empty table counts for itself."""
    things = samples.centrality[_above(plane, samples)].sum()
    return float(things + 0.1 * samples.centrality[plane.inlier].sum())


def _table(plane: _Plane, samples: _Samples) -> Table:
    """The world of the plane, and the space above the part of it that is seen."""
    seen = plane.inlier | _above(plane, samples)
    foot = samples.point - plane.height(samples.point)[:, None] * plane.normal
    central = seen & (samples.centrality > np.exp(-1))
    origin = np.median(foot[central if central.any() else seen], axis=0)
    x = np.array([1.0, 0.0, 0.0]) - plane.normal[0] * plane.normal
    x /= np.linalg.norm(x)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.stack([x, np.cross(plane.normal, x), plane.normal])
    X_WC[:3, 3] = -X_WC[:3, :3] @ origin
    p_W = foot[plane.inlier] @ X_WC[:3, :3].T + X_WC[:3, 3]
    lower, upper = np.percentile(p_W[:, :2], [1, 99], axis=0)
    noise = float(np.std(plane.height(samples.point[plane.inlier])))
    workspace = Workspace(
        lower=[*lower.tolist(), 2.5 * noise],
        upper=[*upper.tolist(), MAX_OBJECT_HEIGHT],
        table_height=0.0,
    )
    return Table(X_WC, workspace, noise)
