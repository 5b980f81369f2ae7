"""Arm and hand over LCM, as systems of a Diagram: what their drivers say, and are told."""

import time
from collections import deque
from collections.abc import Callable

import numpy as np
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
    State,
)

from tog_drake.panda import MAX_OPENING
from tog_drake.safety import PERIOD
from tog_drake.stations.guard import GuardState, Heard
from tog_drake.stations.lcm_bus import (
    HAND_COMMAND,
    HAND_STATUS,
    PANDA_COMMAND,
    PANDA_STATUS,
    ArmStatus,
    HandStatus,
    Inbox,
    arm_command_message,
    hand_command_message,
    read_arm_status,
    read_hand_status,
)
from tog_drake.values import Array

UNCHANGED = 0.02  # [s] an opening that was asked for so long is what is wanted: no ramp is sent
REPEAT = 0.1  # [s] between two messages to the hand
_SAME = 1e-4  # [m] openings this close are one
_OPEN = 0.002  # [m] a hand so close to an opening is open enough
_REMEMBERED = 1000  # of the commands sent: 5 s


class PandaBus:
    """The channels of arm and hand: what was heard there, and what was sent there.

    Messages arrive while somebody calls ``lcm.HandleSubscriptions``, never inside a Diagram.
    """

    def __init__(self, lcm: DrakeLcm, clock: Callable[[], float] = time.time):
        self.arm: Inbox[ArmStatus] = Inbox(lcm, PANDA_STATUS, read_arm_status, clock)
        self.hand: Inbox[HandStatus] = Inbox(lcm, HAND_STATUS, read_hand_status, clock)
        self.foreign = False  # whether somebody else has commanded the arm
        self._lcm = lcm
        self._clock = clock
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED)
        lcm.Subscribe(PANDA_COMMAND, self._overhear)

    def heard(self) -> Heard:
        """Returns what is known of the arm now."""
        return Heard(self.arm.newest, self.arm.age(), self.foreign)

    def command_arm(self, q: Array) -> None:
        """Tells the arm to be at ``q`` (7,) [rad]; stamped with the time of sending."""
        message = arm_command_message(q, self._now())
        self._sent.append(message)
        self._lcm.Publish(PANDA_COMMAND, message)

    def command_hand(self, opening: float, force: float) -> None:
        """Tells the hand to go to ``opening`` [m], pressing with ``force`` [N]."""
        self._lcm.Publish(HAND_COMMAND, hand_command_message(opening, force, self._now()))

    def _overhear(self, data: bytes) -> None:
        # Multicast brings this program its own commands, too.
        self.foreign = self.foreign or data not in self._sent

    def _now(self) -> int:
        return round(1e6 * self._clock())


class PandaStatus(LeafSystem):
    """Brings what the arm's driver says into a Diagram.

    .. pydrake_system::

        name: PandaStatus
        output_ports:
        - panda.position_measured
        - panda.velocity_measured
        - panda.torque_external
        - heard

    Outputs read the state, which an update every ``PERIOD`` takes over. There must be a status
    before the Diagram is initialized: zeros would be a posture.
    """

    def __init__(self, bus: PandaBus):
        super().__init__()
        self._bus = bus
        self._state = self.DeclareAbstractState(Value(bus.heard()))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._take)
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._take)
        tickets = {self.abstract_state_ticket(self._state)}
        for port, name in (
            ("panda.position_measured", "q"),
            ("panda.velocity_measured", "v"),
            ("panda.torque_external", "torque_external"),
        ):
            self.DeclareVectorOutputPort(
                port,
                7,
                lambda context, output, name=name: self._CalcVector(name, context, output),
                prerequisites_of_calc=tickets,
            )
        self.DeclareAbstractOutputPort(
            "heard",
            alloc=lambda: Value(Heard()),
            calc=lambda context, output: output.set_value(self._heard(context)),
            prerequisites_of_calc=tickets,
        )

    def _take(self, context: Context, state: State) -> EventStatus:
        state.get_mutable_abstract_state(int(self._state)).set_value(self._bus.heard())
        return EventStatus.Succeeded()

    def _heard(self, context: Context) -> Heard:
        heard: Heard = context.get_abstract_state(int(self._state)).get_value()
        return heard

    def _CalcVector(self, name: str, context: Context, output: BasicVector) -> None:
        status = self._heard(context).status
        output.SetFromVector(np.full(7, np.nan) if status is None else getattr(status, name))


class PandaCommand(LeafSystem):
    """Sends each new command of the guard to the arm's driver.

    .. pydrake_system::

        name: PandaCommand
        input_ports:
        - guarded
    """

    def __init__(self, bus: PandaBus):
        super().__init__()
        self._bus = bus
        self._guarded = self.DeclareAbstractInputPort("guarded", Value(GuardState()))
        self.DeclarePeriodicPublishEvent(PERIOD, 0.0, self._send)

    def _send(self, context: Context) -> EventStatus:
        guarded: GuardState = self._guarded.Eval(context)
        if guarded.commands and guarded.commanded is not None:
            self._bus.command_arm(guarded.commanded.q)
        return EventStatus.Succeeded()


class HandStatusPort(LeafSystem):
    """Brings what the hand's driver says into a Diagram.

    .. pydrake_system::

        name: HandStatusPort
        output_ports:
        - hand.state_measured
    """

    def __init__(self, bus: PandaBus):
        super().__init__()
        self._bus = bus
        self._state = self.DeclareDiscreteState(2)
        self.DeclareInitializationDiscreteUpdateEvent(self._take)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._take)
        self.DeclareStateOutputPort("hand.state_measured", self._state)

    def _take(self, context: Context, state: DiscreteValues) -> EventStatus:
        status = self._bus.hand.newest
        values = [np.nan, np.nan] if status is None else [status.opening, status.rate]
        state.set_value(int(self._state), values)
        return EventStatus.Succeeded()


class HandCommand(LeafSystem):
    """Makes of the opening that is asked for what the hand's driver can carry out.

    .. pydrake_system::

        name: HandCommand
        input_ports:
        - guarded

    A new command makes the driver give up what it is doing, so that none is sent before the opening
    has stayed the same for ``UNCHANGED``. And the driver grasps, whatever the width, when it is
    told to go to a narrower one than now: so it is told to open, where it is not open already, or
    to close until something resists (an opening of 0 or below), and nothing between: before a grasp
    the hand stays wider open than planned. What it was told it is told again and again, which the
    driver ignores: a single message may be lost among those of the cameras.

    Args:
        bus: to the driver.
        force: [N] of each finger.
    """

    def __init__(self, bus: PandaBus, force: float):
        super().__init__()
        self._bus = bus
        self._force = force
        # Asked for last [m], since when [s], told last [m]; NaN: nothing yet.
        self._state = self.DeclareDiscreteState([np.nan, 0.0, np.nan])
        self._guarded = self.DeclareAbstractInputPort("guarded", Value(GuardState()))
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._note)
        self.DeclarePeriodicPublishEvent(REPEAT, 0.0, self._send)

    def _note(self, context: Context, state: DiscreteValues) -> EventStatus:
        asked, since, told = context.get_discrete_state(self._state).value()
        opening, now = self._opening(context), self._bus.hand.newest
        if opening is None:
            asked, since = np.nan, 0.0
        elif not abs(opening - asked) < _SAME:
            asked, since = opening, context.get_time()
        elif due(asked, since, told, context.get_time()) and (
            asked == 0.0 or now is None or now.opening < asked - _OPEN
        ):
            told = asked
        state.set_value(int(self._state), [asked, since, told])
        return EventStatus.Succeeded()

    def _send(self, context: Context) -> EventStatus:
        told = context.get_discrete_state(self._state).value()[2]
        if np.isfinite(told) and self._opening(context) is not None:
            self._bus.command_hand(told, self._force)
        return EventStatus.Succeeded()

    def _opening(self, context: Context) -> float | None:
        """What is asked for now [m], 0 for whatever presses; None: nothing."""
        guarded: GuardState = self._guarded.Eval(context)
        if not guarded.commands or guarded.opening is None:
            return None
        opening = min(guarded.opening, MAX_OPENING)
        # What is almost 0, on a ramp that goes through it, would else count as the same as 0.
        return opening if opening > _SAME else 0.0


def due(asked: float, since: float, told: float, now: float) -> bool:
    """Whether a hand that was told ``told`` [m] is to be told what is asked for since then [s]."""
    if not np.isfinite(asked) or now - since < UNCHANGED - 1e-9:
        return False
    if np.isnan(told):
        return True
    return asked > told + _SAME or asked <= 0.0 < told
