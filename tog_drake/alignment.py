"""How far the cameras' poses disagree: a surface that two cameras see must be one surface.

All views are registered to each other at once, the first held fast: the points of each are moved
until they lie in the surfaces of the others (point to plane, Chen and Medioni 1992; robust, by
Gauss-Newton). A camera that shares little with the first is tied to it by those between them. The
points are drawn so that surfaces that are not level, of which a table with things has few, are
well represented (Rusinkiewicz and Levoy 2001).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tog_drake.cloud import Spheres, flying, inside
from tog_drake.denoising import denoised, inverse_depth_noise
from tog_drake.pinhole import unproject_pixels
from tog_drake.points import Rows, group_means, neighbors, surface_normals, voxel_numbers
from tog_drake.values import Array, View, Workspace

TOLERABLE = 0.003  # [m] beyond that, what is fused is thicker by more than a point's spacing
REACH = 0.1  # [m] a turn is weighed by how far it moves what is this far from the middle

_VOXEL = 0.005  # [m]
_EVERY = 4  # pixel of a row, staggered: what is denoised hardly differs from pixel to pixel
_NEIGHBORS = 12  # points that a normal is fitted to
_BELOW = 0.03  # [m] below the table top: of a camera that is off, the table may be there
_PADDING = 0.03  # [m] around the robot: its outline may be off, too
_MAX_SLOPE = 10.0  # as in ``CloudConfig``
_LEVEL = 0.95  # z of a normal from which a surface is level
_DRAWN = (150, 500)  # points of a view that are level, and others, at most
_SAME_SIDE = 0.8  # cosine between normals of one surface
_GATES = np.concatenate([np.geomspace(0.03, 0.004, 10), np.full(4, 0.004)])
# [m] farther apart than this, step by step, two points are not of one surface
_TOLD = 0.008  # a direction is told if it moves the average point by more than the root of this
# along its normal, as a share. Below, it may be the scatter of the normals alone: the turn of a
# bottle about its axis comes to 0.0002, with the noise of an L515 to 0.006; the least that is told
# of a hammer, a pot or a whisk to 0.009 and more.
_MOSTLY = 0.7  # of a shift or turn along an axis, the share that must be told


@dataclass(frozen=True)
class Alignment:
    """How far one camera's pose is off, taken that of the first camera is right."""

    X: Array  # (4, 4) X @ X_WC is its pose, corrected, in the directions that can be told
    shift: float  # [m] of the middle of what the cameras see
    turn: float  # [rad]
    shift_told: bool  # whether the views share enough to say so in every direction
    turn_told: bool

    @property
    def tolerable(self) -> bool:
        """Whether it is off by less than matters, as far as can be told."""
        return max(self.shift, self.turn * REACH) < TOLERABLE

    def said(self, first: str) -> str:
        """For a person: how far the camera is off against ``first``, and what to do about it."""
        if not self.shift_told and self.tolerable:
            return f"its view shares too little with that of {first} to tell"
        turn = f", {np.degrees(self.turn):.1f} deg" if self.turn_told else ""
        untold = "" if self.turn_told else " (how far it is turned, the views do not tell)"
        advice = "" if self.tolerable else ": recalibrate its X_PB"
        return f"{1e3 * self.shift:.1f} mm{turn} off against {first}{untold}{advice}"


@dataclass(frozen=True)
class _Surface:
    """What one view shows of table and things."""

    point: Array  # (N, 3) [m] in W
    normal: Array  # (N, 3)
    tree: cKDTree
    drawn: Rows  # those that are compared with other views


class Aligner(LeafSystem):
    """Says of each camera how far it is off against the first.

    .. pydrake_system::

        name: Aligner
        input_ports:
        - views
        - panda.position_measured
        output_ports:
        - alignments

    ``alignments`` is a dict, camera -> ``Alignment``, without the first; of the cameras as they
    look now, not of earlier looks.

    Args:
        robot_spheres: from the arm's position (7,) [rad] to the balls that cover arm and hand.
    """

    def __init__(self, workspace: Workspace, robot_spheres: Callable[[Array], Spheres]):
        super().__init__()
        self._workspace = workspace
        self._robot_spheres = robot_spheres
        self._views = self.DeclareAbstractInputPort("views", Value(()))
        self._position = self.DeclareVectorInputPort("panda.position_measured", 7)
        self.DeclareAbstractOutputPort(
            "alignments",
            alloc=lambda: Value({}),
            calc=self._CalcAlignments,
            prerequisites_of_calc={self._views.ticket(), self._position.ticket()},
        )

    def _CalcAlignments(self, context: Context, output: Value) -> None:
        images = [image for image in self._views.Eval(context) if image.q is None]
        robot = self._robot_spheres(self._position.Eval(context))
        found = alignments([image.view for image in images], self._workspace, robot)
        output.set_value({i.camera: a for i, a in list(zip(images, found, strict=True))[1:]})


def alignments(
    views: Sequence[View], workspace: Workspace, robot: Spheres | None = None
) -> tuple[Alignment, ...]:
    """Returns how far each camera is off against the first, in the order of the views.

    What is farther apart than 3 cm is not taken for the same surface.

    Args:
        views: at least one; the first is right by definition.
        workspace: what lies outside it is not compared.
        robot: the balls that cover the robot; the points in them are left out.
    """
    surfaces = [_surface(view, workspace, robot) for view in views]
    middle = np.append(np.add(workspace.lower, workspace.upper)[:2] / 2, workspace.table_height)
    things = [s.point[s.drawn] for s in surfaces if len(s.drawn) > 0]
    if things:
        middle = np.median(np.concatenate(things), axis=0)
    X = np.tile(np.eye(4), (len(views), 1, 1))
    told = np.ones((len(views), 6))
    for gate in _GATES if len(views) > 1 else ():
        step, told[1:] = _step(surfaces, X, middle, gate)
        for i, s in enumerate(step, 1):
            X[i] = _moved(s, middle) @ X[i]
    return tuple(_alignment(*of_camera, middle) for of_camera in zip(X, told, strict=True))


def _alignment(X: Array, told: Array, middle: Array) -> Alignment:
    return Alignment(
        X,
        shift=float(np.linalg.norm(X[:3, :3] @ middle + X[:3, 3] - middle)),
        turn=float(np.linalg.norm(Rotation.from_matrix(X[:3, :3]).as_rotvec())),
        shift_told=bool(told[3:].min() > _MOSTLY),
        turn_told=bool(told[:3].min() > _MOSTLY),
    )


def _moved(step: Array, middle: Array) -> Array:
    """The pose change (4, 4) of a turn about the middle, (0:3) [m] at REACH, and a shift, (3:6)."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(step[:3] / REACH).as_matrix()
    X[:3, 3] = middle + step[3:] - X[:3, :3] @ middle
    return X


def _step(
    surfaces: Sequence[_Surface], X: Array, middle: Array, gate: float
) -> tuple[Array, Array]:
    """One step of Gauss and Newton for the C − 1 cameras after the first.

    Returns:
        (C−1, 6) how to move what each view shows, see ``_moved``; (C−1, 6) how much of each of
        these six can be told, from 0 to 1.
    """
    count = 6 * len(surfaces)
    information, gradient = np.zeros((count, count)), np.zeros(count)
    total = 0.0
    for a in range(len(surfaces)):
        for b in range(len(surfaces)):
            if a == b:
                continue
            normal, p, q = _pairs(surfaces[a], X[a], surfaces[b], X[b], gate)
            r = np.einsum("ni,ni->n", normal, p - q)
            weight = 1 / (1 + (4 * r / gate) ** 2) ** 2  # Geman and McClure
            J = np.column_stack([np.cross(p - middle, normal) / REACH, normal])
            square, pull = (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ r
            for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
                information[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] += sign * square
            gradient[6 * b : 6 * b + 6] += pull
            gradient[6 * a : 6 * a + 6] -= pull
            total += weight.sum()
    share, direction = np.linalg.eigh(information[6:, 6:])  # the first stays where it is
    known = share > max(_TOLD * 2 * total / len(surfaces), 1e-9)
    direction = direction[:, known]
    step = -direction @ ((direction.T @ gradient[6:]) / share[known])
    return step.reshape(-1, 6), (direction**2).sum(axis=1).reshape(-1, 6)


def _pairs(
    a: _Surface, X_a: Array, b: _Surface, X_b: Array, gate: float
) -> tuple[Array, Array, Array]:
    """Which drawn points p of b are on a's surface, near its points q with these normals.

    Returns:
        normal, p, q: (N, 3) each, as they are moved.
    """
    p = b.point[b.drawn] @ X_b[:3, :3].T + X_b[:3, 3]
    facing = b.normal[b.drawn] @ X_b[:3, :3].T
    if len(p) == 0 or len(a.point) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    distance, row = a.tree.query((p - X_a[:3, 3]) @ X_a[:3, :3], distance_upper_bound=gate)
    found = np.isfinite(distance)
    p, facing, row = p[found], facing[found], row[found]
    normal = a.normal[row] @ X_a[:3, :3].T
    same = np.einsum("ni,ni->n", normal, facing) > _SAME_SIDE
    q = a.point[row[same]] @ X_a[:3, :3].T + X_a[:3, 3]
    return normal[same], p[same], q


def _surface(view: View, workspace: Workspace, robot: Spheres | None) -> _Surface:
    """What a view shows in the workspace, with the table."""
    view = replace(view, depth=denoised(view.depth, inverse_depth_noise(view.depth)))
    pixel = np.flatnonzero(view.depth > 0)
    width = view.depth.shape[1]
    pixel = pixel[(pixel // width + pixel % width) % _EVERY == 0]
    p_W = unproject_pixels(view, pixel)
    lower = [*workspace.lower[:2], workspace.table_height - _BELOW]
    keep = np.all((p_W > lower) & (p_W < workspace.upper), axis=1)
    pixel, p_W = pixel[keep], p_W[keep]
    p_W = p_W[~flying(view, pixel, _MAX_SLOPE)]
    p_W = group_means(voxel_numbers(p_W, _VOXEL), p_W) if len(p_W) else p_W
    if robot is not None:
        p_W = p_W[~inside(p_W, robot, _PADDING)]
    if len(p_W) == 0:
        return _Surface(p_W, p_W, cKDTree(p_W), np.zeros(0, np.int64))
    near = neighbors(p_W, _NEIGHBORS)
    normal = surface_normals(p_W, near, 2.5 * _VOXEL, view.X_WC[:3, 3])
    level = normal[:, 2] > _LEVEL
    drawn = [_evenly(np.flatnonzero(k), n) for k, n in zip((level, ~level), _DRAWN, strict=True)]
    return _Surface(p_W, normal, cKDTree(p_W), np.concatenate(drawn))


def _evenly(rows: NDArray[np.int64], most: int) -> Rows:
    """At most so many of the rows, evenly spaced."""
    picked: Rows = rows[:: max(1, -(-len(rows) // most))]
    return picked
