"""The Panda: its frames, its model files, and what the robot knows of itself."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Role,
    Shape,
    Sphere,
    TriangleSurfaceMesh,
    VolumeMesh,
)
from pydrake.multibody.parsing import (
    LoadModelDirectives,
    ModelDirective,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import PdControllerGains
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder

from tog_drake import panda
from tog_drake.errors import InputError
from tog_drake.planning_model import MakePlanningModel, PlanningModel
from tog_drake.resources import make_package_map, resource_dir
from tog_drake.sphere_cover import MARGIN, cover_shape
from tog_drake.values import Array

HOME = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])
FOLDED = np.array([0.0, -1.0, 0.0, -3.0, 0.0, 0.0, 0.0])  # the hand inside the upper arm
MODELS = resource_dir("models")
SCENE = MODELS / "scenes" / "panda_table.dmd.yaml"


@pytest.fixture(scope="module")
def model() -> PlanningModel:
    return MakePlanningModel()


def random_configurations(count: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(panda.Q_LOWER, panda.Q_UPPER, (count, 7))


def context_at(model: PlanningModel, q: Array, opening: float) -> Context:
    """A context of the planning model's plant at one configuration."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, model.full_positions(q, opening))
    return context


def pose(model: PlanningModel, context: Context, body: str) -> Array:
    return model.plant.GetBodyByName(body).EvalPoseInWorld(context).GetAsMatrix4()


# Frames.


def test_forward_kinematics_are_those_of_the_published_table_worked_by_hand() -> None:
    # At q = 0 the arm stands upright: 0.333 + 0.316 + 0.384 up, 0.088 forwards, then down.
    X_L0H = panda.forward_kinematics(np.zeros(7))
    np.testing.assert_allclose(
        X_L0H[:3, 3], [0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107], atol=1e-12
    )
    np.testing.assert_allclose(X_L0H[:3, 2], [0.0, 0.0, -1.0], atol=1e-12)
    # Turning the first joint turns everything about the vertical.
    X_turned = panda.forward_kinematics(np.array([0.7, 0, 0, 0, 0, 0, 0]))
    R = AngleAxis(0.7, [0.0, 0.0, 1.0]).rotation()
    np.testing.assert_allclose(X_turned[:3], R @ X_L0H[:3], atol=1e-12)


def test_the_model_file_agrees_with_the_table_at_every_link(model: PlanningModel) -> None:
    names = [f"panda_link{i}" for i in range(8)] + ["panda_hand"]
    for q in random_configurations(20):
        context = context_at(model, q, 0.0)
        expected = np.array([pose(model, context, name) for name in names])
        np.testing.assert_allclose(panda.link_frames(q), expected, rtol=0, atol=1e-9)


def test_forward_kinematics_take_any_shape_of_batch() -> None:
    q = random_configurations(6).reshape(2, 3, 7)
    batch = panda.forward_kinematics(q)
    assert batch.shape == (2, 3, 4, 4)
    np.testing.assert_array_equal(batch[1, 2], panda.forward_kinematics(q[1, 2]))


def test_the_grasp_frame_lies_midway_between_the_pads(model: PlanningModel) -> None:
    context = context_at(model, HOME, 0.06)
    X_WG = model.X_WG(HOME)
    pads = {}
    for side in ("left", "right"):
        body = model.plant.GetBodyByName(f"panda_{side}finger")
        pads[side] = min(corners_in(model, context, body.name(), X_WG), key=lambda box: -box[1][2])
    for lower, upper in pads.values():
        np.testing.assert_allclose((lower + upper)[[0, 2]] / 2, 0.0, atol=1e-12)
        np.testing.assert_allclose((upper - lower)[0], panda.PAD_WIDTH, atol=1e-12)
    assert pads["left"][0][1] == pytest.approx(0.03, abs=1e-12)
    assert pads["right"][1][1] == pytest.approx(-0.03, abs=1e-12)


def corners_in(
    model: PlanningModel, context: Context, body: str, X_WF: Array
) -> list[tuple[Array, Array]]:
    """Corners, in F, of a body's collision boxes, which must be aligned with F."""
    inspector = model.diagram.scene_graph().model_inspector()
    X_FB = np.linalg.inv(X_WF) @ pose(model, context, body)
    corners = []
    for geometry in model.plant.GetCollisionGeometriesForBody(model.plant.GetBodyByName(body)):
        shape = inspector.GetShape(geometry)
        assert isinstance(shape, Box)
        X_FS = X_FB @ inspector.GetPoseInFrame(geometry).GetAsMatrix4()
        half = np.abs(X_FS[:3, :3] @ shape.size()) / 2
        corners.append((X_FS[:3, 3] - half, X_FS[:3, 3] + half))
    return corners


@pytest.mark.parametrize("opening", [0.0, 0.035, panda.MAX_OPENING])
def test_the_hand_lies_inside_the_boxes_that_grasps_are_checked_with(
    model: PlanningModel, opening: float
) -> None:
    lower, upper = panda.gripper_boxes(opening)
    context = context_at(model, HOME, opening)
    for row, body in enumerate(("panda_rightfinger", "panda_leftfinger", "panda_hand")):
        for low, high in corners_in(model, context, body, model.X_WG(HOME)):
            assert (low >= lower[row] - 1e-12).all(), body
            assert (high <= upper[row] + 1e-12).all(), body


# The model files.


def test_the_model_files_are_what_their_generator_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = MODELS / "panda" / "make_urdf.py"
    monkeypatch.setattr(sys, "argv", [str(generator), str(tmp_path)])
    runpy.run_path(str(generator), run_name="__main__")
    for name in ("panda_arm.urdf", "panda_hand.urdf"):
        assert (tmp_path / name).read_text() == (MODELS / "panda" / name).read_text()


def test_joint_limits_are_the_published_ones(model: PlanningModel) -> None:
    plant = model.plant
    half = panda.MAX_OPENING / 2
    np.testing.assert_array_equal(plant.GetPositionLowerLimits(), [*panda.Q_LOWER, 0, 0])
    np.testing.assert_array_equal(plant.GetPositionUpperLimits(), [*panda.Q_UPPER, half, half])
    np.testing.assert_array_equal(plant.GetVelocityUpperLimits()[:7], panda.V_MAX)
    np.testing.assert_array_equal(plant.GetAccelerationUpperLimits()[:7], panda.A_MAX)
    np.testing.assert_array_equal(plant.GetEffortUpperLimits(), [87] * 4 + [12] * 3 + [70] * 2)


def test_the_arm_is_as_heavy_as_its_data_sheet_says_and_can_carry_itself(
    model: PlanningModel,
) -> None:
    plant = model.plant
    stretched_forwards = np.array([0.0, np.pi / 2, 0.0, -0.07, 0.0, np.pi / 2, 0.0])
    context = context_at(model, stretched_forwards, 0.0)
    arm, hand = (plant.GetModelInstanceByName(name) for name in ("panda", "hand"))
    assert plant.CalcTotalMass(context, [arm]) == pytest.approx(18.0, abs=0.1)
    assert plant.CalcTotalMass(context, [hand]) == pytest.approx(0.73 + 2 * 0.1, abs=1e-9)
    weight = plant.CalcGravityGeneralizedForces(context)
    assert 30.0 < abs(weight[1]) < 70.0  # the shoulder bears most, and 3 kg more would do
    assert (np.abs(weight[:7]) < plant.GetEffortUpperLimits()[:7]).all()


def test_every_link_has_inertia_that_a_body_can_have(model: PlanningModel) -> None:
    for i in [*(f"panda_link{i}" for i in range(8)), "panda_hand", "panda_leftfinger"]:
        inertia = model.plant.GetBodyByName(i).default_spatial_inertia()
        assert inertia.IsPhysicallyValid()
        assert inertia.get_mass() > 0.05


def test_every_surface_that_touches_objects_is_hydroelastic_the_fingers_rigid(
    model: PlanningModel,
) -> None:
    """Objects are compliant. Rigid against rigid would silently fall back to point contact."""
    inspector = model.diagram.scene_graph().model_inspector()
    for body in ("panda_hand", "panda_leftfinger", "panda_rightfinger", "table"):
        for geometry in model.plant.GetCollisionGeometriesForBody(model.plant.GetBodyByName(body)):
            # Drake meshes the volume of compliant shapes, and the surface alone of rigid ones.
            mesh = inspector.maybe_get_hydroelastic_mesh(geometry)
            if body in panda.FINGER_BODIES:
                assert isinstance(mesh, TriangleSurfaceMesh)
                continue
            assert isinstance(mesh, VolumeMesh)
            properties = inspector.GetProximityProperties(geometry)
            assert properties.GetProperty("hydroelastic", "hydroelastic_modulus") >= 1e6


def test_everything_that_is_drawn_has_a_colour_for_the_camera(model: PlanningModel) -> None:
    inspector = model.diagram.scene_graph().model_inspector()
    drawn = inspector.GetAllGeometryIds(Role.kPerception)
    assert len(drawn) > 50
    for geometry in drawn:
        assert inspector.GetPerceptionProperties(geometry).HasProperty("phong", "diffuse")


def test_what_is_drawn_of_the_arm_lies_inside_what_collides(model: PlanningModel) -> None:
    inspector = model.diagram.scene_graph().model_inspector()
    rng = np.random.default_rng(0)
    for i in range(1, 8):
        body = model.plant.GetBodyByName(f"panda_link{i}")
        geometries = model.plant.GetCollisionGeometriesForBody(body)
        centres = np.array([inspector.GetPoseInFrame(g).translation() for g in geometries])
        radii = np.array([inspector.GetShape(g).radius() for g in geometries])
        for visual in model.plant.GetVisualGeometriesForBody(body):
            p_S = surface_points(inspector.GetShape(visual), rng, 200)
            p_B = (inspector.GetPoseInFrame(visual) @ p_S.T).T
            distance = np.linalg.norm(p_B[:, None] - centres, axis=-1) - radii
            assert distance.min(axis=1).max() < 0.003, body.name()  # dark rings stand out


def surface_points(shape: Shape, rng: np.random.Generator, count: int) -> Array:
    """Random points on the surface of a shape, in its frame, (count, 3)."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if isinstance(shape, Sphere):
        return shape.radius() * direction
    if isinstance(shape, Box):
        half = shape.size() / 2
        # Push a direction outwards until it meets the first face.
        return direction * (half / np.abs(direction)).min(axis=1, keepdims=True)
    assert isinstance(shape, Capsule | Cylinder)
    if isinstance(shape, Capsule):
        points = shape.radius() * direction
        points[:, 2] += rng.uniform(-0.5, 0.5, count) * shape.length()
        return points  # on or inside the surface
    around = direction[:, :2] / np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
    height = rng.uniform(-0.5, 0.5, (count, 1)) * shape.length()
    return np.hstack([shape.radius() * around, height])


# What the robot knows.


def test_positions_are_the_arm_then_half_the_opening_for_each_finger(
    model: PlanningModel,
) -> None:
    np.testing.assert_array_equal(model.full_positions(HOME, 0.05), [*HOME, 0.025, 0.025])
    assert model.full_positions(np.zeros((3, 4, 7)), 0.0).shape == (3, 4, 9)
    context = context_at(model, HOME, 0.05)
    X_FW = np.linalg.inv(pose(model, context, "panda_rightfinger"))
    X_FLeft = X_FW @ pose(model, context, "panda_leftfinger")
    np.testing.assert_allclose(X_FLeft[:3, 3], [0.0, 0.05, 0.0], atol=1e-12)


@pytest.mark.parametrize("opening", [0.0, 0.08])
def test_known_postures_are_free_or_in_collision(model: PlanningModel, opening: float) -> None:
    through_table = np.array([0.0, 0.9, 0.0, -1.9, 0.0, 2.8, np.pi / 4])
    assert model.X_WG(through_table)[2, 3] < -0.05
    upright = np.array([0.0, 0.0, 0.0, -0.1, 0.0, 1.6, 0.0])
    postures = np.array([HOME, FOLDED, through_table, upright])
    free = model.check_configs(postures, opening)
    np.testing.assert_array_equal(free, [True, False, False, True])


def test_spheres_cover_the_collision_geometry_wherever_the_robot_is(model: PlanningModel) -> None:
    inspector = model.diagram.scene_graph().model_inspector()
    rng = np.random.default_rng(1)
    q = random_configurations(4, seed=1)
    opening = 0.05
    centres, radii, bodies = model.spheres(q, opening)
    assert centres.shape == (4, len(radii), 3)
    assert set(bodies) == {
        *(f"panda_link{i}" for i in range(8)),
        *("panda_hand", "panda_leftfinger", "panda_rightfinger"),
    }
    for i in range(len(q)):
        context = context_at(model, q[i], opening)
        for name in set(bodies):
            own = [row for row, body in enumerate(bodies) if body == name]
            body = model.plant.GetBodyByName(name)
            for geometry in model.plant.GetCollisionGeometriesForBody(body):
                X_WS = body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(geometry)
                p_W = (X_WS @ surface_points(inspector.GetShape(geometry), rng, 50).T).T
                outside = np.linalg.norm(p_W[:, None] - centres[i, own], axis=-1) - radii[own]
                assert outside.min(axis=1).max() < 1e-9, name


sizes = st.floats(0.005, 0.4)


@given(sizes, sizes, sizes)
def test_spheres_of_a_box_cover_it_and_stand_out_by_the_margin_at_most(
    x: float, y: float, z: float
) -> None:
    box = Box(x, y, z)
    centres, radius = cover_shape(box)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)) * box.size()
    assert (np.linalg.norm(points[:, None] - centres, axis=-1).min(axis=1) <= radius + 1e-9).all()
    to_faces = (box.size() / 2 - np.abs(centres)).min()
    assert radius - to_faces <= MARGIN + 1e-9


@given(st.floats(0.01, 0.1), st.floats(0.01, 0.5), st.booleans())
def test_spheres_of_a_capsule_or_cylinder_stand_out_of_its_side_by_the_margin_at_most(
    radius: float, length: float, flat: bool
) -> None:
    shape = Cylinder(radius, length) if flat else Capsule(radius, length)
    centres, r = cover_shape(shape)
    points = surface_points(shape, np.random.default_rng(0), 200)
    assert (np.linalg.norm(points[:, None] - centres, axis=-1).min(axis=1) <= r + 1e-9).all()
    assert r - radius <= MARGIN + 1e-9


def directives_of(file: str) -> list[ModelDirective]:
    return LoadModelDirectives(MODELS / file).directives


def test_directives_without_a_hand_are_refused_by_name() -> None:
    arm_alone = directives_of("panda/panda.dmd.yaml")[:2]
    with pytest.raises(InputError, match="no model named 'hand'"):
        MakePlanningModel(arm_alone)


def test_directives_with_something_else_that_moves_are_refused() -> None:
    loose = directives_of("scenes/table.dmd.yaml")[:1]
    with pytest.raises(InputError, match="nothing else"):
        MakePlanningModel([*directives_of("panda/panda.dmd.yaml"), *loose])


def test_drakes_own_models_are_added_under_the_same_names() -> None:
    ours, drakes = (directives_of(f"panda/{name}.dmd.yaml") for name in ("panda", "drake_models"))
    for directive in (*ours, *drakes):
        if directive.add_model is not None:
            directive.add_model.file = "the only difference"
    assert [str(directive) for directive in ours] == [str(directive) for directive in drakes]


# Simulation.


def test_the_arm_goes_home_and_holds_it_to_a_milliradian() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=0.002,
            contact_model="hydroelastic_with_fallback",
            discrete_contact_approximation="lagged",
        ),
        builder,
    )
    parser = Parser(plant)
    parser.package_map().AddMap(make_package_map())
    ProcessModelDirectives(LoadModelDirectives(SCENE), parser)
    set_gains(plant)
    plant.Finalize()
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    wanted = np.concatenate([HOME, [0.02, 0.02]])
    plant.SetPositions(context, wanted + 0.01)
    arm, hand = (plant.GetModelInstanceByName(name) for name in ("panda", "hand"))
    plant.get_desired_state_input_port(arm).FixValue(context, np.concatenate([HOME, np.zeros(7)]))
    plant.get_desired_state_input_port(hand).FixValue(context, [0.02, 0.02, 0.0, 0.0])
    simulator.AdvanceTo(1.0)
    np.testing.assert_allclose(plant.GetPositions(context), wanted, rtol=0, atol=1e-3)


def set_gains(plant: MultibodyPlant) -> None:
    p = dict(zip(panda.JOINT_NAMES, (4000, 4000, 3000, 3000, 1500, 1500, 600), strict=True))
    for name in ("panda", "hand"):
        plant.set_gravity_enabled(plant.GetModelInstanceByName(name), False)
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        gain = p.get(actuator.joint().name(), 3000)
        damping = 1.6 * gain**0.5 if actuator.joint().name() in p else 60
        actuator.set_controller_gains(PdControllerGains(p=gain, d=damping))


def test_grasps_are_apart_by_place_and_turn_and_half_a_turn_about_z_is_none():
    turn = AngleAxis(0.3, np.array([1.0, 0.0, 0.0])).rotation()
    X_WG = np.tile(np.eye(4), (4, 1, 1))
    X_WG[:, :3, :3] = [np.eye(3), np.diag([-1.0, -1.0, 1.0]), turn, turn @ np.diag([-1, -1, 1])]
    X_WG[:, 0, 3] = [0.0, 0.1, 0.2, 0.0]
    place, angle = panda.grasps_apart(X_WG, X_WG[0])
    np.testing.assert_allclose(place, [0.0, 0.1, 0.2, 0.0])
    np.testing.assert_allclose(angle, [0.0, 0.0, 0.3, 0.3], atol=1e-7)
