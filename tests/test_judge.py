"""The judge's decision, on samples written by hand: boundaries are met from both sides."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator

from tog_drake.compliance import PartLabels
from tog_drake.executor import ExecutorState, Phase
from tog_drake.judge import COMPLIANT_SHARE, HOLD, LIFT, TURN, Judge, Sample, verdict_of
from tog_drake.object_parts import load_parts
from tog_drake.record import OUTCOMES
from tog_drake.resources import resource_dir
from tog_drake.scenario import load_scenario
from tog_drake.stations.simulation import SimulationStation
from tog_drake.world import load_objects

TWO = """
directives:
- add_directives: {file: package://tog_drake/scenes/table.dmd.yaml}
- add_model: {name: hammer, file: package://tog_drake/objects/hammer/hammer.sdf}
- add_model: {name: mug, file: package://tog_drake/objects/mug/mug.sdf}
"""
PHASES = {"approach": 0.5, "close": 1.0, "lift": 2.0, "hold": 3.0}
END = 6.0  # [s] three seconds of hold
HANDLE, HEAD = ("hammer", "handle"), ("hammer", "head")


def _samples(height=0.15, *, held=None, end=END, hit=0.0, touched=None, others=None):
    """An episode in steps of 0.1 s: rises to ``height`` (a number, or of time) from the lift on."""
    held = {HANDLE: 10.0} if held is None else held
    rise = height if callable(height) else lambda t: height * np.clip(t - PHASES["lift"], 0, 1)
    return [
        Sample(
            time=t,
            lift=float(rise(t)),
            held=held if t > 1.2 else {},
            hit=hit,
            touched=(touched or {}) if t > 1.2 else {},
            others=others or {},
            R_HO=np.eye(3),
        )
        for t in np.round(np.arange(0.0, end + 0.05, 0.1), 3)
    ]


def _verdict(samples, *, stopped=False, allowed=("handle",)):
    return verdict_of(samples, PHASES, stopped=stopped, target="hammer", allowed=allowed)


def test_an_object_that_is_up_and_stays_up_is_lifted():
    verdict = _verdict(_samples())
    assert (verdict.outcome, verdict.message) == ("lifted", None)
    assert verdict.grasp_success
    assert verdict.lift == pytest.approx(0.15)


@pytest.mark.parametrize(("height", "outcome"), [(LIFT, "lifted"), (LIFT - 1e-6, "slipped")])
def test_ten_centimetres_are_enough_and_less_is_not(height, outcome):
    assert _verdict(_samples(height)).outcome == outcome


@pytest.mark.parametrize(("since", "outcome"), [(END - HOLD, "lifted"), (4.2, "dropped")])
def test_two_seconds_up_are_enough_and_less_is_not(since, outcome):
    verdict = _verdict(_samples(lambda t: 0.15 if t >= since else 0.0))
    assert verdict.outcome == outcome
    if outcome == "dropped":
        assert verdict.message == "lifted by 0.15 m, but not held there for 2 s"


def test_an_object_that_falls_after_the_lift_is_dropped():
    verdict = _verdict(_samples(lambda t: 0.15 if 3.0 <= t < 5.9 else 0.0))
    assert verdict.outcome == "dropped"
    assert verdict.message == "lost after 0.15 m of lift"
    assert verdict.lift == 0.0


def test_a_dip_below_ten_centimetres_while_it_is_held_counts():
    assert _verdict(_samples(lambda t: 0.09 if t == 5.0 else 0.15)).outcome == "dropped"


@pytest.mark.parametrize(
    ("held", "outcome"), [({}, "empty"), ({HANDLE: 0.49}, "empty"), ({HANDLE: 0.5}, "slipped")]
)
def test_a_grip_without_force_is_empty_and_one_that_does_not_lift_has_slipped(held, outcome):
    assert _verdict(_samples(0.02, held=held)).outcome == outcome


def test_what_was_touched_only_before_the_hand_was_closed_was_not_gripped():
    pushed = [replace(s, held={HANDLE: 9.0} if s.time <= 1.5 else {}) for s in _samples(0.0)]
    assert _verdict(pushed).outcome == "empty"


@pytest.mark.parametrize(("force", "outcome"), [(30.0, "lifted"), (31.0, "collision")])
def test_a_hard_hit_is_a_collision_although_the_object_was_lifted(force, outcome):
    samples = _samples()
    samples[15] = replace(samples[15], hit=force)
    verdict = _verdict(samples)
    assert verdict.outcome == outcome
    if outcome == "collision":
        assert "31 N" in verdict.message
        assert "1.50 s" in verdict.message
        assert not verdict.grasp_success


@pytest.mark.parametrize("end", [0.3, 1.5, END])
def test_an_arm_that_was_stopped_is_a_collision_whenever_that_was(end):
    verdict = _verdict(_samples(end=end), stopped=True)
    assert verdict.outcome == "collision"
    assert "no longer followed its command" in verdict.message
    assert verdict.held == ({"handle": 1.0} if end == END else {})
    assert verdict.task_compliance is (end == END)


def test_every_outcome_of_the_judge_is_explained_in_the_record():
    cases = (
        _samples(),
        _samples(0.02),
        _samples(0.02, held={}),
        _samples(hit=99.0),
        _samples(lambda t: 0.15 if 3.0 <= t < 5.9 else 0.0),
        _samples(0.0, others={"mug": 0.15}),
    )
    outcomes = {_verdict(samples).outcome for samples in cases}
    assert outcomes == {"lifted", "slipped", "empty", "collision", "dropped", "wrong_object"}
    assert outcomes <= set(OUTCOMES)


@pytest.mark.parametrize(
    ("on_handle", "allowed", "compliance"),
    [
        (COMPLIANT_SHARE, ("handle",), True),
        (COMPLIANT_SHARE - 0.01, ("handle",), False),
        (COMPLIANT_SHARE, ("head",), False),
        (0.5, ("handle", "head"), True),
        (0.5, None, None),
    ],
)
def test_the_task_is_met_when_four_fifths_of_the_force_are_on_allowed_parts(
    on_handle, allowed, compliance
):
    held = {HANDLE: 20 * on_handle, HEAD: 20 * (1 - on_handle)}
    verdict = _verdict(_samples(held=held), allowed=allowed)
    assert verdict.task_compliance is compliance
    assert verdict.held == pytest.approx({"handle": on_handle, "head": 1 - on_handle})


def test_the_part_held_is_the_one_at_lift_off_and_not_what_was_touched_later():
    samples = [
        replace(s, held={HEAD: 10.0} if s.time < 2.2 else {HANDLE: 10.0}) for s in _samples()
    ]
    assert _verdict(samples).held == {"head": 1.0}


def test_force_on_another_object_is_no_share_of_the_target():
    held = {HANDLE: 5.0, ("mug", "body"): 15.0}
    verdict = _verdict(_samples(held=held))
    assert verdict.held == {"handle": 0.25}
    assert verdict.task_compliance is False


LEFT_ON_MUG = ("panda_leftfinger", "mug")


def test_another_object_lifted_in_place_of_the_target_is_the_wrong_one():
    verdict = _verdict(_samples(0.02, held={}, others={"spoon": 0.0, "mug": LIFT}))
    assert verdict.outcome == "wrong_object"
    assert verdict.message == "lifted mug instead of hammer"
    assert not verdict.grasp_success
    assert _verdict(_samples(0.02, held={}, others={"mug": LIFT - 1e-6})).outcome == "empty"


def test_a_target_that_comes_up_on_what_was_grasped_is_not_held():
    verdict = _verdict(_samples(held={}, touched={LEFT_ON_MUG: 8.0}, others={"mug": 0.15}))
    assert verdict.outcome == "wrong_object"
    assert verdict.message == "hammer came up with what the fingers hold"


def test_another_object_that_comes_along_with_the_target_does_no_harm():
    assert _verdict(_samples(others={"mug": 0.2})).outcome == "lifted"


@pytest.mark.parametrize(
    ("on_mug", "on_hammer", "outcome"),
    [(6.0, 5.0, "wrong_object"), (5.0, 6.0, "slipped"), (0.4, 0.0, "empty")],
)
def test_what_the_fingers_close_on_more_firmly_is_what_was_grasped(on_mug, on_hammer, outcome):
    samples = _samples(
        0.02, held={HANDLE: on_hammer}, touched={LEFT_ON_MUG: on_mug}, others={"mug": 0.0}
    )
    assert _verdict(samples).outcome == outcome


def test_fingers_that_press_on_the_table_have_grasped_nothing():
    table = {("panda_leftfinger", "table"): 9.0}
    assert _verdict(_samples(0.0, held={}, touched=table, others={"mug": 0.0})).outcome == "empty"


def _turning(axis, degrees):
    """Lifted; from 2.5 s on, after lift-off, the object is turned by ``degrees`` in the hand."""
    R = RotationMatrix(AngleAxis(np.radians(degrees), np.array(axis))).matrix()
    return [replace(s, R_HO=R if s.time > 2.5 else s.R_HO) for s in _samples()]


@pytest.mark.parametrize("degrees", [0.0, 0.01, 9.9, 90.0, 180.0])
def test_the_turn_in_the_hand_is_the_angle_between_lift_off_and_end(degrees):
    verdict = _verdict(_turning([0.6, 0.0, 0.8], degrees))
    assert verdict.turned == pytest.approx(degrees, abs=1e-6)
    assert verdict.grasp_success
    assert verdict.strict_success is (degrees < TURN)


def test_a_turn_before_lift_off_does_not_count_and_one_of_a_lost_object_is_not_known():
    turning = [
        replace(s, R_HO=np.diag([-1.0, -1, 1]) if s.time < 1.9 else s.R_HO) for s in _samples()
    ]
    assert _verdict(turning).turned == 0.0
    verdict = _verdict(_samples(0.02))
    assert verdict.turned is None
    assert not verdict.strict_success


def test_collisions_are_the_hardest_touch_of_each_pair_and_touches_too_light_are_none():
    samples = _samples(others={"mug": 0.0, "spoon": 0.0})
    samples[3] = replace(samples[3], touched={LEFT_ON_MUG: 1.0, ("panda_hand", "spoon"): 0.49})
    samples[7] = replace(samples[7], touched={LEFT_ON_MUG: 2.0, ("panda_link5", "table"): 7.0})
    verdict = _verdict(samples)
    assert verdict.collisions == {"panda_link5 / table": 7.0, "panda_leftfinger / mug": 2.0}
    assert list(verdict.collisions) == ["panda_link5 / table", "panda_leftfinger / mug"]
    assert verdict.outcome == "lifted"
    assert _verdict(_samples()).collisions == {}


def test_the_judge_sees_a_hammer_at_rest_and_nobody_touching_it():
    scenario = load_scenario("Hammer")
    scenario.cameras = {}
    station = SimulationStation(scenario)
    parts = {"hammer": load_parts(resource_dir("models") / "objects" / "hammer" / "parts.yaml")}
    labels = PartLabels.from_plant(station.plant, station.scene_graph, parts)
    judge = Judge(station, labels, "hammer")
    context = station.CreateDefaultContext()
    station.GetInputPort("panda.position").FixValue(context, np.zeros(7))
    station.GetInputPort("hand.position").FixValue(context, [0.08])
    judge.observe(context, ExecutorState(phase=Phase.READY))
    body = station.plant.GetBodyByName("base", station.plant.GetModelInstanceByName("hammer"))
    plant_context = station.plant.GetMyMutableContextFromRoot(context)
    X_WB = body.EvalPoseInWorld(plant_context)
    X_WB.set_translation(X_WB.translation() + np.array([0, 0, 0.12]))
    station.plant.SetFreeBodyPose(plant_context, body, X_WB)
    judge.observe(context, ExecutorState(phase=Phase.MOVE, start_time=-1.5))
    before, after = judge.samples
    assert (before.time, before.lift, before.held, before.hit) == (-1.0, 0.0, {}, 0.0)
    assert (after.time, after.lift) == (1.5, pytest.approx(0.12))
    assert (before.touched, before.others) == ({}, {})


def test_the_judge_sees_what_the_hand_touches_and_whom():
    scenario = load_scenario("Hammer", TWO)
    scenario.cameras = {}
    station = SimulationStation(scenario)
    parts = load_objects(scenario)
    labels = PartLabels.from_plant(station.plant, station.scene_graph, parts)
    judge = Judge(station, labels, "hammer")
    context = station.CreateDefaultContext()
    station.GetInputPort("panda.position").FixValue(context, np.zeros(7))
    station.GetInputPort("hand.position").FixValue(context, [0.08])
    plant_context = station.plant.GetMyMutableContextFromRoot(context)
    hand = station.plant.GetBodyByName("panda_hand").EvalPoseInWorld(plant_context)
    below = hand.translation() - [
        0,
        0,
        0.08,
    ]  # the mug's rim in the palm, the hammer in the fingers
    for model in ("hammer", "mug"):
        body = station.plant.GetBodyByName("base", station.plant.GetModelInstanceByName(model))
        station.plant.SetFreeBodyPose(plant_context, body, RigidTransform(below))
    Simulator(station, context).AdvanceTo(scenario.plant_config.time_step)  # contact is sampled
    judge.observe(context, ExecutorState(phase=Phase.READY))
    (sample,) = judge.samples
    assert sample.touched["panda_hand", "mug"] > 1.0
    assert all(other == "mug" for _, other in sample.touched)
    assert sample.others == {"mug": 0.0}
