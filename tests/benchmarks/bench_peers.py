"""What others need for the same work, beside the rows of ``bench_stages``: ``make bench``."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.perception import DepthImageToPointCloud
from pydrake.solvers import Solve
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.panda import Q_LOWER, Q_UPPER, forward_kinematics
from tog_drake.panda_ik import inverse_kinematics
from tog_drake.planning_model import HAND, MakePlanningModel
from tog_drake.scenario import LOOK_POSTURE
from tog_drake.values import Intrinsics, View, Workspace

POSES = 50


@pytest.fixture(scope="module")
def poses():
    """Poses of the hand's frame that the arm can reach, (POSES, 4, 4), in the frame of link 0."""
    rng = np.random.default_rng(0)
    q = np.clip(LOOK_POSTURE + rng.uniform(-0.5, 0.5, (POSES, 7)), Q_LOWER, Q_UPPER)
    return forward_kinematics(q)


def test_ik_of_50_poses_ours_at_24_q7(poses, benchmark):
    """All branches at 24 values of the free joint, the poses together; the time is of all."""
    q = benchmark(inverse_kinematics, poses, np.linspace(Q_LOWER[6], Q_UPPER[6], 24))
    found = np.isfinite(q).all(axis=-1).any(axis=(1, 2)).mean()
    benchmark.extra_info.update({"poses": POSES, "found": float(found)})


def test_ik_of_50_poses_pydrake_inverse_kinematics(poses, benchmark):
    """Drake's nonlinear program from the posture of the look; the time is of all poses."""
    model = MakePlanningModel()
    hand = model.plant.GetFrameByName("panda_hand", model.plant.GetModelInstanceByName(HAND))
    home = model.full_positions(np.asarray(LOOK_POSTURE), 0.08)

    def solve_all():
        return sum(_solved(model.plant, hand, RigidTransform(model.X_WL0 @ X), home) for X in poses)

    found = benchmark.pedantic(solve_all, rounds=3)
    benchmark.extra_info.update({"poses": POSES, "found": found / POSES})


def _solved(plant, hand, X_WH, home):
    ik = InverseKinematics(plant)
    world, at = plant.world_frame(), X_WH.translation()
    ik.AddPositionConstraint(hand, np.zeros(3), world, at - 1e-3, at + 1e-3)
    ik.AddOrientationConstraint(world, X_WH.rotation(), hand, RigidTransform().rotation(), 1e-2)
    return Solve(ik.prog(), home).is_success()


@pytest.fixture(params=["640x480", "1280x720"])
def depth(request):
    """The depth image of a table 0.5 m below the camera, and the camera."""
    width, height = map(int, request.param.split("x"))
    focal = {480: 609.4, 720: 914.1}[height]
    camera = Intrinsics(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    image = np.full((height, width), 0.5, np.float32)
    image[height // 3 : height // 2, width // 3 : width // 2] = 0.45
    return camera, image


def test_cloud_ours_cropped_thinned_with_normals(depth, benchmark):
    camera, image = depth
    X_WC = np.diag([1.0, -1.0, -1.0, 1.0])
    X_WC[:3, 3] = [0.5, 0.0, 0.5]
    view = View(np.zeros((*image.shape, 3), np.uint8), image, camera, X_WC)
    nobody = np.zeros((0, 3)), np.zeros(0)
    benchmark(scene_cloud, view, Workspace(), CloudConfig(), nobody)


def test_cloud_drake_depth_image_to_point_cloud(depth, benchmark):
    """Drake's C++ system: every pixel to a point of the camera's frame, and nothing else."""
    camera, image = depth
    system = DepthImageToPointCloud(
        CameraInfo(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    )
    given = ImageDepth32F(camera.width, camera.height)
    given.mutable_data[:, :, 0] = image
    context = system.CreateDefaultContext()
    system.depth_image_input_port().FixValue(context, Value(given))

    def convert():
        context.SetAllCacheEntriesOutOfDate()
        return system.point_cloud_output_port().Eval(context)

    assert benchmark(convert).size() == image.size
