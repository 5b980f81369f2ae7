"""``tog hardware emulate``, ``tog hardware run`` and what befalls them; prints what came of it.

python hardware_pair.py ORDER FOLDER, an order being JSON: ``task``, ``text`` (of the scenario),
``options`` (of the run), ``fault`` (of the emulator, or null), ``act`` (null, "foreign" for
somebody else who commands the arm to stay, or a signal for the run), and ``start``, when that
happens [s] after the arm has begun to move (null: from the beginning).
"""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from tog_drake.stations.lcm_bus import (
    PANDA_COMMAND,
    PANDA_STATUS,
    Inbox,
    arm_command_message,
    make_lcm,
    read_arm_status,
)

DEADLINE = 150.0  # [s] for a whole run, the start of its process with it
STANDING = 2.5  # [s] after the end in which nothing may move or be sent


def pair(order: dict, folder: Path) -> dict:
    """Runs in a network of its own: the emulator, then the program, then what befalls it."""
    tog = [sys.executable, "-m", "tog_drake.cli", "hardware"]
    common = ["--scenario-text", json.dumps(order["text"])]
    fault = ["--fault", order["fault"]] if order["fault"] else []
    with (
        (folder / "emulator.txt").open("w") as errors,
        subprocess.Popen(
            [*tog, "emulate", "--log", folder / "robot.jsonl", *common, *fault],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as emulator,
    ):
        try:
            assert "an emulated robot" in emulator.stdout.readline()
            command = [*tog, "run", "--task", order["task"], "--out", folder, "--no-meshcat"]
            told = run_against([*command, "--json", *common, *order["options"]], order)
            time.sleep(STANDING)
            emulator.send_signal(signal.SIGINT)
            emulator.wait(30)
        finally:
            emulator.kill()
    return told


def run_against(command: list, order: dict) -> dict:
    foreign = list[int]()
    end = time.monotonic() + DEADLINE
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        if order["act"] == "foreign":
            foreign = command_too(program, order["start"], end)
        elif order["act"] and wait_for_motion(program, order["start"], end):
            program.send_signal(signal.Signals[order["act"]])
        hung = False
        try:
            out, err = program.communicate(timeout=max(1.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            hung = True
            program.kill()
            out, err = program.communicate()
    record = json.loads(out.splitlines()[-1]) if out.strip() else None
    return {
        "status": program.returncode,
        "record": record,
        "err": err,
        "hung": hung,
        "ended": time.time(),
        "foreign": foreign,
    }


def wait_for_motion(program: subprocess.Popen, start: float, end: float) -> bool:
    """Waits until ``start`` s after the arm began to move; whether the program still runs."""
    lcm = make_lcm()
    arm = Inbox(lcm, PANDA_STATUS, read_arm_status)
    home, moved = None, None
    while program.poll() is None and time.monotonic() < end:
        lcm.HandleSubscriptions(50)
        if arm.newest is None:
            continue
        home = arm.newest.q if home is None else home
        if moved is None and np.abs(arm.newest.q - home).max() > 1e-3:
            moved = time.monotonic()
        if moved is not None and time.monotonic() >= moved + start:
            return True
    return False


def command_too(program: subprocess.Popen, start: float | None, end: float) -> list[int]:
    """Commands the arm to stay where it is, as long as the program runs; returns the stamps."""
    if start is not None and not wait_for_motion(program, start, end):
        return []
    lcm = make_lcm()
    arm, stamps = Inbox(lcm, PANDA_STATUS, read_arm_status), list[int]()
    while program.poll() is None and time.monotonic() < end:
        lcm.HandleSubscriptions(5)
        if arm.newest is not None:
            stamps.append(round(1e6 * time.time()))
            lcm.Publish(PANDA_COMMAND, arm_command_message(arm.newest.q, stamps[-1]))
            time.sleep(0.005)
    return stamps


if __name__ == "__main__":
    print(json.dumps(pair(json.loads(sys.argv[1]), Path(sys.argv[2]))))
