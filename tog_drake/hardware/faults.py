"""What can go wrong between a robot and who commands it, injected on purpose.

A fault is written ``KIND:CHANNEL:START:DURATION[:AMOUNT]``, times in seconds. START counts from
the moment when the arm was first told to move, or, with a plus before it, from the emulator's own
start: ``drop:PANDA_STATUS:0.5:0.2``, ``freeze:TOG_WRIST:+3:inf``.
"""

import heapq
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from drake import (
    lcmt_image_array,
    lcmt_panda_command,
    lcmt_panda_status,
    lcmt_schunk_wsg_command,
    lcmt_schunk_wsg_status,
)

from tog_drake.errors import InputError
from tog_drake.stations.lcm_bus import (
    HAND_COMMAND,
    HAND_STATUS,
    PANDA_COMMAND,
    PANDA_STATUS,
    images_message,
    read_images,
)

# What befalls the messages of a channel, and AMOUNT where it is not given.
OF_MESSAGES = {
    "drop": 1.0,  # this share of them is lost
    "delay": 0.2,  # [s] they come later
    "freeze": 0.0,  # they repeat the last one before, with stamps that go on
    "reorder": 0.0,  # each two change places
    "duplicate": 1.0,  # so many more of each
    "nan": 0.0,  # the measured or commanded values are no numbers
}
# What befalls the arm; the channel is PANDA_STATUS, which tells it.
OF_ARM = {
    "restart": 0.0,  # its driver is gone for DURATION, then starts anew
    "reflex": 0.0,  # its controller stops it, until it recovers after DURATION
    "push": 30.0,  # [Nm] external torque on the elbow, joint 4
}
_TYPES: dict[str, Any] = {
    PANDA_COMMAND: lcmt_panda_command,
    PANDA_STATUS: lcmt_panda_status,
    HAND_COMMAND: lcmt_schunk_wsg_command,
    HAND_STATUS: lcmt_schunk_wsg_status,
}  # any other channel has images


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong, for a while."""

    kind: str  # of OF_MESSAGES or OF_ARM
    channel: str
    start: float  # [s]
    duration: float  # [s]
    amount: float
    from_begin: bool  # ``start`` counts from the emulator's start, not the arm's first motion


def parse_fault(text: str, image_channels: list[str]) -> Fault:
    """Reads a fault as it is written in a command.

    Raises:
        InputError: it is none; the message says what would be one.
    """
    kinds, channels = OF_MESSAGES | OF_ARM, [*_TYPES, *image_channels]
    parts = text.split(":")
    form = f"--fault {text}: valid: KIND:CHANNEL:START:DURATION[:AMOUNT]"
    if not 4 <= len(parts) <= 5:
        raise InputError(f"{form}, such as drop:PANDA_STATUS:0.5:0.2")
    kind, channel, start = parts[:3]
    if kind not in kinds:
        raise InputError(f"{form}, where KIND is {', '.join(kinds)}")
    valid = [PANDA_STATUS] if kind in OF_ARM else channels
    if channel not in valid:
        raise InputError(f"{form}, where CHANNEL of {kind} is {', '.join(valid)}")
    try:
        numbers = [float(part) for part in (start, *parts[3:])]
    except ValueError:
        numbers = [math.nan]
    if not all(number >= 0 for number in numbers) or math.isinf(numbers[0]):
        raise InputError(f"{form}, where the others are numbers that are not negative")
    amount = numbers[2] if len(numbers) == 3 else kinds[kind]
    if not math.isfinite(amount) or amount > (1.0 if kind == "drop" else 1000.0):
        raise InputError(f"{form}, where AMOUNT is at most 1 for drop and 1000 else")
    return Fault(kind, channel, numbers[0], numbers[1], amount, start.startswith("+"))


class Schedule:
    """Which faults there are when.

    Args:
        faults: all of them.
        begin: [s] when the emulator started; None: it has yet to.
    """

    def __init__(self, faults: list[Fault], begin: float | None = None):
        self.begin = begin
        self.moved: float | None = None  # [s] when the arm was first told to move
        self._faults = faults
        self._seen: set[int] = set()

    def active(self, channel: str, now: float) -> list[Fault]:
        """Returns the faults of a channel at a time [s], in the order in which they were given."""
        return [
            fault
            for fault in self._faults
            if fault.channel == channel and 0 <= self._since(fault, now) < fault.duration
        ]

    def begun(self, now: float) -> list[Fault]:
        """Returns the faults that have begun since the last call, however short they are."""
        new = [
            i
            for i, fault in enumerate(self._faults)
            if i not in self._seen and self._since(fault, now) >= 0
        ]
        self._seen.update(new)
        return [self._faults[i] for i in new]

    def _since(self, fault: Fault, now: float) -> float:
        """How long ago it began [s]; negative: it has not."""
        origin = self.begin if fault.from_begin else self.moved
        return -math.inf if origin is None else now - origin - fault.start


class FaultyLine:
    """Carries the messages of a channel, as well as its faults allow.

    Args:
        channel: whose faults, and what its messages are.
        schedule: the faults.
        seed: of the luck of each message.
    """

    def __init__(self, channel: str, schedule: Schedule, seed: int):
        self._channel = channel
        self._schedule = schedule
        self._rng = np.random.default_rng([seed, *channel.encode()])
        self._on_the_way: list[tuple[float, int, bytes]] = []  # when it arrives, its number
        self._count = 0
        self._before: bytes | None = None  # the last message that was not frozen
        self._held: bytes | None = None  # the first of two that change places

    def send(self, data: bytes, now: float) -> None:
        faults = {f.kind: f for f in self._schedule.active(self._channel, now)}
        if "freeze" not in faults or self._before is None:
            self._before = data
        else:
            data = _with_stamp_of(self._channel, self._before, data)
        if "drop" in faults and self._rng.random() < faults["drop"].amount:
            return
        if "nan" in faults:
            data = _with_nan(self._channel, data)
        copies = 1 + (int(faults["duplicate"].amount) if "duplicate" in faults else 0)
        arrival = now + (faults["delay"].amount if "delay" in faults else 0.0)
        for message in [data] * copies:
            for one in self._in_order(message, "reorder" in faults):
                self._count += 1
                heapq.heappush(self._on_the_way, (arrival, self._count, one))

    def _in_order(self, data: bytes, swapped: bool) -> list[bytes]:
        held, self._held = self._held, None
        if swapped and held is None:
            self._held = data
            return []
        return [m for m in ((data, held) if swapped else (held, data)) if m is not None]

    def due(self, now: float) -> list[bytes]:
        """Returns what has arrived by now, each message once."""
        arrived = []
        while self._on_the_way and self._on_the_way[0][0] <= now:
            arrived.append(heapq.heappop(self._on_the_way)[2])
        return arrived


def _with_stamp_of(channel: str, data: bytes, stamped: bytes) -> bytes:
    """Returns a message with the ``utime`` of another of its channel; noise stays as it is."""
    kind = _TYPES.get(channel, lcmt_image_array)
    try:
        message, other = kind.decode(data), kind.decode(stamped)
    except Exception:  # of struct, of numbers, of text: LCM's own code does not say
        return data
    if kind is lcmt_image_array:
        message.header.utime = other.header.utime
    else:
        message.utime = other.utime
    changed: bytes = message.encode()
    return changed


def _with_nan(channel: str, data: bytes) -> bytes:
    """Returns a message whose values are no numbers; noise stays as it is."""
    try:
        if channel not in _TYPES:
            images = read_images(data)
            return images_message(images.rgb, np.full_like(images.depth, np.nan), images.utime)
        message = _TYPES[channel].decode(data)
    except Exception:  # of struct, of numbers, of text: LCM's own code does not say
        return data
    if channel in (PANDA_COMMAND, PANDA_STATUS):
        message.joint_position = [math.nan] * len(message.joint_position)
    elif channel == HAND_STATUS:
        message.actual_position_mm = math.nan
    else:
        message.target_position_mm = math.nan
    changed: bytes = message.encode()
    return changed
