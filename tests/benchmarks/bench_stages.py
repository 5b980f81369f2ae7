"""How long each stage takes, by itself: ``make bench``. Nothing here asserts a time.

Every stage is the plain function under the LeafSystem, on the hammer of seed 0.
"""

import pytest
from pydrake.systems.analysis import Simulator

from tog_drake.candidates import pick_candidates
from tog_drake.cloud import scene_cloud
from tog_drake.episode import build_world
from tog_drake.feasibility import feasible_grasps
from tog_drake.panda import MAX_OPENING
from tog_drake.pipeline import decide, make_proposer, make_selector
from tog_drake.scenario import LOOK_POSTURE, load_scenario
from tog_drake.trajectory import plan_motion

TASK = "use the hammer to drive a nail"


@pytest.fixture(scope="module")
def looked():
    scenario = load_scenario("Hammer")
    world = build_world(scenario)
    simulator = Simulator(world.diagram)
    context = simulator.get_mutable_context()
    world.diagram.GetInputPort("task").FixValue(context, TASK)
    simulator.AdvanceTo(world.pipeline.executor.look_time)
    measured = world.station.GetOutputPort("panda.position_measured")
    q = measured.Eval(world.station.GetMyContextFromRoot(context))
    return scenario.pipeline, world, simulator, decide(world.pipeline, context), q


def test_render(looked, benchmark):
    """The same context gives the cached image, so a fresh one is made before each round."""
    _, world, _, _, _ = looked

    def fresh():
        context = world.station.CreateDefaultContext()
        world.station.GetInputPort("panda.position").FixValue(context, LOOK_POSTURE)
        return (context,), {}

    def render(context):
        world.station.GetOutputPort("wrist.rgb_image").Eval(context)
        world.station.GetOutputPort("wrist.depth_image").Eval(context)

    benchmark.pedantic(render, setup=fresh, rounds=10)


def test_cloud(looked, benchmark):
    config, world, _, decision, q = looked
    centres, radii, _ = world.planning_model.spheres(q[None], MAX_OPENING)
    benchmark(scene_cloud, decision.view, config.workspace, config.cloud, (centres[0], radii))


def test_propose(looked, benchmark):
    config, _, _, decision, _ = looked
    benchmark(make_proposer(config, 0).propose, decision.cloud)


def test_filter(looked, benchmark):
    config, world, _, decision, q = looked
    benchmark(
        feasible_grasps,
        decision.grasps,
        decision.cloud,
        q,
        world.planning_model,
        config.feasibility,
    )


def test_candidates(looked, benchmark):
    config, _, _, decision, _ = looked
    benchmark(pick_candidates, decision.feasible_grasps, config.candidates, 0)


def test_select(looked, benchmark):
    config, _, _, decision, _ = looked
    selector = make_selector(config, 0)
    benchmark(selector.select, decision.view, decision.cloud, decision.candidates, TASK)


def test_plan(looked, benchmark):
    config, world, _, decision, q = looked
    benchmark(
        plan_motion,
        decision.choice,
        decision.candidates,
        q,
        decision.cloud,
        world.planning_model,
        config.trajectory,
        0,
    )


def test_simulate_one_second_of_standing_still(looked, benchmark):
    _, world, _, _, _ = looked

    def fresh():
        simulator = Simulator(world.diagram)
        world.diagram.GetInputPort("task").FixValue(simulator.get_mutable_context(), TASK)
        simulator.Initialize()
        return (simulator,), {}

    benchmark.pedantic(lambda s: s.AdvanceTo(0.99), setup=fresh, rounds=3)
