"""Whether the real-robot part is safe, measured on the emulated robot's side of the wire.

    python tests/benchmarks/bench_hardware.py runs [N]
    python tests/benchmarks/bench_hardware.py faults [SEEDS [N]]
    python tests/benchmarks/bench_hardware.py wire-runs [N]
    python tests/benchmarks/bench_hardware.py wire-faults [SEEDS [N]]

``runs``: N episodes, each with another pose of the object, look posture, speed and task.
``faults``: the first N of the injections below, each with the seeds 0 to SEEDS - 1. Both run in
memory, robot and program, on a clock of their own (``robot_in_memory``). With ``wire-`` before
them, ``tog hardware emulate`` and ``tog hardware run`` are two processes over LCM in a network of
their own, a pair after another, in real time. Exit status 1: something was outside the limits,
hung, ended without a type, or went on where it had to stop.
"""

import json
import logging
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from own_network import in_own_network
from robot_in_memory import HungError, RobotInMemory
from wire_judging import Judged, judge_wire, read_log

from tog_drake.hardware.faults import parse_fault
from tog_drake.scenario import LOOK_POSTURE, load_scenario

TASKS = ("hand me the hammer", "hammer in the nail")
PERTURBED = 0.05  # [rad] each joint of the look posture, at most
SLOWEST = 0.05
FAULTS_SPEED = 0.8
SHORT = {
    "hardware": {"speed": FAULTS_SPEED},
    "pipeline": {"trajectory": {"settle_time": 1.0, "hold_time": 0.5}},
}
# A computer that is busy with two processes is late by more than a lab's; how fast an arm may move
# and how it stops is not forgiven anything.
BUSY = {
    "hardware": {
        "safety": {"status_age": 0.5, "image_age": 10.0, "stall": 0.5, "tracking_error": 0.3}
    },
    "pipeline": {"executor": {"max_tracking_error": 0.4}},
}


@dataclass(frozen=True)
class Injection:
    """What goes wrong, when, and how an episode may end by it."""

    what: str  # a fault without its start, what somebody does, or a signal
    moment: str  # "start" of the emulator, or a phase of the motion
    ends: str  # rules, outcomes, or "refused" with status 2

    def fault(self, phases: dict[str, float]) -> str | None:
        """As ``--fault`` wants it; None: it is no fault of the emulator's."""
        if ":" not in self.what:
            return None
        kind, channel, *rest = self.what.split(":")
        start = "+0" if self.moment == "start" else f"{self.start(phases):.2f}"
        return ":".join((kind, channel, start, *rest))

    def start(self, phases: dict[str, float]) -> float:
        """[s] since the arm has begun to move."""
        return {"move": 0.5, "close": phases["close"] + 0.1, "lift": phases["lift"] + 0.3}[
            self.moment
        ]


_ANY_STOP = "robot_mode tracking stale_status"
INJECTIONS = (
    # Each kind once ...
    Injection("drop:PANDA_STATUS:1.5", "move", "stale_status"),
    Injection("delay:PANDA_STATUS:1.5:0.8", "move", "stale_status"),
    Injection("freeze:PANDA_STATUS:inf", "move", "tracking"),
    Injection("reorder:PANDA_STATUS:3", "move", "lifted"),
    Injection("duplicate:PANDA_STATUS:3:5", "move", "lifted"),
    Injection("nan:PANDA_STATUS:1.5", "lift", "stale_status"),
    Injection("push:PANDA_STATUS:1", "move", "external_torque"),
    Injection("reflex:PANDA_STATUS:inf", "move", "robot_mode"),
    Injection("restart:PANDA_STATUS:1.5", "move", "stale_status robot_mode"),
    Injection("SIGINT", "move", "operator"),
    Injection("foreign", "move", "foreign_command robot_mode"),
    Injection("drop:PANDA_COMMAND:1.5", "move", _ANY_STOP),
    Injection("drop:PANDA_HAND_COMMAND:inf", "start", "empty dropped"),
    Injection("drop:TOG_WRIST:inf", "start", "no_image"),
    Injection("drop:PANDA_HAND_STATUS:inf", "move", "stale_status"),
    # ... and other channels and moments.
    Injection("delay:PANDA_COMMAND:1.5:0.3", "move", _ANY_STOP),
    Injection("freeze:PANDA_COMMAND:0.3", "move", _ANY_STOP),
    Injection("reorder:PANDA_COMMAND:1", "move", "robot_mode"),
    Injection("duplicate:PANDA_COMMAND:2:3", "move", "lifted robot_mode"),
    Injection("nan:PANDA_COMMAND:0.2", "lift", "robot_mode stale_status"),
    Injection("nan:PANDA_HAND_STATUS:inf", "close", "stale_status lifted empty dropped"),
    Injection("nan:TOG_WRIST:inf", "start", "refused no_image no_grasp no_view"),
    Injection("drop:TOG_WRIST:inf", "move", "lifted"),
    Injection("drop:PANDA_STATUS:1.5", "close", "stale_status"),
    Injection("push:PANDA_STATUS:1", "close", "external_torque"),
    Injection("reflex:PANDA_STATUS:inf", "start", "robot_mode"),
    Injection("drop:PANDA_STATUS:inf", "start", "refused"),
    Injection("foreign", "start", "foreign_command robot_mode"),
    Injection("SIGINT", "lift", "operator"),
    Injection("SIGTERM", "close", "operator"),
)


@dataclass
class Row:
    """A run, as the table shows it."""

    name: str
    end: str  # rule, else outcome, else "refused", "hung" or "untyped"
    judged: Judged

    def print(self) -> None:
        j = self.judged
        stop, settled = ("   -" if s is None else f"{s:4.2f}" for s in (j.stop, j.settled))
        print(
            f"{self.name:45} {self.end:16} {j.commands:6} {j.first:7.1e} {j.step:5.2f} "
            f"{j.change:6.3f} {j.acceleration:5.2f} {j.measured_speed:5.2f} {stop:>5} "
            f"{settled:>5}  {'; '.join(j.outside)}",
            flush=True,
        )


def print_head() -> None:
    print(
        f"{'':45} {'end':16} {'sent':>6} {'first':>7} {'step':>5} {'change':>6} {'acc':>5} "
        f"{'v':>5} {'stop':>5} {'still':>5}  outside\n"
        f"{'':45} {'':16} {'':>6} {'rad':>7} {'1':>5} {'1':>6} {'1':>5} {'1':>5} {'s':>5} {'s':>5}"
    )


def random_run(index: int) -> tuple[str, float, dict]:
    """Returns task, speed, and what differs in the scenario."""
    chance = np.random.default_rng(index)
    speed = {0: 1.0, 1: SLOWEST}.get(index % 25, float(chance.uniform(SLOWEST, 1.0)))
    q = np.array(LOOK_POSTURE) + chance.uniform(-PERTURBED, PERTURBED, 7)
    text = {
        "random_seed": index,
        "initial_position": {
            "panda": {f"panda_joint{i}": float(a) for i, a in enumerate(q, 1)},
            "hand": {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04},
        },
        "hardware": {"speed": speed},
        # Closing and standing still need not be slow.
        "pipeline": {"trajectory": {"settle_time": 1.0 * speed, "hold_time": 0.3 * speed}},
    }
    return TASKS[index % len(TASKS)], speed, text


def merged(first: dict, second: dict) -> dict:
    """Returns both, the second where they differ."""
    both = {**first, **second}
    for key in first.keys() & second.keys():
        if isinstance(first[key], dict):
            both[key] = merged(first[key], second[key])
    return both


def run_alone(
    name: str, task: str, text: dict, injection: Injection | None = None, phases=None
) -> Row:
    """Runs an episode in memory, with what befalls it."""
    scenario = load_scenario("panda_lcm", json.dumps(text))
    faults, act, start = (), None, None
    if injection is not None:
        fault = injection.fault(phases)
        faults = (parse_fault(fault, ["TOG_WRIST"]),) if fault else ()
        act = None if fault else injection.what
        start = None if injection.moment == "start" else injection.start(phases)
    robot = RobotInMemory(scenario, faults, act, start)
    try:
        record, ended = robot.run(task)
        end, problem = ending(record, refused=record is None), ""
    except HungError as error:
        record, ended, end, problem = None, robot.time(), "hung", str(error)
    except Exception as error:  # any: it is what is looked for
        record, ended, end, problem = None, robot.time(), "untyped", repr(error)
    row = judged_row(name, end, record, robot.log, ended, robot.foreign)
    row.judged.outside += [problem] if problem else []
    return row


def ending(record: dict | None, *, refused: bool) -> str:
    if record is None:
        return "refused" if refused else "untyped"
    return record["hardware"]["rule"] or record["outcome"]


def judged_row(name, end, record, log, ended, foreign, *, real_time=False) -> Row:
    """Judges a run; the guard's own stop is looked for where it stopped a motion."""
    rule = record and record["hardware"]["rule"]
    moved = record is not None and record["seconds"].get("execute") is not None
    stopped = bool(rule) and rule != "robot_mode" and moved
    judged = judge_wire(
        log, ended=ended, stopped=stopped, foreign=frozenset(foreign), real_time=real_time
    )
    return Row(name, end, judged)


def run_pair(folder: Path, name: str, order: dict) -> Row:
    """Runs an emulator and a program that commands it."""
    folder.mkdir(parents=True)
    done = in_own_network("hardware_pair.py", json.dumps(order), folder)
    if done.returncode != 0:
        raise RuntimeError(f"{name}: {done.stderr[-3000:]}")
    told = json.loads(done.stdout.splitlines()[-1])
    record = told["record"]
    end = "hung" if told["hung"] else ending(record, refused=told["status"] == 2)
    log = read_log(folder / "robot.jsonl")
    row = judged_row(name, end, record, log, told["ended"], told["foreign"], real_time=True)
    if end in ("hung", "untyped"):
        row.judged.outside.append(f"{end}: status {told['status']}: {told['err'][-300:]}")
    return row


def order_for(task: str, text: dict, *options: str, fault=None, act=None, start=None) -> dict:
    return {
        "task": task,
        "text": text,
        "options": options,
        "fault": fault,
        "act": act,
        "start": start,
    }


def verdict(rows: list[Row], unexpected: list[str]) -> int:
    """Prints the last lines; returns the exit status."""
    judged = [row.judged for row in rows]
    bad = [row for row in rows if row.judged.outside]
    stops = [j.stop for j in judged if j.stop is not None]
    print(
        f"largest: first {max(j.first for j in judged):.1e} rad, step "
        f"{max(j.step for j in judged):.3f}, change {max(j.change for j in judged):.3f}, "
        f"measured speed {max(j.measured_speed for j in judged):.3f}"
        + (f"; {len(stops)} stops, the longest {max(stops):.3f} s" if stops else "")
    )
    for line in unexpected:
        print(f"another end than meant: {line}")
    print(
        f"{len(rows)} runs, {len(rows) - len(bad)} inside all limits, {len(bad)} outside, "
        f"{len(unexpected)} with another end than meant: {'UNSAFE' if bad else 'safe'}"
    )
    return 1 if bad or not rows else 0


def main_runs(count: int, folder: Path | None) -> int:
    """In memory where there is no folder."""
    print_head()
    rows = []
    for index in range(count):
        task, speed, text = random_run(index)
        name = f"{index}: {speed:.2f} {task}"
        if folder is None:
            rows.append(run_alone(name, task, text))
        else:
            order = order_for(task, merged(BUSY, text), "--yes")
            rows.append(run_pair(folder / f"{index}", name, order))
        # A command may come too late on a busy computer; nothing else may be wrong with one.
        if refused := rows[-1].judged.refused.keys() - {"expired"}:
            rows[-1].judged.outside.append(f"the driver's verdict: {', '.join(sorted(refused))}")
        rows[-1].print()
    return verdict(rows, [])


def main_faults(seeds: int, count: int, folder: Path | None) -> int:
    """In memory where there is no folder."""
    print_head()
    rows, unexpected = [], []
    for seed in range(seeds):
        task, text = TASKS[seed % len(TASKS)], merged(SHORT, {"random_seed": seed})
        if folder is not None:
            text = merged(text, BUSY)
        phases = phases_of(task, text)
        for index, injection in enumerate(INJECTIONS[:count]):
            name = f"{seed}.{index} {injection.moment} {injection.what}"
            if folder is None:
                row = run_alone(name, task, text, injection, phases)
            else:
                row = run_order(folder / f"{seed}-{index}", name, task, text, injection, phases)
            if row.end not in injection.ends.split():
                unexpected.append(f"{name}: {row.end}, not {injection.ends}")
                if row.end == "lifted":
                    row.judged.outside.append("it went on as if nothing were wrong")
            rows.append(row)
            row.print()
    return verdict(rows, unexpected)


def phases_of(task: str, text: dict) -> dict[str, float]:
    """Returns when the phases of the motion begin [s], as it is played."""
    record, _ = RobotInMemory(load_scenario("panda_lcm", json.dumps(text))).run(task, dry_run=True)
    return {k: t / FAULTS_SPEED for k, t in record["motion"]["phases"].items()}


def run_order(folder, name, task, text, injection, phases) -> Row:
    fault = injection.fault(phases)
    order = order_for(
        *(task, text, "--yes"),
        fault=fault,
        act=None if fault else injection.what,
        start=None if injection.moment == "start" else injection.start(phases),
    )
    return run_pair(folder, name, order)


def main(what: str, *given: str) -> int:
    numbers = [int(number) for number in given]
    folder = None
    if what.startswith("wire"):
        folder = Path(tempfile.mkdtemp(prefix="hardware-"))
        print(folder)
    if what.endswith("runs"):
        return main_runs(*(numbers or [5 if folder else 50]), folder)
    seeds, count = [*numbers, *(3, len(INJECTIONS))[len(numbers) :]]
    return main_faults(seeds, count, folder)


if __name__ == "__main__":
    logging.getLogger("drake").setLevel(logging.WARNING)
    sys.exit(main(*sys.argv[1:]))
