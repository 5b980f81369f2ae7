"""The scenario: one YAML file that says what is in the world, who looks, and how it is decided.

The vocabulary is Drake's (``directives``, ``cameras``, ``plant_config``, ``simulator_config`` ...)
plus ``planning_directives``, the part of the world that the robot knows, and ``pipeline``.
Config dataclasses are not frozen, because Drake's YAML loader fills them field by field.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import yaml
from pydrake.common.yaml import yaml_load_typed
from pydrake.multibody.parsing import AddDirectives, ModelDirective
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.sensors import CameraConfig

from tog_drake.assets.library import PACKAGE, asset_dir
from tog_drake.assets.model import CORE_FILE, MODEL
from tog_drake.assets.surface import read_core
from tog_drake.cameras import L515, Camera, drake_config
from tog_drake.errors import InputError
from tog_drake.hardware.config import HardwareConfig
from tog_drake.pipeline import PipelineConfig
from tog_drake.placement import Settle, placed
from tog_drake.resources import make_package_map, scenario_files
from tog_drake.schema_check import check_yaml

SIDE_CAMERAS = "side_cameras"  # the scenario that has them
MAX_SCENARIO_BYTES = 1_000_000  # a scenario is a page; anything larger is not one
MAX_GRIP_FORCE = 140.0  # [N] the Franka hand's, for a moment (data sheet; 70 N continuously)
MAX_FRICTION = 2.0  # rubber on rubber; more is a slip of the pen

# The wrist camera half a metre above the table's middle, tilted 24° [rad].
LOOK_POSTURE = (0.0, -0.9564, 0.0, -2.7824, 0.0, 2.2558, 0.7853)


@dataclass
class Primitives:
    """The arm and hand of this project, made of primitive shapes: `!Primitives {}`."""

    url: ClassVar[str] = "package://tog_drake/panda/panda.dmd.yaml"


@dataclass
class DrakeModels:
    """Drake's own Franka models, which Drake downloads at first use: `!DrakeModels {}`."""

    url: ClassVar[str] = "package://tog_drake/panda/drake_models.dmd.yaml"


@dataclass
class Scenario:
    """What ``tog run`` runs."""

    random_seed: int = 0
    """Seeds everything that is random: object poses, proposals, candidates, plans."""
    robot: Primitives | DrakeModels = field(default_factory=Primitives)
    """The model of arm (instance `panda`) and hand (instance `hand`), on a table at z = 0."""
    directives: list[ModelDirective] = field(default_factory=list)
    """The world around the robot. A stochastic `default_free_body_pose` is drawn by the seed."""
    asset: str | None = None
    """An imported object (`tog assets list`) that stands among them as in its file, turned any way;
    its name is that of its model."""
    settle: Settle | None = None
    """Where given, `settle: {}`, the objects fall from these poses and come to rest."""
    planning_directives: list[ModelDirective] = field(default_factory=lambda: [_table()])
    """What the robot knows of that world. It does not know the objects."""
    initial_position: dict[str, dict[str, float]] = field(
        default_factory=lambda: {
            "panda": {f"panda_joint{i}": q for i, q in enumerate(LOOK_POSTURE, 1)},
            "hand": {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04},
        }
    )
    """Joint positions at the start [rad or m]: looking at the table with the hand open."""
    grip_force: float = 70.0
    """The greatest force of each finger [N]; the hand's data sheet gives 70, at most 140."""
    object_friction: float | None = None
    """Replaces the friction coefficient of every free object and of the fingers."""
    cameras: dict[str, Camera] = field(default_factory=lambda: {"wrist": L515()})
    """RGB-D cameras by name."""
    plant_config: MultibodyPlantConfig = field(
        default_factory=lambda: MultibodyPlantConfig(
            time_step=0.005,
            contact_model="hydroelastic_with_fallback",
            discrete_contact_approximation="lagged",
        )
    )
    """How contact is simulated. TAMSI cannot couple the fingers and is refused."""
    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(target_realtime_rate=0.0)
    )
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    hardware: HardwareConfig | None = None
    """The real robot of this scenario, for `tog hardware`."""


def _table() -> ModelDirective:
    return ModelDirective(
        add_directives=AddDirectives(file="package://tog_drake/scenes/table.dmd.yaml")
    )


def load_scenario(
    name_or_file: str, text: str | None = None, *, seed: int | None = None
) -> Scenario:
    """Loads a scenario by name or from a file.

    Args:
        name_or_file: which.
        text: YAML that overrides single fields of it.
        seed: overrides its ``random_seed``.

    Raises:
        InputError: if there is no such scenario, or a field or tag of it is unknown.
    """
    files = scenario_files()
    path = files.get(name_or_file, Path(name_or_file))
    if not path.is_file():
        raise InputError(
            f"unknown scenario {name_or_file!r}; valid: {', '.join(files)}, or a YAML file"
        )
    if path.stat().st_size > MAX_SCENARIO_BYTES:
        raise InputError(f"{path} is larger than {MAX_SCENARIO_BYTES} bytes: not a scenario")
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read scenario {path}: {error}; valid: YAML in UTF-8") from error
    scenario = parse_scenario(content, str(path), Scenario())
    if text:
        scenario = parse_scenario(text, "--scenario-text", scenario)
    if seed is not None:
        scenario.random_seed = seed
    return scenario


def with_side_cameras(cameras: dict[str, Camera]) -> dict[str, Camera]:
    """Returns the cameras with those of the scenario ``side_cameras``; names in both stay."""
    side = load_scenario(SIDE_CAMERAS).cameras
    return cameras | {name: camera for name, camera in side.items() if name not in cameras}


def parse_scenario(content: str, source: str, defaults: Scenario) -> Scenario:
    """Returns ``defaults`` with the fields of the YAML ``content`` in their place.

    Raises:
        InputError: naming ``source``, the field, what was given and what would be valid.
    """
    checked = check_yaml(Scenario, content, source)
    try:
        scenario: Scenario = yaml_load_typed(
            schema=Scenario, data=checked, defaults=defaults, retain_map_defaults=True
        )
    except (RuntimeError, ValueError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise InputError(f"{source}: {error}") from error
    _check(scenario, source)
    return scenario


def _check(scenario: Scenario, source: str) -> None:
    """Raises InputError for a value that is of the right type, but senseless."""
    if scenario.random_seed < 0:
        raise InputError(f"{source}: random_seed must not be below 0, not {scenario.random_seed}")
    if not 0 < scenario.grip_force <= MAX_GRIP_FORCE:
        raise InputError(
            f"{source}: grip_force must be above 0 and at most {MAX_GRIP_FORCE:g} N, not "
            f"{scenario.grip_force:g}"
        )
    friction = scenario.object_friction
    if friction is not None and not 0 < friction <= MAX_FRICTION:
        raise InputError(
            f"{source}: object_friction must be above 0 and at most {MAX_FRICTION:g}, or left out "
            f"for what each model says, not {friction:g}"
        )
    settle = scenario.settle
    if settle is not None and not (
        len(settle.lower) == len(settle.upper) == 2
        and all(low < high for low, high in zip(settle.lower, settle.upper, strict=True))
    ):
        raise InputError(
            f"{source}: settle: lower {settle.lower} and upper {settle.upper} must be two numbers "
            "each [m], x and y, every lower below its upper"
        )
    if scenario.plant_config.discrete_contact_approximation == "tamsi":
        raise InputError(
            f"{source}: plant_config.discrete_contact_approximation: tamsi ignores the coupling "
            "of the fingers and the joint gains; valid: lagged, similar, sap"
        )


def sampled_directives(scenario: Scenario) -> list[ModelDirective]:
    """Returns the directives of robot and world, the objects where an episode begins.

    Raises:
        InputError: if the scenario settles its objects and they do not come to rest.
    """
    world = placed(world_directives(scenario), scenario.random_seed, scenario.settle)
    return [robot_directive(scenario), *world]


def world_directives(scenario: Scenario) -> list[ModelDirective]:
    """Returns the directives of the world around the robot, with that of ``asset``.

    Raises:
        InputError: if that object is not imported, saying how it is.
    """
    if scenario.asset is None:
        return scenario.directives
    folder = asset_dir(scenario.asset)
    vertices, _ = read_core(folder / CORE_FILE)
    z = 0.001 - vertices[:, 2].min()
    directive: ModelDirective = yaml_load_typed(
        schema=ModelDirective,
        data=f"""
add_model:
  name: {scenario.asset}
  file: package://{PACKAGE}/{scenario.asset}/{MODEL}
  default_free_body_pose:
    base:
      translation: !UniformVector {{ min: [0.52, -0.08, {z}], max: [0.60, 0.08, {z}] }}
      rotation: !Rpy {{ deg: !UniformVector {{ min: [0, 0, -180], max: [0, 0, 180] }} }}
""",
    )
    return [*scenario.directives, directive]


def robot_directive(scenario: Scenario) -> ModelDirective:
    """Returns the directive that adds arm and hand."""
    return ModelDirective(add_directives=AddDirectives(file=scenario.robot.url))


def camera_configs(scenario: Scenario) -> dict[str, CameraConfig]:
    """Returns the scenario's cameras in Drake's terms."""
    return {name: drake_config(camera) for name, camera in scenario.cameras.items()}


def model_files(scenario: Scenario) -> dict[str, Path]:
    """Returns the file of each model that the scenario's own directives and ``asset`` add, by name.

    Raises:
        InputError: if there is no such file or package, or an object is not imported.
    """
    packages = make_package_map()
    models = [d.add_model for d in world_directives(scenario) if d.add_model is not None]
    for model in models:
        if model.file.startswith(f"package://{PACKAGE}/"):
            asset_dir(model.file.split("/")[3])
    try:
        return {model.name: Path(packages.ResolveUrl(model.file)) for model in models}
    except RuntimeError as error:
        raise InputError(
            f"a model of the scenario cannot be found: {error}; valid: a file that is there"
        ) from error
