from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

import tog_drake.pipeline
from tog_drake.decision import STAGES, decide
from tog_drake.errors import InputError
from tog_drake.pipeline import PipelineConfig, make_selector
from tog_drake.scenario import load_scenario
from tog_drake.selectors.oracle import Oracle
from tog_drake.world import build_world

TASK = "use the hammer to drive a nail"


@pytest.fixture(scope="module")
def looked():
    """A world at the moment of the look, its simulator, and the decision."""
    world = build_world(load_scenario("Hammer"))
    simulator = Simulator(world.diagram)
    context = simulator.get_mutable_context()
    world.diagram.GetInputPort("task").FixValue(context, TASK)
    simulator.AdvanceTo(1.0)
    return world, simulator, decide(world.pipeline, simulator.get_context())


def test_every_stage_gives_its_value_and_its_time(looked):
    _, _, decision = looked
    assert decision.error is None
    assert all(getattr(decision, stage.port) is not None for stage in STAGES)
    assert set(decision.seconds) == {
        "render", "cloud", "propose", "filter", "candidates", "choose_view", "select",
        "plan",
    }  # fmt: skip


def test_the_numbers_of_the_funnel_agree(looked):
    _, _, decision = looked
    feasible = decision.feasible_grasps
    assert len(feasible) + sum(feasible.rejected.values()) == len(decision.grasps)
    assert decision.candidates.grasps is not None
    assert len(decision.candidates.grasps) == len(feasible)
    assert 1 <= len(decision.candidates) <= len(feasible)


def test_the_cloud_shows_the_hammer_and_neither_table_nor_robot(looked):
    world, simulator, decision = looked
    points = decision.cloud.xyzs().T
    poses = world.station.GetOutputPort("cheat.body_poses").Eval(
        world.station.GetMyContextFromRoot(simulator.get_context())
    )
    body = world.station.plant.GetBodyByName("base").index()
    assert np.linalg.norm(points[:, :2] - poses[body].translation()[:2], axis=1).max() < 0.25
    assert points[:, 2].min() > 0.003


def test_the_motion_starts_where_the_arm_is_and_ends_lifted(looked):
    world, simulator, decision = looked
    station_context = world.station.GetMyContextFromRoot(simulator.get_context())
    measured = world.station.GetOutputPort("panda.position_measured").Eval(station_context)
    arm, duration = decision.motion.arm, decision.motion.duration
    np.testing.assert_allclose(arm.value(0).ravel(), measured, atol=1e-6)
    model = world.planning_model
    rise = (
        model.X_WG(arm.value(duration).ravel())[2, 3]
        - model.X_WG(arm.value(decision.motion.phase_times["lift"]).ravel())[2, 3]
    )
    assert rise > 0.10


def test_the_executor_moves_by_the_motion_that_was_decided_without_deciding_again(
    looked, monkeypatch
):
    world, simulator, decision = looked

    def again(*args):
        raise AssertionError("the chain was computed twice")

    monkeypatch.setattr("tog_drake.trajectory.plan_motion", again)
    simulator.AdvanceTo(1.1)
    executor = world.pipeline.executor
    state = executor.state(executor.GetMyContextFromRoot(simulator.get_context()))
    for t in np.linspace(0, decision.motion.duration, 7):
        np.testing.assert_array_equal(state.motion.arm.value(t), decision.motion.arm.value(t))


def test_the_oracle_needs_a_simulation():
    config = PipelineConfig(selector=Oracle())
    with pytest.raises(InputError, match=r"simulated part labels.*geometric, top-score, random"):
        make_selector(config, seed=0)


def test_no_stage_imports_another_stage_a_station_or_the_scenario():
    stages = (
        "camera", "cloud", "look_planning", "proposer", "feasibility", "candidates",
        "view_selection", "selector",
        "trajectory", "executor",
    )  # fmt: skip
    package = Path(tog_drake.pipeline.__file__).parent
    for stage in stages:
        lines = (package / f"{stage}.py").read_text(encoding="utf-8").splitlines()
        imports = [line for line in lines if line.startswith(("from tog_drake", "import tog"))]
        for other in (*stages, "stations", "scenario", "episode", "pipeline"):
            assert not any(
                f"tog_drake.{other} " in line or f"tog_drake.{other}." in line for line in imports
            ), f"{stage} imports {other}"
