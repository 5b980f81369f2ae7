"""What others need for the same work, beside the rows of ``bench_stages``: ``make bench``.

mplib (MIT licence, github.com/haosulab/MPlib) is installed for this alone, from PyPI into an
environment of its own, ``out/mplib-venv``; where that fails its row is skipped, with the reason.
"""

import json
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from planning_tasks import exact_checker, planning_tasks
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.perception import DepthImageToPointCloud
from pydrake.solvers import Solve
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.distance_field import DistanceField
from tog_drake.errors import NoPlan
from tog_drake.obstacles import Obstacles
from tog_drake.panda import (
    A_MAX,
    HAND_YAW,
    J_MAX,
    MAX_OPENING,
    Q_LOWER,
    Q_UPPER,
    V_MAX,
    forward_kinematics,
)
from tog_drake.panda_ik import inverse_kinematics
from tog_drake.planning_model import HAND, MakePlanningModel
from tog_drake.resources import resource_dir
from tog_drake.scenario import LOOK_POSTURE
from tog_drake.time_parameterization import JointLimits
from tog_drake.trajectory import TrajectoryConfig
from tog_drake.transfer import plan_transfer
from tog_drake.values import Intrinsics, View, Workspace

POSES = 50
TASKS, TASK_SEED = 10, 1
TIME_STEP = 0.02  # [s] between the samples of a motion, here and in mplib_plan.py
CONFIG = TrajectoryConfig()
LIMITS = JointLimits(Q_LOWER, Q_UPPER, V_MAX, A_MAX, J_MAX).scaled(CONFIG.speed)
MPLIB = ("mplib==0.2.1", "numpy<2")
MPLIB_VENV = Path(__file__).resolve().parents[2] / "out" / "mplib-venv"


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
    benchmark(scene_cloud, [view], Workspace(), CloudConfig(), nobody)


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


@pytest.fixture(scope="module")
def planning_model():
    return MakePlanningModel()


@pytest.fixture(scope="module")
def tasks(planning_model):
    return list(islice(planning_tasks(TASK_SEED, planning_model), TASKS))


@pytest.fixture
def planner(request, planning_model, tmp_path):
    if request.param == "ours":
        yield OurPlanner(planning_model)
    else:
        yield from mplib_planner(planning_model, tmp_path)


@pytest.mark.parametrize("planner", ["ours", "mplib"], indirect=True)
def test_plan_to_pregrasp(planner, planning_model, tasks, benchmark, capsys):
    """From the posture of the look to the pregrasp, around what stands on the table.

    Each round is another task; both get the same robot, table, points and limits, and the points
    before the clock starts. What differs: ours is given the joint posture (its grasps come with
    one), keeps 1 cm from the points, 5 mm from the robot itself, and the limits of jerk, and its
    time holds a dense check of what it returns. mplib is given the hand's pose and solves the
    inverse kinematics; it keeps no distance, knows no jerk, and interpolates its path after the
    last check. ``free`` is the share of motions found that touch nothing by Drake's exact geometry;
    the tasks were drawn so that both ends are free by our spheres, which are thicker.
    """
    upcoming, found = iter([tasks[0], *tasks]), []  # the first warms up

    def see():
        task = next(upcoming)
        planner.see(task.cloud.xyzs().T)
        return (task.q_now, task.candidates.grasps.q_pregrasp[task.choice.index]), {}

    def plan(q_now, q_pregrasp):
        found.append(planner.plan(q_now, q_pregrasp))

    benchmark.pedantic(plan, setup=see, rounds=TASKS, warmup_rounds=1)
    found = found[-TASKS:]
    for task, motion in zip(tasks, found, strict=False):  # one alone with --benchmark-disable
        if "positions" in motion:
            motion["free"] = is_free(motion.pop("positions"), task, planning_model)
    motions = [motion for motion in found if "seconds" in motion]
    assert motions, found
    info = {
        "found": len(motions) / len(found),
        "free": float(np.mean([motion["free"] for motion in motions])),
        "motion_seconds": float(np.median([motion["seconds"] for motion in motions])),
        "cpu_ms": float(np.median([motion["cpu_ms"] for motion in motions])),
    }
    benchmark.extra_info.update(info, tasks=found)
    with capsys.disabled():
        print(f"\n{planner.name}: {info['found']:.0%} found, {info['free']:.0%} of these free")
        print(f"  medians: motion {info['motion_seconds']:.2f} s, CPU {info['cpu_ms']:.0f} ms")


def is_free(q, task, planning_model):
    checker = exact_checker(planning_model, task, margin=0.0)
    positions = planning_model.full_positions(np.asarray(q), MAX_OPENING)
    return all(checker.CheckConfigCollisionFree(row) for row in positions)


class OurPlanner:
    name = "ours"

    def __init__(self, planning_model):
        self._model = planning_model

    def see(self, points):
        self._obstacles = Obstacles(self._model, DistanceField(points), MAX_OPENING)

    def plan(self, q_now, q_pregrasp):
        way, started = None, time.process_time()
        try:
            way, status = plan_transfer(
                q_now, q_pregrasp, "the way", self._obstacles, LIMITS, CONFIG.transfer, 0
            )
        except NoPlan as error:
            status = str(error)
        answer = {"status": status, "cpu_ms": 1e3 * (time.process_time() - started)}
        if way is not None:
            end = way.end_time()
            positions = way.vector_values(np.linspace(0, end, int(end / TIME_STEP))).T
            answer |= {"seconds": end, "positions": positions}
        return answer


class MplibPlanner:
    """Talks to ``mplib_plan.py``; what passes between is timed, too: a line each way."""

    name = "mplib"

    def __init__(self, process, planning_model):
        self._process, self._model = process, planning_model

    def ask(self, request):
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def see(self, points):
        self.ask({"points": points.tolist()})

    def plan(self, q_now, q_pregrasp):
        q = self._model.full_positions(q_now, MAX_OPENING)
        return self.ask({"q": q.tolist(), "X_WH": self._model.X_WH(q_pregrasp).tolist()})


def mplib_planner(planning_model, folder):
    urdf = folder / "panda_on_table.urdf"
    write_joined_urdf(urdf)
    script = Path(__file__).with_name("mplib_plan.py")
    with (
        (folder / "mplib.log").open("w+") as log,
        subprocess.Popen(
            [mplib_python(), "-I", script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        ) as process,
    ):
        planner = MplibPlanner(process, planning_model)
        velocity, acceleration, _ = (limit.tolist() for limit in LIMITS.rates())
        try:
            planner.ask({"urdf": str(urdf), "velocity": velocity, "acceleration": acceleration})
        except (OSError, json.JSONDecodeError):  # it ended instead of answering
            log.seek(0)
            pytest.skip(f"mplib does not work here: {log.read().strip()[-300:]}")
        yield planner
        process.stdin.close()


def mplib_python():
    """Returns the Python of mplib's own environment, which is made where there is none."""
    python = MPLIB_VENV / "bin" / "python"
    test = [python, "-I", "-c", "import mplib"]
    if python.exists() and subprocess.run(test, capture_output=True).returncode == 0:
        return python
    install = [python, "-m", "pip", "install", "--quiet", *MPLIB]
    for command in ([sys.executable, "-m", "venv", MPLIB_VENV], install, test):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            pytest.skip(f"mplib cannot be installed: {done.stderr.strip()[-300:]}")
    return python


def write_joined_urdf(file):
    """Writes table, arm and hand as one robot: what our planner knows, too."""
    models = resource_dir("models")
    parts = ("scenes/table.urdf", "panda/panda_arm.urdf", "panda/panda_hand.urdf")
    robot, arm, hand = (ElementTree.parse(models / part).getroot() for part in parts)
    robot.extend([*arm, *hand])
    for parent, child, yaw in (
        ("table", "panda_link0", 0.0),
        ("panda_link8", "panda_hand", HAND_YAW),
    ):
        joint = ElementTree.SubElement(robot, "joint", name=f"{child}_weld", type="fixed")
        ElementTree.SubElement(joint, "origin", xyz="0 0 0", rpy=f"0 0 {yaw}")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
    ElementTree.ElementTree(robot).write(file)
