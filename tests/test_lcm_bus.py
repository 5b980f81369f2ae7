"""Messages of the robot's drivers: what is sent is what is read; nothing else is believed."""

import time

import numpy as np
import pytest
from drake import (
    lcmt_image_array,
    lcmt_panda_command,
    lcmt_panda_status,
    lcmt_schunk_wsg_command,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmPublisherSystem
from pydrake.systems.sensors import (
    ImageDepth16U,
    ImageRgba8U,
    ImageToLcmImageArrayT,
    PixelType,
)

from tog_drake.stations.lcm_bus import (
    PANDA_STATUS,
    Inbox,
    arm_command_message,
    arm_status_message,
    hand_command_message,
    hand_status_message,
    images_message,
    read_arm_status,
    read_hand_status,
    read_images,
)

Q = np.array([0.1, -0.2, 0.3, -2.4, 0.5, 1.6, 0.7])
V = 0.1 * Q
TORQUE = np.array([1.0, -2.0, 0.0, 0.5, 0.0, 0.0, -0.25])


def test_a_status_of_the_arm_is_read_as_it_was_sent():
    status = read_arm_status(arm_status_message(Q, V, TORQUE, robot_mode=2, utime=5))
    np.testing.assert_array_equal(status.q, Q)
    np.testing.assert_array_equal(status.v, V)
    np.testing.assert_array_equal(status.torque_external, TORQUE)
    assert (status.robot_mode, status.utime) == (2, 5)


def test_on_the_wire_the_external_torque_has_the_opposite_sign():
    message = lcmt_panda_status.decode(arm_status_message(Q, V, TORQUE, robot_mode=2, utime=5))
    np.testing.assert_array_equal(message.joint_torque_external, -TORQUE)


def test_a_command_has_seven_positions_and_nothing_else():
    message = lcmt_panda_command.decode(arm_command_message(Q, utime=7))
    assert message.control_mode_expected == lcmt_panda_status.CONTROL_MODE_POSITION
    assert (message.num_joint_velocity, message.num_joint_torque) == (0, 0)
    np.testing.assert_array_equal(message.joint_position, Q)


def test_the_hand_is_told_millimetres_and_never_more_than_it_opens():
    sent = [hand_command_message(opening, 40.0, 1) for opening in (0.05, 0.2, -0.02)]
    messages = [lcmt_schunk_wsg_command.decode(data) for data in sent]
    assert [m.target_position_mm for m in messages] == [50.0, 80.0, 0.0]
    assert {m.force for m in messages} == {40.0}
    status = read_hand_status(hand_status_message(0.03, 0.005, utime=9))
    assert (status.opening, status.rate, status.utime) == (0.03, 0.005, 9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e9])
def test_a_status_with_a_value_that_cannot_be_is_refused(bad):
    q = Q.copy()
    q[3] = bad
    with pytest.raises(ValueError, match="seven finite"):
        read_arm_status(arm_status_message(q, V, TORQUE, robot_mode=2, utime=5))
    with pytest.raises(ValueError, match="finite"):
        read_hand_status(hand_status_message(bad, 0.0, utime=9))


@given(data=st.binary(max_size=400))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_read_or_refused_with_one_kind_of_error(data):
    for read in (read_arm_status, read_hand_status, read_images):
        with pytest.raises(ValueError, match="it is no"):
            read(data)


@given(cut=st.integers(0, 400), flips=st.lists(st.tuples(st.integers(0, 399), st.integers(0, 255))))
@settings(max_examples=200, deadline=None)
def test_a_damaged_message_is_read_or_refused_with_one_kind_of_error(cut, flips):
    good = [
        (read_arm_status, arm_status_message(Q, V, TORQUE, robot_mode=2, utime=5)),
        (read_images, images_message(*_pictures(6, 8), utime=5)),
    ]
    for read, message in good:
        damaged = bytearray(message)
        for at, value in flips:
            damaged[at % len(damaged)] = value
        try:
            read(bytes(damaged[: len(damaged) - cut]))
        except ValueError as error:
            assert str(error)


def test_images_are_read_to_the_last_bit():
    rgb, depth = _pictures(48, 64)
    depth[3, 4], depth[5, 6] = np.inf, np.nan
    pair = read_images(images_message(rgb, depth, utime=11))
    np.testing.assert_array_equal(pair.rgb, rgb)
    np.testing.assert_array_equal(pair.depth, depth)
    assert pair.utime == 11


def test_images_as_drake_sends_them_are_read():
    """RGBA, and depth as 16-bit millimetres, compressed: what ``ImageToLcmImageArrayT`` makes."""
    rgb, depth = _pictures(6, 8)
    color, millimetres = ImageRgba8U(8, 6), ImageDepth16U(8, 6)
    color.mutable_data[:] = np.dstack([rgb, np.full((6, 8), 255, np.uint8)])
    millimetres.mutable_data[..., 0] = (1e3 * depth).astype(np.uint16)
    lcm, received = DrakeLcm("memq://"), []
    lcm.Subscribe("IMAGES", received.append)
    builder = DiagramBuilder()
    images = builder.AddSystem(ImageToLcmImageArrayT(do_compress=True))
    publisher = builder.AddSystem(
        LcmPublisherSystem.Make(
            "IMAGES", lcmt_image_array, lcm, use_cpp_serializer=True, publish_period=0.1
        )
    )
    builder.Connect(images.image_array_t_msg_output_port(), publisher.get_input_port())
    ports = [
        images.DeclareImageInputPort[PixelType.kRgba8U]("color"),
        images.DeclareImageInputPort[PixelType.kDepth16U]("depth"),
    ]
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    for port, image in zip(ports, (color, millimetres), strict=True):
        port.FixValue(images.GetMyContextFromRoot(context), image)
    diagram.ForcedPublish(context)
    lcm.HandleSubscriptions(0)
    pair = read_images(received[0])
    np.testing.assert_array_equal(pair.rgb, rgb)
    np.testing.assert_allclose(pair.depth, depth, atol=0.001)


def _pictures(height, width):
    random = np.random.default_rng(0)
    rgb = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return rgb, random.uniform(0.3, 2.0, (height, width)).astype(np.float32)


def test_an_image_that_unpacks_to_more_than_it_says_is_refused():
    rgb, depth = _pictures(6, 8)
    message = lcmt_image_array.decode(images_message(rgb, depth, utime=1))
    for image in message.images:
        image.height = 3
    with pytest.raises(ValueError, match="bytes, not"):
        read_images(message.encode())
    for image in message.images:
        image.height, image.width = 100_000, 100_000
    with pytest.raises(ValueError, match="pixels large"):
        read_images(message.encode())


def _inbox(clock=time.time):
    lcm = DrakeLcm("memq://")
    return lcm, Inbox(lcm, PANDA_STATUS, read_arm_status, clock)


def _send(lcm, utime, q=Q):
    lcm.Publish(PANDA_STATUS, arm_status_message(q, V, TORQUE, robot_mode=2, utime=utime))
    lcm.HandleSubscriptions(0)


def test_an_inbox_keeps_the_newest_message_whatever_the_order():
    lcm, inbox = _inbox()
    assert inbox.newest is None
    assert inbox.age() == np.inf
    for utime in (3, 1, 2, 3):
        _send(lcm, utime)
    assert inbox.newest.utime == 3
    assert (inbox.received, inbox.refused) == (1, 3)
    assert "not newer" in inbox.why_refused


def test_an_inbox_counts_what_it_cannot_believe_and_grows_old_meanwhile():
    lcm, inbox = _inbox(clock=lambda: 10.0)
    _send(lcm, 9_800_000)
    _send(lcm, 9_900_000, q=np.full(7, np.nan))
    _send(lcm, 60_000_000)
    assert (inbox.received, inbox.refused) == (1, 2)
    assert inbox.age() == pytest.approx(0.2)
    assert "clocks" in inbox.why_refused
