"""An emulated robot and who commands it in one process, on a clock of their own.

What commands is all that runs on a real arm: the episode, the loop, the station and the guard. The
messages go through LCM's queue in memory. The clock goes on while that program sleeps or waits for
messages, and only then: it is never late, whatever it has to compute.
"""

import os
import signal
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from pydrake.lcm import DrakeLcm

from tog_drake.errors import InputError
from tog_drake.hardware import connection, episode, real_time
from tog_drake.hardware.arm_driver import ArmDriver, Verdict
from tog_drake.hardware.emulated_world import Drive, EmulatedWorld
from tog_drake.hardware.emulator import ELBOW, HAND_PERIOD, IMAGE_PERIOD, _logged, image_channels
from tog_drake.hardware.faults import Fault, FaultyLine, Schedule
from tog_drake.hardware.hand_driver import HandDriver
from tog_drake.safety import PERIOD
from tog_drake.scenario import Scenario
from tog_drake.stations.lcm_bus import (
    HAND_COMMAND,
    HAND_STATUS,
    PANDA_COMMAND,
    PANDA_STATUS,
    arm_command_message,
    arm_status_message,
    hand_status_message,
    images_message,
)
from tog_drake.stations.panda_lcm import PandaBus
from tog_drake.stations.simulation import FINGER_P

BEGIN = 1000.0  # [s] when the clock begins
WARM_UP = 0.3  # [s] in which the drivers speak already
NOISE = 2e-4  # [rad] standard deviation of each measured joint: a simulated arm stands too still
STANDING = 1.0  # [s] after the end in which nothing may move or be sent


class HungError(Exception):
    """The program did not end in time."""


class RobotInMemory:
    """The drivers, the simulated world behind them, and the clock.

    ``time``, ``monotonic`` and ``sleep`` are what the commanding program uses of Python's ``time``.

    Args:
        scenario: of the world, with one camera.
        faults: as of the emulator.
        act: "foreign", for somebody else who commands the arm to stay, or a signal's name.
        start: [s] when that happens, since the arm first moved; None: from the beginning.
        deadline: [s] on the clock for the whole program.
    """

    def __init__(
        self,
        scenario: Scenario,
        faults: tuple[Fault, ...] = (),
        act: str | None = None,
        start: float | None = None,
        deadline: float = 1000.0,
    ):
        self.log: list[dict[str, Any]] = []  # as of an emulator
        self.foreign: set[int] = set()  # stamps of the commands of somebody else
        self._scenario = scenario
        self._world = EmulatedWorld(scenario)
        self._state = self._world.state()
        self._arm = ArmDriver(self._state.q)
        self._hand = HandDriver(self._state.opening, FINGER_P)
        ((camera, self._camera),) = image_channels(scenario).items()
        self._rgb, self._depth = (
            self._world._station.GetOutputPort(f"{camera}.{image}_image")
            .Eval(self._world._simulator.get_context())
            .data.copy()
            for image in ("rgb", "depth")
        )
        self._schedule = Schedule(list(faults), BEGIN)
        self._lines = {
            channel: FaultyLine(channel, self._schedule, scenario.random_seed)
            for channel in (PANDA_COMMAND, PANDA_STATUS, HAND_COMMAND, HAND_STATUS, self._camera)
        }
        self._act, self._start, self._deadline = act, start, deadline
        self._rng = np.random.default_rng(scenario.random_seed)
        self._ticks = 0
        self._rest = 0.0  # [s] slept, less than a period
        self._lcm, self._camera_lcm = Line(self), Line(self)

    def time(self) -> float:
        return BEGIN + self._ticks * PERIOD

    monotonic = time

    def sleep(self, seconds: float) -> None:
        self._rest += seconds
        while self._rest > PERIOD / 2:
            self._rest -= PERIOD
            self._tick()

    def run(self, task: str, *, dry_run: bool = False) -> tuple[dict[str, Any] | None, float]:
        """Runs an episode with this robot; returns its record (None: refused), and its end [s]."""
        lines = iter((self._lcm, self._camera_lcm))
        record = None
        self.sleep(WARM_UP)
        with (
            patch.object(connection, "time", self),
            patch.object(episode, "time", self),
            patch.object(real_time, "time", self),
            patch.object(connection, "make_lcm", lambda url: next(lines)),
            patch.object(connection, "PandaBus", partial(PandaBus, clock=self.time)),
        ):
            try:
                record = episode.run_hardware_episode(
                    self._scenario,
                    name="panda_lcm",
                    task=task,
                    ask=lambda decision, listen: True,
                    dry_run=dry_run,
                ).record
            except InputError as error:
                print(f"refused: {error}")
        ended = self.time()
        self.sleep(STANDING)
        return record, ended

    def take(self, channel: str, data: bytes) -> None:
        """Takes a message that somebody sends."""
        if channel == PANDA_COMMAND:
            self._write("command", **_logged(data))
        self._lines[channel].send(data, self.time())

    def _write(self, event: str, **content: Any) -> None:
        self.log.append({"time": self.time(), "event": event, **content})

    def _tick(self) -> None:
        self._ticks += 1
        now = self.time()
        if now > BEGIN + self._deadline:
            raise HungError(f"it has not ended after {self._deadline:g} s")
        if self._arm.moved and self._schedule.moved is None:
            self._schedule.moved = now
        self._carry_out(now)
        self._befall(now)
        q = self._arm.advance(now, PERIOD)
        opening = self._hand.advance(self._state.opening, PERIOD)
        self._state = self._world(Drive(q, opening, PERIOD))
        self._write("measured", q=self._state.q.tolist(), v=self._state.v.tolist())
        self._publish(now, round(1e6 * now))

    def _carry_out(self, now: float) -> None:
        for data in self._lines[PANDA_COMMAND].due(now):
            verdict = self._arm.receive(data, now)
            if verdict is not Verdict.ACCEPTED:
                self._write("verdict", verdict=verdict.value)
        for data in self._lines[HAND_COMMAND].due(now):
            self._hand.receive(data, self._state.opening)

    def _befall(self, now: float) -> None:
        for fault in self._schedule.begun(now):
            if fault.kind == "reflex":
                self._arm.reflex("a fault: reflex", now, fault.duration)
            elif fault.kind == "restart":
                self._arm.end("a fault: restart", now, fault.duration)
        moved = self._schedule.moved
        if self._act is None or (
            self._start is not None and (moved is None or now < moved + self._start)
        ):
            return
        if self._act == "foreign":
            utime = round(1e6 * now) + 1  # no other program's
            self.foreign.add(utime)
            message = arm_command_message(self._state.q, utime)
            self._lcm.bring(PANDA_COMMAND, message)
            self.take(PANDA_COMMAND, message)
        else:
            os.kill(os.getpid(), signal.Signals[self._act])
            self._act = None

    def _publish(self, now: float, utime: int) -> None:
        state = self._state
        if self._arm.running:
            q = state.q + self._rng.normal(0.0, NOISE, 7)
            torque = state.torque_external.copy()
            for fault in self._schedule.active(PANDA_STATUS, now):
                if fault.kind == "push":
                    torque[ELBOW] += fault.amount
            self._lines[PANDA_STATUS].send(
                arm_status_message(q, state.v, torque, self._arm.mode, utime), now
            )
        if self._ticks % round(HAND_PERIOD / PERIOD) == 0:
            status = hand_status_message(state.opening, self._hand.rate, utime)
            self._lines[HAND_STATUS].send(status, now)
        # Nobody looks at the images any more once it moves.
        if self._ticks % round(IMAGE_PERIOD / PERIOD) == 0 and not self._arm.moved:
            images = images_message(self._rgb[..., :3], self._depth[..., 0], utime)
            self._lines[self._camera].send(images, now)
        for channel in (PANDA_STATUS, HAND_STATUS, self._camera):
            to = self._camera_lcm if channel == self._camera else self._lcm
            for message in self._lines[channel].due(now):
                to.bring(channel, message)


class Line:
    """What the commanding program uses of ``DrakeLcm``: waiting lets the clock go on."""

    def __init__(self, robot: RobotInMemory):
        self._robot = robot
        self._lcm = DrakeLcm("memq://")

    def Subscribe(self, channel: str, handler: Callable[[bytes], None]) -> None:
        self._lcm.Subscribe(channel, handler)

    def Publish(self, channel: str, data: bytes) -> None:
        self._lcm.Publish(channel, data)  # multicast brings a program its own messages, too
        self._robot.take(channel, data)

    def HandleSubscriptions(self, milliseconds: int) -> int:
        self._robot.sleep(1e-3 * milliseconds)
        return int(self._lcm.HandleSubscriptions(0))

    def bring(self, channel: str, data: bytes) -> None:
        self._lcm.Publish(channel, data)
