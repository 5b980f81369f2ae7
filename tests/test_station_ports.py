import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from tog_drake.errors import InputError
from tog_drake.scenario import LOOK_POSTURE, load_scenario
from tog_drake.stations.simulation import SimulationStation
from tog_drake.world import build_world

INPUTS = ["panda.position", "hand.position"]
OUTPUTS = [
    "panda.position_measured", "panda.velocity_measured", "panda.torque_external",
    "hand.state_measured", "wrist.rgb_image", "wrist.depth_image", "wrist.X_WC",
]  # fmt: skip
CHEATS = ["cheat.body_poses", "cheat.query_object", "cheat.contact_results"]


@pytest.fixture(scope="module")
def world():
    return build_world(load_scenario("Hammer"))


def _inputs(system):
    return [system.get_input_port(i).get_name() for i in range(system.num_input_ports())]


def _outputs(system):
    return [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]


def test_the_station_has_the_ports_of_a_panda_and_says_which_cheat(world):
    assert _inputs(world.station) == INPUTS
    assert _outputs(world.station) == OUTPUTS + CHEATS


def test_both_ends_of_every_connection_carry_the_same_type(world):
    for diagram in (world.diagram, world.pipeline):
        for (reader, i), (writer, o) in diagram.connection_map().items():
            read, written = reader.get_input_port(i), writer.get_output_port(o)
            assert read.get_data_type() == written.get_data_type(), read.GetFullDescription()
            if hasattr(reader, "DeclareAbstractInputPort"):  # a stage, not a diagram
                expected = type(reader.AllocateInputAbstract(read).get_value())
                given = type(written.Allocate().get_value())
                assert issubclass(given, expected), read.GetFullDescription()


def test_only_the_oracle_is_given_ground_truth(world):
    assert not any(name.startswith("cheat") for name in _inputs(world.pipeline))
    oracle = build_world(load_scenario("Hammer", "pipeline: {selector: !Oracle {}}"))
    assert "cheat.query_object" in _inputs(oracle.pipeline)


def test_nothing_feeds_through_from_perception_to_the_command(world):
    pipeline = world.pipeline
    for image in ("wrist.rgb_image", "wrist.depth_image", "wrist.X_WC", "task"):
        for command in INPUTS:
            assert not pipeline.HasDirectFeedthrough(
                pipeline.GetInputPort(image).get_index(),
                pipeline.GetOutputPort(command).get_index(),
            )


def test_the_arm_follows_a_fast_command_to_a_few_milliradians():
    scenario = load_scenario("Hammer")
    scenario.cameras = {}
    station = SimulationStation(scenario)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    start = np.array(LOOK_POSTURE)
    station.GetInputPort("hand.position").FixValue(context, [0.08])
    command = station.GetInputPort("panda.position").FixValue(context, start)
    simulator.Initialize()
    worst, swing = 0.0, np.array([0.5, 0.2, 0.0, 0.2, 0.0, 0.0, 0.5])
    for t in np.arange(0.0, 1.0, 0.005):
        q = start + swing * (1 - np.cos(np.pi * t)) / 2
        command.GetMutableData().get_mutable_value().SetFromVector(q)
        simulator.AdvanceTo(t + 0.005)
        measured = station.GetOutputPort("panda.position_measured").Eval(context)
        worst = max(worst, np.abs(measured - q).max())
    assert worst < 0.01


def test_the_hand_closes_evenly_and_stops_at_nothing():
    scenario = load_scenario("Hammer")
    scenario.cameras = {}
    station = SimulationStation(scenario)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.GetInputPort("panda.position").FixValue(context, LOOK_POSTURE)
    station.GetInputPort("hand.position").FixValue(context, [-0.02])
    simulator.AdvanceTo(1.0)
    opening, speed = station.GetOutputPort("hand.state_measured").Eval(context)
    assert abs(opening) < 0.003
    assert abs(speed) < 0.01
    hand = station.plant.GetModelInstanceByName("hand")
    left, right = station.plant.GetPositions(station.plant.GetMyContextFromRoot(context), hand)
    assert left == pytest.approx(right, abs=1e-4)


def test_cameras_see_the_arm_move_and_contact_does_not_pay_for_it():
    """The scene that contact asks in every step draws nothing; the cameras have their own."""
    side = "X_PB: {translation: [0.5, 0, 1.5], rotation: !Rpy {deg: [180, 0, 0]}}"
    text = f"cameras: {{top: !CameraConfig {{width: 64, height: 48, {side}}}}}"
    station = SimulationStation(load_scenario("Hammer", text))
    assert station.scene_graph.RendererCount() == 0
    context = station.CreateDefaultContext()
    image = station.GetOutputPort("top.rgb_image")
    before = image.Eval(context).data.copy()
    panda = station.plant.GetModelInstanceByName("panda")
    station.plant.SetPositions(
        station.plant.GetMyMutableContextFromRoot(context), panda, np.array(LOOK_POSTURE) + 0.3
    )
    after = image.Eval(context).data
    assert (before != after).any(axis=2).mean() > 0.02
    again = station.CreateDefaultContext()
    np.testing.assert_array_equal(image.Eval(again).data, before)


def test_a_camera_with_unaligned_depth_is_refused():
    text = (
        "cameras: {side: !CameraConfig {width: 64, height: 48, X_BD: {translation: [0.1, 0, 0]}}}"
    )
    with pytest.raises(InputError, match="colour and depth must be aligned"):
        SimulationStation(load_scenario("Hammer", text))
