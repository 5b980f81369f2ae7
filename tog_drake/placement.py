"""Where the objects lie when an episode begins: poses drawn by the seed, settled by physics."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.common.schema import Transform
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import (
    AddModel,
    ModelDirective,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import RigidBody
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder

from tog_drake.assets.ground import finalize
from tog_drake.assets.library import PACKAGE
from tog_drake.errors import InputError
from tog_drake.resources import make_package_map
from tog_drake.values import Array

_DRAWS = 20  # poses tried for an object before it is dropped onto the others
_RAISE = np.array([0.0, 0.0, 0.02])  # [m] by which it is then raised until it is clear of them
_RAISES = 100  # so often at most: 2 m above all others
_TIME_STEP = 0.005  # [s] nothing is held here, so that the steps may be large
_LOOK = 0.1  # [s] between two looks whether all is at rest
_SLOWED = 0.5  # of its speed is left to everything at each look: what is round would roll on
_REST = 0.001  # [m/s] slower is at rest; of turning, what a point 0.1 m away does
_PATIENCE = 4.0  # [s] what then still moves will roll on
_SCENES = 20  # drops tried until everything comes to rest where it should


@dataclass
class Settle:
    """Objects are dropped from the poses of their directives, and lie where they come to rest.

    In the order of the directives, each pose is drawn until it is clear of the objects before, or
    raised above them. A drop that leaves anything outside the area is drawn anew.
    """

    lower: list[float] = field(default_factory=lambda: [0.40, -0.25])  # [m] x, y of W
    upper: list[float] = field(default_factory=lambda: [0.65, 0.25])  # [m] for centres of mass


def placed(
    directives: Sequence[ModelDirective], seed: int, settle: Settle | None
) -> list[ModelDirective]:
    """Returns copies of the directives in which every pose of a free body is certain.

    Raises:
        InputError: if the objects do not come to rest within the area of ``settle``, or cannot
            be put clear of each other, or a pose is not given in the world's frame.
    """
    if settle is None:
        generator = RandomGenerator(seed)
        return _with_poses(directives, lambda model: _drawn(model, generator))
    text = yaml_dump_typed(ModelDirectives(directives=list(directives)))
    poses = _settled(text, seed, tuple(settle.lower), tuple(settle.upper))
    return _with_poses(directives, lambda model: poses.get(model.name, {}))


Poses = dict[str, Transform]  # of the free bodies of one model, by body


def _with_poses(
    directives: Sequence[ModelDirective], poses: Callable[[AddModel], Poses]
) -> list[ModelDirective]:
    copies = [deepcopy(directive) for directive in directives]
    for directive in copies:
        model = directive.add_model
        if model is not None:
            # Drake hands out a copy of the mapping, so it is assigned as a whole.
            model.default_free_body_pose = poses(model)
    return copies


def _drawn(model: AddModel, generator: RandomGenerator) -> Poses:
    poses = {}
    for body, pose in model.default_free_body_pose.items():
        poses[body] = pose
        if not pose.IsDeterministic():
            poses[body] = Transform(pose.Sample(generator))
            poses[body].base_frame = pose.base_frame
    return poses


@lru_cache(maxsize=64)  # scenes that are looked at more than once: one for each task and selector
def _settled(
    text: str, seed: int, lower: tuple[float, ...], upper: tuple[float, ...]
) -> dict[str, Poses]:
    """Returns where the objects of directives (YAML) come to rest, by model."""
    directives = yaml_load_typed(schema=ModelDirectives, data=text)
    table = _Table(directives)
    generator = RandomGenerator(seed)
    trouble = ""
    for _ in range(_SCENES):
        simulator = Simulator(table.diagram)
        context = table.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        table.drop(context, generator)
        trouble = table.fall(simulator, context, np.array(lower), np.array(upper))
        if not trouble:
            return table.poses(context)
    raise InputError(
        f"settle: dropped {_SCENES} times, at last {trouble}; give the objects more room or fewer "
        "of them, or poses nearer to the table"
    )


def _check_base_frames(directives: ModelDirectives) -> None:
    for model in (d.add_model for d in directives.directives if d.add_model is not None):
        for pose in model.default_free_body_pose.values():
            if pose.base_frame not in (None, "", "world"):
                raise InputError(
                    f"settle: the default_free_body_pose of {model.name} has base_frame "
                    f"{pose.base_frame!r}; objects are dropped in the world's frame: leave it out, "
                    "or give world"
                )


class _Table:
    """The world without robot and cameras, to drop things on."""

    def __init__(self, directives: ModelDirectives):
        builder = DiagramBuilder()
        scanned = any(
            d.add_model is not None and d.add_model.file.startswith(f"package://{PACKAGE}/")
            for d in directives.directives
        )
        config = MultibodyPlantConfig(
            time_step=_TIME_STEP,
            contact_model="hydroelastic_with_fallback",
            # The calmest at such steps, but round things with rigid cores creep on and on with it.
            discrete_contact_approximation="lagged" if scanned else "sap",
        )
        self.plant, scene_graph = AddMultibodyPlant(config, builder)
        parser = Parser(self.plant)
        parser.package_map().AddMap(make_package_map())
        _check_base_frames(directives)
        without_poses = _with_poses(directives.directives, lambda model: {})
        ProcessModelDirectives(ModelDirectives(directives=without_poses), parser)
        finalize(self.plant, scene_graph)
        self.diagram = builder.Build()
        self._objects = [
            (self.plant.GetBodyByName(body, self.plant.GetModelInstanceByName(model.name)), pose)
            for model in (d.add_model for d in directives.directives if d.add_model is not None)
            for body, pose in model.default_free_body_pose.items()
        ]

    def drop(self, context: Context, generator: RandomGenerator) -> None:
        """Puts each object where it is drawn to be, clear of the table and of those before it."""
        for i, (body, _) in enumerate(self._objects):
            self.plant.SetFreeBodyPose(context, body, RigidTransform([10.0 + i, 0.0, 10.0]))  # away
        for body, pose in self._objects:
            for _ in range(_DRAWS):
                X_WB = pose.Sample(generator)
                if self._is_clear(context, body, X_WB):
                    break
            self._raise_until_clear(context, body, X_WB)

    def _raise_until_clear(self, context: Context, body: RigidBody, X_WB: RigidTransform) -> None:
        for _ in range(_RAISES):
            if self._is_clear(context, body, X_WB):
                return
            X_WB = RigidTransform(X_WB.rotation(), X_WB.translation() + _RAISE)
        remedy = "give it a default_free_body_pose above the table"
        if without := self._without_pose():
            remedy = f"give these a default_free_body_pose too: {', '.join(without)}"
        raise InputError(
            f"settle: {self._name(body)} cannot be put clear of the others, not even "
            f"{_RAISES * _RAISE[2]:g} m above its pose; {remedy}"
        )

    def _without_pose(self) -> list[str]:
        """Names of the free objects that stay where their models or other directives put them."""
        dropped = {body.index() for body, _ in self._objects}
        free = self.plant.GetFloatingBaseBodies()
        return sorted(self._name(self.plant.get_body(i)) for i in free - dropped)

    def _is_clear(self, context: Context, body: RigidBody, X_WB: RigidTransform) -> bool:
        self.plant.SetFreeBodyPose(context, body, X_WB)
        query_object = self.plant.get_geometry_query_input_port().Eval(context)
        return not query_object.HasCollisions()

    def fall(self, simulator: Simulator, context: Context, lower: Array, upper: Array) -> str:
        """Simulates until all is at rest; returns what is wrong with it, nothing if all is well."""
        calm = 0
        while calm < 2:  # an object that turns round in the air is slow for a moment
            if context.get_time() >= _PATIENCE:
                return f"{self._fastest(context)} still moved after {_PATIENCE:g} s"
            simulator.AdvanceTo(context.get_time() + _LOOK)
            calm = calm + 1 if max(self._speeds(context), default=0.0) < _REST else 0
            self.plant.SetVelocities(context, _SLOWED * self.plant.GetVelocities(context))
        for body, _ in self._objects:
            p_WCom = body.EvalPoseInWorld(context) @ body.CalcCenterOfMassInBodyFrame(context)
            if (p_WCom[:2] < lower).any() or (p_WCom[:2] > upper).any() or p_WCom[2] < 0.0:
                return f"{self._name(body)} came to rest at {np.round(p_WCom, 2).tolist()}"
        return ""

    def _speeds(self, context: Context) -> list[float]:
        speeds = []
        for body, _ in self._objects:
            V = body.EvalSpatialVelocityInWorld(context)
            speeds.append(
                float(np.linalg.norm(V.translational()) + 0.1 * np.linalg.norm(V.rotational()))
            )
        return speeds

    def _fastest(self, context: Context) -> str:
        return self._name(self._objects[int(np.argmax(self._speeds(context)))][0])

    def _name(self, body: RigidBody) -> str:
        return str(self.plant.GetModelInstanceName(body.model_instance()))

    def poses(self, context: Context) -> dict[str, Poses]:
        """Returns where the objects are, by model."""
        poses: dict[str, Poses] = {}
        for body, _ in self._objects:
            X_WB = Transform(body.EvalPoseInWorld(context))
            poses.setdefault(self._name(body), {})[body.name()] = X_WB
        return poses
