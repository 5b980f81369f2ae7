"""The judge's decision, on samples written by hand: boundaries are met from both sides."""

from dataclasses import replace

import numpy as np
import pytest

from tog_drake.compliance import PartLabels, load_parts
from tog_drake.executor import ExecutorState, Phase
from tog_drake.judge import COMPLIANT_SHARE, HOLD, LIFT, Judge, Sample, verdict_of
from tog_drake.record import OUTCOMES
from tog_drake.resources import resource_dir
from tog_drake.scenario import load_scenario
from tog_drake.stations.simulation import SimulationStation

PHASES = {"approach": 0.5, "close": 1.0, "lift": 2.0, "hold": 3.0}
END = 6.0  # [s] three seconds of hold
HANDLE, HEAD = ("hammer", "handle"), ("hammer", "head")


def _samples(height=0.15, *, held=None, end=END, hit=0.0):
    """An episode in steps of 0.1 s: rises to ``height`` (a number, or of time) from the lift on."""
    held = {HANDLE: 10.0} if held is None else held
    rise = height if callable(height) else lambda t: height * np.clip(t - PHASES["lift"], 0, 1)
    return [
        Sample(time=t, lift=float(rise(t)), held=held if t > 1.2 else {}, hit=hit)
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
    )
    outcomes = {_verdict(samples).outcome for samples in cases}
    assert outcomes == {"lifted", "slipped", "empty", "collision", "dropped"}
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
