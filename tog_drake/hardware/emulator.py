"""The robot without the robot: its drivers' LCM messages, with a simulated arm and hand behind."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.hardware.arm_driver import ArmDriver, Verdict, read_arm_command
from tog_drake.hardware.emulated_world import Child, Drive, EmulatedWorld, WorldState
from tog_drake.hardware.hand_driver import HandDriver
from tog_drake.scenario import Scenario
from tog_drake.stations.lcm_bus import (
    HAND_COMMAND,
    HAND_STATUS,
    PANDA_COMMAND,
    PANDA_STATUS,
    arm_status_message,
    hand_status_message,
    make_lcm,
)
from tog_drake.stations.simulation import FINGER_P

HAND_PERIOD = 0.1  # [s] of the hand's status
# The world is behind by as much as its last step took. A slow machine is to slow the world down,
# not to let it take ever longer steps.
LONGEST_STEP = 0.01  # [s]


class EmulatorLog:
    """What happened, one JSON object a line; each with ``time``, Unix time [s], and ``event``.

    - ``command``: on the wire, before any fault: ``utime``, ``q`` (null: not understood)
    - ``verdict``: what the arm's driver made of a command, where it was not accepted
    - ``measured``: ``q``
    - ``mode``: ``mode`` of the arm, ``running`` (the driver), ``why``
    - ``hand_command``: ``verdict``, ``opening`` measured [m]
    """

    def __init__(self, path: Path | None):
        self._file = None if path is None else path.open("w", encoding="utf-8", buffering=1)

    def write(self, now: float, event: str, **content: Any) -> None:
        if self._file is not None:
            line = {"time": now, "event": event, **content}
            self._file.write(json.dumps(line) + "\n")

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


class Emulator:
    """The drivers of an emulated robot; a context manager.

    Args:
        scenario: what the world is.
        rate: [Hz] of the arm's status.
        recover_after: see ``ArmDriver``.
        log: where everything is written down; None: nowhere.
        clock: Unix time [s].

    Raises:
        InputError: the scenario cannot be built.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        rate: float = 200.0,
        recover_after: float | None = None,
        log: Path | None = None,
        clock: Callable[[], float] = time.time,
    ):
        self._period = 1 / rate
        self._clock = clock
        self._log = EmulatorLog(log)
        self._world: Child[Drive | None, WorldState] = Child(EmulatedWorld, scenario)
        try:
            self._world.wait()
            self._world.ask(None)
            self._state: WorldState = self._world.wait()
        except BaseException:
            self.close()
            raise
        self._lcm = make_lcm()
        self._commands: list[bytes] = []
        self._hand_commands: list[bytes] = []
        self._lcm.Subscribe(PANDA_COMMAND, self._commands.append)
        self._lcm.Subscribe(HAND_COMMAND, self._hand_commands.append)
        self._arm = ArmDriver(self._state.q, recover_after)
        self._hand = HandDriver(self._state.opening, FINGER_P)
        self._mode: tuple[object, ...] = ()  # as it was written down last
        self._last_tick = self._last_step = clock()
        self._hand_status_at = self._last_tick

    def __enter__(self) -> "Emulator":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        self._world.end()
        self._log.close()

    def run(self) -> None:
        """Drives, until it is interrupted."""
        deadline = self._clock()
        while True:
            while (rest := deadline - self._clock()) > 0:
                # It returns with the first message; LCM keeps only one of each channel.
                self._lcm.HandleSubscriptions(max(1, round(1e3 * rest)))
                self._carry_out(self._clock())
            self.tick(self._clock())
            # When late, the next period begins now: no burst of messages.
            deadline = max(deadline, self._clock() - self._period) + self._period

    def tick(self, now: float) -> None:
        """What a period brings: the world a little later, and what the drivers say of it."""
        dt, self._last_tick = now - self._last_tick, now
        q = self._arm.advance(now, dt)
        opening = self._hand.advance(self._state.opening, dt)
        if (state := self._world.answer()) is not None:
            self._state = state
        if not self._world.busy:
            step, self._last_step = min(now - self._last_step, LONGEST_STEP), now
            self._world.ask(Drive(q, opening, step))
        self._log.write(now, "measured", q=self._state.q.tolist())
        self._say_mode(now)
        self._publish(now)

    def _carry_out(self, now: float) -> None:
        """Gives the drivers what came."""
        for data in self._commands:
            self._log.write(now, "command", **_logged(data))
            verdict = self._arm.receive(data, now)
            if verdict is not Verdict.ACCEPTED:
                self._log.write(now, "verdict", verdict=verdict.value, why=self._arm.why)
        for data in self._hand_commands:
            opening = self._state.opening
            said = self._hand.receive(data, opening).value
            self._log.write(now, "hand_command", verdict=said, opening=opening)
        self._commands.clear()
        self._hand_commands.clear()

    def _say_mode(self, now: float) -> None:
        mode = self._arm.mode.name, self._arm.running, self._arm.why
        if mode != self._mode:
            self._mode = mode
            self._log.write(now, "mode", mode=mode[0], running=mode[1], why=mode[2])

    def _publish(self, now: float) -> None:
        state, utime = self._state, int(1e6 * now)
        if self._arm.running:
            status = arm_status_message(
                state.q, state.v, state.torque_external, self._arm.mode, utime
            )
            self._lcm.Publish(PANDA_STATUS, status)
        if now >= self._hand_status_at:
            self._hand_status_at = max(self._hand_status_at, now - HAND_PERIOD) + HAND_PERIOD
            status = hand_status_message(state.opening, self._hand.rate, utime)
            self._lcm.Publish(HAND_STATUS, status)


def _logged(data: bytes) -> dict[str, Any]:
    try:
        utime, q = read_arm_command(data)
    except ValueError:
        return {"utime": None, "q": None}
    return {"utime": utime, "q": [a if np.isfinite(a) else None for a in q.tolist()]}
