"""Both stations have the same ports, of the same kinds: one takes the place of the other."""

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import DiagramBuilder, PortDataType

from tog_drake.pipeline import GraspPipeline, connect_to_station
from tog_drake.planning_model import MakePlanningModel
from tog_drake.scenario import LOOK_POSTURE, load_scenario, robot_directive
from tog_drake.stations.hardware import HardwareStation
from tog_drake.stations.lcm_bus import (
    HAND_STATUS,
    PANDA_STATUS,
    RobotMode,
    arm_status_message,
    hand_status_message,
)
from tog_drake.stations.lcm_camera import LcmImages
from tog_drake.stations.panda_lcm import PandaBus
from tog_drake.stations.simulation import SimulationStation

HOME = np.array(LOOK_POSTURE)


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("panda_lcm")


@pytest.fixture(scope="module")
def hardware(scenario):
    """A hardware station, its drivers having spoken; on no network."""
    lcm = DrakeLcm("memq://")
    bus = PandaBus(lcm, clock=lambda: 1.0)
    feeds = {"wrist": LcmImages("TOG_WRIST").open(lcm, scenario.cameras["wrist"].camera_config())}
    status = arm_status_message(HOME, np.zeros(7), np.arange(7.0), RobotMode.MOVE, 1_000_000)
    lcm.Publish(PANDA_STATUS, status)
    lcm.Publish(HAND_STATUS, hand_status_message(0.05, 0.0, 1_000_000))
    for _ in range(5):
        lcm.HandleSubscriptions(0)
    return HardwareStation(scenario, bus=bus, feeds=feeds)


@pytest.fixture(scope="module")
def simulated(scenario):
    return SimulationStation(scenario)


def inputs(system):
    ports = (system.get_input_port(i) for i in range(system.num_input_ports()))
    return {port.get_name(): _kind(port) for port in ports}


def outputs(system):
    ports = (system.get_output_port(i) for i in range(system.num_output_ports()))
    return {port.get_name(): _kind(port) for port in ports}


def _kind(port):
    if port.get_data_type() == PortDataType.kVectorValued:
        return port.size()
    if hasattr(port, "Allocate"):
        return type(port.Allocate().get_value()).__name__
    return "abstract"


def test_the_ports_of_both_stations_are_equal_but_for_the_cheats(simulated, hardware):
    real = {n: kind for n, kind in outputs(simulated).items() if not n.startswith("cheat.")}
    assert outputs(hardware) == real
    assert inputs(hardware) == inputs(simulated)
    assert "cheat.body_poses" in outputs(simulated)


def test_what_is_measured_is_what_the_drivers_said(hardware, simulated):
    from pydrake.systems.analysis import Simulator

    simulator = Simulator(hardware)
    hardware.GetInputPort("panda.position").FixValue(simulator.get_mutable_context(), HOME)
    hardware.GetInputPort("hand.position").FixValue(simulator.get_mutable_context(), [0.08])
    simulator.Initialize()
    context = simulator.get_context()
    assert hardware.GetOutputPort("panda.position_measured").Eval(context) == pytest.approx(HOME)
    torque = hardware.GetOutputPort("panda.torque_external").Eval(context)
    assert torque == pytest.approx(np.arange(7.0))
    assert hardware.GetOutputPort("hand.state_measured").Eval(context) == pytest.approx([0.05, 0])
    # The camera is where the simulated one is: the arm stands in the same posture.
    X_WC, X_WC_simulated = (
        station.GetOutputPort("wrist.X_WC").Eval(c).GetAsMatrix4()
        for station, c in (
            (hardware, context),
            (simulated, simulated.CreateDefaultContext()),
        )
    )
    np.testing.assert_allclose(X_WC, X_WC_simulated, atol=1e-9)


def test_one_pipeline_fits_both(scenario, simulated, hardware):
    feed = hardware.feeds["wrist"]
    assert feed.GetOutputPort("stamp").size() == 1
    for station in (SimulationStation(scenario), hardware):
        model = MakePlanningModel([robot_directive(scenario), *scenario.planning_directives])
        camera = LcmImages("X").open(DrakeLcm("memq://"), scenario.cameras["wrist"].camera_config())
        pipeline = GraspPipeline(
            scenario.pipeline,
            cameras={"wrist": camera.intrinsics},
            planning_model=model,
            seed=0,
        )
        builder = DiagramBuilder()
        builder.AddSystem(station)
        builder.AddSystem(pipeline)
        connect_to_station(builder, station, pipeline)
        diagram = builder.Build()
        assert diagram.HasInputPort("task")
        for output, inputs_ in _connections(diagram).items():
            assert all(kind == output[1] for kind in inputs_), output


def _connections(diagram):
    """(output's name, kind) -> kinds of the inputs it feeds, where they have a value."""
    found = {}
    for (system, index), (source, port) in diagram.connection_map().items():
        output = source.get_output_port(port)
        key = output.get_name(), _kind(output)
        if system.get_input_port(index).get_data_type() == PortDataType.kVectorValued:
            found.setdefault(key, []).append(system.get_input_port(index).size())
    return found
