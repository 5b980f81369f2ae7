"""Lets a Diagram run with the wall clock, in steps of the commands' period."""

import gc
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from tog_drake.hardware.connection import Robot
from tog_drake.safety import PERIOD, StopReason, braked, limits_of

STOP_BUTTON = "STOP"
_HAND_SLOWER = 10  # times as old may the hand's status be: it speaks so much less often
_PATIENCE = 1.0  # [s] for a fresh status, after a time in which nobody listened
_MESSAGES = 20  # that are taken in at once, at most: nobody floods the loop


class RealTime:
    """The loop: listen, advance by a period, sleep until the next one.

    When it is late, everything after is late by as much: never does it catch up in a burst, which
    on an arm would be a jump. Being late while the arm moves is itself a reason to stop.

    Args:
        simulator: of the robot's Diagram, its time at 0.
        robot: it.
        meshcat: where there is a STOP button while the arm moves, if anywhere.
    """

    def __init__(self, simulator: Simulator, robot: Robot, meshcat: Meshcat | None = None):
        self.late = 0.0  # [s] the most that it was while the arm moved
        self._simulator = simulator
        self._robot = robot
        self._meshcat = meshcat

    @property
    def time(self) -> float:
        """The Context's [s]."""
        return float(self._simulator.get_context().get_time())

    def stand(self, until: float) -> None:
        """Advances to the time ``until`` [s], the arm standing still."""
        self._run(lambda: self.time >= until - 1e-9, moving=False)

    def move(self, ended: Callable[[], bool], longest: float) -> None:
        """Lets the arm be commanded until ``ended``, or until it was stopped.

        Ctrl-C stops it, as does the STOP button. Whatever is raised, the arm is brought to rest
        before that goes on.

        Args:
            ended: whether the motion has.
            longest: [s] of wall time after which it is stopped.
        """
        operator, context = self._robot.station.operator, self._simulator.get_context()

        def ended_or_stopped() -> bool:
            if time.monotonic() > end:
                operator.stop(StopReason.DEADLINE, f"the motion took longer than {longest:.0f} s")
            guarded = self._robot.guarded(context)
            return ended() if guarded.broken is None else not guarded.commands

        with self._stoppable():
            self.catch_up()
            # The executor first takes over the motion: the first command is where that begins.
            self.stand(self.time + PERIOD)
            operator.arm()
            end = time.monotonic() + longest
            try:
                self._run(ended_or_stopped, moving=True)
            except BaseException:
                self._brake()
                raise

    def _run(self, ended: Callable[[], bool], *, moving: bool) -> None:
        deadline, late = time.monotonic(), 0.0
        while not ended():
            if moving:
                self._watch(late)
            self.listen(cameras=not moving)
            self._simulator.AdvanceTo((round(self.time / PERIOD) + 1) * PERIOD)
            deadline += PERIOD
            time.sleep(max(0.0, deadline - time.monotonic()))
            late = time.monotonic() - deadline
            deadline += late  # the next period begins now

    def listen(self, *, cameras: bool = True) -> None:
        """Takes in what has come."""
        robot = self._robot
        for lcm in (robot.lcm, robot.camera_lcm) if cameras else (robot.lcm,):
            for _ in range(_MESSAGES):
                if lcm.HandleSubscriptions(0) == 0:
                    break

    def catch_up(self) -> None:
        """Listens until what is known of the arm is fresh, or does not become so.

        LCM keeps the *first* message that came while nobody listened.
        """
        end = time.monotonic() + _PATIENCE
        while (
            self._robot.bus.arm.age() > self._robot.safety.status_age / 2 and time.monotonic() < end
        ):
            self.listen()
            time.sleep(PERIOD)

    def _watch(self, late: float) -> None:
        """Stops the arm for what is seen from outside the Diagram."""
        self.late = max(self.late, late)
        operator = self._robot.station.operator
        if late > self._robot.safety.stall:
            operator.stop(StopReason.STALLED, f"this program was {late:.2f} s late")
        if self._meshcat is not None and self._meshcat.GetButtonClicks(STOP_BUTTON) > 0:
            operator.stop(StopReason.OPERATOR, "the STOP button")
        if (age := self._robot.bus.hand.age()) > _HAND_SLOWER * self._robot.safety.status_age:
            operator.stop(StopReason.STALE_STATUS, f"the hand's status is {age:.1f} s old")

    @contextmanager
    def _stoppable(self) -> Iterator[None]:
        """Ctrl-C and the STOP button stop the arm; the garbage collector does not make it late."""

        def stop(signum: int, frame: object) -> None:
            self._robot.station.operator.stop(StopReason.OPERATOR, signal.Signals(signum).name)

        before = {s: signal.signal(s, stop) for s in (signal.SIGINT, signal.SIGTERM)}
        if self._meshcat is not None:
            self._meshcat.AddButton(STOP_BUTTON, "Escape")
        gc.collect()
        gc.freeze()  # or it would go through the whole program while the arm moves
        try:
            yield
        finally:
            gc.unfreeze()
            if self._meshcat is not None:
                self._meshcat.DeleteButton(STOP_BUTTON)
            for each, handler in before.items():
                signal.signal(each, handler)

    def _brake(self) -> None:
        """Brings the arm to rest without the Diagram, which has failed."""
        state = self._robot.guarded(self._simulator.get_context())
        last, limits = state.commanded, limits_of(self._robot.safety)
        self._robot.station.operator.stop(StopReason.OPERATOR, "this program failed")
        if not state.commands or last is None:
            return
        while last.v.any() or last.a.any():
            last = braked(last, limits)
            self._robot.bus.command_arm(last.q)
            time.sleep(PERIOD)
