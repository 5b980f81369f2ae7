"""Faults as what they make of a stream of messages."""

import numpy as np
import pytest
from drake import lcmt_panda_status
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError
from tog_drake.hardware.faults import FaultyLine, Schedule, parse_fault
from tog_drake.stations.lcm_bus import (
    HAND_COMMAND,
    HAND_STATUS,
    PANDA_COMMAND,
    PANDA_STATUS,
    arm_command_message,
    arm_status_message,
    hand_command_message,
    hand_status_message,
    images_message,
    read_arm_status,
    read_hand_status,
    read_images,
)

Q = np.zeros(7)
PERIOD = 0.01  # [s]
CAMERA = "TOG_WRIST"
TIMES = st.floats(0.0, 1.0)


def stream(*faults, messages=100, seed=0, moved=0.0):
    """Sends statuses 0, 1, ... every 10 ms; returns what arrives: when, stamp, q of joint 1."""
    schedule = Schedule([parse_fault(fault, [CAMERA]) for fault in faults], begin=0.0)
    line = FaultyLine(PANDA_STATUS, schedule, seed)
    arrived = []
    for i in range(messages + 200):
        now = i * PERIOD
        if now >= moved:
            schedule.moved = moved
        if i < messages:
            line.send(arm_status_message(Q + i, Q, Q, robot_mode=2, utime=i), now)
        for data in line.due(now):
            m = lcmt_panda_status.decode(data)
            arrived.append((i, m.utime, m.joint_position[0]))
    return arrived


UNTOUCHED = [(i, i, float(i)) for i in range(100)]


def within(start, duration):
    """The messages that are sent meanwhile."""
    return {i for i in range(100) if start <= i * PERIOD and i * PERIOD - start < duration}


def test_without_a_fault_everything_arrives_at_once():
    assert stream() == UNTOUCHED


@pytest.mark.parametrize("kind", ["drop", "delay", "freeze", "reorder", "duplicate", "nan"])
def test_what_is_sent_while_a_fault_is_not_there_arrives_as_it_was_sent(kind):
    before = stream(f"{kind}:PANDA_STATUS:0.305:0.2")
    assert before[:31] == UNTOUCHED[:31]
    assert before[-30:] == UNTOUCHED[-30:]


@settings(max_examples=30)
@given(start=TIMES, duration=TIMES)
def test_dropped_messages_do_not_arrive_and_all_others_do(start, duration):
    lost = within(start, duration)
    got = stream(f"drop:PANDA_STATUS:{start}:{duration}")
    assert got == [m for m in UNTOUCHED if m[1] not in lost]


def test_a_share_of_messages_is_dropped_the_same_ones_with_the_same_seed():
    fault = "drop:PANDA_STATUS:0:inf:0.3"
    assert 50 < len(stream(fault)) < 90
    assert stream(fault) == stream(fault)
    assert stream(fault) != stream(fault, seed=1)


@settings(max_examples=30)
@given(start=TIMES, duration=TIMES, by=st.integers(1, 50))
def test_delayed_messages_arrive_later_and_none_is_lost(start, duration, by):
    late = within(start, duration)
    got = stream(f"delay:PANDA_STATUS:{start}:{duration}:{by * PERIOD - 1e-6}")
    expected = {(i + by if i in late else i, i, float(i)) for i in range(100)}
    assert set(got) == expected
    assert [m[0] for m in got] == sorted(m[0] for m in got)


@settings(max_examples=30)
@given(start=st.floats(0.02, 0.5), duration=TIMES)
def test_frozen_messages_repeat_the_last_one_before_but_their_stamps_go_on(start, duration):
    frozen = within(start, duration)
    last = min(frozen, default=0) - 1
    got = stream(f"freeze:PANDA_STATUS:{start}:{duration}")
    assert got == [(i, i, float(last if i in frozen else i)) for i in range(100)]


@settings(max_examples=30)
@given(start=TIMES, duration=TIMES)
def test_of_reordered_messages_each_two_change_places_and_none_is_lost(start, duration):
    swapped = sorted(within(start, duration))
    stamps = [m[1] for m in stream(f"reorder:PANDA_STATUS:{start}:{duration}")]
    order = list(range(100))
    for first, second in zip(swapped[::2], swapped[1::2], strict=False):
        order[first], order[second] = second, first
    # One that has no partner waits for the next message, and comes before it.
    assert stamps == (order if not (len(swapped) % 2 and swapped[-1] == 99) else order[:99])


@settings(max_examples=30)
@given(start=TIMES, duration=TIMES, more=st.integers(1, 4))
def test_duplicated_messages_arrive_so_many_times_more_at_once(start, duration, more):
    doubled = within(start, duration)
    got = stream(f"duplicate:PANDA_STATUS:{start}:{duration}:{more}")
    assert got == [m for m in UNTOUCHED for _ in range(1 + more * (m[1] in doubled))]


def test_values_that_are_no_numbers_are_what_arrives_and_nobody_believes_them():
    got = stream("nan:PANDA_STATUS:0.3:0.2")
    assert {m[1] for m in got if np.isnan(m[2])} == within(0.3, 0.2)


@pytest.mark.parametrize(
    ("channel", "message", "read"),
    [
        (PANDA_STATUS, arm_status_message(Q, Q, Q, 2, 5), read_arm_status),
        (HAND_STATUS, hand_status_message(0.04, 0.0, 5), read_hand_status),
    ],
)
def test_no_number_is_refused_on_every_status(channel, message, read):
    with pytest.raises(ValueError, match="finite"):
        read(through(f"nan:{channel}:+0:1", channel, message))


def through(fault, channel, *messages):
    """The last of the messages, as it arrives."""
    line = FaultyLine(channel, Schedule([parse_fault(fault, [CAMERA])], begin=0.0), seed=0)
    for message in messages:
        line.send(message, 0.5)
    return line.due(0.5)[-1]


def test_images_too_may_be_without_depth_or_frozen():
    rgb = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    depth = np.full((2, 4), 0.5, np.float32)
    old, new = images_message(rgb, depth, 7), images_message(rgb + 1, depth + 1, 8)
    blind = read_images(through(f"nan:{CAMERA}:+0:1", CAMERA, old))
    assert np.all(np.isnan(blind.depth))
    np.testing.assert_array_equal(blind.rgb, rgb)
    frozen = read_images(through(f"freeze:{CAMERA}:+0:1", CAMERA, old, new))
    assert frozen.utime == 8
    np.testing.assert_array_equal(frozen.rgb, rgb)
    np.testing.assert_array_equal(frozen.depth, depth)


@pytest.mark.parametrize("kind", ["nan", "freeze"])
@pytest.mark.parametrize("channel", [PANDA_COMMAND, HAND_COMMAND, HAND_STATUS, CAMERA])
def test_a_message_that_is_none_passes_as_it_is(kind, channel):
    assert through(f"{kind}:{channel}:+0:1", channel, b"noise", b"other noise") in (
        b"noise",
        b"other noise",
    )


def test_commands_too_are_frozen_or_no_numbers():
    for channel, message in (
        (PANDA_COMMAND, arm_command_message(Q + 0.5, 5)),
        (HAND_COMMAND, hand_command_message(0.05, 40.0, 5)),
    ):
        assert through(f"nan:{channel}:+0:1", channel, message) != message
        assert through(f"freeze:{channel}:+0:1", channel, message, message) == message


def test_a_start_counts_from_the_first_motion_or_with_a_plus_from_the_emulators_own():
    lost = {m[1] for m in UNTOUCHED}
    lost -= {m[1] for m in stream("drop:PANDA_STATUS:0.095:0.1", moved=0.5)}
    assert lost == set(range(60, 70))
    lost = {m[1] for m in UNTOUCHED}
    lost -= {m[1] for m in stream("drop:PANDA_STATUS:+0.095:0.1", moved=0.5)}
    assert lost == set(range(10, 20))


def test_a_fault_of_the_arm_begins_once():
    schedule = Schedule([parse_fault("reflex:PANDA_STATUS:+1:5", [])], begin=10.0)
    assert schedule.begun(10.9) == []
    assert [f.kind for f in schedule.begun(11.1)] == ["reflex"]
    assert schedule.begun(11.2) == []


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("drop", "DURATION"),
        ("drop:PANDA_STATUS:1", "DURATION"),
        ("drop:PANDA_STATUS:1:2:3:4", "DURATION"),
        ("lose:PANDA_STATUS:1:2", "KIND is drop"),
        ("drop:IIWA_STATUS:1:2", "PANDA_HAND_STATUS, TOG_WRIST"),
        ("reflex:PANDA_COMMAND:1:2", "reflex is PANDA_STATUS"),
        ("drop:PANDA_STATUS:soon:2", "numbers"),
        ("drop:PANDA_STATUS:-1:2", "not negative"),
        ("drop:PANDA_STATUS:nan:2", "numbers"),
        ("drop:PANDA_STATUS:inf:2", "numbers"),
        ("drop:PANDA_STATUS:1:2:1.5", "AMOUNT"),
        ("duplicate:PANDA_STATUS:1:2:1e9", "AMOUNT"),
        ("delay:PANDA_STATUS:1:2:inf", "AMOUNT"),
    ],
)
def test_what_is_no_fault_is_refused_with_what_would_be_one(text, word):
    with pytest.raises(InputError, match=word):
        parse_fault(text, [CAMERA])
