"""From views to the cloud of what stands on the table: cropped, thinned, with normals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.denoising import Image, denoised, inverse_depth_noise
from tog_drake.errors import InputError, NoGrasp, NoImage
from tog_drake.fusion import EXACT, Surface, fused
from tog_drake.pinhole import unproject_pixels
from tog_drake.points import (
    clusters,
    group_means,
    neighbors,
    surface_normals,
    voxel_numbers,
)
from tog_drake.values import Array, CameraView, View, Workspace

_NEAR_TABLE = 0.02  # [m] points so close to the table's height tell how noisy it is
_BINS = 6  # into which they are sorted by depth
_MIN_TABLE = 100  # points a bin needs

Spheres = tuple[Array, Array]
"""Centres (S, 3) [m] in W and radii (S,) [m] of the balls that cover the robot."""


@dataclass
class CloudConfig:
    """How a view becomes a cloud."""

    fuse: bool = False  # the views of all cameras, not of the pipeline's own alone
    voxel: float = 0.003  # [m] one point is kept per cube of this edge: the mean of its points. The
    # geometric selector counts points and expects about this spacing.
    table_clearance: float = 0.004  # [m] what lies lower above the table top counts as table
    normal_neighbors: int = 16  # points that a normal is fitted to
    min_cluster_points: int = 20  # a smaller connected cluster is a speck, and dropped
    min_rise: float = 0.003  # [m] a cluster that rises less above the clearance is table, too
    noise_margin: float = 2.5  # standard deviations of the table's own points that count as table
    min_fill: float = 0.1  # of noisy depth: a cube is kept if it holds this share of the pixels
    # that a surface seen squarely would put into it
    max_gap: float = 0.010  # [m] points farther apart than this are not connected
    robot_padding: float = 0.015  # [m] the robot's spheres are inflated by this
    max_slope: float = 10.0  # depth change per width; a steeper ramp is no surface but its edge


class SceneCloud(LeafSystem):
    """Turns the view, or all views, into the cloud of the things on the table.

    .. pydrake_system::

        name: SceneCloud
        input_ports:
        - view
        - panda.position_measured
        output_ports:
        - cloud

    With ``fuse`` it reads ``views``, of all cameras, in place of ``view``.
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
        if config.fuse:
            self._images = self.DeclareAbstractInputPort("views", Value(()))
        else:
            self._images = self.DeclareAbstractInputPort("view", Value(View.empty()))
        ports = [self._images]
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
        images = self._images.Eval(context)
        taken = images if self._config.fuse else [CameraView("", images)]
        robots: list[Spheres | None] = [None] * len(taken)
        if self._robot_spheres is not None:
            q_now = self._position.Eval(context)
            robots = [self._robot_spheres(q_now if v.q is None else v.q) for v in taken]
        views = [image.view for image in taken]
        output.set_value(scene_cloud(views, self._workspace, self._config, robots))


def scene_cloud(
    views: Sequence[View],
    workspace: Workspace,
    config: CloudConfig,
    robots: Sequence[Spheres | None] | None = None,
) -> PointCloud:
    """Returns the points of the things on the table.

    Args:
        views: the images and where they were taken from, at least one.
        workspace: what lies outside it, or not above its table, is left out.
        config: see ``CloudConfig``.
        robots: of each view the balls that covered the robot when it was taken; the points in them
            are left out.

    Returns:
        A cloud in W with colours and with unit normals turned towards the cameras that saw them,
        in an order that depends only on where the points are.

    Raises:
        NoImage: a depth image is all holes.
        NoGrasp: nothing is left.
    """
    robots = robots or [None] * len(views)
    seen = [
        _seen(view, workspace, config, robot) for view, robot in zip(views, robots, strict=True)
    ]
    surface = seen[0] if len(seen) == 1 else fused(seen, config.voxel)
    keep = _of_things(surface, workspace, config)
    if not keep.any():
        raise NoGrasp(
            f"no object in view: {surface.pixels} of "
            f"{sum(np.count_nonzero(view.depth > 0) for view in views)} pixels with "
            f"depth lie in the workspace above the table; thinned and without the robot they are "
            f"{len(surface.p_W)} points, none of them in a cluster of at least "
            f"{config.min_cluster_points} that rises {config.min_rise} m above the table's "
            "clearance. Check the camera's pose, the workspace and the table height"
        )
    return _point_cloud(surface.p_W[keep], surface.rgb[keep], surface.normal[keep])


def _seen(view: View, workspace: Workspace, config: CloudConfig, robot: Spheres | None) -> Surface:
    """What one view shows."""
    if not np.any(view.depth > 0):
        raise NoImage(
            f"all {view.depth.size} pixels of the depth image are holes (0, NaN or inf): check the "
            "camera and the depth scale"
        )
    view = replace(view, depth=denoised(view.depth, inverse_depth_noise(view.depth)))
    pixel, noise = _standing_out(view, workspace, config)
    p_W, rgb, noise = _thinned(view, pixel, noise, config)
    if robot is not None:
        keep = ~inside(p_W, robot, config.robot_padding)
        p_W, rgb, noise = p_W[keep], rgb[keep], noise[keep]
    normal = np.zeros((0, 3))
    if len(p_W) > 0:
        neighborhood = neighbors(p_W, config.normal_neighbors)
        normal = surface_normals(p_W, neighborhood, config.max_gap, view.X_WC[:3, 3])
    return Surface(p_W, rgb, noise, normal, len(pixel))


def _of_things(surface: Surface, workspace: Workspace, config: CloudConfig) -> NDArray[np.bool_]:
    """Which points are in no speck and no bump of the table, (N,)."""
    p_W, noise = surface.p_W, surface.noise
    if len(p_W) == 0:
        return np.zeros(0, dtype=bool)
    label = clusters(neighbors(p_W, config.normal_neighbors), config.max_gap)
    keep = np.bincount(label)[label] >= config.min_cluster_points
    rise = p_W[:, 2] - workspace.table_height - _margin(noise, workspace, config)
    keep &= np.bincount(label, rise > np.maximum(config.min_rise, noise))[label] > 0
    return keep


def _standing_out(
    view: View, workspace: Workspace, config: CloudConfig
) -> tuple[NDArray[np.int64], Array]:
    """The pixels that show a surface in the workspace above the table, (N,), and how noisy the
    table is at their depth, (N,) [m]."""
    height = _height(view) - np.float32(workspace.table_height)
    upper = workspace.upper[2] - workspace.table_height
    least = _margin(np.zeros(1), workspace, config)
    pixel = np.flatnonzero((height > least) & (height < upper))  # not the holes, NaN
    noise = np.interp(view.depth.ravel()[pixel], *_table_noise(view.depth, height))
    above = height.ravel()[pixel] > _margin(noise, workspace, config)
    pixel, noise = pixel[above], noise[above]
    p_W = unproject_pixels(view, pixel)[:, :2]
    keep = np.all((p_W > workspace.lower[:2]) & (p_W < workspace.upper[:2]), axis=1)
    keep &= ~flying(view, pixel, config.max_slope)
    return pixel[keep], noise[keep]


def _margin(noise: Array, workspace: Workspace, config: CloudConfig) -> Array:
    """Up to which height above the table [m] a point may be one of the table's."""
    clearance = max(config.table_clearance, workspace.lower[2] - workspace.table_height)
    return np.maximum(clearance, config.noise_margin * noise)


def _height(view: View) -> NDArray[np.float32]:
    """Height in W of what every pixel shows, (H, W) [m]; NaN in holes."""
    camera = view.intrinsics
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    R = view.X_WC[2, :3]
    along, down = (R[0] * x).astype(np.float32), (R[1] * y + R[2]).astype(np.float32)
    height: Image = along + down[:, None]
    height *= view.depth
    height += np.float32(view.X_WC[2, 3])
    height[view.depth <= 0] = np.nan
    return height


def _table_noise(depth: Image, height: Image) -> tuple[Array, Array]:
    """How noisy the table's own points are, by their depth: (K,) [m] and (K,) [m], the standard
    deviation of their height. 0 where hardly any table is seen."""
    depth, height = depth[::4, ::4], height[::4, ::4]
    near = np.abs(height) < _NEAR_TABLE
    order = np.argsort(depth[near])
    if len(order) < _BINS * _MIN_TABLE:
        return np.zeros(1), np.zeros(1)
    parts = [(depth[near][i], height[near][i]) for i in np.array_split(order, _BINS)]
    spread = [1.4826 * np.median(np.abs(h - np.median(h))) for _, h in parts]
    return np.array([np.median(d) for d, _ in parts]), np.array(spread)


def _thinned(
    view: View, pixel: NDArray[np.int64], noise: Array, config: CloudConfig
) -> tuple[Array, Array, Array]:
    """Means of points, colours and noise over each cube that enough of the pixels fall in."""
    p_W = unproject_pixels(view, pixel)
    number = voxel_numbers(p_W, config.voxel)
    mean = group_means(number, np.column_stack([p_W, view.rgb.reshape(-1, 3)[pixel], noise]))
    p_W, rgb, noise = mean[:, :3], mean[:, 3:6], mean[:, 6]
    # Pixels on a surface of a cube's size that is seen squarely.
    distance = np.linalg.norm(p_W - view.X_WC[:3, 3], axis=1)
    full = (config.voxel * view.intrinsics.fx / distance) ** 2
    keep = (np.bincount(number) >= config.min_fill * full) | (noise < EXACT)
    return p_W[keep], rgb[keep], noise[keep]


def flying(view: View, pixel: NDArray[np.int64], max_slope: float) -> NDArray[np.bool_]:
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


def inside(p_W: Array, spheres: Spheres, padding: float) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in one of the spheres, inflated by ``padding`` [m]."""
    center, radius = spheres
    # |p − c|² = |p|² − 2 p·c + |c|², as a product of matrices
    squared = np.sum(p_W**2, axis=1)[:, None] - 2 * p_W @ center.T + np.sum(center**2, axis=1)
    return np.asarray(np.any(squared < (radius + padding) ** 2, axis=1))


def _point_cloud(p_W: Array, rgb: Array, normal: Array) -> PointCloud:
    fields = Fields(BaseField.kXYZs | BaseField.kNormals | BaseField.kRGBs)
    cloud = PointCloud(len(p_W), fields)
    cloud.mutable_xyzs()[:] = p_W.T
    cloud.mutable_normals()[:] = normal.T
    cloud.mutable_rgbs()[:] = np.rint(rgb).T
    return cloud
