"""``tog hardware emulate`` in a process of its own, and this side of its wire."""

import json
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np

from tog_drake.stations.lcm_bus import (
    HAND_COMMAND,
    HAND_STATUS,
    PANDA_COMMAND,
    PANDA_STATUS,
    Inbox,
    arm_command_message,
    hand_command_message,
    make_lcm,
    read_arm_status,
    read_hand_status,
    read_images,
)


class Wire:
    """What a program that drives the robot hears and says."""

    def __init__(self, log, process):
        self.process = process
        self.lcm = make_lcm()
        self.arm = Inbox(self.lcm, PANDA_STATUS, read_arm_status)
        self.hand = Inbox(self.lcm, HAND_STATUS, read_hand_status)
        self.camera = Inbox(self.lcm, "TOG_WRIST", read_images)
        self._log = log.open(encoding="utf-8")
        self._lines, self._rest = [], ""

    def listen(self, seconds):
        end = time.time() + seconds
        while (rest := end - time.time()) > 0:
            self.lcm.HandleSubscriptions(max(1, round(1e3 * rest)))

    def until(self, what, seconds=60):
        """Listens until ``what()`` is true; says whether it became so."""
        end = time.time() + seconds
        while not what() and time.time() < end:
            self.listen(0.02)
        return bool(what())

    def command(self, q, late=0.0):
        self.lcm.Publish(PANDA_COMMAND, arm_command_message(q, int(1e6 * (time.time() - late))))

    def stream(self, joint, speed, seconds, q=None):
        """Moves one joint at a speed [rad/s], at 200 Hz; returns where that ends."""
        q = np.array(self.arm.newest.q if q is None else q)
        for _ in range(round(seconds / 0.005)):
            self.command(q)
            q[joint] += 0.005 * speed
            self.listen(0.005)
        return q

    def hand_to(self, opening, force=40.0):
        self.lcm.Publish(HAND_COMMAND, hand_command_message(opening, force, int(1e6 * time.time())))

    def logged(self, event):
        *lines, self._rest = (self._rest + self._log.read()).split("\n")
        self._lines += map(json.loads, lines)
        return [line for line in self._lines if line["event"] == event]


@contextmanager
def emulated_robot(folder, *options):
    """Yields a ``Wire`` to an emulated robot that has begun to speak."""
    log = folder / "robot.jsonl"
    process = subprocess.Popen(
        [sys.executable, "-m", "tog_drake.cli", "hardware", "emulate", "--log", log, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert "an emulated robot" in process.stdout.readline(), process.stderr.read()
        wire = Wire(log, process)
        assert wire.until(lambda: wire.arm.newest and wire.hand.newest)
        yield wire
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
        assert (process.returncode, told) == (130, "interrupted\n")
    finally:
        process.kill()
        process.communicate()
