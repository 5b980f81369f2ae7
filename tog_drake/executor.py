"""The one stage with state: it looks, stands still while it thinks, moves, and may try again."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from enum import Enum

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    InputPort,
    LeafSystem,
    State,
)
from pydrake.trajectories import Trajectory

from tog_drake.errors import InputError, NoPlan
from tog_drake.panda import A_MAX, J_MAX, MAX_OPENING, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.safety import SafetyConfig, check_motion, check_start
from tog_drake.time_parameterization import JointLimits, come_to_rest
from tog_drake.values import Array, CameraView, GraspMotion, Grasps, NextLook


@dataclass
class ExecutorConfig:
    """When the executor looks, and when it gives up."""

    look_time: float = 1.0  # [s] pull the chain at the first update from then on
    period: float = 0.01  # [s] of the executor's update
    max_tracking_error: float = 0.15  # [rad] measured against commanded; beyond it, stop
    empty_opening: float = 0.002  # [m] closed further than this after the hold, it holds nothing
    speed: float = 1.0  # of the planned motion's, above 0 to 1; 0.5 takes twice as long
    hand_patience: float = 0.0  # [s] the lift waits at most so long for fingers that still move


class Phase(Enum):
    """What the executor is doing."""

    OBSERVE = "observe"  # standing still, before the look
    READY = "ready"  # the motion is there; the next update stamps its start
    LOOK = "look"  # going to where it looks again, before anything is decided
    MOVE = "move"  # playing the motion
    RETREAT = "retreat"  # it held nothing: back to where the motion began, to look again
    DONE = "done"  # holding its end
    FAILED = "failed"  # braking, as the arm no longer followed, then holding where that ends


_MOVING = 0.001  # [m/s] of fingers; the Franka hand's driver says 0.005 while they move, else 0
_PLAYING = (Phase.LOOK, Phase.MOVE, Phase.RETREAT)


@dataclass(frozen=True)
class ExecutorState:
    """What the executor remembers."""

    phase: Phase = Phase.OBSERVE
    q_hold: Array | None = None  # (7,) [rad] posture held outside MOVE; None before first update
    opening_hold: float | None = None  # [m] likewise of the hand
    motion: GraspMotion | None = None  # of the last look
    next_look: GraspMotion | None = None  # to it, in LOOK and in READY before
    start_time: float = 0.0  # [s] of the motion, in the time of the Context
    look_at: float = 0.0  # [s] of the next look in OBSERVE, of the last one afterwards
    attempt: int = 1
    stop: Callable[[float], Array] | None = None  # commanded in FAILED, from time [s] to (7,) [rad]
    opening_after: float | None = None  # [m] measured at the end of the last motion
    waited: float = 0.0  # [s] for the fingers, before the last motion's lift

    def __deepcopy__(self, memo: dict[int, object]) -> "ExecutorState":
        # Every update copies the state, and nothing in it ever changes: a sixth of the run's time.
        return self


class GraspExecutor(LeafSystem):
    """Plays the motion that the pipeline computes from a look; may look again before and after.

    .. pydrake_system::

        name: GraspExecutor
        input_ports:
        - motion
        - panda.position_measured
        - hand.state_measured
        - next_look
        output_ports:
        - panda.position
        - hand.position
        - failed_grasps
        - earlier_views

    Before the first update the measured positions pass straight through, so that the first command
    moves neither arm nor hand; then the hand opens. At ``look_time`` the update evaluates
    ``motion`` **once**, which runs the whole chain, and latches it. Deciding may take seconds of
    wall time, after which a simulator that chases real time bursts ahead; therefore the motion's
    start is stamped by the *next* update (READY), never by the one that planned. An error raised by
    a stage reaches the caller of ``AdvanceTo`` unchanged.

    That a grasp failed is told by the hand alone: after the hold its fingers have closed on almost
    nothing. Then, ``retries`` times at most, the arm goes back to where the motion began, looks
    again and plays what the pipeline now says. ``failed_grasps`` is what it has learned; it comes
    from the state, so that the pipeline may read it without a loop.

    With ``max_looks`` above 0 there are ``next_look`` and ``earlier_views``. Before ``motion`` it
    evaluates ``next_look``; where that has a motion, it remembers the present view among
    ``earlier_views``, plays it with the hand open, stands still for ``look_time`` and begins anew.
    Where a grasp held nothing, the views from before it are forgotten: it may have moved things.

    Raises:
        NoPlan: in the update, if the motion does not start where the arm is: to command it would
            be a jump.
        Stopped: in the update, if ``safety`` is given and all of the motion is not inside it, or
            the arm is no longer where it begins when it is to begin.
    """

    def __init__(
        self,
        config: ExecutorConfig,
        *,
        retries: int = 0,
        max_looks: int = 0,
        safety: SafetyConfig | None = None,
    ):
        super().__init__()
        # At time 0 it would look while the simulator initializes, before anybody else can.
        if min(config.period, config.look_time, config.max_tracking_error) <= 0:
            raise InputError(
                f"executor: period ({config.period}), look_time ({config.look_time}) and "
                f"max_tracking_error ({config.max_tracking_error}) must be above 0"
            )
        if not 0 < config.speed <= 1:
            raise InputError(f"executor: speed is {config.speed:g}; valid: above 0 to 1")
        if retries < 0:
            raise InputError(f"retries is {retries}; valid: 0 or more")
        self._config = config
        self._retries = retries
        self._max_looks = max_looks
        self._safety = safety
        self._look_time = self._on_grid(config.look_time)
        self._motion = self.DeclareAbstractInputPort("motion", Value(GraspMotion.still()))
        self._measured = self.DeclareVectorInputPort("panda.position_measured", 7)
        self._hand = self.DeclareVectorInputPort("hand.state_measured", 2)
        self._state = self.DeclareAbstractState(Value(ExecutorState(look_at=self._look_time)))
        self._failed = self.DeclareAbstractState(Value(Grasps.empty()))
        self._earlier = self.DeclareAbstractState(Value(()))
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
            prerequisites_of_calc={state_ticket, self.time_ticket(), self._hand.ticket()},
        )
        self.DeclareAbstractOutputPort(
            "failed_grasps",
            alloc=lambda: Value(Grasps.empty()),
            calc=self._CalcFailed,
            prerequisites_of_calc={self.abstract_state_ticket(self._failed)},
        )
        self._next_look: InputPort | None = None
        if max_looks > 0:
            self._next_look = self.DeclareAbstractInputPort("next_look", Value(NextLook.none()))
            self.DeclareAbstractOutputPort(
                "earlier_views",
                alloc=lambda: Value(()),
                calc=self._CalcEarlierViews,
                prerequisites_of_calc={self.abstract_state_ticket(self._earlier)},
            )
        self.DeclarePeriodicUnrestrictedUpdateEvent(config.period, 0.0, self._Update)

    @property
    def look_time(self) -> float:
        """When the chain is pulled first [s]: the time of an update, to the last digit.

        Who evaluates a stage at this very time sees the value that will be executed.
        """
        return self._look_time

    @property
    def empty_opening(self) -> float:
        """Closed further than this [m], the hand holds nothing."""
        return self._config.empty_opening

    def state(self, context: Context) -> ExecutorState:
        """Returns what the executor remembers in its own ``context``."""
        value: ExecutorState = context.get_abstract_state(int(self._state)).get_value()
        return value

    def looks_left(self, context: Context) -> int:
        """Returns how many further looks it may still take in its own ``context``."""
        return self._max_looks - len(self._earlier_views(context))

    def brake(self, context: Context) -> None:
        """Lets what is played come to rest from now on, as where the arm no longer follows it.

        Args:
            context: its own, which is changed; where nothing is played, it is not.
        """
        s, t = self.state(context), context.get_time()
        if s.phase in _PLAYING:
            played, elapsed = _played(s, t)
            stop = _stop(played.arm, elapsed, t)
            braking = replace(_holding(s, played, elapsed), phase=Phase.FAILED, stop=stop)
            context.get_mutable_abstract_state(int(self._state)).set_value(braking)

    def _earlier_views(self, context: Context) -> tuple[CameraView, ...]:
        views: tuple[CameraView, ...] = context.get_abstract_state(int(self._earlier)).get_value()
        return views

    def _Update(self, context: Context, state: State) -> EventStatus:
        before = self.state(context)
        look = self._look(before, context)
        after = self._next(before, context) if look is None else _to_look(before, look)
        if after is before:
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._state)).set_value(after)
        if look is not None:
            earlier = (*self._earlier_views(context), look.left)
            state.get_mutable_abstract_state(int(self._earlier)).set_value(earlier)
        if after.attempt > before.attempt:
            state.get_mutable_abstract_state(int(self._earlier)).set_value(())
        if after.phase is Phase.RETREAT and before.phase is Phase.MOVE:
            assert after.motion is not None
            failed: Grasps = context.get_abstract_state(int(self._failed)).get_value()
            state.get_mutable_abstract_state(int(self._failed)).set_value(
                _appended(failed, after.motion.grasp)
            )
        return EventStatus.Succeeded()

    def _look(self, s: ExecutorState, context: Context) -> NextLook | None:
        """Returns the further look that begins now, if one does."""
        observes = s.phase is Phase.OBSERVE and context.get_time() >= s.look_at
        if not observes or self._next_look is None or self.looks_left(context) <= 0:
            return None
        look: NextLook = deepcopy(self._next_look.Eval(context))
        if look.motion is None:
            return None
        return replace(look, motion=self._accepted(look.motion, context))

    def _next(self, s: ExecutorState, context: Context) -> ExecutorState:
        t = context.get_time()
        if s.q_hold is None:
            s = replace(s, q_hold=self._measured.Eval(context).copy(), opening_hold=MAX_OPENING)
        if s.phase is Phase.OBSERVE and t >= s.look_at:
            motion = self._accepted(deepcopy(self._motion.Eval(context)), context)
            return replace(_holding(s, motion, 0.0), phase=Phase.READY, motion=motion)
        if s.phase is Phase.READY:
            phase = Phase.MOVE if s.next_look is None else Phase.LOOK
            s = replace(s, phase=phase, start_time=t, waited=0.0)
            if self._safety is not None:  # a person may have thought about it for a minute
                check_start(_played(s, t)[0], self._measured.Eval(context), self._safety)
            return s
        if s.phase in _PLAYING:
            return self._watch(self._wait_for_hand(s, context), context)
        return s

    def _wait_for_hand(self, s: ExecutorState, context: Context) -> ExecutorState:
        """Holds the motion back where the arm rests before the lift, while fingers still move."""
        patience = self._config.hand_patience
        if s.phase is not Phase.MOVE or s.motion is None or s.waited >= patience:
            return s
        rest = s.start_time + s.motion.phase_times["lift"] - self._config.period
        late = context.get_time() - rest
        moves = abs(self._hand.Eval(context)[1]) > _MOVING
        if not (moves and 0.0 <= late <= self._config.period + 1e-9):
            return s
        return replace(s, start_time=s.start_time + late, waited=s.waited + late)

    def _accepted(self, motion: GraspMotion, context: Context) -> GraspMotion:
        """Returns the motion as it is played."""
        q_measured = self._measured.Eval(context)
        self._require_start(motion, q_measured)
        motion = motion.slowed(self._config.speed)
        if self._safety is not None:
            check_motion(motion, q_measured, self._safety)
            if motion.retreat is not None:
                end = motion.arm.value(motion.duration).ravel()
                check_motion(motion.retreat, end, self._safety)
        return motion

    def _require_start(self, motion: GraspMotion, q_measured: Array) -> None:
        away = np.abs(motion.arm.value(0.0).ravel() - q_measured).max()
        if not away <= self._config.max_tracking_error:  # NaN is not, either
            raise NoPlan(
                f"the motion starts {away:.3f} rad away from where the arm is; it is not executed: "
                "plan from the measured posture"
            )

    def _watch(self, s: ExecutorState, context: Context) -> ExecutorState:
        """Goes on at the end of what is played, or stops where the arm no longer follows it."""
        t, q_measured = context.get_time(), self._measured.Eval(context)
        played, elapsed = _played(s, t)
        commanded = played.arm.value(elapsed).ravel()
        if not np.abs(commanded - q_measured).max() <= self._config.max_tracking_error:
            # A command that stopped at once would itself break the limits of a real arm, and one
            # that went to a measurement that is wrong could lead anywhere. The hand keeps what it
            # holds; opening it would drop the object.
            stop = _stop(played.arm, elapsed, t)
            return replace(_holding(s, played, elapsed), phase=Phase.FAILED, stop=stop)
        if elapsed < played.duration:
            return s
        s = _holding(s, played, played.duration)
        look_at = self._on_grid(t + self._config.look_time)
        if s.phase is Phase.LOOK:
            return replace(s, phase=Phase.OBSERVE, next_look=None, look_at=look_at)
        if s.phase is Phase.RETREAT:
            return replace(s, phase=Phase.OBSERVE, attempt=s.attempt + 1, look_at=look_at)
        opening = float(self._hand.Eval(context)[0])
        empty = opening < self._config.empty_opening and played.retreat is not None
        again = empty and s.attempt <= self._retries
        return replace(s, phase=Phase.RETREAT if again else Phase.DONE, opening_after=opening)

    def _on_grid(self, t: float) -> float:
        """Returns the time of the first update at ``t`` [s] or later.

        Updates come at whole multiples of the period; in floating point, exactly at these.
        """
        return float(np.ceil(t / self._config.period - 1e-9) * self._config.period)

    def _CalcArm(self, context: Context, output: BasicVector) -> None:
        s = self.state(context)
        if s.phase in _PLAYING:
            played, elapsed = _played(s, context.get_time())
            output.SetFromVector(played.arm.value(elapsed).ravel())
        elif s.stop is not None:
            output.SetFromVector(s.stop(context.get_time()))
        elif s.q_hold is not None:
            output.SetFromVector(s.q_hold)
        else:
            output.SetFromVector(self._measured.Eval(context))

    def _CalcHand(self, context: Context, output: BasicVector) -> None:
        s = self.state(context)
        if s.phase in _PLAYING:
            played, elapsed = _played(s, context.get_time())
            output.SetAtIndex(0, float(played.hand.value(elapsed).item()))
        elif s.opening_hold is not None:
            output.SetAtIndex(0, s.opening_hold)
        else:
            output.SetAtIndex(0, float(self._hand.Eval(context)[0]))

    def _CalcFailed(self, context: Context, output: Value) -> None:
        output.set_value(context.get_abstract_state(int(self._failed)).get_value())

    def _CalcEarlierViews(self, context: Context, output: Value) -> None:
        output.set_value(self._earlier_views(context))


def _played(s: ExecutorState, t: float) -> tuple[GraspMotion, float]:
    """Returns what is played at ``t`` [s], and how far it has come [s]."""
    played = s.next_look if s.phase is Phase.LOOK else s.motion
    start = s.start_time
    if s.phase is Phase.RETREAT:
        assert played is not None
        start += played.duration
        played = played.retreat
    assert played is not None
    return played, min(t - start, played.duration)


def _to_look(s: ExecutorState, look: NextLook) -> ExecutorState:
    """Returns the state that is ready for a further look."""
    assert look.motion is not None
    return replace(_holding(s, look.motion, 0.0), phase=Phase.READY, next_look=look.motion)


def _holding(s: ExecutorState, motion: GraspMotion, elapsed: float) -> ExecutorState:
    """Returns the state that holds what ``motion`` commands at ``elapsed`` [s]."""
    return replace(
        s,
        q_hold=motion.arm.value(elapsed).ravel(),
        opening_hold=float(motion.hand.value(elapsed).item()),
    )


def _stop(arm: Trajectory, elapsed: float, now: float) -> Callable[[float], Array]:
    """Returns the command from ``now`` [s] on: from the motion at ``elapsed`` [s] to rest."""
    q, velocity, acceleration = (arm.EvalDerivative(elapsed, n).ravel() for n in range(3))
    limits = JointLimits(Q_LOWER, Q_UPPER, V_MAX, A_MAX, J_MAX)
    stop = come_to_rest(q, velocity, acceleration, limits)
    return lambda t: stop(t - now)


def _appended(grasps: Grasps, more: Grasps) -> Grasps:
    """Returns plain grasps, those of ``more`` last."""
    columns = (f.name for f in fields(Grasps))
    return Grasps(*(np.concatenate([getattr(grasps, c), getattr(more, c)]) for c in columns))
