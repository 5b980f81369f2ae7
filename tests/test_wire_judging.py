"""The judge of the hardware benchmark: it sees what is outside the limits, and what a stop is."""

import numpy as np
import pytest
from wire_judging import braking_periods, judge_wire

from tog_drake.panda import Q_UPPER, V_MAX
from tog_drake.safety import PERIOD, Commanded, SafetyConfig, braked, limits_of
from tog_drake.scenario import LOOK_POSTURE

HOME = np.array(LOOK_POSTURE)
SPEED = 0.5 * np.eye(7)[0]  # [rad/s]


def moving(n=50):
    """Commands that come to a speed within half a second, and go on at it."""
    v = np.minimum(np.arange(n) / (n / 2), 1.0)[:, None] * SPEED
    return HOME + PERIOD * np.cumsum(v, axis=0)


def with_stop(q):
    limits = limits_of(SafetyConfig())
    v, v_before = ((q[-1 - k] - q[-2 - k]) / PERIOD for k in (0, 1))
    last, stop = Commanded(q[-1], v, (v - v_before) / PERIOD), []
    while last.v.any() or last.a.any():
        last = braked(last, limits)
        stop.append(last.q)
    return np.vstack([q, stop]), len(stop) - 1  # the last one stands already


def log_of(q, *, measured=None, v=None):
    measured = q if measured is None else measured
    v = np.zeros_like(measured) if v is None else v
    lines = []
    for i, q_i in enumerate(measured):
        at = 100.0 + i * PERIOD
        lines.append({"event": "measured", "time": at, "q": q_i.tolist(), "v": v[i].tolist()})
    for i, q_i in enumerate(q):
        at = 100.0 + i * PERIOD
        line = {"event": "command", "time": at, "utime": round(1e6 * at), "q": q_i.tolist()}
        lines.append(line)
    return lines


def test_a_stop_is_known_by_how_each_command_follows_from_the_one_before():
    q, n = with_stop(moving())
    assert braking_periods(q) == n
    lossy = np.delete(q, [len(q) - 3, len(q) - 5], axis=0)
    assert braking_periods(lossy) == n
    assert braking_periods(moving()) is None  # it goes on
    assert braking_periods(np.vstack([moving(), np.repeat(moving()[-1:], 9, axis=0)])) is None
    assert braking_periods(np.repeat(HOME[None], 9, axis=0)) == 0


def test_a_run_inside_all_limits_has_nothing_outside():
    q, n = with_stop(moving())
    judged = judge_wire(log_of(q), ended=200.0, stopped=True)
    assert judged.outside == []
    assert judged.stop == pytest.approx(n * PERIOD)
    assert judged.step == pytest.approx((SPEED / V_MAX).max())


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        (lambda q: {"q": q + np.where(np.arange(len(q)) > 30, 0.01, 0.0)[:, None]}, "leaps"),
        (lambda q: {"q": q + 0.02, "measured": q}, "first command"),
        (lambda q: {"q": q, "measured": q - HOME + Q_UPPER + 0.01}, "measured position"),
        (lambda q: {"q": q, "v": np.full_like(q, 3.0)}, "measured speed"),
        (lambda q: {"q": q, "v": np.full_like(q, 0.1)}, "stand still"),
        (lambda q: {"q": np.vstack([q, q[-1:] * np.nan]), "measured": q}, "posture"),
    ],
    ids=["jump", "start", "position", "speed", "drift", "nan"],
)
def test_what_is_outside_is_said(changed, says):
    q, _ = with_stop(moving())
    lines = log_of(**changed(q))
    for line in lines:
        line["q"] = [float(a) if np.isfinite(a) else None for a in line["q"]]
    judged = judge_wire(lines, ended=200.0, stopped=False)
    assert any(says in what for what in judged.outside), judged.outside


def test_a_command_after_the_end_is_seen_and_that_of_somebody_else_is_not_counted():
    q, _ = with_stop(moving())
    lines = log_of(q)
    last = lines[-1]
    assert "after the program ended" in judge_wire(lines, ended=100.0, stopped=True).outside[0]
    foreign = {**last, "utime": last["utime"] + 1, "q": (q[-1] + 1).tolist()}
    judged = judge_wire(
        [*lines, foreign], ended=200.0, stopped=True, foreign=frozenset([foreign["utime"]])
    )
    assert judged.outside == []
