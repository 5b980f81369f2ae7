"""The one stage with state: it looks once, stands still while it thinks, then moves."""

from copy import deepcopy
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from tog_drake.errors import InputError, NoPlan
from tog_drake.panda import MAX_OPENING
from tog_drake.values import Array, GraspMotion


@dataclass
class ExecutorConfig:
    """When the executor looks, and when it gives up."""

    look_time: float = 1.0  # [s] pull the chain at the first update from then on
    period: float = 0.01  # [s] of the executor's update
    max_tracking_error: float = 0.15  # [rad] measured against commanded; beyond it, stop


class Phase(Enum):
    """What the executor is doing."""

    OBSERVE = "observe"  # standing still, before the look
    READY = "ready"  # the motion is there; the next update stamps its start
    MOVE = "move"  # playing the motion
    DONE = "done"  # holding its end
    FAILED = "failed"  # holding where the arm was stopped


@dataclass(frozen=True)
class ExecutorState:
    """What the executor remembers."""

    phase: Phase = Phase.OBSERVE
    q_hold: Array | None = None  # (7,) [rad] posture held outside MOVE; None before first update
    opening_hold: float = MAX_OPENING  # [m]
    motion: GraspMotion | None = None
    start_time: float = 0.0  # [s] of the motion, in the time of the Context


class GraspExecutor(LeafSystem):
    """Plays the motion that the pipeline computes from one look.

    .. pydrake_system::

        name: GraspExecutor
        input_ports:
        - motion
        - panda.position_measured
        output_ports:
        - panda.position
        - hand.position

    Before the first update the measured position passes straight through, so that the first
    command never moves the arm. At ``look_time`` the update evaluates ``motion`` **once**, which
    runs the whole chain, and latches it. Deciding may take seconds of wall time, after which a
    simulator that chases real time bursts ahead; therefore the motion's start is stamped by the
    *next* update (READY), never by the one that planned. An error raised by a stage reaches the
    caller of ``AdvanceTo`` unchanged.

    Raises:
        NoPlan: in the update, if the motion does not start where the arm is: to command it would
            be a jump.
    """

    def __init__(self, config: ExecutorConfig):
        super().__init__()
        # At time 0 it would look while the simulator initializes, before anybody else can.
        if min(config.period, config.look_time, config.max_tracking_error) <= 0:
            raise InputError(
                f"executor: period ({config.period}), look_time ({config.look_time}) and "
                f"max_tracking_error ({config.max_tracking_error}) must be above 0"
            )
        self._config = config
        # Updates come at whole multiples of the period; in floating point, exactly at these.
        self._look_time = float(np.ceil(config.look_time / config.period - 1e-9) * config.period)
        self._motion = self.DeclareAbstractInputPort("motion", Value(GraspMotion.still()))
        self._measured = self.DeclareVectorInputPort("panda.position_measured", 7)
        self._state = self.DeclareAbstractState(Value(ExecutorState()))
        state_ticket = self.abstract_state_ticket(self._state)
        self.DeclareVectorOutputPort(
            "panda.position",
            7,
            self._CalcArm,
            prerequisites_of_calc={state_ticket, self.time_ticket(), self._measured.ticket()},
        )
        self.DeclareVectorOutputPort(
            "hand.position",
            1,
            self._CalcHand,
            prerequisites_of_calc={state_ticket, self.time_ticket()},
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(config.period, 0.0, self._Update)

    @property
    def look_time(self) -> float:
        """When the chain is pulled [s]: the time of an update, to the last digit.

        Who evaluates a stage at this very time sees the value that will be executed.
        """
        return self._look_time

    def state(self, context: Context) -> ExecutorState:
        """Returns what the executor remembers in its own ``context``."""
        value: ExecutorState = context.get_abstract_state(int(self._state)).get_value()
        return value

    def _Update(self, context: Context, state: State) -> EventStatus:
        before = self.state(context)
        after = self._next(before, context)
        if after is before:
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._state)).set_value(after)
        return EventStatus.Succeeded()

    def _next(self, s: ExecutorState, context: Context) -> ExecutorState:
        t = context.get_time()
        if s.q_hold is None:
            s = replace(s, q_hold=self._measured.Eval(context).copy())
        if s.phase is Phase.OBSERVE and t >= self._look_time:
            motion = deepcopy(self._motion.Eval(context))
            self._require_start(motion, self._measured.Eval(context))
            return replace(
                s,
                phase=Phase.READY,
                motion=motion,
                q_hold=motion.arm.value(0.0).ravel(),
                opening_hold=float(motion.hand.value(0.0).item()),
            )
        if s.phase is Phase.READY:
            return replace(s, phase=Phase.MOVE, start_time=t)
        if s.phase is Phase.MOVE:
            return self._watch(s, t, self._measured.Eval(context))
        return s

    def _require_start(self, motion: GraspMotion, q_measured: Array) -> None:
        away = np.abs(motion.arm.value(0.0).ravel() - q_measured).max()
        if not away <= self._config.max_tracking_error:  # NaN is not, either
            raise NoPlan(
                f"the motion starts {away:.3f} rad away from where the arm is; it is not executed: "
                "plan from the measured posture"
            )

    def _watch(self, s: ExecutorState, t: float, q_measured: Array) -> ExecutorState:
        """Ends the motion at its end, or where the arm no longer follows it."""
        assert s.motion is not None
        elapsed = min(t - s.start_time, s.motion.duration)
        commanded = s.motion.arm.value(elapsed).ravel()
        if not np.abs(commanded - q_measured).max() <= self._config.max_tracking_error:
            # Where a measurement is NaN, the command stays: NaN must never become one.
            q_hold = np.where(np.isfinite(q_measured), q_measured, commanded)
            # The hand keeps what it holds; opening it would drop the object.
            opening = float(s.motion.hand.value(elapsed).item())
            return replace(s, phase=Phase.FAILED, q_hold=q_hold, opening_hold=opening)
        if t - s.start_time >= s.motion.duration:
            end = s.motion.duration
            return replace(
                s,
                phase=Phase.DONE,
                q_hold=s.motion.arm.value(end).ravel(),
                opening_hold=float(s.motion.hand.value(end).item()),
            )
        return s

    def _CalcArm(self, context: Context, output: BasicVector) -> None:
        s = self.state(context)
        if s.phase is Phase.MOVE:
            assert s.motion is not None
            elapsed = min(context.get_time() - s.start_time, s.motion.duration)
            output.SetFromVector(s.motion.arm.value(elapsed).ravel())
        elif s.q_hold is not None:
            output.SetFromVector(s.q_hold)
        else:
            output.SetFromVector(self._measured.Eval(context))

    def _CalcHand(self, context: Context, output: BasicVector) -> None:
        s = self.state(context)
        opening = s.opening_hold
        if s.phase is Phase.MOVE:
            assert s.motion is not None
            elapsed = min(context.get_time() - s.start_time, s.motion.duration)
            opening = float(s.motion.hand.value(elapsed).item())
        output.SetAtIndex(0, opening)
