"""The rules of the emulated drivers, without LCM, a clock or a simulation."""

import numpy as np
import pytest
from drake import lcmt_panda_command, lcmt_schunk_wsg_command
from hypothesis import given
from hypothesis import strategies as st

from tog_drake.hardware.arm_driver import ArmDriver, Verdict
from tog_drake.hardware.hand_driver import MOVING_RATE, HandDriver, HandVerdict
from tog_drake.panda import A_MAX, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.scenario import LOOK_POSTURE
from tog_drake.stations.lcm_bus import RobotMode, arm_command_message, hand_command_message

Q = np.array(LOOK_POSTURE)
NOW = 1e9  # [s]
PERIOD = 0.005  # [s]
STIFFNESS = 8000.0  # [N/m] of a finger


def sent(q, at=NOW):
    return arm_command_message(q, round(1e6 * at))


def standing(driver, steps=200, now=NOW):
    """Lets one second pass; returns what the joints were told, (steps, 7)."""
    return np.array([driver.advance(now + i * PERIOD, PERIOD) for i in range(1, steps + 1)])


def moving(driver, v, steps=40):
    """Speeds joint 1 up to ``v`` and keeps it; returns when and where the last command was."""
    q = Q.copy()
    for i in range(steps):
        assert driver.receive(sent(q, NOW + i * PERIOD), NOW + i * PERIOD) is Verdict.ACCEPTED
        driver.advance(NOW + i * PERIOD, PERIOD)
        q[0] += v * min(1, i / 20) * PERIOD
    return NOW + steps * PERIOD, q


def test_the_arm_goes_where_the_newest_command_says_and_stays_there():
    driver = ArmDriver(Q)
    now, q = moving(driver, v=1.0)
    np.testing.assert_allclose(standing(driver, now=now)[-1], q, atol=0.006)
    assert (driver.mode, driver.running, driver.moved) == (RobotMode.MOVE, True, True)


def test_an_arm_that_is_told_to_stay_where_it_is_has_not_moved():
    driver = ArmDriver(Q)
    assert driver.receive(sent(Q), NOW) is Verdict.ACCEPTED
    assert not driver.moved


@pytest.mark.parametrize("late", [0.11, 3.0, -0.11])
def test_a_command_that_is_too_old_or_of_the_future_is_as_none(late):
    driver = ArmDriver(Q)
    assert driver.receive(sent(Q + 1.0), NOW + late) is Verdict.EXPIRED
    assert driver.mode is RobotMode.MOVE
    np.testing.assert_array_equal(standing(driver)[-1], Q)


def test_the_first_command_must_be_where_the_arm_is_held():
    assert ArmDriver(Q).receive(sent(Q + 0.009), NOW) is Verdict.ACCEPTED
    assert ArmDriver(Q).receive(sent(Q + 0.011), NOW) is Verdict.REFLEX


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("sign", [1, -1])
def test_a_jump_of_any_joint_is_a_reflex(joint, sign):
    driver = ArmDriver(Q)
    driver.receive(sent(Q), NOW)
    q = Q.copy()
    q[joint] += sign * 1.01 * V_MAX[joint] * PERIOD
    assert driver.receive(sent(q, NOW + PERIOD), NOW + PERIOD) is Verdict.REFLEX
    assert f"joint {joint + 1}" in driver.why


@given(gap=st.floats(0.0, 0.099), speed=st.floats(1.05, 100.0))
def test_no_gap_between_commands_allows_a_jump(gap, speed):
    driver = ArmDriver(Q)
    driver.receive(sent(Q), NOW)
    q = Q + speed * V_MAX * max(0.005, min(gap, 0.02)) * np.eye(7)[0]
    assert driver.receive(sent(q, NOW + gap), NOW + gap) is Verdict.REFLEX


def test_to_start_or_stop_at_once_from_half_the_speed_limit_is_a_discontinuity():
    driver = ArmDriver(Q)
    now, q = moving(driver, v=0.6 * V_MAX[0])
    driver.receive(sent(q, now), now)
    assert driver.receive(sent(q, now + PERIOD), now + PERIOD) is Verdict.REFLEX
    assert "discontinuity" in driver.why


@pytest.mark.parametrize("limit", [Q_LOWER - 0.001, Q_UPPER + 0.001])
def test_a_position_beyond_its_limit_is_a_reflex(limit):
    inside = np.clip(limit, Q_LOWER, Q_UPPER)
    driver = ArmDriver(inside)
    assert driver.receive(sent(limit), NOW) is Verdict.REFLEX
    assert "limit" in driver.why


def test_a_position_that_is_no_number_is_a_reflex():
    q = Q.copy()
    q[2] = np.nan
    assert ArmDriver(Q).receive(sent(q), NOW) is Verdict.REFLEX


def test_after_a_reflex_the_arm_brakes_within_its_limits_and_then_obeys_nobody():
    driver = ArmDriver(Q)
    now, q = moving(driver, v=1.0)
    assert driver.receive(sent(q + 1.0, now), now) is Verdict.REFLEX
    told = standing(driver, now=now)
    a = np.diff(told, n=2, axis=0) / PERIOD**2
    assert np.all(np.abs(a) <= 1.5 * A_MAX)
    np.testing.assert_allclose(told[-1], told[60], atol=1e-6)  # it stands after 0.3 s
    assert 0 < told[-1][0] - q[0] < 0.1
    assert driver.receive(sent(told[-1], now + 1.0), now + 1.0) is Verdict.IGNORED
    np.testing.assert_allclose(standing(driver, now=now + 1e4)[-1], told[-1], atol=1e-9)
    assert driver.mode is RobotMode.REFLEX


def test_a_recovered_arm_wants_a_first_command_again():
    driver = ArmDriver(Q, recover_after=2.0)
    driver.receive(sent(Q + 1.0), NOW)
    standing(driver)
    assert driver.mode is RobotMode.REFLEX
    driver.advance(NOW + 2.01, PERIOD)
    assert driver.mode is RobotMode.MOVE
    assert driver.receive(sent(Q, NOW + 2.1), NOW + 2.1) is Verdict.ACCEPTED


def _wrong(**fields):
    m = lcmt_panda_command.decode(sent(Q))
    for name, value in fields.items():
        setattr(m, name, value)
    return m.encode()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"nothing" * 9,
        _wrong(control_mode_expected=2),
        _wrong(num_joint_position=6, joint_position=[0.0] * 6),
        _wrong(num_joint_velocity=7, joint_velocity=[0.0] * 7),
        _wrong(num_joint_torque=7, joint_torque=[0.0] * 7),
    ],
    ids=["empty", "noise", "mode", "six", "velocities", "torques"],
)
def test_a_message_that_it_does_not_understand_ends_the_driver(data):
    driver = ArmDriver(Q)
    assert driver.receive(data, NOW) is Verdict.ENDED
    standing(driver)
    assert not driver.running
    assert driver.receive(sent(Q), NOW) is Verdict.IGNORED


def test_a_driver_that_was_ended_for_a_time_stands_meanwhile_and_comes_back():
    driver = ArmDriver(Q)
    now, _ = moving(driver, v=0.5)
    driver.end("restarted", now, silence=1.5)
    told = standing(driver, now=now)
    assert not driver.running
    driver.advance(now + 1.51, PERIOD)
    assert (driver.running, driver.mode) == (True, RobotMode.MOVE)
    np.testing.assert_allclose(driver.q_desired, told[-1], atol=1e-9)


def closed(hand, opening, least=0.0, seconds=2.0):
    """A hand whose fingers follow; nothing lets them closer than ``least``. The last command."""
    command = opening
    for _ in range(round(seconds / PERIOD)):
        command = hand.advance(opening, PERIOD)
        opening = max(command, least)
    return opening, command


def test_a_wider_command_moves_the_hand_and_its_force_is_nothing():
    hand = HandDriver(0.02, STIFFNESS)
    assert hand.receive(hand_command_message(0.06, 0.0, 1), 0.02) is HandVerdict.MOVE
    assert hand.rate == MOVING_RATE
    opening, _ = closed(hand, 0.02)
    assert (opening, hand.rate) == (pytest.approx(0.06, abs=1e-3), 0.0)


@pytest.mark.parametrize("width", [0.0, 0.03, 0.07])
def test_a_narrower_command_closes_on_what_is_there_with_its_force_whatever_its_width(width):
    hand = HandDriver(0.08, STIFFNESS)
    assert hand.receive(hand_command_message(width, 40.0, 1), 0.08) is HandVerdict.GRASP
    opening, command = closed(hand, 0.08, least=0.028)
    assert opening == 0.028
    assert STIFFNESS * (opening - command) / 2 == pytest.approx(40.0)
    assert hand.rate == 0.0


def test_a_grasp_without_force_does_nothing():
    hand = HandDriver(0.08, STIFFNESS)
    hand.receive(hand_command_message(0.0, 0.0, 1), 0.08)
    assert closed(hand, 0.08)[0] == 0.08


def test_a_command_like_the_last_one_is_ignored_for_ever_and_a_changed_one_is_not():
    hand = HandDriver(0.08, STIFFNESS)
    hand.receive(hand_command_message(0.0, 40.0, 1), 0.08)
    opening, _ = closed(hand, 0.08, least=0.03)
    assert hand.receive(hand_command_message(0.0, 40.0, 2), 0.08) is HandVerdict.IGNORED
    assert hand.receive(hand_command_message(0.0, 41.0, 3), opening) is HandVerdict.GRASP


def test_a_new_command_stops_what_is_going_on():
    hand = HandDriver(0.08, STIFFNESS)
    hand.receive(hand_command_message(0.0, 40.0, 1), 0.08)
    opening, _ = closed(hand, 0.08, seconds=0.3)
    assert opening == pytest.approx(0.05, abs=1e-3)
    hand.receive(hand_command_message(0.07, 40.0, 2), opening)
    assert closed(hand, opening)[0] == pytest.approx(0.07, abs=1e-3)


@pytest.mark.parametrize("field", ["target_position_mm", "force"])
def test_a_hand_command_without_a_number_is_refused(field):
    m = lcmt_schunk_wsg_command()
    m.utime, m.target_position_mm, m.force = 1, 0.0, 40.0
    setattr(m, field, np.nan)
    hand = HandDriver(0.08, STIFFNESS)
    assert hand.receive(m.encode(), 0.08) is HandVerdict.REFUSED
    assert hand.receive(b"noise", 0.08) is HandVerdict.REFUSED
    assert closed(hand, 0.08)[0] == 0.08
