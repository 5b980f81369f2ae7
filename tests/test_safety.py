"""A whole motion against the rules of safety, and how the executor keeps to them."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from tog_drake.errors import InputError, Stopped
from tog_drake.executor import ExecutorConfig, GraspExecutor, Phase
from tog_drake.safety import SafetyConfig, StopReason, check_motion
from tog_drake.scenario import LOOK_POSTURE
from tog_drake.values import GraspMotion

HOME = np.array(LOOK_POSTURE)
THERE = HOME + np.array([0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.2])

ANYWHERE = {"workspace_lower": [-2.0] * 3, "workspace_upper": [2.0] * 3}


def motion(duration=1.0, end=THERE):
    """From home to ``end``, smoothly."""
    arm = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, duration / 2, duration],
        np.column_stack([HOME, (HOME + end) / 2, end]),
        np.zeros(7),
        np.zeros(7),
    )
    hand = PiecewisePolynomial.FirstOrderHold([0.0, duration], [[0.08, -0.02]])
    return GraspMotion(arm, hand, duration, {"close": duration / 2, "lift": duration})


def test_a_motion_inside_the_rules_is_accepted():
    check_motion(motion(), HOME, SafetyConfig())


@pytest.mark.parametrize(
    ("rule", "changed", "settings"),
    [
        (StopReason.START, {"end": THERE}, {}),
        (StopReason.VELOCITY, {}, {"velocity": 0.01}),
        (StopReason.HAND_SPEED, {}, {"hand_speed": 0.05}),
        (StopReason.WORKSPACE, {"end": HOME + 1.2 * np.eye(7)[0], "duration": 4.0}, {}),
        (StopReason.POSITION, {"end": HOME + 2.9 * np.eye(7)[0], "duration": 9.0}, ANYWHERE),
    ],
    ids=lambda value: getattr(value, "value", ""),
)
def test_a_motion_that_breaks_a_rule_is_refused_by_its_name(rule, changed, settings):
    q = HOME + (0.011 if rule is StopReason.START else 0.0)
    with pytest.raises(Stopped) as error:
        check_motion(motion(**changed), q, SafetyConfig(**settings))
    assert error.value.rule is rule


def test_a_slowed_motion_takes_the_same_way_in_more_time():
    planned, slow = motion(), motion().slowed(0.25)
    assert slow.duration == 4.0
    assert slow.phase_times == {"close": 2.0, "lift": 4.0}
    for t in np.linspace(0, 1, 11):
        np.testing.assert_allclose(slow.arm.value(4 * t), planned.arm.value(t), atol=1e-12)
        np.testing.assert_allclose(slow.hand.value(4 * t), planned.hand.value(t), atol=1e-12)
        faster = slow.arm.EvalDerivative(4 * t, 1)
        np.testing.assert_allclose(4 * faster, planned.arm.EvalDerivative(t, 1), atol=1e-9)
    assert planned.slowed(1.0) is planned


def executor(q=HOME, *, safety=None, planned=None, **config):
    """An executor whose arm stands at ``q``, with its simulator."""
    system = GraspExecutor(ExecutorConfig(look_time=0.1, **config), safety=safety)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("motion").FixValue(context, Value(planned or motion()))
    system.GetInputPort("panda.position_measured").FixValue(context, q)
    system.GetInputPort("hand.state_measured").FixValue(context, [0.08, 0.0])
    return system, simulator, context


def test_the_executor_plays_a_motion_at_the_speed_it_is_set_to():
    system, simulator, context = executor(speed=0.5)
    simulator.AdvanceTo(0.15)
    state = system.state(context)
    assert (state.phase, state.motion.duration) == (Phase.MOVE, 2.0)


@pytest.mark.parametrize("speed", [0.0, 1.5, float("nan")])
def test_a_speed_that_is_no_share_is_refused(speed):
    with pytest.raises(InputError, match="speed"):
        GraspExecutor(ExecutorConfig(speed=speed))


def test_the_executor_never_begins_what_breaks_a_rule():
    strict = SafetyConfig(hand_speed=0.05)
    system, simulator, context = executor(safety=strict)
    with pytest.raises(Stopped, match="hand_speed"):
        simulator.AdvanceTo(0.15)
    assert system.state(context).phase is Phase.OBSERVE
    _, simulator, _ = executor(safety=strict, speed=0.1)
    simulator.AdvanceTo(0.15)  # slowly it may


def test_an_arm_that_moved_while_somebody_thought_about_it_is_not_commanded():
    system, simulator, context = executor(safety=SafetyConfig())
    simulator.AdvanceTo(0.105)
    assert system.state(context).phase is Phase.READY
    system.GetInputPort("panda.position_measured").FixValue(context, HOME + 0.02)
    with pytest.raises(Stopped) as error:
        simulator.AdvanceTo(0.15)
    assert error.value.rule is StopReason.START
