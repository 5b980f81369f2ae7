"""The robot without the robot: its drivers' LCM messages, with a simulated arm and hand behind."""

import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.hardware.arm_driver import LONGEST, ArmDriver, Verdict, read_arm_command
from tog_drake.hardware.config import hardware_of
from tog_drake.hardware.emulated_camera import EmulatedCameras, Scene
from tog_drake.hardware.emulated_world import Child, Drive, EmulatedWorld, WorldState
from tog_drake.hardware.faults import Fault, FaultyLine, Schedule
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
from tog_drake.stations.lcm_camera import LcmImages
from tog_drake.stations.simulation import FINGER_P

HAND_PERIOD = 0.1  # [s] of the hand's status
IMAGE_PERIOD = 0.2  # [s] at least, from one image to the next
UNSEEN = 1e-5  # [m, rad] what has moved by less looks the same: it is not rendered again
ELBOW = 3  # index of the joint that a fault pushes
# The world is behind by as much as its last step took. A slow machine is to slow the world down,
# not to let it take ever longer steps.
LONGEST_STEP = 0.01  # [s]


class EmulatorLog:
    """What happened, one JSON object a line; each with ``time``, Unix time [s], and ``event``.

    - ``command``: on the wire, before any fault: ``utime``, ``q`` (null: not understood)
    - ``verdict``: of the arm's driver, on a command it did not accept: ``utime``, ``q``
    - ``measured``: ``q``, and ``v`` [rad/s]
    - ``mode``: ``mode`` of the arm, ``running`` (the driver), ``why``
    - ``hand_command``: ``verdict``, ``opening`` measured [m]
    - ``image``: what is rendered: ``positions`` of the plant; ``time`` is its stamp
    - ``fault``: begins: ``kind``, ``channel``
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


@dataclass(frozen=True)
class EmulatorConfig:
    """How the emulated robot behaves."""

    rate: float = 200.0  # [Hz] of the arm's status
    recover_after: float = math.inf  # [s] see ``ArmDriver``
    faults: list[Fault] = field(default_factory=list)
    log: Path | None = None  # see ``EmulatorLog``


def image_channels(scenario: Scenario) -> dict[str, str]:
    """Returns the LCM channels of the cameras whose images come over LCM, by the cameras' names.

    Raises:
        InputError: the scenario says nothing of a real robot.
    """
    return {
        name: camera.channel
        for name, camera in hardware_of(scenario).cameras.items()
        if isinstance(camera, LcmImages) and camera.channel and name in scenario.cameras
    }


class Emulator:
    """The drivers of an emulated robot; a context manager.

    Raises:
        InputError: the scenario cannot be built.
    """

    def __init__(self, scenario: Scenario, config: EmulatorConfig):
        channels = image_channels(scenario)
        self._period = 1 / config.rate
        self._schedule = Schedule(config.faults)
        self._log = EmulatorLog(config.log)
        self._world: Child[Drive | None, WorldState] = Child(EmulatedWorld, scenario, nice=5)
        self._cameras: Child[Scene, None] = Child(
            EmulatedCameras, scenario, channels, self._schedule, nice=15
        )
        try:
            self._cameras.wait()
            self._world.wait()
            self._world.ask(None)
            self._state: WorldState = self._world.wait()
        except BaseException:
            self.close()
            raise
        # A scenario that forgives the commanding program a longer stall forgives this one, too.
        longest = max(LONGEST, hardware_of(scenario).safety.stall / 5)
        self._arm = ArmDriver(self._state.q, config.recover_after, longest)
        self._hand = HandDriver(self._state.opening, FINGER_P)
        self._shown = self._state.positions
        self._mode: tuple[object, ...] = ()  # as it was written down last
        self._last_tick = self._last_step = time.time()
        self._hand_status_at = self._images_at = self._last_tick
        # The first to start a thread: what is forked comes before.
        self._lcm = make_lcm(hardware_of(scenario).lcm_url)
        self._lines = {
            channel: FaultyLine(channel, self._schedule, scenario.random_seed)
            for channel in (PANDA_COMMAND, PANDA_STATUS, HAND_COMMAND, HAND_STATUS)
        }
        self._came: list[tuple[str, bytes]] = []
        for channel in (PANDA_COMMAND, HAND_COMMAND):
            self._lcm.Subscribe(channel, lambda data, c=channel: self._came.append((c, data)))

    def __enter__(self) -> "Emulator":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        self._world.end()
        self._cameras.end()
        self._log.close()

    def run(self) -> None:
        """Drives, until it is interrupted."""
        deadline = self._schedule.begin = time.time()
        while True:
            # It returns with the first message; LCM keeps only one of each channel. When late,
            # it takes what is there.
            rest = deadline - time.time()
            self._lcm.HandleSubscriptions(max(0, round(1e3 * rest)))
            self._carry_out(time.time())
            if time.time() >= deadline:
                self._tick(time.time())
                # The next period begins now at the earliest: no burst of messages.
                deadline = max(deadline, time.time() - self._period) + self._period

    def _carry_out(self, now: float) -> None:
        """Gives the drivers what came."""
        came, self._came = self._came, []
        for channel, data in came:
            if channel == PANDA_COMMAND:
                self._log.write(now, "command", **_logged(data))
            self._lines[channel].send(data, now)
        for data in self._lines[PANDA_COMMAND].due(now):
            verdict = self._arm.receive(data, now)
            if verdict is not Verdict.ACCEPTED:
                self._log.write(now, "verdict", verdict=verdict.value, **_logged(data))
        for data in self._lines[HAND_COMMAND].due(now):
            opening = self._state.opening
            said = self._hand.receive(data, opening).value
            force = self._hand.force
            self._log.write(now, "hand_command", verdict=said, opening=opening, force=force)

    def _tick(self, now: float) -> None:
        """What a period brings: the world a little later, and what the drivers say of it."""
        dt, self._last_tick = now - self._last_tick, now
        if self._arm.moved and self._schedule.moved is None:
            self._schedule.moved = now
        self._befall_arm(now)
        q = self._arm.advance(now, dt)
        self._state = self._world.answer() or self._state
        if not self._world.busy:
            step, self._last_step = min(now - self._last_step, LONGEST_STEP), now
            # The hand's speed is one in the world: fingers that lag seem to press on something.
            opening = self._hand.advance(self._state.opening, step)
            self._world.ask(Drive(q, opening, step))
        self._look(now)
        self._log.write(now, "measured", q=self._state.q.tolist(), v=self._state.v.tolist())
        self._say_mode(now)
        self._publish(now)

    def _befall_arm(self, now: float) -> None:
        for fault in self._schedule.begun(now):
            if fault.kind == "reflex":
                self._arm.reflex("a fault: reflex", now, fault.duration)
            elif fault.kind == "restart":
                self._arm.end("a fault: restart", now, fault.duration)
            self._log.write(now, "fault", kind=fault.kind, channel=fault.channel)

    def _look(self, now: float) -> None:
        self._cameras.answer()
        if now < self._images_at or self._cameras.busy:
            return
        self._images_at = now + IMAGE_PERIOD
        if np.abs(self._state.positions - self._shown).max() > UNSEEN:
            self._shown = self._state.positions
        scene = Scene(self._shown, now, self._schedule.begin, self._schedule.moved)
        self._cameras.ask(scene)
        self._log.write(now, "image", positions=scene.positions.tolist())

    def _say_mode(self, now: float) -> None:
        mode = self._arm.mode.name, self._arm.running, self._arm.why
        if mode != self._mode:
            self._mode = mode
            self._log.write(now, "mode", mode=mode[0], running=mode[1], why=mode[2])

    def _publish(self, now: float) -> None:
        state, utime = self._state, round(1e6 * now)
        if self._arm.running:
            torque = state.torque_external.copy()
            for fault in self._schedule.active(PANDA_STATUS, now):
                if fault.kind == "push":
                    torque[ELBOW] += fault.amount
            status = arm_status_message(state.q, state.v, torque, self._arm.mode, utime)
            self._lines[PANDA_STATUS].send(status, now)
        if now >= self._hand_status_at:
            self._hand_status_at = max(self._hand_status_at, now - HAND_PERIOD) + HAND_PERIOD
            status = hand_status_message(state.opening, self._hand.rate, utime)
            self._lines[HAND_STATUS].send(status, now)
        for channel in (PANDA_STATUS, HAND_STATUS):
            for message in self._lines[channel].due(now):
                self._lcm.Publish(channel, message)


def _logged(data: bytes) -> dict[str, Any]:
    try:
        utime, q = read_arm_command(data)
    except ValueError:
        return {"utime": None, "q": None}
    return {"utime": utime, "q": [a if np.isfinite(a) else None for a in q.tolist()]}
