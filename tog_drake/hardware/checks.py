"""Checks the real robot before anything moves, and says what to do about what is wrong.

It listens and never commands. Whatever is missing is a finding: nothing here waits for ever.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from pydrake.lcm import DrakeLcm

from tog_drake.cameras import drake_config
from tog_drake.doctor import Check
from tog_drake.errors import InputError
from tog_drake.hardware.config import HardwareConfig, RealCamera
from tog_drake.hardware.mount import mount_of
from tog_drake.panda import MAX_OPENING, Q_LOWER, Q_UPPER
from tog_drake.planning_model import MakePlanningModel
from tog_drake.scenario import Scenario, robot_directive
from tog_drake.stations.camera_feed import Feed
from tog_drake.stations.lcm_bus import (
    HAND_STATUS,
    PANDA_STATUS,
    ArmStatus,
    HandStatus,
    ImagePair,
    Inbox,
    RobotMode,
    make_lcm,
    read_arm_status,
    read_hand_status,
)
from tog_drake.stations.lcm_camera import scenario_intrinsics
from tog_drake.table import find_table
from tog_drake.values import Array, View

LEAST_RATE = 100.0  # [Hz] of the arm's status
LONGEST_GAP = 0.1  # [s] in it; the station stops the arm where one is longer
MOST_SKEW = 0.03  # [s]; the driver drops commands that are 0.05 to 0.1 s old by its clock
LEAST_FRAMES = 2.0  # [Hz]
OLDEST_IMAGE = 1.0  # [s] an older one is not decided on
MARGIN = 0.02  # [rad] to a joint limit
MOST_TILT = np.radians(1.0)  # of the table that is seen against the one that is known
MOST_HEIGHT = 0.008  # [m] likewise

_MODES = {
    RobotMode.IDLE: "start the driver with --control_mode=position",
    RobotMode.GUIDING: "let go of the buttons at the hand",
    RobotMode.REFLEX: "clear the arm by hand, then restart the driver",
    RobotMode.USER_STOPPED: "release the user stop, then restart the driver",
    RobotMode.RECOVERY: "wait, then restart the driver",
}


@dataclass
class Heard:
    """What was heard from the robot; each age and gap by this computer's clock."""

    lcm: DrakeLcm
    arm: Inbox[ArmStatus] = field(init=False)
    hand: Inbox[HandStatus] = field(init=False)
    arm_at: list[float] = field(default_factory=list)  # [s] when its messages arrived
    arm_age: list[float] = field(default_factory=list)  # [s] how old they were then
    stamps: dict[str, list[int]] = field(default_factory=dict)  # camera -> [µs] of its images

    def __post_init__(self) -> None:
        self.arm = Inbox(self.lcm, PANDA_STATUS, self._read_arm, time.time)
        self.hand = Inbox(self.lcm, HAND_STATUS, read_hand_status, time.time)

    def _read_arm(self, data: bytes) -> ArmStatus:
        status, now = read_arm_status(data), time.time()
        self.arm_at.append(now)
        self.arm_age.append(now - status.utime / 1e6)
        return status

    def listen(self, feeds: dict[str, Feed], seconds: float) -> None:
        """Listens for so long [s]."""
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0:
            self.lcm.HandleSubscriptions(max(1, min(5, round(1e3 * rest))))
            for name, feed in feeds.items():
                images, stamps = feed.newest(), self.stamps.setdefault(name, [])
                if images is not None and stamps[-1:] != [images.utime]:
                    stamps.append(images.utime)


def hardware_checks(
    scenario: Scenario, seconds: float = 3.0, lcm: DrakeLcm | None = None
) -> list[Check]:
    """Returns every check in order, having listened for so long [s].

    Args:
        scenario: its section ``hardware`` says where the drivers and the cameras are.
        seconds: to listen for.
        lcm: for tests; None is that of the scenario.
    """
    hardware = scenario.hardware or HardwareConfig()
    heard = Heard(lcm or make_lcm(hardware.lcm_url))
    feeds: dict[str, Feed] = {}
    checks: list[Check] = []
    try:
        for name, camera in hardware.cameras.items():
            opened = _opened(scenario, name, camera, heard.lcm)
            if isinstance(opened, Check):
                checks.append(opened)
            else:
                feeds[name] = opened
        heard.listen(feeds, seconds)
        checks = [*_arm(heard, seconds), *_hand(heard), *checks]
        for name, feed in feeds.items():
            checks += _camera(scenario, name, feed, heard, seconds)
    finally:
        for feed in feeds.values():
            feed.close()
    return checks


def _opened(scenario: Scenario, name: str, camera: RealCamera, lcm: DrakeLcm) -> Feed | Check:
    try:
        mount_of(scenario, name)
        return camera.open(lcm, drake_config(scenario.cameras[name]))
    except InputError as error:
        return Check(f"camera {name}", False, str(error))


def _arm(heard: Heard, seconds: float) -> Iterator[Check]:
    status = heard.arm.newest
    if status is None:
        why = f"; {heard.arm.refused} were refused, {heard.arm.why_refused}"
        yield Check(
            "arm's driver",
            False,
            f"no {PANDA_STATUS} in {seconds:g} s{why if heard.arm.refused else ''}: start "
            "franka_driver on this computer with the same LCM URL (or tog hardware emulate)",
        )
        return
    yield Check("arm's driver", True, f"{heard.arm.received} messages on {PANDA_STATUS}")
    yield _rate(np.array(heard.arm_at), seconds)
    yield _skew(float(np.median(heard.arm_age)))
    room = np.minimum(status.q - Q_LOWER, Q_UPPER - status.q)
    joint = int(np.argmin(room))
    inside = f"joint {joint + 1} is {room[joint]:.2f} rad from its limit"
    yield _check("joints", room[joint] >= MARGIN, inside, "move the arm away from it by hand")
    mode = RobotMode(status.robot_mode) if status.robot_mode in list(RobotMode) else RobotMode.OTHER
    advice = _MODES.get(mode, "look at Desk, then restart the driver")
    yield _check("robot mode", mode == RobotMode.MOVE, mode.name, advice)


def _rate(at: Array, seconds: float) -> Check:
    """Of the arm's status: by the time from the first to the last, and by the longest silence."""
    rate = (len(at) - 1) / max(at[-1] - at[0], 1e-9)
    gaps = np.append(np.diff(at), time.time() - at[-1])
    found = (
        f"{rate:.0f} Hz, gaps {1e3 * np.median(gaps):.1f} ms (median), {1e3 * gaps.max():.0f} ms "
        "(longest)"
    )
    good = len(at) > 2 and rate >= LEAST_RATE and gaps.max() < LONGEST_GAP
    return _check(
        "arm's status",
        good,
        found,
        f"at least {LEAST_RATE:g} Hz and no gap of {1e3 * LONGEST_GAP:g} ms is needed: end other "
        "programs, use a real-time kernel, connect the controller directly",
    )


def _skew(age: float) -> Check:
    return _check(
        "clocks",
        -MOST_SKEW < age < MOST_SKEW,
        f"messages arrive {1e3 * age:.1f} ms after they were sent (median)",
        "run the driver on this computer, or set both clocks by the same server (chrony)",
    )


def _hand(heard: Heard) -> Iterator[Check]:
    status = heard.hand.newest
    if status is None:
        yield Check(
            "hand's driver",
            False,
            f"no {HAND_STATUS}: start franka_hand_driver; it says nothing until it has homed",
        )
        return
    width = f"{1e3 * status.opening:.1f} mm open"
    yield _check(
        "hand",
        -0.002 <= status.opening <= MAX_OPENING + 0.002 and heard.hand.age() < OLDEST_IMAGE,
        f"{width}, {heard.hand.age():.2f} s ago",
        "restart its driver, which homes it; nothing may be between the fingers",
    )


def _camera(
    scenario: Scenario, name: str, feed: Feed, heard: Heard, seconds: float
) -> Iterator[Check]:
    images, title = feed.newest(), f"camera {name}"
    if images is None:
        why = feed.problem()
        yield Check(title, False, f"no image in {seconds:g} s; is it running? {why}".rstrip())
        return
    # The first image may be from before.
    rate, age = (len(heard.stamps[name]) - 1) / seconds, time.time() - images.utime / 1e6
    yield _check(
        title,
        rate >= LEAST_FRAMES and abs(age) < OLDEST_IMAGE,
        f"{rate:.1f} images a second, the last {age:.2f} s old",
        "see whether its program keeps up and the clocks agree; over LCM: sysctl -w "
        "net.core.rmem_max=4194304",
    )
    expected = feed.intrinsics
    height, width = images.depth.shape
    sizes_agree = (width, height) == (expected.width, expected.height)
    said = scenario_intrinsics(drake_config(scenario.cameras[name]))
    yield _check(
        f"intrinsics of {name}",
        sizes_agree,
        f"{width}x{height} pixels, expected {expected.width}x{expected.height}; focal length "
        f"{expected.fx:.1f} pixels, {said.fx:.1f} in the scenario",
        "give the scenario's camera the resolution of its images",
    )
    if sizes_agree and heard.arm.newest is not None:
        yield _guarded(
            f"mount of {name}", lambda: _mount(scenario, name, feed, images, heard.arm.newest)
        )


def _mount(
    scenario: Scenario, name: str, feed: Feed, images: ImagePair, arm: ArmStatus | None
) -> Check:
    """Whether the table is where it is known to be, as seen through posture and mount."""
    assert arm is not None
    title = f"mount of {name}"
    X_WH = MakePlanningModel([robot_directive(scenario), *scenario.planning_directives]).X_WH(arm.q)
    X_WC = X_WH @ mount_of(scenario, name)
    depth = np.where(np.isfinite(images.depth) & (images.depth > 0), images.depth, 0)
    view = View(images.rgb, depth.astype(np.float32), feed.intrinsics, X_WC)
    up = X_WC[2, :3]  # W's z, in C
    seen = find_table(view, up=up).X_WC
    tilt = float(np.arccos(np.clip(seen[2, :3] @ up, -1.0, 1.0)))
    known = scenario.pipeline.workspace.table_height
    # Both are compared where the camera looks: a tilt alone must not count as height.
    axis = seen[2, 2]
    if abs(axis) < 0.1:
        raise InputError("the camera looks along the table; look down at it")
    p_W = X_WC @ np.array([0.0, 0.0, -seen[2, 3] / axis, 1.0])
    height = float(p_W[2] - known)
    return _check(
        title,
        tilt < MOST_TILT and abs(height) < MOST_HEIGHT,
        f"the table is seen {1e3 * height:+.1f} mm from where it is known to be, tilted by "
        f"{np.degrees(tilt):.2f} deg",
        "is the table where planning_directives say? Else: tog hardware calibrate",
    )


def _guarded(name: str, look: Callable[[], Check]) -> Check:
    try:
        return look()
    except InputError as error:
        return Check(name, False, f"{error}; move the arm so that it looks down at the table")


def _check(name: str, ok: bool | np.bool_, found: str, advice: str) -> Check:
    return Check(name, bool(ok), found if ok else f"{found}: {advice}")
