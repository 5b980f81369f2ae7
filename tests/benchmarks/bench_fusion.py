"""What five views add to one on scanned objects: ``pytest tests/benchmarks/bench_fusion.py``.

For each imported object of the suite (TOG_ASSETS) with the wrist camera alone, and fused with the
four side cameras: points, proposals, feasible grasps, the share of its surface within 5 mm of the
cloud, and the time that it took. ``-k looks`` asks for that alone; ``-k grasps`` carries out the
grasp with the best score. FUSION_NOISE=1 makes depth noisy, FUSION_SEEDS=3 takes more seeds.
"""

import os

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tog_drake.assets.library import asset_names
from tog_drake.benchmark.statistics import Rate
from tog_drake.benchmark.suite import SCENARIO, load_suite
from tog_drake.cameras import with_noise
from tog_drake.decision import decide
from tog_drake.episode import run_episode
from tog_drake.scenario import load_scenario, with_side_cameras
from tog_drake.selectors.baselines import TopScore
from tog_drake.world import build_world, look

SUITE = {trial.object for trial in load_suite("tog29").trials}
OBJECTS = [name for name in asset_names() if name in SUITE]
SEEDS = range(int(os.environ.get("FUSION_SEEDS", "1")))
COVERED = 0.005  # [m]

pytestmark = pytest.mark.skipif(not OBJECTS, reason="no object of the suite is imported")


def scenario_of(name, seed, fuse):
    scenario = load_scenario(SCENARIO, seed=seed)
    scenario.asset = name
    scenario.pipeline.selector = TopScore()
    scenario.pipeline.cloud.fuse = fuse
    scenario.cameras = with_side_cameras(scenario.cameras)
    if os.environ.get("FUSION_NOISE"):
        scenario.cameras = with_noise(scenario.cameras)
    return scenario


@pytest.fixture(scope="module")
def table(request):
    """Rows of numbers by (what, fused); their means are printed at the end."""
    found = {}
    yield found
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        for key, rows in found.items():
            print(
                f"\nmean of {len(rows)}, {key}: {np.round(np.mean(rows, axis=0), 3).tolist()}",
                end="",
            )


def covered(world, context, cloud):
    """The share of the object's surface that is within 5 mm of the cloud; reads ground truth."""
    poses = world.station.GetOutputPort("cheat.body_poses").Eval(
        world.station.GetMyContextFromRoot(context)
    )
    (surface,) = world.labels.surfaces.values()
    p_W = poses[surface.body].multiply(surface.tree.data.T).T
    return np.mean(cKDTree(cloud.xyzs().T).query(p_W)[0] < COVERED)


@pytest.mark.parametrize("fuse", [False, True], ids=["one", "five"])
@pytest.mark.parametrize("name", OBJECTS)
def test_looks(name, fuse, table, capsys):
    for seed in SEEDS:
        scenario = scenario_of(name, seed, fuse)
        world = build_world(scenario, target=name)
        context = look(world, scenario, "pick it up").get_context()
        decision = decide(world.pipeline, context)
        assert decision.cloud is not None
        feasible = decision.feasible_grasps
        seconds = [decision.seconds.get(key, np.nan) for key in ("cloud", "propose", "filter")]
        row = [
            decision.cloud.size(),
            0 if decision.grasps is None else len(decision.grasps),
            0 if feasible is None else len(feasible),
            covered(world, context, decision.cloud),
            *seconds,
        ]
        kind = "points, proposed, feasible, covered, s of cloud, propose, filter"
        table.setdefault((kind, "five" if fuse else "one"), []).append(row)
        with capsys.disabled():
            print(
                f"\n{name} {seed} {'five' if fuse else 'one'}: {np.round(row, 3).tolist()}", end=""
            )


@pytest.mark.parametrize("fuse", [False, True], ids=["one", "five"])
@pytest.mark.parametrize("name", OBJECTS)
def test_grasps(name, fuse, table, capsys):
    for seed in SEEDS:
        scenario = scenario_of(name, seed, fuse)
        record = run_episode(scenario, name=SCENARIO, task="pick it up", target=name).record
        counts, views = record["counts"], "five" if fuse else "one"
        row = [
            counts["proposed"] or 0,
            counts["feasible"] or 0,
            record["grasp_success"] or 0,
            record["strict_success"] or 0,
            len(record["collisions"] or {}),
        ]
        found = table.setdefault(("proposed, feasible, grasp, strict, collisions", views), [])
        found.append(row)
        grasped = Rate(sum(bool(each[2]) for each in found), len(found))
        low, high = grasped.interval
        with capsys.disabled():
            print(
                f"\n{name} {seed} {views}: {record['outcome']}, {row[0]} proposed, {row[1]} "
                f"feasible; so far {grasped.successes}/{grasped.n} [{low:.2f}, {high:.2f}]",
                end="",
            )
        assert record["outcome"] != "broken"
