"""What episodes share: the same as if each had computed it, and computed again when in doubt."""

import json
import os
from dataclasses import asdict, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tog_drake import sharing
from tog_drake.episode import run_episode
from tog_drake.judge import Verdict
from tog_drake.pipeline import make_proposer
from tog_drake.scenario import load_scenario
from tog_drake.selectors.baselines import TopScore
from tog_drake.selectors.oracle import Oracle
from tog_drake.sharing import Execution, SharedWork, execution_key, look_key, world_key
from tog_drake.values import GraspMotion
from tog_drake.world import build_world, look

VERDICT = Verdict("lifted", None, {"head": 1.0}, True, 0.15, 3.0, {})
EXECUTION = Execution(VERDICT, opening=0.02, executed=8.1, wall=4.0, end=9.1)


def hammer(selector=None, text=None, seed=0):
    scenario = load_scenario("Hammer", text, seed=seed)
    scenario.pipeline.selector = selector or TopScore()
    return scenario


def run(scenario, shared, task="use the hammer"):
    return run_episode(scenario, name="Hammer", task=task, shared=shared).record


def without_times(record):
    return json.dumps({k: v for k, v in record.items() if k not in ("seconds", "sim")})


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    return SharedWork(tmp_path_factory.mktemp("shared"), "program")


@pytest.fixture(scope="module")
def first(shared):
    return run(hammer(), shared)


def test_an_episode_from_what_is_kept_is_the_same_as_the_one_that_computed_it(shared, first):
    again = run(hammer(), shared)
    assert without_times(again) == without_times(first)
    assert again["seconds"]["filter"] == first["seconds"]["filter"]  # as it took then
    assert again["seconds"]["execute"] == first["seconds"]["execute"]
    assert again["sim"] == first["sim"]


def test_the_same_motion_for_another_task_is_judged_for_that_task(shared, first):
    task = "hand me the hammer"
    other = run(hammer(), shared, task)
    assert other["held"] == first["held"]
    assert other["allowed"] != first["allowed"]
    assert {first["task_compliance"], other["task_compliance"]} == {True, False}


def test_a_look_that_is_kept_comes_back_bit_by_bit(shared, first):
    scenario = hammer(Oracle())
    world = build_world(scenario, task="use the hammer")
    context = look(world, scenario, "use the hammer").get_context()
    key = look_key(
        world_key("program", scenario, context), scenario.pipeline, world.pipeline.proposer, seed=0
    )
    kept = shared.look(key)
    assert kept is not None
    port = world.pipeline.GetOutputPort
    mine = world.pipeline.GetMyContextFromRoot(context)
    for name in ("view", "grasps", "feasible_grasps"):
        there, here = asdict(getattr(kept, name)), asdict(port(name).Eval(mine))
        assert there.keys() == here.keys()
        for field, value in here.items():
            if isinstance(value, np.ndarray):
                assert value.dtype == there[field].dtype
                np.testing.assert_array_equal(there[field], value)
            else:
                assert there[field] == value
    cloud = port("cloud").Eval(mine)
    for content in ("xyzs", "normals", "rgbs"):
        np.testing.assert_array_equal(getattr(kept.cloud, content)(), getattr(cloud, content)())


def key_of(text=None, seed=0, program="program"):
    scenario = hammer(text=text, seed=seed)
    world = build_world(scenario, task="use the hammer")
    return world_key(program, scenario, world.diagram.CreateDefaultContext())


def test_another_world_has_another_key_and_another_selector_has_not():
    ordinary = key_of()
    assert key_of(text="pipeline: {selector: !Random {}, candidates: {k: '3'}}") == ordinary
    assert key_of(text="grip_force: 30") != ordinary
    assert key_of(seed=1) != ordinary
    assert key_of(program="edited") != ordinary


def test_who_proposes_and_how_the_filter_is_set_tell_looks_apart():
    def key(scenario):
        return look_key("world", scenario.pipeline, make_proposer(scenario.pipeline, 0), seed=0)

    ordinary = key(hammer())
    assert key(hammer(text="pipeline: {proposer: !Antipodal {max_grasps: 50}}")) != ordinary
    assert key(hammer(text="pipeline: {feasibility: {lift_height: 0.17}}")) != ordinary
    assert key(hammer(Oracle())) == ordinary


class Elsewhere:
    """A proposer that says nothing of what it works with, such as a server."""

    def propose(self, cloud, view):
        raise NotImplementedError


class Network(Elsewhere):
    weights: ClassVar = {"file": "a.pt", "note": "", "sha256": "1" * 64}


def test_looks_are_shared_only_where_it_is_known_what_is_proposed_tomorrow():
    config = hammer().pipeline
    assert look_key("world", config, Elsewhere(), seed=0) is None
    assert look_key("world", config, Network(), seed=0) is not None


def test_another_motion_or_another_target_has_another_key():
    config, motion = hammer().pipeline, GraspMotion.still()
    ordinary = execution_key("world", config, motion, "hammer")
    assert execution_key("world", config, motion, "hammer") == ordinary
    assert execution_key("world", config, motion, "mug") != ordinary
    assert execution_key("other", config, motion, "hammer") != ordinary
    later = replace(motion, phase_times={"close": 1.0})
    assert execution_key("world", config, later, "hammer") != ordinary


def test_an_execution_that_is_kept_comes_back(tmp_path):
    shared = SharedWork(tmp_path, "program")
    assert shared.execution("a") is None
    shared.keep_execution("a", EXECUTION)
    assert shared.execution("a") == EXECUTION


@given(st.binary(max_size=300))
def test_what_is_damaged_is_as_if_it_were_not_there(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "a.npz").write_bytes(content)
    (folder / "a.json").write_bytes(content)
    assert SharedWork(folder, "program").look("a") is None
    assert SharedWork(folder, "program").execution("a") is None


def test_a_look_that_was_cut_off_is_as_if_it_were_not_there(shared, first, tmp_path):
    whole = next(shared._folder.glob("*.npz")).read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 1):
        (tmp_path / "a.npz").write_bytes(whole[:length])
        assert SharedWork(tmp_path, "program").look("a") is None


def test_the_oldest_goes_first_where_there_is_too_much(tmp_path):
    shared = SharedWork(tmp_path, "program")
    for age, name in enumerate("cab"):
        shared.keep_execution(name, EXECUTION)
        os.utime(tmp_path / f"{name}.json", (1e9 - age, 1e9 - age))
    size = (tmp_path / "a.json").stat().st_size
    shared.prune(2 * size)
    assert [shared.execution(name) is not None for name in "cab"] == [True, True, False]


def test_what_is_kept_never_takes_more_than_its_bytes(tmp_path, shared, first, monkeypatch):
    path = next(shared._folder.glob("*.npz"))
    kept, size = shared.look(path.stem), path.stat().st_size
    monkeypatch.setattr(sharing, "MAX_BYTES", 3 * size)
    mine = SharedWork(tmp_path, "program")
    for n in range(5):
        mine.keep_look(str(n), kept)
        os.utime(tmp_path / f"{n}.npz", (1e9 + n, 1e9 + n))
        assert sum(file.stat().st_size for file in tmp_path.iterdir()) <= 3 * size
    assert {file.stem for file in tmp_path.iterdir()} == {"2", "3", "4"}
