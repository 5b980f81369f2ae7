"""The last thing before the wire: what a real arm is commanded, whatever the pipeline says."""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from tog_drake.safety import (
    PERIOD,
    Broken,
    Commanded,
    SafetyConfig,
    StopReason,
    braked,
    broken_rule,
    limits_of,
)
from tog_drake.stations.lcm_bus import ArmStatus, RobotMode


class GuardMode(Enum):
    """Whether the arm is commanded."""

    DISARMED = "disarmed"  # nothing is commanded, for nobody has said yes
    ARMED = "armed"  # what comes in goes out, as long as no rule is broken
    STOPPING = "stopping"  # it brakes, whatever comes in
    STOPPED = "stopped"  # it stands; nothing is commanded any more


@dataclass(frozen=True)
class GuardState:
    """What is commanded, if anything, and why it was stopped."""

    mode: GuardMode = GuardMode.DISARMED
    commanded: Commanded | None = None  # the last command; None: there was none
    opening: float | None = None  # [m] that the hand is asked for; None: nothing
    broken: Broken | None = None  # the rule by which it was stopped, and how

    @property
    def commands(self) -> bool:
        return self.mode in (GuardMode.ARMED, GuardMode.STOPPING)

    def __deepcopy__(self, memo: dict[int, object]) -> "GuardState":
        # Every update of a Diagram copies its state, and nothing in it ever changes.
        return self


@dataclass(frozen=True)
class Heard:
    """What has come from the arm's driver and about it."""

    status: ArmStatus | None = None  # the newest; None: none has come
    age: float = np.inf  # [s] of it
    foreign: bool = False  # whether somebody else has commanded the arm

    def __deepcopy__(self, memo: dict[int, object]) -> "Heard":
        return self


class Operator:
    """What a person, or the program around the Diagram, tells the guard."""

    def __init__(self) -> None:
        self.armed = False
        self.wants_stop: Broken | None = None

    def arm(self) -> None:
        """Lets the arm be commanded, until it is stopped."""
        self.armed = True

    def stop(self, reason: StopReason, how: str) -> None:
        """Stops it for good; the first reason stays."""
        self.wants_stop = self.wants_stop or (reason, how)


class Guard(LeafSystem):
    """Passes on what breaks no rule; at the first that does, brakes, and never commands again.

    .. pydrake_system::

        name: Guard
        input_ports:
        - panda.position
        - hand.position
        - heard
        output_ports:
        - guarded

    ``guarded`` is a ``GuardState``; a new one every ``PERIOD``. While it brakes it follows its own
    last commands within the limits of ``safety``, and listens to nobody. When the arm stands, or
    carries out no commands any more, it falls silent: the driver holds the last command by itself,
    and a driver that was started anew must not be met by one from before.
    """

    def __init__(self, safety: SafetyConfig, operator: Operator):
        super().__init__()
        self._safety = safety
        self._limits = limits_of(safety)
        self._operator = operator
        self._wanted = self.DeclareVectorInputPort("panda.position", 7)
        self._opening = self.DeclareVectorInputPort("hand.position", 1)
        self._heard = self.DeclareAbstractInputPort("heard", Value(Heard()))
        self._state = self.DeclareAbstractState(Value(GuardState()))
        self.DeclareAbstractOutputPort(
            "guarded",
            alloc=lambda: Value(GuardState()),
            calc=lambda context, output: output.set_value(self.state(context)),
            prerequisites_of_calc={self.abstract_state_ticket(self._state)},
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._update)

    def state(self, context: Context) -> GuardState:
        """Returns what is commanded in its own ``context``."""
        value: GuardState = context.get_abstract_state(int(self._state)).get_value()
        return value

    def _update(self, context: Context, state: State) -> EventStatus:
        before = self.state(context)
        after = self._next(before, context)
        if after is before:
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._state)).set_value(after)
        return EventStatus.Succeeded()

    def _next(self, s: GuardState, context: Context) -> GuardState:
        match s.mode:
            case GuardMode.DISARMED:
                return self._begin(context) if self._operator.armed else s
            case GuardMode.ARMED:
                return self._pass_on(s, context)
            case GuardMode.STOPPING:
                return self._brake(s)
            case GuardMode.STOPPED:
                return s

    def _begin(self, context: Context) -> GuardState:
        """The first command is where the arm is, or there is none."""
        q = self._wanted.Eval(context)
        heard: Heard = self._heard.Eval(context)
        broken = self._operator.wants_stop or self._wrong(heard)
        if broken is None:
            assert heard.status is not None
            away = np.abs(q - heard.status.q).max()
            if not away <= self._safety.start_tolerance:  # NaN is not, either
                broken = StopReason.START, f"the first command is {away:.3f} rad from the arm"
        if broken is None:
            broken = broken_rule(Commanded.at_rest(q), q[None], self._safety, self._limits)
        if broken is not None:
            return GuardState(GuardMode.STOPPED, broken=broken)
        return GuardState(GuardMode.ARMED, Commanded.at_rest(q), self._asked_opening(context))

    def _pass_on(self, s: GuardState, context: Context) -> GuardState:
        assert s.commanded is not None
        q = self._wanted.Eval(context)
        heard: Heard = self._heard.Eval(context)
        broken = (
            self._operator.wants_stop
            or self._wrong(heard)
            or self._astray(s.commanded, heard)
            or broken_rule(s.commanded, q[None], self._safety, self._limits)
        )
        if broken is None:
            opening = self._asked_opening(context)
            return replace(s, commanded=s.commanded.then(q), opening=opening)
        if broken[0] is StopReason.ROBOT_MODE:  # the controller itself has stopped the arm
            return replace(s, mode=GuardMode.STOPPED, broken=broken)
        return self._brake(replace(s, mode=GuardMode.STOPPING, broken=broken))

    def _brake(self, s: GuardState) -> GuardState:
        assert s.commanded is not None
        if not (s.commanded.v.any() or s.commanded.a.any()):
            return replace(s, mode=GuardMode.STOPPED)
        return replace(s, commanded=braked(s.commanded, self._limits))

    def _asked_opening(self, context: Context) -> float | None:
        """What the hand is asked for [m]; nothing where that is no number."""
        opening = float(self._opening.Eval(context)[0])
        return opening if np.isfinite(opening) else None

    def _wrong(self, heard: Heard) -> Broken | None:
        """What is wrong with what comes from the arm."""
        status = heard.status
        if status is None:
            return StopReason.STALE_STATUS, "the arm's driver has said nothing"
        if not heard.age <= self._safety.status_age:
            return StopReason.STALE_STATUS, f"the arm's status is {heard.age:.2f} s old"
        if status.robot_mode != RobotMode.MOVE:
            return StopReason.ROBOT_MODE, f"the arm is in mode {mode_name(status.robot_mode)}"
        excess = np.abs(status.torque_external) - self._safety.external_torque
        if excess.max() > 0:
            joint = int(excess.argmax())
            torque = float(abs(status.torque_external[joint]))
            return StopReason.EXTERNAL_TORQUE, f"joint {joint + 1} meets {torque:.1f} Nm"
        if heard.foreign:
            return StopReason.FOREIGN_COMMAND, "somebody else commands the arm, too"
        return None

    def _astray(self, last: Commanded, heard: Heard) -> Broken | None:
        assert heard.status is not None
        away = float(np.abs(last.q - heard.status.q).max())
        if away <= self._safety.tracking_error:
            return None
        return StopReason.TRACKING, f"the arm is {away:.3f} rad from where it was commanded to be"


def mode_name(robot_mode: int) -> str:
    """Returns what to call a robot mode, also one that ``RobotMode`` does not know."""
    try:
        return RobotMode(robot_mode).name
    except ValueError:
        return str(robot_mode)
