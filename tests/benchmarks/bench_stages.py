"""How long each stage takes, by itself: ``make bench``. Nothing here asserts a time.

Every stage is the plain function under the LeafSystem, on what the wrist camera sees of seed 0.
"""

import time

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from tog_drake.candidates import pick_candidates
from tog_drake.cloud import scene_cloud
from tog_drake.decision import decide
from tog_drake.feasibility import feasible_grasps
from tog_drake.panda import MAX_OPENING
from tog_drake.pipeline import make_proposer, make_selector
from tog_drake.scenario import LOOK_POSTURE, load_scenario
from tog_drake.trajectory import plan_motion
from tog_drake.world import build_world

# Scenario, object and task: an object by itself, and one among others.
SCENES = {
    "Hammer": ("hammer", "use the hammer to drive a nail"),
    "Tools": ("hammer", "use the hammer to drive a nail"),
}
VIEWS = [f"{s}-{r}" for s in SCENES for r in ("640x480", "1280x720")]
GRASPS = 200  # the filter is given so many


@pytest.fixture(scope="module", params=VIEWS)
def looked(request):
    name, resolution = request.param.split("-")
    target, task = SCENES[name]
    scenario = load_scenario(name, f"cameras: {{wrist: !L515 {{resolution: {resolution}}}}}")
    world = build_world(scenario, target=target)
    simulator = Simulator(world.diagram)
    context = simulator.get_mutable_context()
    world.diagram.GetInputPort("task").FixValue(context, task)
    simulator.AdvanceTo(world.pipeline.executor.look_time)
    measured = world.station.GetOutputPort("panda.position_measured")
    q = measured.Eval(world.station.GetMyContextFromRoot(context))
    decision = decide(world.pipeline, context)
    if decision.error is not None:
        pytest.skip(f"{request.param}: {decision.error}")
    return scenario.pipeline, world, simulator, decision, q, task


def test_1_render(looked, benchmark):
    """The same context gives the cached image, so a fresh one is made before each round."""
    _, world, *_ = looked

    def fresh():
        context = world.station.CreateDefaultContext()
        world.station.GetInputPort("panda.position").FixValue(context, LOOK_POSTURE)
        return (context,), {}

    def render(context):
        world.station.GetOutputPort("wrist.rgb_image").Eval(context)
        world.station.GetOutputPort("wrist.depth_image").Eval(context)

    benchmark.pedantic(render, setup=fresh, rounds=10)


def test_2_cloud(looked, benchmark):
    config, world, _, decision, q, _ = looked
    centres, radii, _ = world.planning_model.spheres(q[None], MAX_OPENING)
    benchmark(scene_cloud, [decision.view], config.workspace, config.cloud, (centres[0], radii))


def test_3_propose(looked, benchmark):
    config, _, _, decision, *_ = looked
    benchmark(make_proposer(config, 0).propose, decision.cloud, decision.view)


def test_4_filter_200_grasps(looked, benchmark):
    config, world, _, decision, q, _ = looked
    rows = np.linspace(0, len(decision.grasps) - 1, GRASPS).astype(int)
    grasps, model = decision.grasps.take(rows), world.planning_model
    benchmark(
        feasible_grasps,
        grasps,
        decision.cloud,
        q,
        model,
        config.feasibility,
        table_height=config.workspace.table_height,
        view=decision.view,
    )


def test_5_candidates(looked, benchmark):
    config, _, _, decision, *_ = looked
    benchmark(pick_candidates, decision.feasible_grasps, config.candidates, 0)


def test_6_select(looked, benchmark):
    config, _, _, decision, _, task = looked
    selector = make_selector(config, 0)
    benchmark(selector.select, decision.view, decision.cloud, decision.candidates, task)


def test_7_plan(looked, benchmark):
    config, world, _, decision, q, _ = looked
    args = (decision.choice, decision.candidates, q, decision.cloud, world.planning_model)
    benchmark(plan_motion, *args, config.trajectory, 0)


def test_8_decide_as_a_whole(looked, benchmark):
    """From the depth image to the motion; the images are rendered before, and not counted."""
    _, world, simulator, *_, task = looked
    context = simulator.get_context().Clone()
    world.diagram.GetInputPort("task").FixValue(context, task)
    mine = world.pipeline.GetMyMutableContextFromRoot(context)

    def fresh():
        mine.SetAllCacheEntriesOutOfDate()
        world.pipeline.GetOutputPort("view").Eval(mine)
        return (world.pipeline, context), {}

    benchmark.pedantic(decide, setup=fresh, rounds=5)


def test_9_simulate_one_second_of_grasping(looked, benchmark):
    """Closed on the thing and lifting it, the camera in the scene as always."""
    _, world, simulator, decision, *_ = looked
    lift = world.pipeline.executor.look_time + decision.motion.phase_times["lift"]
    simulator.AdvanceTo(lift)
    started = time.perf_counter()
    benchmark.pedantic(simulator.AdvanceTo, args=(lift + 1.0,), rounds=1)
    benchmark.extra_info["real_time_rate"] = 1.0 / (time.perf_counter() - started)
