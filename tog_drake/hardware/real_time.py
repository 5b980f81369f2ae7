"""Lets a Diagram run with the wall clock, in steps of the commands' period."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from tog_drake.safety import PERIOD, SafetyConfig, StopReason, braked, limits_of
from tog_drake.stations.hardware import HardwareStation
from tog_drake.stations.panda_lcm import PandaBus

STOP_BUTTON = "STOP"
_HAND_AGE = 1.0  # [s] the hand's driver speaks ten times a second
_PATIENCE = 1.0  # [s] for a fresh status, after a time in which nobody listened
_MESSAGES = 20  # that are taken in at once, at most: nobody floods the loop


class RealTime:
    """The loop: listen, advance by a period, sleep until the next one.

    When it is late, everything after is late by as much: never does it catch up in a burst, which
    on an arm would be a jump. Being late while the arm moves is itself a reason to stop.

    Args:
        simulator: of the whole Diagram, its time at 0.
        station: in it.
        bus: to the drivers.
        lcm: where they are heard.
        camera_lcm: where cameras are heard; not while the arm moves, for images are large.
        safety: what is too late.
        meshcat: where the STOP button is, if anywhere.
    """

    def __init__(
        self,
        simulator: Simulator,
        station: HardwareStation,
        bus: PandaBus,
        *,
        lcm: DrakeLcm,
        camera_lcm: DrakeLcm,
        safety: SafetyConfig,
        meshcat: Meshcat | None = None,
    ):
        self.late = 0.0  # [s] the most that it was while the arm moved
        self._simulator = simulator
        self._station = station
        self._bus = bus
        self._lcm, self._camera_lcm = lcm, camera_lcm
        self._safety = safety
        self._meshcat = meshcat

    @property
    def time(self) -> float:
        """The Context's [s]."""
        return float(self._simulator.get_context().get_time())

    def stand(self, until: float) -> None:
        """Advances to the time ``until`` [s], the arm standing still."""
        self._run(lambda: self.time >= until - 1e-9, moving=False)

    def move(self, done: Callable[[], bool], longest: float) -> None:
        """Advances until ``done``, or until it was stopped.

        Ctrl-C stops the arm, as does the STOP button. Whatever is raised, the arm is brought to
        rest before it goes on.

        Args:
            done: whether the motion has ended.
            longest: [s] of wall time after which it is stopped.
        """
        guard, operator = self._station.guard, self._station.operator
        context = guard.GetMyContextFromRoot(self._simulator.get_context())
        end = time.monotonic() + longest

        def ended() -> bool:
            if time.monotonic() > end:
                operator.stop(StopReason.DEADLINE, f"the motion took longer than {longest:.0f} s")
            state = guard.state(context)
            return done() if state.broken is None else not state.commands

        with self._stopped_by_signals():
            try:
                self._run(ended, moving=True)
            except BaseException:
                self._brake()
                raise

    def _run(self, ended: Callable[[], bool], *, moving: bool) -> None:
        deadline = time.monotonic()
        while not ended():
            late = time.monotonic() - deadline
            if moving:
                self._watch(late)
            self.listen(cameras=not moving)
            self._simulator.AdvanceTo((round(self.time / PERIOD) + 1) * PERIOD)
            # When late, the next period begins now.
            deadline = max(deadline, time.monotonic() - PERIOD) + PERIOD
            time.sleep(max(0.0, deadline - time.monotonic()))

    def listen(self, *, cameras: bool = True) -> None:
        """Takes in what has come."""
        for lcm in (self._lcm, self._camera_lcm) if cameras else (self._lcm,):
            for _ in range(_MESSAGES):
                if lcm.HandleSubscriptions(0) == 0:
                    break

    def catch_up(self) -> None:
        """Listens until what is known of the arm is fresh, or does not become so.

        LCM keeps the *first* message that came while nobody listened.
        """
        end = time.monotonic() + _PATIENCE
        while self._bus.arm.age() > self._safety.status_age / 2 and time.monotonic() < end:
            self.listen()
            time.sleep(PERIOD)

    def _watch(self, late: float) -> None:
        """Stops the arm for what is seen from outside the Diagram."""
        self.late = max(self.late, late)
        operator = self._station.operator
        if late > self._safety.stall:
            operator.stop(StopReason.STALLED, f"this program was {late:.2f} s late")
        if self._meshcat is not None and self._meshcat.GetButtonClicks(STOP_BUTTON) > 0:
            operator.stop(StopReason.OPERATOR, "the STOP button")
        if (age := self._bus.hand.age()) > _HAND_AGE:
            operator.stop(StopReason.STALE_STATUS, f"the hand's status is {age:.1f} s old")

    @contextmanager
    def _stopped_by_signals(self) -> Iterator[None]:
        def stop(signum: int, frame: object) -> None:
            self._station.operator.stop(StopReason.OPERATOR, signal.Signals(signum).name)

        before = {s: signal.signal(s, stop) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for each, handler in before.items():
                signal.signal(each, handler)

    def _brake(self) -> None:
        """Brings the arm to rest without the Diagram, which has failed."""
        guard = self._station.guard
        state = guard.state(guard.GetMyContextFromRoot(self._simulator.get_context()))
        last, limits = state.commanded, limits_of(self._safety)
        self._station.operator.stop(StopReason.OPERATOR, "this program failed")
        if not state.commands or last is None:
            return
        while last.v.any() or last.a.any():
            last = braked(last, limits)
            self._bus.command_arm(last.q)
            time.sleep(PERIOD)
