"""The guard: whatever comes in, what goes out is inside the limits, or stops inside them."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from tog_drake.errors import InputError
from tog_drake.panda import A_MAX, J_MAX, Q_LOWER, Q_UPPER, V_MAX, X_HG, forward_kinematics
from tog_drake.safety import (
    LONGEST_STOP,
    PERIOD,
    Commanded,
    SafetyConfig,
    StopReason,
    braked,
    broken_rule,
    limits_of,
    rest,
)
from tog_drake.scenario import LOOK_POSTURE
from tog_drake.stations.guard import Guard, GuardMode, Heard, Operator
from tog_drake.stations.lcm_bus import ArmStatus, RobotMode

HOME = np.array(LOOK_POSTURE)
TICKS = 400


def status(q=HOME, **changes):
    fields = {"utime": 1, "q": q, "v": np.zeros(7), "torque_external": np.zeros(7)}
    return ArmStatus(**{**fields, "robot_mode": RobotMode.MOVE, **changes})


class Bench:
    """A guard by itself: ticks with what is wanted and heard; keeps what it commanded."""

    def __init__(self, safety=None, *, armed=True):
        self.operator = Operator()
        self.guard = Guard(safety or SafetyConfig(), self.operator)
        self.simulator = Simulator(self.guard)
        self.context = self.simulator.get_mutable_context()
        self.sent, self.ticks = [], 0
        if armed:
            self.operator.arm()

    @property
    def state(self):
        return self.guard.state(self.context)

    def tick(self, q, heard=None, opening=0.08):
        """Of the arm it hears that it is where it was last commanded to be."""
        if heard is None:
            at = self.sent[-1] if self.sent else HOME
            heard = Heard(status(at), 0.0)
        self.guard.GetInputPort("panda.position").FixValue(self.context, q)
        self.guard.GetInputPort("hand.position").FixValue(self.context, [opening])
        self.guard.GetInputPort("heard").FixValue(self.context, Value(heard))
        self.ticks += 1
        self.simulator.AdvanceTo(self.ticks * PERIOD)
        if self.state.commands:
            self.sent.append(self.state.commanded.q)
        return self.state

    def rates(self):
        """Finite differences of what was sent, as if the arm had stood still before."""
        q = np.vstack([self.sent[:1] * 3, self.sent])
        v, a, j = (np.diff(q, n, axis=0) / PERIOD**n for n in (1, 2, 3))
        return v, a, j


def assert_inside_limits(bench):
    v, a, j = bench.rates()
    q, p = np.array(bench.sent), (forward_kinematics(np.array(bench.sent)) @ X_HG)[:, :3, 3]
    config = SafetyConfig()
    assert (np.abs(v) <= config.velocity * V_MAX * (1 + 1e-5)).all()
    assert (np.abs(a) <= config.acceleration * A_MAX * (1 + 1e-5)).all()
    assert (np.abs(j) <= config.jerk * J_MAX * (1 + 1e-5)).all()
    assert (q >= Q_LOWER + 0.99 * config.position_margin).all()
    assert (q <= Q_UPPER - 0.99 * config.position_margin).all()
    return v, p


def wish(kind, rng, ticks=TICKS):
    """A stream of desired positions (ticks, 7) that begins at home."""
    t = np.arange(ticks)[:, None] * PERIOD
    amplitude, frequency = rng.uniform(0, 0.5, 7), rng.uniform(0.1, 1.5, 7)
    smooth = HOME + amplitude * (1 - np.cos(2 * np.pi * frequency * t)) * np.minimum(t, 1) ** 3
    when = int(rng.integers(20, ticks // 2))
    if kind == "jump":
        smooth[when:] += rng.normal(0, 10.0 ** rng.uniform(-3, 1), 7)
    elif kind == "nan":
        smooth[when, rng.integers(7)] = rng.choice([np.nan, np.inf, -np.inf])
    elif kind == "noise":
        smooth[when:] += rng.normal(0, 10.0 ** rng.uniform(-6, -2), (ticks - when, 7))
    elif kind == "straight to a limit":
        smooth = HOME + np.sign(rng.normal(size=7)) * rng.uniform(0.1, 1) * V_MAX * t**2
    elif kind == "walk":
        a = rng.uniform(-1, 1, (ticks, 7)) * A_MAX
        smooth = HOME + np.cumsum(np.cumsum(a, axis=0), axis=0) * PERIOD**2
    return smooth


KINDS = ("smooth", "jump", "nan", "noise", "straight to a limit", "walk")


@pytest.mark.parametrize("kind", KINDS)
def test_whatever_comes_in_what_goes_out_keeps_the_limits_and_stops_in_time(kind):
    stops = 0
    for seed in range(8):
        bench = Bench()
        stopping = []
        for q in wish(kind, np.random.default_rng(seed)):
            state = bench.tick(q)
            stopping.append(state.mode is GuardMode.STOPPING)
        assert_inside_limits(bench)
        if state.mode is not GuardMode.ARMED:
            stops += 1
            assert sum(stopping) * PERIOD <= LONGEST_STOP
            stopped_at = len(bench.sent)
            for _ in range(20):  # whoever asks for whatever: it stays stopped
                assert bench.tick(HOME).mode is GuardMode.STOPPED
            assert len(bench.sent) == stopped_at
    assert stops > 0


def test_the_longest_stop_there_may_be_is_inside_the_limits_and_takes_no_longer_than_allowed():
    limits = limits_of(SafetyConfig())
    rng = np.random.default_rng(0)
    for _ in range(200):
        v = rng.choice([-1, 1], 7) * limits.velocity * rng.choice([1.0, rng.uniform()], 7)
        a = rng.uniform(-1, 1, 7) * limits.acceleration
        last, n = Commanded(HOME, v, a), 0
        expected = rest(HOME, v, limits)
        while last.v.any() or last.a.any():
            after = braked(last, limits)
            assert (np.abs(after.a) <= limits.acceleration * (1 + 1e-9)).all()
            assert (np.abs(after.a - last.a) <= PERIOD * limits.jerk * (1 + 1e-9)).all()
            last, n = after, n + 1
        assert n * PERIOD <= LONGEST_STOP
        np.testing.assert_allclose(last.q, expected, atol=1e-12)


def test_a_smooth_motion_passes_unchanged():
    bench = Bench()
    wanted = HOME + 0.1 * (1 - np.cos(np.pi * PERIOD * np.arange(TICKS)))[:, None]
    for q in wanted:
        assert bench.tick(q).mode is GuardMode.ARMED
    np.testing.assert_array_equal(bench.sent, wanted)


def test_nothing_goes_out_before_somebody_says_yes():
    bench = Bench(armed=False)
    for q in wish("walk", np.random.default_rng(0), 50):
        assert bench.tick(q).mode is GuardMode.DISARMED
    assert bench.state.opening is None
    assert not bench.sent


def test_the_first_command_is_where_the_arm_is_or_there_is_none():
    bench = Bench()
    assert bench.tick(HOME + 0.009).mode is GuardMode.ARMED
    np.testing.assert_array_equal(bench.sent, [HOME + 0.009])
    for q in (HOME + 0.011, np.full(7, np.nan), np.zeros(7)):
        bench = Bench()
        assert bench.tick(q).mode is GuardMode.STOPPED
        assert bench.state.broken[0] is StopReason.START
        assert not bench.sent


def moving_bench():
    """One that moves at 0.4 rad/s, and where it wants to go next."""
    bench = Bench()
    for move in PERIOD * np.cumsum(np.minimum(0.02 * np.arange(60), 0.4)):
        q = HOME + move * np.eye(7)[0]
        bench.tick(q)
    assert bench.state.mode is GuardMode.ARMED, bench.state.broken
    return bench, q + 0.4 * PERIOD * np.eye(7)[0]


TROUBLE = {
    StopReason.STALE_STATUS: lambda q: Heard(status(q), 0.101),
    StopReason.ROBOT_MODE: lambda q: Heard(status(q, robot_mode=RobotMode.REFLEX), 0.0),
    StopReason.TRACKING: lambda q: Heard(status(q + 0.11), 0.0),
    StopReason.EXTERNAL_TORQUE: lambda q: Heard(status(q, torque_external=-21 * np.eye(7)[1]), 0.0),
    StopReason.FOREIGN_COMMAND: lambda q: Heard(status(q), 0.0, foreign=True),
}


@pytest.mark.parametrize("rule", TROUBLE, ids=lambda rule: rule.value)
def test_what_the_arm_says_stops_it_for_good(rule):
    bench, q = moving_bench()
    bench.tick(q, TROUBLE[rule](bench.sent[-1]))
    assert bench.state.broken[0] is rule
    # A reflex is the controller's own stop: it is not commanded against.
    assert (bench.state.mode is GuardMode.STOPPED) == (rule is StopReason.ROBOT_MODE)
    for _ in range(80):
        bench.tick(q)  # all is well again, and the pipeline goes on
    assert bench.state.mode is GuardMode.STOPPED
    assert bench.state.broken[0] is rule
    assert_inside_limits(bench)


def test_a_person_stops_it_and_the_first_reason_stays():
    bench, q = moving_bench()
    bench.operator.stop(StopReason.OPERATOR, "Ctrl-C")
    bench.operator.stop(StopReason.STALLED, "later")
    for _ in range(80):
        bench.tick(q)
    assert bench.state.mode is GuardMode.STOPPED
    assert bench.state.broken == (StopReason.OPERATOR, "Ctrl-C")
    assert (bench.rates()[0][-1] == 0).all()


BEYOND = {
    StopReason.NOT_FINITE: HOME * np.nan,
    StopReason.POSITION: HOME + 0.001 * np.eye(7)[1],
    StopReason.VELOCITY: HOME + 0.1 * np.eye(7)[6],
    StopReason.WORKSPACE: HOME + 1e-5 * np.eye(7)[6],
    StopReason.HAND_SPEED: HOME + 1e-5 * np.eye(7)[1],
    StopReason.ACCELERATION: HOME + 1e-3 * np.eye(7)[6],
}
SETTINGS = {
    StopReason.WORKSPACE: SafetyConfig(workspace_upper=[0.85, 0.5, 0.05]),
    StopReason.HAND_SPEED: SafetyConfig(hand_speed=1e-6),
}


@pytest.mark.parametrize("rule", BEYOND, ids=lambda rule: rule.value)
def test_each_rule_names_itself(rule):
    config = SETTINGS.get(rule, SafetyConfig())
    last = Commanded.at_rest(HOME)
    if rule is StopReason.POSITION:  # at a speed at which it could not stop in time
        edge = HOME + (Q_UPPER[1] - 0.1 - HOME[1]) * np.eye(7)[1]
        last = Commanded(edge, 1.5 * np.eye(7)[1], np.zeros(7))
        broken = broken_rule(
            last, edge[None] + 1.5 * PERIOD * np.eye(7)[1], config, limits_of(config)
        )
    else:
        broken = broken_rule(last, BEYOND[rule][None], config, limits_of(config))
    assert broken is not None
    assert broken[0] is rule
    assert (
        broken_rule(Commanded.at_rest(HOME), HOME[None], SafetyConfig(), limits_of(SafetyConfig()))
        is None
    )


@pytest.mark.parametrize(
    "settings",
    [
        {"velocity": 1.5},
        {"velocity": 1.0, "acceleration": 0.5},
        {"jerk": 0.1},
        {"hand_speed": -1.0},
        {"position_margin": float("nan")},
        {"workspace_lower": [0.0, 0.0]},
        {"external_torque": [1.0]},
        {"status_age": float("nan")},
    ],
    ids=str,
)
def test_settings_that_make_no_sense_are_refused(settings):
    with pytest.raises(InputError, match=r"safety: "):
        limits_of(SafetyConfig(**settings))
