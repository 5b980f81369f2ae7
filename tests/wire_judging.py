"""Judges what an arm was commanded, and did, by what was heard on its side of the wire."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.panda import A_MAX, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.safety import (
    LONGEST_STOP,
    PERIOD,
    Commanded,
    SafetyConfig,
    braked,
    limits_of,
)
from tog_drake.time_parameterization import JointLimits

STILL = 0.02  # [rad/s] an arm that is slower stands
SETTLED = 0.5  # [s] after the last command, in which the joints' controllers bring it to rest
# In real time, a world that a busy computer simulates slowly moves by leaps towards what goes on in
# real time: how fast it is counts as anybody next to it would see it.
SEEN = 0.1  # [s] from one look to the next
SETTLED_SLOWLY = 2.0  # [s]
CHANGE = 0.5  # of the velocity limit: more from one command to the next is a discontinuity
LOST = 10  # messages in a row at most, within a stop that is still recognized

Line = dict[str, Any]
"""Of ``tog_drake.hardware.emulator.EmulatorLog``."""


@dataclass
class Judged:
    """One run, shares of the arm's own limits (not of those with a margin)."""

    commands: int = 0
    first: float = 0.0  # [rad] from the first command to where the arm was measured
    step: float = 0.0  # of velocity limit x period, from one command to the next
    change: float = 0.0  # of the same: how much that changes at once
    acceleration: float = 0.0  # over the wire, time stamps make it a rough figure
    measured_speed: float = 0.0
    stop: float | None = None  # [s] commanded, from the first braking command to the last
    settled: float | None = None  # [s] from the last command to a measured standstill
    refused: dict[str, int] = field(default_factory=dict)  # the driver's verdicts
    outside: list[str] = field(default_factory=list)  # what was not as it must be


def read_log(path: Path) -> list[Line]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def judge_wire(
    lines: list[Line],
    *,
    ended: float,
    stopped: bool,
    foreign: frozenset[int] = frozenset(),
    real_time: bool = False,
) -> Judged:
    """Returns what the log says.

    Args:
        lines: of the log, to the end.
        ended: Unix time [s] at which the commanding program had ended.
        stopped: whether the guard says that it stopped the motion.
        foreign: ``utime`` of the commands that somebody else sent.
        real_time: whether the clock went on whether or not the world could follow.
    """
    judged = Judged()
    for verdict in (line["verdict"] for line in lines if line["event"] == "verdict"):
        judged.refused[verdict] = judged.refused.get(verdict, 0) + 1
    measured = [line for line in lines if line["event"] == "measured"]
    commands = [c for c in lines if c["event"] == "command" and c["utime"] not in foreign]
    if real_time:
        measured = as_seen(measured)
    _judge_measured(judged, measured)
    judged.commands = len(commands)
    if not commands:
        return judged
    if any(c["q"] is None or None in c["q"] for c in commands):
        judged.outside.append("a command is no posture")
        return judged
    before = [m for m in measured if m["time"] <= commands[0]["time"]]
    q, t = (np.array([c[key] for c in commands], dtype=float) for key in ("q", "utime"))
    _judge_commands(judged, q, t / 1e6, np.array((before or measured)[-1]["q"]))
    last = commands[-1]["time"]
    if last > ended:
        judged.outside.append(f"a command {last - ended:.2f} s after the program ended")
    if stopped:
        _judge_stop(judged, q)
    judged.settled = _settled(measured, last)
    longest = SETTLED_SLOWLY if real_time else SETTLED
    if judged.settled is None or judged.settled > longest:
        judged.outside.append(f"the arm did not stand still {longest:g} s after the last command")
    return judged


def as_seen(measured: list[Line]) -> list[Line]:
    """Returns the measurements with the speed from one look to the next, ``SEEN`` later."""
    t, q = (np.array([m[key] for m in measured]) for key in ("time", "q"))
    later = np.searchsorted(t, t + SEEN)
    n = int((later < len(t)).sum())
    v = (q[later[:n]] - q[:n]) / (t[later[:n]] - t[:n])[:, None]
    return [{**m, "v": v_seen.tolist()} for m, v_seen in zip(measured[:n], v, strict=True)]


def _judge_measured(judged: Judged, measured: list[Line]) -> None:
    q, v = (np.array([m[key] for m in measured]).reshape(-1, 7) for key in ("q", "v"))
    if np.any((q < Q_LOWER) | (q > Q_UPPER)):
        judged.outside.append("a measured position is beyond its limit")
    judged.measured_speed = float((np.abs(v) / V_MAX).max(initial=0.0))
    if judged.measured_speed > 1:
        judged.outside.append(f"a measured speed is {judged.measured_speed:.2f} of its limit")


def _judge_commands(judged: Judged, q: np.ndarray, t: np.ndarray, q_measured: np.ndarray) -> None:
    dt = np.maximum(np.diff(t), PERIOD)[:, None]
    v = np.vstack([np.zeros(7), np.diff(q, axis=0) / dt])
    change = np.abs(np.diff(v, axis=0))
    judged.first = float(np.abs(q[0] - q_measured).max())
    judged.step = float((np.abs(v) / V_MAX).max())
    judged.change = float((change / V_MAX).max(initial=0.0))
    judged.acceleration = float((change / dt / A_MAX).max(initial=0.0))
    if np.any((q < Q_LOWER) | (q > Q_UPPER)):
        judged.outside.append("a commanded position is beyond its limit")
    for name, value, most in (
        ("the first command is {:.3f} rad from the arm", judged.first, 0.01),
        ("a commanded speed is {:.2f} of its limit", judged.step, 1.0),
        ("the commanded speed leaps by {:.2f} of its limit", judged.change, CHANGE),
    ):
        if value > most:
            judged.outside.append(name.format(value))


def _judge_stop(judged: Judged, q: np.ndarray) -> None:
    periods = braking_periods(q)
    if periods is None:
        judged.outside.append("the last commands are no stop")
        return
    judged.stop = periods * PERIOD
    if judged.stop > LONGEST_STOP:
        judged.outside.append(f"it took {judged.stop:.2f} s to brake")


def braking_periods(q: np.ndarray) -> int | None:
    """Returns how many of the last commands (N, 7) brake as a stop does, 0 where the arm stood.

    None: they do not end at rest by a stop. A stop is known by each command's following from the
    one before, whatever was lost on the way.
    """
    limits = limits_of(SafetyConfig())
    longest = round(LONGEST_STOP / PERIOD) + 2 * LOST
    for start in range(max(2, len(q) - longest), len(q)):
        v, v_before = ((q[start - k] - q[start - k - 1]) / PERIOD for k in (0, 1))
        last, n = Commanded(q[start], v, (v - v_before) / PERIOD), 0
        for wanted in q[start + 1 :]:
            for _ in range(LOST):
                last = braked(last, limits)
                n += int(_moves(last))
                if np.abs(last.q - wanted).max() < 1e-9:
                    break
            else:
                break
        else:
            if np.abs(last.v).max() < 1e-6:
                return n if n or _came_to_rest_before(q[-longest:], limits) else None
    return None


def _moves(command: Commanded) -> bool:
    return max(np.abs(command.v).max(), PERIOD * np.abs(command.a).max()) > 1e-9


def _came_to_rest_before(q: np.ndarray, limits: JointLimits) -> bool:
    """Whether it was not at once that the commands (N, 7) came to the rest in which they end."""
    a = np.diff(q, 2, axis=0) / PERIOD**2
    return bool(np.all(np.abs(a) <= limits.acceleration * (1 + 1e-6)))


def _settled(measured: list[Line], since: float) -> float | None:
    """How long after ``since`` the arm moved last [s]; None where it moves to the end."""
    after = [m for m in measured if m["time"] >= since]
    moving = [m["time"] for m in after if np.abs(m["v"]).max() > STILL]
    if not after or (moving and moving[-1] >= after[-1]["time"]):
        return None
    return moving[-1] - since if moving else 0.0
