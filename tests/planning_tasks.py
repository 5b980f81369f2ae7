"""Random planning tasks: boxes, walls, posts and lids stand around a block to be grasped."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.planning import SceneGraphCollisionChecker

from tog_drake.distance_field import DistanceField
from tog_drake.errors import NoFeasibleGrasp, NoPlan
from tog_drake.feasibility import FeasibilityConfig, feasible_grasps
from tog_drake.obstacles import Obstacles
from tog_drake.panda import MAX_OPENING, Q_LOWER, Q_UPPER
from tog_drake.planning_model import PlanningModel
from tog_drake.scenario import LOOK_POSTURE
from tog_drake.selector import choose
from tog_drake.values import Array, Candidates, Choice, Grasps, View

_SPACING = 0.006  # [m] between the points of a surface
# Sizes [m] of what stands around, and how high its lower side is: least, most.
_KINDS = {
    "box": ([0.06, 0.06, 0.05], [0.15, 0.15, 0.20], 0.0, 0.0),
    "wall": ([0.15, 0.01, 0.15], [0.40, 0.02, 0.45], 0.0, 0.0),
    "post": ([0.03, 0.03, 0.20], [0.05, 0.05, 0.60], 0.0, 0.0),
    "lid": ([0.10, 0.10, 0.01], [0.30, 0.30, 0.02], 0.25, 0.45),
}


@dataclass(frozen=True)
class PlanningTask:
    """A grasp to plan to, which the robot's own filter holds for feasible."""

    q_now: Array  # (7,) [rad]
    boxes: list[tuple[Array, Array]]  # what is there: the middle's pose in W and the size [m]
    cloud: PointCloud  # points all over the boxes
    candidates: Candidates
    choice: Choice


def planning_tasks(seed: int, planning_model: PlanningModel) -> Iterator[PlanningTask]:
    """Yields tasks without end, up to two of a scene; start, approach and lift are free."""
    rng, config = np.random.default_rng(seed), FeasibilityConfig()
    while True:
        boxes, grasps = _scene(rng)
        cloud = _cloud(boxes)
        obstacles = Obstacles(planning_model, DistanceField(cloud.xyzs().T), MAX_OPENING)
        q_now = np.array(LOOK_POSTURE) + rng.uniform(-0.3, 0.3, 7)
        q_now = np.clip(q_now, Q_LOWER + 0.02, Q_UPPER - 0.02)
        if not _is_free(obstacles, q_now):
            continue
        try:
            feasible = feasible_grasps(grasps, cloud, q_now, planning_model, config)
        except NoFeasibleGrasp:
            continue
        zeros = np.zeros(len(feasible), np.int64)
        candidates = Candidates(feasible, zeros[:1], zeros)
        for row in rng.permutation(len(feasible))[:2]:
            # The filter tests few points of the straight lines, the planner all.
            lines = np.vstack([feasible.q_approach[row], feasible.q_lift[row]])
            clearance = obstacles.cloud_clearance(lines, with_hand=False).min()
            if clearance >= config.cloud_clearance and _is_free(obstacles, lines[0]):
                choice = choose(int(row), View.empty(), candidates, "drawn at random")
                yield PlanningTask(q_now, boxes, cloud, candidates, choice)


def exact_checker(
    planning_model: PlanningModel, task: PlanningTask, margin: float
) -> SceneGraphCollisionChecker:
    """Knows the boxes themselves, not points on them; lets nothing nearer than ``margin`` [m]."""
    checker = cast(SceneGraphCollisionChecker, planning_model.checker.Clone())
    checker.SetPaddingAllRobotEnvironmentPairs(margin)
    checker.SetPaddingAllRobotRobotPairs(margin)
    for i, (X_WB, size) in enumerate(task.boxes):
        world = planning_model.plant.world_body()
        checker.AddCollisionShapeToBody(f"{i}", world, Box(*size), RigidTransform(X_WB))
    return checker


def _is_free(obstacles: Obstacles, q: Array) -> bool:
    try:
        obstacles.require_free(q, "it", "")
    except NoPlan:
        return False
    return True


def _scene(rng: np.random.Generator) -> tuple[list[tuple[Array, Array]], Grasps]:
    """A block somewhere on the table, three to six things around it, and grasps of the block."""
    centre = np.array([rng.uniform(0.35, 0.65), rng.uniform(-0.3, 0.3), 0.0])
    size = rng.uniform([0.08, 0.02, 0.03], [0.16, 0.05, 0.10])
    yaw = rng.uniform(-np.pi, np.pi)
    boxes = [_standing(centre, yaw, size)]
    for _ in range(rng.integers(3, 7)):
        least, most, low, high = _KINDS[str(rng.choice(list(_KINDS)))]
        # Around the block, most on the side from which the arm comes.
        direction = rng.normal(np.arctan2(centre[1], centre[0] - 0.3) + np.pi, 1.0)
        p = centre + rng.uniform(0.08, 0.25) * np.array([np.cos(direction), np.sin(direction), 0.0])
        p[2] = rng.uniform(low, high)
        boxes.append(_standing(p, rng.uniform(-np.pi, np.pi), rng.uniform(least, most)))
    return boxes, _grasps_across(rng, *boxes[0])


def _standing(p: Array, yaw: float, size: Array) -> tuple[Array, Array]:
    """A box whose lower side has its middle at p."""
    X_WB = np.eye(4)
    X_WB[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    X_WB[:3, 3] = p
    X_WB[2, 3] += size[2] / 2
    return X_WB, size


def _cloud(boxes: list[tuple[Array, Array]]) -> PointCloud:
    surfaces = []
    for X_WB, size in boxes:
        axes = [np.linspace(-0.5, 0.5, int(np.ceil(s / _SPACING)) + 1) for s in size]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[(np.abs(grid) == 0.5).any(axis=1)]
        surfaces.append((grid * size) @ X_WB[:3, :3].T + X_WB[:3, 3])
    points = np.concatenate(surfaces)
    cloud = PointCloud(len(points))
    cloud.mutable_xyzs()[:] = points.T
    return cloud


def _grasps_across(rng: np.random.Generator, X_WB: Array, size: Array, count: int = 16) -> Grasps:
    """Grasps across the block's y axis, from above or tilted by up to 70° about it."""
    X_BG = np.zeros((count, 4, 4))
    tilt = rng.uniform(-1.2, 1.2, count)
    X_BG[:, :3, 1] = [0.0, 1.0, 0.0]
    X_BG[:, :3, 2] = np.stack([np.sin(tilt), 0 * tilt, -np.cos(tilt)], axis=-1)
    X_BG[:, :3, 0] = np.cross(X_BG[:, :3, 1], X_BG[:, :3, 2])
    X_BG[:, 0, 3] = rng.uniform(-0.4, 0.4, count) * size[0]
    X_BG[:, 2, 3] = np.maximum(size[2] / 2 - 0.02, 0.02 - size[2] / 2)
    X_BG[:, 3, 3] = 1.0
    X_WG = X_WB @ X_BG
    return Grasps(X_WG, np.full(count, size[1]), np.ones(count), X_WG[:, :3, 3])
