import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.trajectories import PiecewisePolynomial

from tog_drake.errors import InputError, NoPlan
from tog_drake.executor import ExecutorConfig, GraspExecutor, Phase
from tog_drake.panda import A_MAX, V_MAX
from tog_drake.values import CameraView, GraspMotion, Grasps, NextLook, View

Q_NOW = np.array([-0.3, -0.2, -0.1, -1.5, 0.1, 1.5, 0.3])
Q_END = Q_NOW + 0.1
GRASP = Grasps(np.eye(4)[None], np.array([0.03]), np.ones(1), np.zeros((1, 3)))
HELD, EMPTY = 0.02, 0.0005  # [m] opening of a hand that presses


def _motion(duration=0.5):
    line = PiecewisePolynomial.FirstOrderHold([0.0, duration], np.column_stack([Q_NOW, Q_END]))
    hand = PiecewisePolynomial.FirstOrderHold([0.0, duration], [[0.08, -0.02]])
    retreat = GraspMotion(
        PiecewisePolynomial.FirstOrderHold([0.0, 0.3], np.column_stack([Q_END, Q_NOW])),
        PiecewisePolynomial.FirstOrderHold([0.0, 0.3], [[-0.02, 0.08]]),
        0.3,
        {},
    )
    return GraspMotion(line, hand, duration, {"lift": 0.2}, grasp=GRASP, retreat=retreat)


class _Planner(LeafSystem):
    """Gives a motion, and counts how often it was asked."""

    def __init__(self, error=None):
        super().__init__()
        self.calls = 0
        self._error = error
        self.DeclareAbstractOutputPort("motion", lambda: Value(GraspMotion.still()), self._Calc)

    def _Calc(self, context, output):
        self.calls += 1
        if self._error:
            raise self._error
        output.set_value(_motion())


class _Arm(LeafSystem):
    """An arm that follows its command with an offset that a test can set."""

    def __init__(self):
        super().__init__()
        self.offset = np.zeros(7)
        self.DeclareVectorOutputPort("q", 7, self._Calc)
        self.position = Q_NOW.copy()
        self.opening, self.rate = HELD, 0.0
        self.DeclareVectorOutputPort("hand", 2, self._CalcHand)

    def _Calc(self, context, output):
        output.SetFromVector(self.position + self.offset)

    def _CalcHand(self, context, output):
        output.SetFromVector([self.opening, self.rate])


class _Looker(LeafSystem):
    """Says where to look next as long as fewer than ``enough`` views are remembered."""

    def __init__(self, enough):
        super().__init__()
        self.calls = 0
        self._enough = enough
        self._earlier = self.DeclareAbstractInputPort("earlier_views", Value(()))
        ticket = {self._earlier.ticket()}
        self.DeclareAbstractOutputPort("n", lambda: Value(NextLook.none()), self._Calc, ticket)

    def _Calc(self, context, output):
        self.calls += 1
        n = len(self._earlier.Eval(context)) + 1
        if n <= self._enough:
            left = CameraView(f"wrist#{n}", View.empty(), Q_NOW)
            output.set_value(NextLook(_way(), "more is to be seen", left=left))
        else:
            output.set_value(NextLook.none())


def _way(duration=0.4):
    """There and back, so that the arm of these tests is where the motion starts."""
    arm = PiecewisePolynomial.FirstOrderHold(
        [0.0, duration / 2, duration], np.column_stack([Q_NOW, Q_END, Q_NOW])
    )
    hand = PiecewisePolynomial.FirstOrderHold([0.0, duration], [[0.08, 0.08]])
    return GraspMotion(arm, hand, duration, {})


def _world(config=None, error=None, retries=0, looks=None):
    builder = DiagramBuilder()
    planner = builder.AddSystem(_Planner(error))
    arm = builder.AddSystem(_Arm())
    config = config or ExecutorConfig(look_time=0.1)
    max_looks, enough = looks or (0, 0)
    executor = builder.AddSystem(GraspExecutor(config, retries=retries, max_looks=max_looks))
    if looks:
        looker = builder.AddNamedSystem("looker", _Looker(enough))
        builder.Connect(looker.get_output_port(), executor.GetInputPort("next_look"))
        builder.Connect(executor.GetOutputPort("earlier_views"), looker.get_input_port())
    builder.Connect(planner.get_output_port(), executor.GetInputPort("motion"))
    builder.Connect(arm.GetOutputPort("q"), executor.GetInputPort("panda.position_measured"))
    builder.Connect(arm.GetOutputPort("hand"), executor.GetInputPort("hand.state_measured"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = executor.GetMyContextFromRoot(simulator.get_context())
    return simulator, executor, context, planner, arm


def _commands(executor, context):
    arm = executor.GetOutputPort("panda.position").Eval(context)
    hand = executor.GetOutputPort("hand.position").Eval(context)
    return arm.copy(), float(hand[0])


def test_first_command_is_the_measured_position_before_any_update():
    _, executor, context, _, _ = _world()
    arm, hand = _commands(executor, context)
    np.testing.assert_array_equal(arm, Q_NOW)
    assert hand == HELD


def test_it_looks_with_an_open_hand():
    simulator, executor, context, _, _ = _world()
    simulator.AdvanceTo(0.05)
    assert _commands(executor, context)[1] == pytest.approx(0.08)


def test_it_stands_still_and_asks_for_no_motion_until_the_look():
    simulator, executor, context, planner, arm = _world()
    simulator.AdvanceTo(0.05)
    arm.offset = np.full(7, 0.01)  # a drift of the measurement must not become a command
    simulator.AdvanceTo(0.09)
    np.testing.assert_array_equal(_commands(executor, context)[0], Q_NOW)
    assert planner.calls == 0


def test_the_chain_is_pulled_once():
    simulator, _, _, planner, _ = _world(ExecutorConfig(look_time=0.1, max_tracking_error=10))
    simulator.AdvanceTo(1.0)
    assert planner.calls == 1


def test_motion_starts_one_update_after_planning_and_ends_at_its_end():
    simulator, executor, context, _, _ = _world(
        ExecutorConfig(look_time=0.1, period=0.01, max_tracking_error=10)
    )
    simulator.AdvanceTo(0.105)
    assert executor.state(context).phase is Phase.READY
    np.testing.assert_array_equal(_commands(executor, context)[0], Q_NOW)
    simulator.AdvanceTo(0.115)
    state = executor.state(context)
    assert state.phase is Phase.MOVE
    assert state.start_time == pytest.approx(0.11)
    simulator.AdvanceTo(0.36)  # half way
    np.testing.assert_allclose(_commands(executor, context)[0], (Q_NOW + Q_END) / 2, atol=1e-9)
    simulator.AdvanceTo(1.0)
    assert executor.state(context).phase is Phase.DONE
    arm, hand = _commands(executor, context)
    np.testing.assert_allclose(arm, Q_END, atol=1e-12)
    assert hand == pytest.approx(-0.02)


def test_the_command_to_an_arm_that_does_not_follow_stops_close_to_where_that_was_noticed():
    simulator, executor, context, _, _ = _world(
        ExecutorConfig(look_time=0.1, max_tracking_error=0.05)
    )
    simulator.AdvanceTo(2.0)  # the arm of this test never moves
    state = executor.state(context)
    assert state.phase is Phase.FAILED
    # It was noticed at an error of 0.050 to 0.052 rad; 0.2 rad/s take 3 mrad to brake.
    held = _commands(executor, context)[0]
    assert (held - Q_NOW > 0.05).all()
    assert (held - Q_NOW < 0.056).all()
    simulator.AdvanceTo(2.5)
    np.testing.assert_array_equal(_commands(executor, context)[0], held)


def test_a_stop_is_no_jump_of_the_command():
    simulator, executor, context, _, _ = _world(
        ExecutorConfig(look_time=0.1, max_tracking_error=0.05)
    )
    q = []
    for t in np.arange(0.2, 1.5, 0.001):
        simulator.AdvanceTo(t)
        q.append(_commands(executor, context)[0])
    velocity = np.diff(q, axis=0) / 0.001
    acceleration = np.diff(velocity, axis=0) / 0.001
    assert executor.state(context).phase is Phase.FAILED
    assert (np.abs(velocity) < 1.01 * V_MAX).all()
    assert (np.abs(acceleration) < 1.01 * A_MAX).all()


def test_an_error_of_a_stage_reaches_the_caller_unchanged():
    simulator, *_ = _world(error=NoPlan("blocked by a wall"))
    with pytest.raises(NoPlan, match="blocked by a wall"):
        simulator.AdvanceTo(0.5)


def test_nothing_feeds_through_from_the_motion_to_the_command():
    executor = GraspExecutor(ExecutorConfig())
    motion = executor.GetInputPort("motion").get_index()
    for name in ("panda.position", "hand.position", "failed_grasps"):
        assert not executor.HasDirectFeedthrough(motion, executor.GetOutputPort(name).get_index())


def test_a_measurement_that_is_not_a_number_stops_the_motion_and_never_becomes_a_command():
    config = ExecutorConfig(look_time=0.1, max_tracking_error=10)
    simulator, executor, context, _, arm = _world(config)
    simulator.AdvanceTo(0.3)
    arm.position = np.full(7, np.nan)
    simulator.AdvanceTo(0.5)
    assert executor.state(context).phase is Phase.FAILED
    assert np.isfinite(_commands(executor, context)[0]).all()


def test_a_motion_that_starts_elsewhere_is_not_executed():
    simulator, _, _, _, arm = _world()
    arm.offset = np.full(7, 0.5)
    with pytest.raises(NoPlan, match=r"0\.500 rad away"):
        simulator.AdvanceTo(0.5)


@pytest.mark.parametrize(("look_time", "update"), [(0.57, 57), (1.005, 101), (1.15, 115)])
def test_the_look_is_at_the_time_of_an_update(look_time, update):
    config = ExecutorConfig(look_time=look_time, max_tracking_error=10)
    simulator, executor, context, planner, _ = _world(config)
    assert executor.look_time == update * 0.01
    simulator.AdvanceTo(executor.look_time)
    assert planner.calls == 0
    simulator.AdvanceTo(executor.look_time + 0.005)
    assert executor.state(context).phase is Phase.READY
    assert planner.calls == 1


RELAXED = ExecutorConfig(look_time=0.1, max_tracking_error=10)


def _failed(executor, context):
    return executor.GetOutputPort("failed_grasps").Eval(context)


def test_a_hand_that_closed_on_nothing_goes_back_looks_again_and_tries_again():
    simulator, executor, context, planner, arm = _world(RELAXED, retries=1)
    arm.opening = EMPTY
    simulator.AdvanceTo(0.605)  # look at 0.1, move from 0.11 to 0.61
    assert executor.state(context).phase is Phase.MOVE
    assert len(_failed(executor, context)) == 0
    simulator.AdvanceTo(0.765)  # half way back
    assert executor.state(context).phase is Phase.RETREAT
    position, hand = _commands(executor, context)
    np.testing.assert_allclose(position, Q_NOW + 0.1 * (0.3 - 0.155) / 0.3, atol=1e-9)
    assert hand == pytest.approx(-0.02 + 0.1 * 0.155 / 0.3)
    np.testing.assert_array_equal(_failed(executor, context).X_WG, GRASP.X_WG)
    simulator.AdvanceTo(0.95)
    state = executor.state(context)
    assert (state.phase, state.attempt) == (Phase.OBSERVE, 2)
    assert state.look_at == pytest.approx(1.01)
    assert state.opening_after == EMPTY
    np.testing.assert_allclose(_commands(executor, context)[0], Q_NOW, atol=1e-12)
    assert planner.calls == 1
    arm.opening = HELD
    simulator.AdvanceTo(1.7)
    state = executor.state(context)
    assert (state.phase, state.attempt, state.opening_after) == (Phase.DONE, 2, HELD)
    assert planner.calls == 2


@pytest.mark.parametrize(("retries", "opening"), [(0, EMPTY), (1, HELD), (1, np.nan)])
def test_without_a_reason_or_leave_to_try_again_the_motion_is_the_last(retries, opening):
    simulator, executor, context, planner, arm = _world(RELAXED, retries=retries)
    arm.opening = opening
    simulator.AdvanceTo(2.0)
    assert executor.state(context).phase is Phase.DONE
    assert planner.calls == 1
    assert len(_failed(executor, context)) == 0


@pytest.mark.parametrize(("until", "begins"), [(0.0, 0.31), (0.6, 0.61), (9.0, 0.81)])
def test_the_lift_waits_for_fingers_that_still_move_but_not_for_ever(until, begins):
    """The look is at 0.1 s, the motion begins one update later, its lift 0.2 s after that."""
    config = ExecutorConfig(look_time=0.1, hand_patience=0.5, max_tracking_error=10)
    simulator, executor, context, _, arm = _world(config)
    lifts = None
    while lifts is None:
        simulator.AdvanceTo(simulator.get_context().get_time() + 0.005)
        t, state = simulator.get_context().get_time(), executor.state(context)
        arm.rate = 0.005 if t < until else 0.0
        if state.phase is Phase.MOVE and t - state.start_time > 0.2:
            lifts = t
    assert lifts == pytest.approx(begins, abs=0.021)


def test_it_tries_again_no_more_often_than_it_may():
    simulator, executor, context, planner, arm = _world(RELAXED, retries=2)
    arm.opening = EMPTY
    simulator.AdvanceTo(5.0)
    assert (executor.state(context).phase, planner.calls) == (Phase.DONE, 3)
    assert len(_failed(executor, context)) == 2


def test_a_negative_number_of_retries_is_refused():
    with pytest.raises(InputError, match="retries is -1; valid: 0 or more"):
        GraspExecutor(ExecutorConfig(), retries=-1)


def _earlier(executor, context):
    return [view.camera for view in executor.GetOutputPort("earlier_views").Eval(context)]


def test_it_looks_again_as_often_as_is_asked_then_decides_and_moves():
    simulator, executor, context, planner, _ = _world(RELAXED, looks=(3, 2))
    looker = simulator.get_system().GetSubsystemByName("looker")
    simulator.AdvanceTo(0.105)  # look at 0.1: the first way from 0.11 to 0.51
    assert (executor.state(context).phase, _earlier(executor, context)) == (
        Phase.READY,
        ["wrist#1"],
    )
    simulator.AdvanceTo(0.31)
    assert executor.state(context).phase is Phase.LOOK
    arm, hand = _commands(executor, context)
    np.testing.assert_allclose(arm, Q_END, atol=1e-9)
    assert hand == pytest.approx(0.08)
    simulator.AdvanceTo(0.55)
    state = executor.state(context)
    assert (state.phase, state.look_at) == (Phase.OBSERVE, pytest.approx(0.61))
    assert planner.calls == 0
    simulator.AdvanceTo(1.15)  # the second from 0.62 to 1.02, the third is not wanted at 1.12
    assert executor.state(context).phase is Phase.MOVE
    assert _earlier(executor, context) == ["wrist#1", "wrist#2"]
    assert (looker.calls, planner.calls) == (3, 1)
    simulator.AdvanceTo(2.0)
    assert executor.state(context).phase is Phase.DONE
    assert executor.looks_left(context) == 1


def test_it_looks_again_no_more_often_than_it_may_and_does_not_ask_then():
    simulator, executor, context, planner, _ = _world(RELAXED, looks=(1, 9))
    simulator.AdvanceTo(2.0)
    looker = simulator.get_system().GetSubsystemByName("looker")
    assert (executor.state(context).phase, looker.calls, planner.calls) == (Phase.DONE, 1, 1)
    assert executor.looks_left(context) == 0


def test_an_arm_that_does_not_follow_on_its_way_to_a_look_is_stopped():
    config = ExecutorConfig(look_time=0.1, max_tracking_error=0.05)
    simulator, executor, context, planner, _ = _world(config, looks=(1, 1))
    simulator.AdvanceTo(2.0)  # the arm of this test never moves
    state = executor.state(context)
    assert (state.phase, state.motion, planner.calls) == (Phase.FAILED, None, 0)


def test_a_look_that_starts_elsewhere_is_not_gone_to():
    simulator, _, _, _, arm = _world(looks=(1, 1))
    arm.offset = np.full(7, 0.5)
    with pytest.raises(NoPlan, match=r"0\.500 rad away"):
        simulator.AdvanceTo(0.5)


def test_a_new_attempt_forgets_what_was_seen_before_it_and_may_look_again():
    simulator, executor, context, planner, arm = _world(RELAXED, retries=1, looks=(1, 1))
    arm.opening = EMPTY
    simulator.AdvanceTo(1.0)
    assert _earlier(executor, context) == ["wrist#1"]
    simulator.AdvanceTo(1.45)  # back at 1.42
    state = executor.state(context)
    assert (state.attempt, state.phase, _earlier(executor, context)) == (2, Phase.OBSERVE, [])
    simulator.AdvanceTo(4.0)
    assert (_earlier(executor, context), planner.calls) == (["wrist#1"], 2)


def test_nothing_feeds_through_from_the_next_look_to_the_commands_nor_to_the_earlier_views():
    executor = GraspExecutor(ExecutorConfig(), max_looks=1)
    look = executor.GetInputPort("next_look").get_index()
    for name in ("panda.position", "hand.position", "earlier_views"):
        assert not executor.HasDirectFeedthrough(look, executor.GetOutputPort(name).get_index())
