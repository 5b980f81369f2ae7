"""Among K candidates, is there one that the task allows? An upper bound for who chooses among them.

Run by itself: ``pytest tests/benchmarks/bench_candidates.py``. It reads the simulated labels.
"""

import pytest
from pydrake.systems.analysis import Simulator

from tog_drake.benchmark.suite import load_suite
from tog_drake.candidates import CandidatesConfig, pick_candidates
from tog_drake.judge import COMPLIANT_SHARE
from tog_drake.scenario import load_scenario
from tog_drake.world import build_world

KS = ("auto", 2, 3, 4, 5, 6, 8)
SEEDS = (0, 1)


@pytest.fixture(scope="module")
def looks():
    """Of every object and seed the feasible grasps, with the shares of parts that each holds."""
    found = []
    for name in {trial.scenario: None for trial in load_suite("builtin").trials}:
        for seed in SEEDS:
            scenario = load_scenario(name)
            scenario.random_seed = seed
            world = build_world(scenario)
            simulator = Simulator(world.diagram)
            context = simulator.get_mutable_context()
            world.diagram.GetInputPort("task").FixValue(context, "pick it up")
            simulator.Initialize()
            simulator.AdvanceTo(world.pipeline.executor.look_time)
            grasps = world.pipeline.GetOutputPort("feasible_grasps").Eval(
                world.pipeline.GetMyContextFromRoot(context)
            )
            query = world.station.GetOutputPort("cheat.query_object").Eval(
                world.station.GetMyContextFromRoot(context)
            )
            regions = world.labels.closing_region(grasps, query)
            tasks = world.labels.objects[world.target].tasks
            found.append((world.target, seed, grasps, regions, tasks))
    return found


@pytest.mark.parametrize("k", KS)
def test_a_candidate_that_the_task_allows(looks, k, capsys):
    had = possible = shown = 0
    for target, seed, grasps, regions, tasks in looks:
        candidates = pick_candidates(grasps, CandidatesConfig(k=k), seed)
        shown += len(candidates)
        for allowed in tasks.values():
            fits = [
                sum(region.get((target, part), 0.0) for part in allowed) >= COMPLIANT_SHARE
                for region in regions
            ]
            possible += any(fits)
            had += any(fits[i] for i in candidates.index)
    with capsys.disabled():
        print(f"\nk {k}: {had} of {possible} tasks, {shown / len(looks):.1f} candidates")
    assert 0 < had <= possible
