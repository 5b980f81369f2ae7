"""``tog hardware run`` against an emulated robot; prints, as JSON, what came of it.

python hardware_session.py lifted|ruled FOLDER
"""

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
from command import tog
from emulated_robot import emulated_robot

from tog_drake.hardware import connection, episode
from tog_drake.hardware.real_time import RealTime
from tog_drake.panda import V_MAX
from tog_drake.resources import resource_dir
from tog_drake.safety import PERIOD, SafetyConfig
from tog_drake.scenario import load_scenario
from tog_drake.stations.lcm_bus import (
    PANDA_COMMAND,
    PANDA_STATUS,
    RobotMode,
    arm_command_message,
    arm_status_message,
    make_lcm,
)

TASK = "hand me the hammer"
SEED = 0
GRIP_FORCE = 55.0  # [N] the most that safety allows; the scenario asks for more
# A busy computer makes everything late. What is judged here is where the arm goes, not when.
PATIENT = """{
  hardware: {safety: {status_age: 10.0, image_age: 60.0, stall: 2.0, tracking_error: 0.5}},
  pipeline: {
    executor: {look_time: 0.2, max_tracking_error: 0.5},
    trajectory: {settle_time: 1.0, hold_time: 0.5}
  }
}"""


def run_options(folder, *options):
    common = ("--task", TASK, "--seed", str(SEED), "--no-meshcat", "--json")
    return ("hardware", "run", *common, "--out", str(folder), *options)


def hardware_run(folder, *options):
    """Runs the command; returns its exit status, its record, and what it wrote on stderr."""
    done = tog(*run_options(folder, *options))
    record = json.loads(done.out.splitlines()[-1]) if done.out.strip() else None
    return {"status": done.status, "record": record, "err": done.err[-2000:]}


def begun_run(folder, *options):
    """Begins the command in a process of its own."""
    command = [sys.executable, "-m", "tog_drake.cli", *run_options(folder, *options)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def sent(wire):
    """How many messages came on the command channels."""
    return len(wire.logged("command")) + len(wire.logged("hand_command"))


def commanded(wire, before=0):
    """How the commands that arrived leap, against what the joints may do, and where they begin.

    Those ``before`` are of an earlier run.
    """
    commands = wire.logged("command")[before:]
    q, t = (np.array([c[k] for c in commands], dtype=float) for k in ("q", "utime"))
    measured = [m for m in wire.logged("measured") if m["time"] <= commands[0]["time"]][-1]
    dt = np.maximum(np.diff(t) / 1e6, PERIOD)[:, None]
    v = np.vstack([np.zeros(7), np.diff(q, axis=0) / dt])
    return {
        "commands": len(commands),
        "first": float(np.abs(q[0] - measured["q"]).max()),
        "fastest": float((np.abs(v) / V_MAX).max()),
        "discontinuity": float((np.abs(np.diff(v, axis=0)) / V_MAX).max()),
        "refused": [
            v["verdict"]
            for v in wire.logged("verdict")
            if v["verdict"] != "expired" and v["time"] >= commands[0]["time"]
        ],
    }


def stillness(wire, seconds):
    """How far the arm moves [rad] in that time, and how many commands come."""
    wire.listen(0.5)  # nobody has, while the command ran
    # The world of a busy computer lags behind: it still moves to where it was told last.
    wire.until(lambda: np.abs(wire.arm.newest.v).max() < 0.002, seconds=10)
    before, q = sent(wire), wire.arm.newest.q
    wire.listen(seconds)
    return float(np.abs(wire.arm.newest.q - q).max()), sent(wire) - before


def program():
    """The program in diagrams, as a user runs it who does not say yes."""
    source = (resource_dir("diagrams") / "hardware.py").read_text()
    patient = source.replace('"panda_lcm")', f'"panda_lcm", {PATIENT!r})')
    assert patient != source
    done = subprocess.run(
        [sys.executable, "-c", patient, TASK],
        input="n\n",
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return {"status": done.returncode, "out": done.stdout, "err": done.stderr[-2000:]}


def lifted(folder):
    with emulated_robot(folder, "--seed", str(SEED), "--scenario-text", PATIENT) as wire:
        gentle = PATIENT.replace("safety: {", f"safety: {{grip_force: {GRIP_FORCE}, ")
        told = {"dry": hardware_run(folder / "dry", "--dry-run", "--scenario-text", PATIENT)}
        told["dry_sent"] = sent(wire)
        told["program"] = program()
        told["program_sent"] = sent(wire)
        options = ("--yes", "--speed", "0.5", "--scenario-text", gentle)
        told["run"] = hardware_run(folder / "run", *options)
        if told["run"]["status"] != 0:
            return told
        told["commanded"] = commanded(wire)
        told["hand"] = [
            (c["verdict"], c["force"])
            for c in wire.logged("hand_command")
            if c["verdict"] != "ignored"
        ]
        told["folder"] = str(folder / "run")
        told["files"] = sorted(path.name for path in (folder / "run").iterdir())
    return told


# Rule of safety, and the setting under which the planned motion would break it. That of jerk cannot
# be the first: whoever breaks it from rest breaks that of acceleration in the same period.
REFUSED = {
    "workspace": {"workspace_upper": [0.85, 0.5, 0.3]},
    "hand_speed": {"hand_speed": 0.05},
    "velocity": {"velocity": 0.05},
    "position": {"position_margin": 0.45},
    "acceleration": {"acceleration": 0.05, "velocity": 0.05},
}


def ruled(folder):
    """What each rule keeps the arm from, and how it stands afterwards."""
    told = {}
    with emulated_robot(
        *(folder, "--seed", str(SEED), "--scenario-text", PATIENT, "--rate", "100"),
        *("--fault", "push:PANDA_STATUS:0.3:2:40"),  # while it moves for the first time
        *("--recover-after", "1"),
    ) as wire:
        for rule, settings in REFUSED.items():
            told[rule] = {**in_this_process(**settings), "sent": sent(wire)}
        told["start"] = {
            **in_this_process(ask=moved_by_hand(wire.arm.newest.q)),
            "sent": sent(wire),
        }
        told["no_image"] = {**in_this_process(channel="NOBODY"), "sent": sent(wire)}
        with somebody_else(wire):
            told["foreign_command"] = in_this_process()
        wire.listen(0.5)
        for rule, settings in (
            ("external_torque", {}),
            ("tracking", {"tracking_error": 0.002}),
            ("stalled", {"stall": 0.3, "loop": Stalling}),
            ("operator", {"loop": Clicked}),
            ("terminated", {"loop": Terminated}),
            ("deadline", {"loop": Hurried}),
            ("stale_status", {"loop": hung(wire.process), "status_age": 0.4}),
            ("robot_mode", {"loop": Jumping}),
        ):
            told[rule] = {**in_this_process(**settings), "still": stillness(wire, 0.5)}
            assert wire.until(lambda: let_go(wire.arm.newest))  # what pushed the arm may still do
        assert wire.until(lambda: wire.arm.newest.robot_mode == RobotMode.MOVE)
        told["interrupted"] = interrupted(wire, folder)
    return told


def let_go(status):
    return (np.abs(status.torque_external) < SafetyConfig().external_torque).all()


def interrupted(wire, folder):
    """What comes of Ctrl-C while the arm moves."""
    before = len(wire.logged("command"))
    with begun_run(folder / "run", "--yes", "--scenario-text", PATIENT) as process:
        home = wire.arm.newest.q
        wire.until(
            lambda: np.abs(wire.arm.newest.q - home).max() > 0.05 or process.poll() is not None,
            seconds=300,
        )
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    return {
        "status": process.returncode,
        "record": json.loads(out.splitlines()[-1]) if out.strip() else None,
        "err": err[-2000:],
        "commanded": commanded(wire, before),
        "still": stillness(wire, 1.0),
    }


def yes(*_):
    return True


def in_this_process(*, channel="TOG_WRIST", loop=RealTime, ask=yes, **settings):
    """Runs one episode with these settings of safety; returns outcome and rule."""
    scenario = load_scenario("panda_lcm", PATIENT, seed=SEED)
    for name, value in settings.items():
        setattr(scenario.hardware.safety, name, value)
    scenario.hardware.cameras["wrist"].channel = channel
    scenario.hardware.speed = 0.5
    patience = 2.0 if channel == "NOBODY" else 20.0
    with (
        mock.patch.multiple(connection, PATIENCE=patience),
        mock.patch.object(episode, "RealTime", loop),
    ):
        found = episode.run_hardware_episode(scenario, name="panda_lcm", task=TASK, ask=ask).record
    return {"outcome": found["outcome"], "rule": found["hardware"]["rule"]}


class Moving(RealTime):
    """A loop to which something happens, once, when the arm has begun to move."""

    ticks = 0

    def listen(self, *, cameras=True):
        self.ticks += not cameras
        if self.ticks == 60:
            self.happens()
        super().listen(cameras=cameras)


class Stalling(Moving):
    """Is kept from working for half a second."""

    def happens(self):
        time.sleep(0.5)


class Terminated(Moving):
    """Gets SIGTERM."""

    def happens(self):
        os.kill(os.getpid(), signal.SIGTERM)


class Jumping(Moving):
    """Sends a command that no arm can follow: its controller stops it."""

    def happens(self):
        bus = self._robot.bus
        bus.command_arm(bus.arm.newest.q + 1.0)


class Clicked(RealTime):
    """Has a STOP button that somebody clicks on while the arm moves."""

    def __init__(self, simulator, robot, meshcat=None):
        button = mock.Mock()
        button.GetButtonClicks.side_effect = itertools.chain([0] * 60, itertools.repeat(1))
        super().__init__(simulator, robot, button)


class Hurried(RealTime):
    """Gives a motion too little time."""

    def move(self, ended, longest):
        super().move(ended, longest=0.4)


def hung(driver):
    """A loop while whose arm moves the driver hangs."""

    class Hung(Moving):
        def happens(self):
            driver.send_signal(signal.SIGSTOP)

        def move(self, ended, longest):
            super().move(ended, longest)
            driver.send_signal(signal.SIGCONT)

    return Hung


@contextmanager
def meanwhile(act, period):
    """Does something again and again."""
    over = threading.Event()

    def repeat():
        lcm = make_lcm()
        while not over.wait(period):
            act(lcm)

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def somebody_else(wire):
    """Another program commands the arm to stay where it is."""
    q = wire.arm.newest.q
    return meanwhile(
        lambda lcm: lcm.Publish(PANDA_COMMAND, arm_command_message(q, int(1e6 * time.time()))),
        period=0.02,
    )


def moved_by_hand(q):
    """Who is asked says yes, but by then the arm is no more where it was, ``q``."""
    status = partial(arm_status_message, q + 0.05, np.zeros(7), np.zeros(7), RobotMode.MOVE)

    def ask(decision, listen):
        with meanwhile(
            # What the emulated robot says is older than this, and does not count.
            lambda lcm: lcm.Publish(PANDA_STATUS, status(int(1e6 * (time.time() + 0.9)))),
            period=0.02,
        ):
            for _ in range(30):
                listen()
                time.sleep(0.01)
        return True

    return ask


if __name__ == "__main__":
    begun = time.monotonic()
    told = {"lifted": lifted, "ruled": ruled}[sys.argv[1]](Path(sys.argv[2]))
    print(json.dumps({**told, "seconds": time.monotonic() - begun}))
