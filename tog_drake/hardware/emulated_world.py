"""What the emulated drivers drive: the simulated robot, asked step by step, without a clock.

It runs in a process of its own (``Child``): a step of contact may take longer than the period of
the status, which the real driver never delays.
"""

import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Generic, TypeVar

import numpy as np
from pydrake.systems.analysis import Simulator

from tog_drake.benchmark.processes import die_with_parent
from tog_drake.errors import InputError
from tog_drake.scenario import Scenario
from tog_drake.stations.simulation import SimulationStation
from tog_drake.terminal import keep_drake_quiet
from tog_drake.values import Array

Asked = TypeVar("Asked")
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Drive:
    """What the drivers tell the joints, and for how long."""

    q: Array  # (7,) [rad]
    opening: float  # [m] between the pads; below what is possible, they squeeze
    dt: float  # [s]


@dataclass(frozen=True)
class WorldState:
    """What can be measured of the robot, and where everything is."""

    q: Array  # (7,) [rad]
    v: Array  # (7,) [rad/s]
    torque_external: Array  # (7,) [Nm], Drake's sign
    opening: float  # [m] between the pads
    positions: Array  # of the whole plant, for who renders it


class EmulatedWorld:
    """The station of a scenario, as it was built at first and then is driven."""

    def __init__(self, scenario: Scenario):
        self._station = SimulationStation(scenario)
        self._simulator = Simulator(self._station)
        context = self._simulator.get_mutable_context()
        self._context = self._station.plant.GetMyContextFromRoot(context)
        self._drive(self._measured("panda.position_measured"), self._opening())
        self._simulator.Initialize()

    def state(self) -> WorldState:
        return WorldState(
            q=self._measured("panda.position_measured"),
            v=self._measured("panda.velocity_measured"),
            torque_external=self._measured("panda.torque_external"),
            opening=self._opening(),
            positions=self._station.plant.GetPositions(self._context).copy(),
        )

    def __call__(self, drive: Drive | None) -> WorldState:
        """Lets ``drive.dt`` pass; None: no time."""
        if drive is not None:
            self._drive(drive.q, drive.opening)
            now = self._simulator.get_context().get_time()
            self._simulator.AdvanceTo(now + drive.dt)
        return self.state()

    def _drive(self, q: Array, opening: float) -> None:
        context = self._simulator.get_mutable_context()
        self._station.GetInputPort("panda.position").FixValue(context, q)
        self._station.GetInputPort("hand.position").FixValue(context, [opening])

    def _measured(self, port: str) -> Array:
        value = self._station.GetOutputPort(port).Eval(self._simulator.get_context())
        return np.array(value)

    def _opening(self) -> float:
        return float(self._measured("hand.state_measured")[0])


class Child(Generic[Asked, Answer]):
    """Does one thing after another in a process of its own; whoever asks never waits.

    The process is a fork: a scenario cannot be pickled. So it is to be made before anything that
    starts threads, as LCM does.

    Args:
        make: makes, in that process, what is called with each thing asked.
        arguments: of ``make``.
        nice: how much it stands back where processors are few.
    """

    def __init__(self, make: Callable[..., Callable[[Asked], Answer]], *arguments: Any, nice: int):
        context = get_context("fork")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, make, arguments, nice), daemon=True
        )
        self._process.start()
        theirs.close()  # so that the death of the process ends the pipe
        self.busy = True

    def wait(self) -> Any:
        """Waits for the answer; the first one, None, says that it was made.

        Raises:
            InputError: it could not be made.
        """
        return self._hear()

    def ask(self, asked: Asked) -> None:
        """Must not be called while it is ``busy``: a full pipe would be waited for."""
        self.busy = True
        with suppress(OSError):  # it is dead, as the end of the pipe will tell
            self._pipe.send(asked)

    def answer(self) -> Answer | None:
        """Returns what came of the last thing asked, once; None as long as it is not there."""
        if not self._pipe.poll():
            return None
        answer: Answer = self._hear()
        return answer

    def _hear(self) -> Any:
        try:
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            self._process.join()
            raise RuntimeError(
                f"a part of the emulator died, status {self._process.exitcode}"
            ) from error
        if isinstance(answer, InputError):
            raise answer
        self.busy = False
        return answer

    def end(self) -> None:
        self._process.terminate()
        self._pipe.close()
        self._process.join()


def _serve(
    pipe: Any, make: Callable[..., Callable[[Any], Any]], arguments: tuple[Any, ...], nice: int
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=die_with_parent, daemon=True).start()
    keep_drake_quiet()
    os.nice(nice)
    try:
        made = make(*arguments)
    except InputError as error:
        pipe.send(InputError(str(error)))
        return
    except RuntimeError as error:  # so Drake refuses a joint, frame, file or setting
        pipe.send(InputError(f"the scenario cannot be built: {error}"))
        return
    pipe.send(None)
    while True:
        try:
            pipe.send(made(pipe.recv()))
        except EOFError:
            return
