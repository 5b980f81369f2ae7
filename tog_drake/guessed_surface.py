"""What a view shows of a thing, and what another would: a guess at the surface not seen yet.

The thing stands on the table. So its surface is taken to be that of the convex hull of the points
that were seen of it and of their feet, the places on the table below them, without the underside.
Points spread evenly over it make the ``Shell``.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from tog_drake.distance_field import DistanceField
from tog_drake.errors import NoGrasp
from tog_drake.points import group_means, voxel_numbers
from tog_drake.values import Array, Intrinsics, View
from tog_drake.visibility import visible

Bools: TypeAlias = NDArray[np.bool_]

_AZIMUTHS = np.radians(np.arange(0, 360, 30))
_ELEVATIONS = np.radians([25, 45, 65])  # above the horizon
_SHELL_POINTS = 400
_GRAZING = 0.25  # cosine of ray and normal: what is seen flatter, by 76° or more, is not shown
_ROOM = 1.2  # the target fills the image to 1 / 1.2 of its smaller side
_CELL = 0.01  # [m] of the columns that fill what was seen down to the table
_SIGHT = np.linspace(0.08, 0.9, 20)  # parts of a line of sight at which it is tested


@dataclass(frozen=True)
class Shell:
    """M points spread evenly over the guessed surface of a thing that stands on the table."""

    p_W: Array  # (M, 3) [m]
    normal: Array  # (M, 3) unit, outwards

    @property
    def middle(self) -> Array:
        """(3,) [m] of the box around it."""
        return np.asarray(self.p_W.min(axis=0) + self.p_W.max(axis=0)) / 2

    @property
    def radius(self) -> float:
        """[m] of the ball around ``middle`` that holds it."""
        return float(np.linalg.norm(self.p_W - self.middle, axis=1).max())

    def facing(self, eye: Array) -> Bools:
        """Which points face an ``eye`` (3,) [m], (M,)."""
        sight = eye - self.p_W
        return np.asarray(
            np.einsum("mi,mi->m", self.normal, sight) > _GRAZING * np.linalg.norm(sight, axis=1)
        )

    def shown(self, view: View) -> Bools:
        """Which points a view that was taken shows, (M,)."""
        return np.asarray(self.facing(view.X_WC[:3, 3]) & visible(self.p_W, view))


def guessed_shell(points: Array, table_height: float, seed: int) -> Shell:
    """Returns the guessed surface of a thing, see the module.

    Args:
        points: (N, 3) [m] of it, in W.
        table_height: [m] z of the table top.
        seed: decides where on the surface its points lie.

    Raises:
        NoGrasp: the points span no volume above the table.
    """
    feet = points * [1, 1, 0] + [0, 0, table_height]
    corner = np.concatenate([points, feet])
    try:
        hull = ConvexHull(corner)
    except (QhullError, ValueError) as error:
        raise NoGrasp(
            f"{len(points)} points span no volume above the table: show more of the object"
        ) from error
    normal = hull.equations[:, :3]
    a, b, c = np.moveaxis(corner[hull.simplices], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    area[normal[:, 2] < -0.5] = 0.0  # the underside, which nobody can see
    rng = np.random.default_rng(seed)
    face = rng.choice(len(area), _SHELL_POINTS, p=area / area.sum())
    u, v = rng.uniform(size=(2, _SHELL_POINTS))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u)[:, None], np.where(over, 1 - v, v)[:, None]
    p_W = a[face] + u * (b - a)[face] + v * (c - a)[face]
    return Shell(p_W, normal[face])


def standing(points: Array, table_height: float) -> Array:
    """Returns points (M, 3) [m] that fill what was seen down to the table, in W.

    Below what was seen there may be anything of it: no way leads through there.

    Args:
        points: (N, 3) [m].
        table_height: [m] z of the table top.
    """
    top = group_means(voxel_numbers(points, _CELL), points)
    below = np.arange(table_height, points[:, 2].max(initial=table_height), _CELL)
    columns = np.repeat(top[None], len(below), axis=0)
    columns[..., 2] = below[:, None]
    return np.concatenate([points, columns[columns[..., 2] < top[:, 2]]])


def unbarred(shell: Shell, eye: Array, others: DistanceField) -> Bools:
    """Which points of the shell an ``eye`` (3,) [m] would see past the other things, (M,)."""
    line = shell.p_W[:, None] + _SIGHT[:, None] * (eye - shell.p_W)[:, None]
    return np.asarray((others.distance(line) > 0).all(axis=1))


def camera_poses(shell: Shell, camera: Intrinsics, distance: float) -> Array:
    """Returns upright poses around the shell from which a camera sees it whole, (D, 4, 4) X_WC.

    Args:
        shell: what to look at.
        camera: that looks.
        distance: [m] to the shell, at least.
    """
    half = np.arctan(np.array([camera.width / camera.fx, camera.height / camera.fy]).min() / 2)
    far = max(distance + shell.radius, _ROOM * shell.radius / np.sin(half))
    azimuth, elevation = (a.ravel() for a in np.meshgrid(_AZIMUTHS, _ELEVATIONS))
    X_WC = np.zeros((len(azimuth), 4, 4))
    X_WC[:, 3, 3] = 1.0
    away = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    X_WC[:, :3, 0] = np.stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth], axis=1)
    X_WC[:, :3, 1] = np.cross(-away, X_WC[:, :3, 0])
    X_WC[:, :3, 2] = -away
    X_WC[:, :3, 3] = shell.middle + far * away
    return X_WC
