"""Drives an emulated robot over LCM and prints, as JSON, what came of it.

python emulator_session.py driven|faulty FOLDER

``gap`` is how long this or the emulator was kept from working at most; where that is long, what
was seen says nothing, or nothing was seen at all.
"""

import json
import sys
import time
import traceback
from pathlib import Path

import numpy as np
from drake import lcmt_panda_status
from emulated_robot import emulated_robot

from tog_drake.scenario import load_scenario
from tog_drake.stations.lcm_bus import PANDA_STATUS, RobotMode
from tog_drake.stations.simulation import SimulationStation

SEED = 3
LASTS, EVERY = 1.5, 3.0  # [s] a fault, and from the begin of one to the next's
# What is seen in this time from the begin of a fault, and from its end, is judged by when it was
# sent: whatever stands still for as long does not mistake one for the other.
SEEN = 0.7  # [s]
FAULTS = {
    "drop": "drop:PANDA_STATUS",
    "nan": "nan:PANDA_STATUS",
    "push": "push:PANDA_STATUS:40",
    "restart": "restart:PANDA_STATUS",
    "reflex": "reflex:PANDA_STATUS",
    "lost": "drop:PANDA_COMMAND",
    "late": "delay:PANDA_COMMAND:0.5",
}
PATIENT = "{hardware: {safety: {stall: 4.0}}}"  # a step is taken to be made in up to 0.8 s


def driven(folder):
    with emulated_robot(folder, "--seed", str(SEED), "--scenario-text", PATIENT) as wire:
        told = {"images": images(wire)}
        before = wire.arm.received, len(wire.logged("measured"))
        wire.listen(2.0)
        told["statuses"] = wire.arm.received - before[0]
        told["ticks"] = len(wire.logged("measured")) - before[1]

        wire.command(wire.arm.newest.q + 1.0, late=0.3)
        assert wire.until(lambda: wire.logged("verdict"))
        told["expired"] = [v["verdict"] for v in wire.logged("verdict")]
        told["mode_after_expired"] = wire.arm.newest.robot_mode

        q = wire.stream(joint=0, speed=0.2, seconds=1.0)
        wire.until(lambda: np.abs(wire.arm.newest.q - q).max() < 0.01)
        told["followed_to"] = float(np.abs(wire.arm.newest.q - q).max())

        told["hand"] = hand(wire)

        wire.command(q + np.array([1.5, 0, 0, 0, 0, 0, 0]))
        told["reflex"] = wire.until(lambda: wire.arm.newest.robot_mode == RobotMode.REFLEX)
        wire.listen(0.5)
        stood = wire.arm.newest.q
        told["still_at"] = float(np.abs(stood - q).max())
        wire.stream(joint=0, speed=0.2, seconds=0.3)
        wire.listen(0.5)
        told["moved_after_reflex"] = float(np.abs(wire.arm.newest.q - stood).max())
        told["mode_at_the_end"] = wire.arm.newest.robot_mode
    return told


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
    options = []
    for number, text in enumerate(FAULTS.values()):
        kind, channel, *amount = text.split(":")
        times = f"+{1 + EVERY * number}", str(LASTS)
        options += ["--fault", ":".join([kind, channel, *times, *amount])]
    with emulated_robot(folder, "--scenario-text", PATIENT, *options) as wire:
        statuses, stood = watched(wire, 1 + EVERY * len(FAULTS))
        begins = [line["time"] for line in wire.logged("fault")]
        assert len(begins) == len(FAULTS)
        told = {
            name: during(wire, statuses, begin) for name, begin in zip(FAULTS, begins, strict=True)
        }
        told["stood"] = stood
        told["mode"] = wire.arm.newest.robot_mode
    return told


def watched(wire, seconds):
    """Tells the arm to stay where it is, for so long.

    Returns:
        Of every status when it was sent, its mode, the torque at the elbow and whether the
        positions are numbers; and how long nobody listened at most [s].
    """
    statuses, last, stood = [], time.time(), 0.0
    wire.lcm.Subscribe(PANDA_STATUS, lambda data: statuses.append(told_by(data)))
    end, q = last + seconds, wire.arm.newest.q
    while time.time() < end:
        wire.command(q)
        wire.listen(0.02)
        now = time.time()
        stood, last = max(stood, now - last), now
    return statuses, stood


def told_by(data):
    message = lcmt_panda_status.decode(data)
    finite = bool(np.isfinite(message.joint_position).all())
    return message.utime / 1e6, message.robot_mode, -message.joint_torque_external[3], finite


def during(wire, statuses, begin):
    """What is seen from the begin of a fault, and after its end."""

    def sent(since, until):
        return [values for at, *values in statuses if begin + since < at < begin + until]

    def logged(event, since=0.0):
        return [e for e in wire.logged(event) if begin + since < e["time"] < begin + SEEN]

    there, after = sent(0.0, SEEN), sent(LASTS + 0.05, LASTS + 0.05 + SEEN)
    return {
        "messages": len(there),
        "modes": sorted({mode for mode, _, _ in there}),
        "torque": float(np.median([torque for _, torque, _ in there] or [np.nan])),
        "numbers": sorted({finite for _, _, finite in there}),
        "commands": len(logged("command")),
        "verdicts": sorted({e["verdict"] for e in logged("verdict", since=0.1)}),
        "after": [sorted({mode for mode, _, _ in after}), sorted({ok for _, _, ok in after})],
    }


def longest_gap(log):
    """How long the emulator was kept from working at most [s]; its period is 0.005."""
    lines = map(json.loads, log.read_text().splitlines())
    return float(np.diff([line["time"] for line in lines if line["event"] == "measured"]).max())


def main():
    folder = Path(sys.argv[2])
    try:
        told = {"driven": driven, "faulty": faulty}[sys.argv[1]](folder)
    except AssertionError:
        told = {"error": traceback.format_exc()}
    told["gap"] = max(longest_gap(folder / "robot.jsonl"), told.get("stood", 0.0))
    sys.stdout.write(json.dumps(told))


if __name__ == "__main__":
    main()
