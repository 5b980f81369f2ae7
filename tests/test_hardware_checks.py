"""``tog hardware doctor``: what it finds of a robot that speaks well, badly, or not at all."""

import time
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm

from tog_drake.cameras import drake_config
from tog_drake.hardware import checks
from tog_drake.hardware.checks import hardware_checks
from tog_drake.hardware.mount import mount_of
from tog_drake.panda import Q_UPPER, forward_kinematics
from tog_drake.scenario import LOOK_POSTURE, load_scenario
from tog_drake.stations.lcm_bus import (
    HAND_STATUS,
    PANDA_STATUS,
    RobotMode,
    arm_status_message,
    hand_status_message,
    images_message,
)
from tog_drake.stations.lcm_camera import scenario_intrinsics

SCENARIO = load_scenario("panda_lcm")
Q = np.array(LOOK_POSTURE)
CAMERA = scenario_intrinsics(drake_config(SCENARIO.cameras["wrist"]))


def table_seen(X_WC, z=0.0):
    """(480, 640) [m]: the depth of a table at that height, with a box on it."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    down = ray @ X_WC[2, :3]
    depth = (z - X_WC[2, 3]) / down
    depth[200:280, 280:360] -= 0.05
    return depth.astype(np.float32)


class Robot:
    """Both drivers and a camera, within this process; each field is one thing to spoil.

    It brings a clock, which goes on by a millisecond whenever somebody listens: how busy the
    computer is changes nothing.
    """

    def __init__(self, **changes):
        self.lcm = DrakeLcm("memq://")
        self.begin = self.now = time.time() - 100.0
        self.period, self.silent, self.until = 0.004, (0.0, 0.0), np.inf  # [s]
        self.q, self.mode, self.opening = Q, RobotMode.MOVE, 0.08
        self.late, self.arm, self.hand, self.camera = 0.0, True, True, True
        self.height, self.size = 0.0, 1
        vars(self).update(changes)
        X_WC = forward_kinematics(self.q) @ mount_of(SCENARIO, "wrist")
        depth = table_seen(X_WC, self.height)[:: self.size, :: self.size]
        self.depth, self.rgb = depth, np.zeros((*depth.shape, 3), np.uint8)
        self.image = images_message(self.rgb, self.depth, 0)
        self.next = dict.fromkeys(("arm", "hand", "camera"), self.begin)

    def Subscribe(self, channel, handler):
        return self.lcm.Subscribe(channel, handler)

    def time(self):
        return self.now

    monotonic = time

    def HandleSubscriptions(self, milliseconds):
        self.now += 0.001
        since, utime = self.now - self.begin, round(1e6 * (self.now - self.late))
        zeros = np.zeros(7)
        silent = self.silent[0] < since < self.silent[1]
        if self.arm and not silent and self.due("arm", self.period):
            message = arm_status_message(self.q, zeros, zeros, self.mode, utime)
            self.lcm.Publish(PANDA_STATUS, message)
        if self.hand and self.due("hand", 0.1):
            self.lcm.Publish(HAND_STATUS, hand_status_message(self.opening, 0.0, utime))
        if self.camera and since < self.until and self.due("camera", 0.2):
            self.lcm.Publish("TOG_WRIST", images_message(self.rgb, self.depth, utime))
        return self.lcm.HandleSubscriptions(0)

    def due(self, what, period):
        if self.now < self.next[what]:
            return False
        self.next[what] = max(self.next[what], self.now - period) + period  # no burst
        return True


def found(robot, scenario=SCENARIO, seconds=1.0):
    with mock.patch.object(checks, "time", robot):
        return {check.name: check for check in hardware_checks(scenario, seconds, robot)}


def problems(robot):
    return {name: check.found for name, check in found(robot).items() if not check.ok}


def test_of_a_robot_that_is_ready_everything_is_found():
    told = found(Robot())
    assert {name for name, check in told.items() if not check.ok} == set(), told
    assert list(told) == [
        "arm's driver",
        "arm's status",
        "clocks",
        "joints",
        "robot mode",
        "hand",
        "camera wrist",
        "intrinsics of wrist",
        "mount of wrist",
    ]
    assert "tilted by 0.0" in told["mount of wrist"].found


def test_where_nothing_speaks_it_is_said_what_to_start_and_it_ends():
    told = problems(Robot(arm=False, hand=False, camera=False))
    assert set(told) == {"arm's driver", "hand's driver", "camera wrist"}
    assert "start franka_driver" in told["arm's driver"]
    assert "franka_hand_driver" in told["hand's driver"]
    assert "is it running?" in told["camera wrist"]


@pytest.mark.parametrize(
    ("changes", "name", "words"),
    [
        ({"mode": RobotMode.REFLEX}, "robot mode", "clear the arm by hand"),
        ({"mode": RobotMode.IDLE}, "robot mode", "--control_mode=position"),
        ({"mode": RobotMode.USER_STOPPED}, "robot mode", "release the user stop"),
        ({"mode": 77}, "robot mode", "look at Desk"),
        ({"late": 0.5}, "clocks", "chrony"),
        ({"opening": 0.2}, "hand", "homes it"),
        ({"height": 0.03}, "mount of wrist", "+30.0 mm"),
        ({"size": 2}, "intrinsics of wrist", "resolution of its images"),
    ],
)
def test_what_is_wrong_is_named_with_what_to_do(changes, name, words):
    told = problems(Robot(**changes))
    assert set(told) == {name}
    assert words in told[name]


def test_a_joint_at_its_limit_is_named():
    q = Q.copy()
    q[5] = Q_UPPER[5] - 0.001
    told = problems(Robot(q=q, camera=False))
    assert set(told) == {"joints", "camera wrist"}
    assert "joint 6 is 0.00 rad" in told["joints"]


def test_a_mount_that_is_turned_by_two_degrees_is_told(monkeypatch):
    X = mount_of(SCENARIO, "wrist")
    c, s = np.cos(np.radians(2)), np.sin(np.radians(2))
    turned = X @ np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
    robot = Robot()
    monkeypatch.setattr(checks, "mount_of", lambda scenario, camera: turned)
    told = problems(robot)
    assert set(told) == {"mount of wrist"}
    assert "tilted by 2.0" in told["mount of wrist"]
    assert "tog hardware calibrate" in told["mount of wrist"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"period": 0.02}, "Hz, gaps 20.0 ms"),
        ({"silent": (0.3, 0.5)}, "20"),
        ({"silent": (0.6, 9.0)}, "(longest)"),  # and for good
    ],
)
def test_gaps_and_a_low_rate_are_problems(changes, words):
    told = problems(Robot(**changes))
    assert set(told) == {"arm's status"}
    assert words in told["arm's status"]
    assert "real-time" in told["arm's status"]


def test_a_camera_that_stopped_is_a_problem():
    told = problems(Robot(until=0.3))
    assert set(told) == {"camera wrist"}


def test_a_camera_that_cannot_be_opened_is_a_finding():
    scenario = load_scenario("Hammer", "hardware: {cameras: {wrist: !LcmImages {channel: ''}}}")
    told = found(Robot(), scenario)
    assert not told["camera wrist"].ok
    assert "needs a channel" in told["camera wrist"].found
    scenario = replace(scenario, cameras={})
    told = found(Robot(), scenario)
    assert "unknown camera" in told["camera wrist"].found
