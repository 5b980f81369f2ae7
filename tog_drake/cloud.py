"""From a view to the cloud of what stands on the table: cropped, thinned, with normals."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.errors import InputError, NoGrasp
from tog_drake.pinhole import unproject
from tog_drake.points import clusters, group_means, neighbors, surface_normals, voxel_numbers
from tog_drake.values import Array, View, Workspace

Spheres = tuple[Array, Array]
"""Centres (S, 3) [m] in W and radii (S,) [m] of the balls that cover the robot."""


@dataclass
class CloudConfig:
    """How a view becomes a cloud."""

    voxel: float = 0.003  # [m] one point is kept per cube of this edge: the mean of its points. The
    # geometric selector counts points and expects about this spacing.
    table_clearance: float = 0.004  # [m] what lies lower above the table top counts as table
    normal_neighbors: int = 16  # points that a normal is fitted to
    min_cluster_points: int = 20  # a smaller connected cluster is a speck, and dropped
    min_rise: float = 0.003  # [m] a cluster that rises less above the clearance is table, too
    max_gap: float = 0.010  # [m] points farther apart than this are not connected
    robot_padding: float = 0.015  # [m] the robot's spheres are inflated by this
    max_slope: float = 10.0  # depth change per width; a steeper ramp is no surface but its edge


class SceneCloud(LeafSystem):
    """Turns the view into the cloud of the things on the table.

    .. pydrake_system::

        name: SceneCloud
        input_ports:
        - view
        - panda.position_measured
        output_ports:
        - cloud

    ``panda.position_measured`` is there only when ``robot_spheres`` is: it places the robot, whose
    own points are no things.

    Args:
        robot_spheres: from the arm's position (7,) [rad] to the balls that cover arm and hand.
    """

    def __init__(
        self,
        config: CloudConfig,
        workspace: Workspace,
        *,
        robot_spheres: Callable[[Array], Spheres] | None = None,
    ):
        super().__init__()
        if config.voxel <= 0 or config.normal_neighbors < 3:
            raise InputError(
                f"cloud: voxel ({config.voxel}) must be above 0 [m], normal_neighbors "
                f"({config.normal_neighbors}) at least 3"
            )
        self._config = config
        self._workspace = workspace
        self._robot_spheres = robot_spheres
        self._view = self.DeclareAbstractInputPort("view", Value(View.empty()))
        ports = [self._view]
        if robot_spheres is not None:
            self._position = self.DeclareVectorInputPort("panda.position_measured", 7)
            ports.append(self._position)
        self.DeclareAbstractOutputPort(
            "cloud",
            alloc=lambda: Value(PointCloud(0)),
            calc=self._CalcCloud,
            prerequisites_of_calc={port.ticket() for port in ports},
        )

    def _CalcCloud(self, context: Context, output: Value) -> None:
        robot = None
        if self._robot_spheres is not None:
            robot = self._robot_spheres(self._position.Eval(context))
        view = self._view.Eval(context)
        output.set_value(scene_cloud(view, self._workspace, self._config, robot))


def scene_cloud(
    view: View, workspace: Workspace, config: CloudConfig, robot: Spheres | None = None
) -> PointCloud:
    """Returns the points of the things on the table.

    Args:
        view: the image and where it was taken from.
        workspace: what lies outside it, or not above its table, is left out.
        config: see ``CloudConfig``.
        robot: the balls that cover the robot; the points in them are left out.

    Returns:
        A cloud in W with colours and with unit normals turned towards the camera, in an order that
        depends only on where the points are.

    Raises:
        InputError: the depth image is all holes.
        NoGrasp: nothing is left.
    """
    if not np.any(view.depth > 0):
        raise InputError(
            f"all {view.depth.size} pixels of the depth image are holes (0, NaN or inf): check the "
            "camera and the depth scale"
        )
    floor = max(workspace.lower[2], workspace.table_height + config.table_clearance)
    p_W, rgb = _crop(view, [*workspace.lower[:2], floor], workspace.upper, config.max_slope)
    in_workspace = len(p_W)
    number = voxel_numbers(p_W, config.voxel)
    p_W, rgb = group_means(number, p_W), group_means(number, rgb)
    if robot is not None:
        keep = ~_inside(p_W, robot, config.robot_padding)
        p_W, rgb = p_W[keep], rgb[keep]
    without_robot = len(p_W)
    if without_robot > 0:
        neighborhood = neighbors(p_W, config.normal_neighbors)
        label = clusters(neighborhood, config.max_gap)
        normal = surface_normals(p_W, neighborhood, config.max_gap, view.X_WC[:3, 3])
        keep = np.bincount(label)[label] >= config.min_cluster_points
        keep &= _top(p_W[:, 2], label) > floor + config.min_rise
        p_W, rgb, normal = p_W[keep], rgb[keep], normal[keep]
    if len(p_W) == 0:
        raise NoGrasp(
            f"no object in view: {in_workspace} of {np.count_nonzero(view.depth > 0)} pixels with "
            f"depth lie in the workspace above the table; thinned and without the robot they are "
            f"{without_robot} points, none of them in a cluster of at least "
            f"{config.min_cluster_points} that rises {config.min_rise} m above the table's "
            "clearance. Check the camera's pose, the workspace and the table height"
        )
    return _point_cloud(p_W, rgb, normal)


def _crop(
    view: View, lower: list[float], upper: list[float], max_slope: float
) -> tuple[Array, Array]:
    """The pixels that show a surface inside the box: points (N, 3) in W, colours (N, 3)."""
    p_W = np.moveaxis(unproject(view), -1, 0)
    keep = np.ones(view.depth.shape, dtype=bool)
    for p, low, high in zip(p_W, lower, upper, strict=True):
        keep &= (p > low) & (p < high)  # False for the holes, which are NaN
    pixel = np.flatnonzero(keep)  # much faster than a mask of two dimensions
    pixel = pixel[~_flying(view, pixel, max_slope)]
    return p_W.reshape(3, -1)[:, pixel].T, view.rgb.reshape(-1, 3)[pixel].astype(np.float64)


def _flying(view: View, pixel: NDArray[np.int64], max_slope: float) -> NDArray[np.bool_]:
    """Which pixels are on a ramp between a near surface and a far one, where nothing is in truth.

    Depth cameras blur edges; a surface as steep as ``max_slope`` = tan(84°) they could not see.
    """
    height, width = view.depth.shape
    depth = view.depth.ravel()
    row, column = np.divmod(pixel, width)
    inner = (row > 0) & (row < height - 1) & (column > 0) & (column < width - 1)
    flying = np.zeros(len(pixel), dtype=bool)
    here = depth[pixel[inner]]
    step = here * np.float32(max_slope / view.intrinsics.fx)
    for beside in (1, width):
        before = here - depth[pixel[inner] - beside]
        after = depth[pixel[inner] + beside] - here
        flying[inner] |= (np.minimum(before, after) > step) | (np.maximum(before, after) < -step)
    return flying


def _inside(p_W: Array, spheres: Spheres, padding: float) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in one of the spheres, inflated by ``padding`` [m]."""
    center, radius = spheres
    # |p − c|² = |p|² − 2 p·c + |c|², as a product of matrices
    squared = np.sum(p_W**2, axis=1)[:, None] - 2 * p_W @ center.T + np.sum(center**2, axis=1)
    return np.asarray(np.any(squared < (radius + padding) ** 2, axis=1))


def _top(z: Array, label: NDArray[np.int64]) -> Array:
    """The largest z of the cluster of each point, (N,)."""
    top = np.full(label.max() + 1, -np.inf)
    np.maximum.at(top, label, z)
    return top[label]


def _point_cloud(p_W: Array, rgb: Array, normal: Array) -> PointCloud:
    fields = Fields(BaseField.kXYZs | BaseField.kNormals | BaseField.kRGBs)
    cloud = PointCloud(len(p_W), fields)
    cloud.mutable_xyzs()[:] = p_W.T
    cloud.mutable_normals()[:] = normal.T
    cloud.mutable_rgbs()[:] = np.rint(rgb).T
    return cloud
