"""What the robot knows of itself and of its world: arm, hand and table, and no camera data.

The same model answers two kinds of question:

- exact ones, by Drake's collision checker (tens of µs a configuration);
- many approximate ones, by spheres that cover the robot and whose centres numpy computes for
  thousands of configurations at once (a few µs a configuration).
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.common import Parallelism
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, SceneGraph
from pydrake.multibody.parsing import (
    LoadModelDirectives,
    ModelDirective,
    ModelDirectives,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Joint, RigidBody
from pydrake.planning import (
    CollisionCheckerParams,
    RobotDiagram,
    RobotDiagramBuilder,
    SceneGraphCollisionChecker,
)

from tog_drake.errors import InputError
from tog_drake.panda import FINGER_JOINT_NAMES, JOINT_NAMES, X_HG, link_frames
from tog_drake.resources import make_package_map, resource_dir
from tog_drake.sphere_cover import SphereCover, cover_shape
from tog_drake.values import Array

PANDA, HAND = "panda", "hand"  # the model instances that planning directives must name so
BASE_LINK = "panda_link0"
MARGIN = 0.005  # [m] that the robot keeps from itself and, but for the hand, from the known world
DEFAULT_DIRECTIVES = "scenes/panda_table.dmd.yaml"

# Bodies of the wrist that never meet, although their shapes overlap or stay close together.
_NEVER_MEET = (
    ("panda_link5", "panda_link7"),
    ("panda_link6", "panda_hand"),
    ("panda_link6", "panda_leftfinger"),
    ("panda_link6", "panda_rightfinger"),
    ("panda_link7", "panda_leftfinger"),
    ("panda_link7", "panda_rightfinger"),
    ("panda_leftfinger", "panda_rightfinger"),
)


@dataclass(frozen=True)
class PlanningModel:
    """Arm, hand and the known world; made by ``MakePlanningModel``.

    Configurations are q (..., 7) [rad] and the opening between the pads [m].
    """

    diagram: RobotDiagram
    plant: MultibodyPlant
    checker: SceneGraphCollisionChecker  # keeps MARGIN, but lets the hand go down to the table
    wary_checker: SceneGraphCollisionChecker  # keeps MARGIN for the hand too
    X_WL0: Array  # (4, 4) where the arm stands
    cover: SphereCover

    def full_positions(self, q: Array, opening: float) -> Array:
        """Returns the plant's positions for arm angles q (..., 7): (..., 9), fingers last."""
        return _full_positions(q, opening)

    def check_configs(
        self, q: Array, opening: float, *, hand_margin: bool = False
    ) -> NDArray[np.bool_]:
        """Tells which of q (N, 7) are free of self-collision and of the known world, (N,).

        The robot keeps ``MARGIN``; the hand keeps it from the known world with ``hand_margin``
        alone, since a grasp of something flat takes it down to the table.

        Joint limits are not checked. Where a distance cannot be computed (FCL gives up on a few
        degenerate contacts) the configuration counts as a collision.
        """
        checker = self.wary_checker if hand_margin else self.checker
        free = np.zeros(len(q), dtype=bool)
        for i, positions in enumerate(self.full_positions(q, opening)):
            # One at a time: an exception inside Drake's parallel batch would end the process.
            try:
                free[i] = checker.CheckConfigCollisionFree(positions)
            except RuntimeError:
                free[i] = False
        return free

    def world_distance(self, p_W: Array) -> float:
        """Returns how far the point p_W (3,) is from the known world [m]; inf beyond 1 m."""
        context, scene_graph = self.diagram.CreateDefaultContext(), self.diagram.scene_graph()
        query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
        robot = {
            geometry
            for body in _robot_bodies(self.plant)
            for geometry in self.plant.GetCollisionGeometriesForBody(body)
        }
        near = query.ComputeSignedDistanceToPoint(p_W, 1.0)
        return min((found.distance for found in near if found.id_G not in robot), default=np.inf)

    def X_WH(self, q: Array) -> Array:
        """Returns the pose of the hand body at q (..., 7): (..., 4, 4)."""
        X_WH: Array = self.X_WL0 @ link_frames(q)[..., 8, :, :]
        return X_WH

    def X_WG(self, q: Array) -> Array:
        """Returns the pose of the grasp frame at q (..., 7): (..., 4, 4)."""
        return self.X_WH(q) @ X_HG

    def spheres(self, q: Array, opening: float) -> tuple[Array, Array, tuple[str, ...]]:
        """Returns spheres that cover the robot's collision geometry.

        Args:
            q: (N, 7) [rad].
            opening: [m].

        Returns:
            Centres in W (N, S, 3) [m], radii (S,) [m] and the name of each sphere's body (S,).
        """
        X_WL = self.X_WL0 @ link_frames(q)[..., :8, :, :]
        return self.cover.centres(X_WL, opening), self.cover.radius, self.cover.body


def MakePlanningModel(
    directives: list[ModelDirective] | None = None,
) -> PlanningModel:
    """Builds what the robot knows from model directives.

    Args:
        directives: the known world; they must name the arm ``panda`` and the hand ``hand``, and
            hold no other joints. None is the Panda on its table.

    Raises:
        InputError: a model or joint is missing, or there are joints too many.
    """
    if directives is None:
        file = resource_dir("models") / DEFAULT_DIRECTIVES
        directives = LoadModelDirectives(file).directives
    plant, diagram, checker = _build(directives)
    X_WL0 = _body_poses(plant, 0.0)[plant.GetBodyByName(BASE_LINK).index()]
    cover = _cover(diagram, X_WL0)
    checker.SetPaddingAllRobotRobotPairs(MARGIN)
    checker.SetPaddingAllRobotEnvironmentPairs(MARGIN)
    wary_checker = cast(SceneGraphCollisionChecker, checker.Clone())
    for body in _robot_bodies(plant):
        if not is_arm(body.name()):
            checker.SetPaddingOneRobotBodyAllEnvironmentPairs(body.index(), 0.0)
    return PlanningModel(diagram, plant, checker, wary_checker, X_WL0, cover)


def is_arm(body: str) -> bool:
    """Tells whether a body of the robot belongs to the arm; all others belong to the hand."""
    return body.startswith("panda_link")


def _build(
    directives: list[ModelDirective],
) -> tuple[MultibodyPlant, RobotDiagram, SceneGraphCollisionChecker]:
    builder = RobotDiagramBuilder(time_step=0.0)
    builder.parser().package_map().AddMap(make_package_map())
    ProcessModelDirectives(ModelDirectives(directives=directives), builder.parser())
    plant = builder.plant()
    plant.Finalize()
    _require_panda(plant)
    _filter_wrist(plant, builder.scene_graph())
    diagram = cast(RobotDiagram, builder.Build())
    params = CollisionCheckerParams(
        model=diagram,
        robot_model_instances=sorted({body.model_instance() for body in _robot_bodies(plant)}),
        edge_step_size=0.05,  # [rad] used by none of ours, but must be given
        implicit_context_parallelism=Parallelism(1),
    )
    return plant, diagram, SceneGraphCollisionChecker(params)


def _filter_wrist(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    manager = scene_graph.collision_filter_manager()
    for pair in _NEVER_MEET:
        first, second = (
            GeometrySet(plant.GetBodyFrameIdOrThrow(plant.GetBodyByName(name).index()))
            for name in pair
        )
        manager.Apply(CollisionFilterDeclaration().ExcludeBetween(first, second))


def _require_panda(plant: MultibodyPlant) -> None:
    found: list[Joint] = []
    for name, joints in ((PANDA, JOINT_NAMES), (HAND, FINGER_JOINT_NAMES)):
        if not plant.HasModelInstanceNamed(name):
            raise InputError(
                f"the planning directives hold no model named '{name}'; add the arm as '{PANDA}' "
                f"and the hand as '{HAND}', as {DEFAULT_DIRECTIVES} does"
            )
        instance = plant.GetModelInstanceByName(name)
        for joint in joints:
            if not plant.HasJointNamed(joint, instance):
                raise InputError(
                    f"model '{name}' of the planning directives has no joint '{joint}': a Panda "
                    "with its hand is needed"
                )
            found.append(plant.GetJointByName(joint, instance))
    if [joint.position_start() for joint in found] != list(range(plant.num_positions())):
        raise InputError(
            "the planning directives must hold the arm, the hand on the arm, and nothing else "
            f"that moves; they have {plant.num_positions()} positions instead of {len(found)}"
        )
    if min(joint.position_lower_limits()[0] for joint in found[-2:]) < 0.0:
        raise InputError(
            f"a finger of model '{HAND}' opens towards negative positions; both must open "
            "towards positive ones (of Drake's own models, hand.urdf does)"
        )


def _full_positions(q: Array, opening: float) -> Array:
    fingers = np.full((*q.shape[:-1], 2), opening / 2)
    return np.concatenate([q, fingers], axis=-1)


def _robot_bodies(plant: MultibodyPlant) -> list[RigidBody]:
    """The base link and every body that moves with the arm (also what is mounted on the hand)."""
    first = plant.GetJointByName(JOINT_NAMES[0], plant.GetModelInstanceByName(PANDA))
    moved = plant.GetBodiesKinematicallyAffectedBy([first.index()])
    return [plant.GetBodyByName(BASE_LINK), *(plant.get_body(index) for index in moved)]


def _cover(diagram: RobotDiagram, X_WL0: Array) -> SphereCover:
    """Covers the robot's collision geometry, placed on the links of the DH table."""
    plant, inspector = diagram.plant(), diagram.scene_graph().model_inspector()
    arm = plant.GetModelInstanceByName(PANDA)
    joints = [plant.GetJointByName(name, arm).index() for name in JOINT_NAMES]
    moved = [plant.GetBodiesKinematicallyAffectedBy([joint]) for joint in joints]
    X_WL = X_WL0 @ link_frames(np.zeros(7))
    # Poses are linear in the opening, so that two values of it tell everything.
    closed, open_1m = _body_poses(plant, 0.0), _body_poses(plant, 1.0)
    rows: list[tuple[int, str, float, Array, Array]] = []
    for body in _robot_bodies(plant):
        link = sum(body.index() in below for below in moved)
        X_LB = np.linalg.solve(X_WL[link], closed[body.index()])
        X_LB_1m = np.linalg.solve(X_WL[link], open_1m[body.index()])
        for geometry in plant.GetCollisionGeometriesForBody(body):
            centres, radius = cover_shape(inspector.GetShape(geometry))
            X_BS = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
            for centre in centres:
                p_B = X_BS @ np.append(centre, 1.0)
                p_L = (X_LB @ p_B)[:3]
                rows.append((link, body.name(), radius, p_L, (X_LB_1m @ p_B)[:3] - p_L))
    rows.sort(key=lambda row: row[0])
    links, names, radii, p_L, dp_L = zip(*rows, strict=True)
    return SphereCover(np.array(radii), names, np.array(links), np.array(p_L), np.array(dp_L))


def _body_poses(plant: MultibodyPlant, opening: float) -> Array:
    """The pose in W of every body at q = 0, (number of bodies, 4, 4)."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, cast(Any, _full_positions(np.zeros(7), opening)))
    bodies = (plant.get_body(BodyIndex(i)) for i in range(plant.num_bodies()))
    return np.array([plant.EvalBodyPoseInWorld(context, b).GetAsMatrix4() for b in bodies])
