"""Drives an emulated robot over LCM and prints, as JSON, what came of it.

python emulator_session.py driven|faulty FOLDER
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
from drake import lcmt_panda_status
from emulated_robot import emulated_robot

from tog_drake.scenario import load_scenario
from tog_drake.stations.lcm_bus import PANDA_STATUS, RobotMode, read_arm_status
from tog_drake.stations.simulation import SimulationStation

SEED = 3
# Each comes when the one before is over.
FAULTS = {
    "drop": "drop:PANDA_STATUS:+1:1",
    "nan": "nan:PANDA_STATUS:+3:1",
    "push": "push:PANDA_STATUS:+5:1:40",
    "restart": "restart:PANDA_STATUS:+7:1",
    "reflex": "reflex:PANDA_STATUS:+9:1",
    "lost": "drop:PANDA_COMMAND:+11:1",
    "late": "delay:PANDA_COMMAND:+13:1:0.5",
}


def driven(folder):
    with emulated_robot(folder, "--seed", str(SEED)) as wire:
        told = {"images": images(wire)}
        before = wire.arm.received, len(wire.logged("measured"))
        wire.listen(2.0)
        told["statuses"] = wire.arm.received - before[0]
        told["ticks"] = len(wire.logged("measured")) - before[1]

        wire.command(wire.arm.newest.q + 1.0, late=0.3)
        wire.listen(0.3)
        told["expired"] = [v["verdict"] for v in wire.logged("verdict")]
        told["mode_after_expired"] = wire.arm.newest.robot_mode

        q = wire.stream(joint=0, speed=0.2, seconds=1.0)
        wire.until(lambda: np.abs(wire.arm.newest.q - q).max() < 0.01)
        told["followed_to"] = float(np.abs(wire.arm.newest.q - q).max())

        told["hand"] = hand(wire)

        wire.command(q + 0.2)
        told["reflex"] = wire.until(lambda: wire.arm.newest.robot_mode == RobotMode.REFLEX)
        wire.listen(0.5)
        stood = wire.arm.newest.q
        told["still_at"] = float(np.abs(stood - q).max())
        wire.stream(joint=0, speed=0.2, seconds=0.3)
        wire.listen(0.5)
        told["moved_after_reflex"] = float(np.abs(wire.arm.newest.q - stood).max())
        told["mode_at_the_end"] = wire.arm.newest.robot_mode
        told["gap"] = longest_gap(wire)
    return told


def longest_gap(wire):
    """How long the emulator was kept from working at most [s]; its period is 0.005."""
    return float(np.diff([line["time"] for line in wire.logged("measured")]).max())


def images(wire):
    """Whether what comes is what the simulation sees, bit for bit."""
    assert wire.until(lambda: wire.camera.newest is not None)
    pair = wire.camera.newest
    (scene,) = [line for line in wire.logged("image") if round(1e6 * line["time"]) == pair.utime]
    station = SimulationStation(load_scenario("panda_lcm", seed=SEED))
    context = station.CreateDefaultContext()
    station.plant.SetPositions(station.plant.GetMyContextFromRoot(context), scene["positions"])
    rgb, depth = (
        station.GetOutputPort(f"wrist.{kind}_image").Eval(context).data for kind in ("rgb", "depth")
    )
    return {
        "shape": pair.rgb.shape,
        "rgb": bool(np.array_equal(pair.rgb, rgb[..., :3])),
        "depth": bool(np.array_equal(pair.depth, depth[..., 0])),
        "contrast": float(np.std(pair.rgb)),
    }


def hand(wire):
    wire.hand_to(0.0)
    assert wire.until(lambda: wire.hand.newest.opening < 0.07)
    moving = wire.hand.newest.rate
    wire.hand_to(0.0)
    assert wire.until(lambda: wire.hand.newest.rate == 0.0)
    closed = wire.hand.newest.opening
    wire.hand_to(0.08)
    assert wire.until(lambda: wire.hand.newest.opening > 0.079)
    verdicts = [line["verdict"] for line in wire.logged("hand_command")]
    return {"verdicts": verdicts, "moving": moving, "closed": closed}


def faulty(folder):
    options = [word for text in FAULTS.values() for word in ("--fault", text)]
    with emulated_robot(folder, *options) as wire:
        raw = []  # when each was sent, and the message: a busy computer brings it late
        wire.lcm.Subscribe(PANDA_STATUS, lambda data: raw.append((sent_at(data), data)))
        seen = {}
        for name in FAULTS:
            seen[name] = during(wire, raw, name)
        wire.listen(1.0)
        seen["after"] = wire.arm.newest.robot_mode
        seen["gap"] = longest_gap(wire)
    return seen


def sent_at(data):
    return lcmt_panda_status.decode(data).utime / 1e6


def during(wire, raw, name):
    """What is seen from a moment after a fault has begun until it is nearly over."""
    count = list(FAULTS).index(name) + 1
    assert wire.until(lambda: len(wire.logged("fault")) >= count)
    begin = wire.logged("fault")[-1]["time"]
    wire.listen(begin + 0.3 - time.time())
    before = wire.arm.newest.q
    modes, torques, refused = [], [], wire.arm.refused
    while time.time() < begin + 0.8:
        if name in ("lost", "late"):
            wire.command(before)
        wire.listen(0.02)
        modes.append(wire.arm.newest.robot_mode)
        torques.append(wire.arm.newest.torque_external[3])
    assert wire.until(lambda: raw[-1][0] > begin + 1.4)
    after = [read_arm_status(data).robot_mode for at, data in raw if at > begin + 1.3]
    return {
        "messages": len([at for at, _ in raw if begin + 0.3 < at < begin + 0.8]),
        "refused": wire.arm.refused - refused,
        "modes": sorted(set(modes)),
        "torque": float(np.median(torques)),
        "verdicts": [v["verdict"] for v in wire.logged("verdict") if v["time"] > begin],
        "commands": len([c for c in wire.logged("command") if c["time"] > begin]),
        "after": [len(after), sorted(set(after))],
    }


if __name__ == "__main__":
    sys.stdout.write(
        json.dumps({"driven": driven, "faulty": faulty}[sys.argv[1]](Path(sys.argv[2])))
    )
