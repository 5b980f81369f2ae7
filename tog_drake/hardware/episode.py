"""One episode on a real robot: connect, look, decide standing still, ask, move, judge, record."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, field

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from tog_drake.decision import Decision, decide
from tog_drake.episode import Episode, draw, sketch_of_decision
from tog_drake.errors import EpisodeError, Stopped
from tog_drake.executor import ExecutorState, Phase
from tog_drake.hardware.config import hardware_of
from tog_drake.hardware.connection import Robot, connect
from tog_drake.hardware.real_time import RealTime
from tog_drake.record import HardwareRecord, new_record
from tog_drake.recording import Recorder, Recording
from tog_drake.safety import StopReason, check_motion
from tog_drake.scenario import Scenario
from tog_drake.stations.guard import GuardState
from tog_drake.visualization import replay_html

CLOSED = 0.001  # [m] that the fingers close at least, or they did not close at all
LOST = 0.003  # [m] that the fingers close further during the lift: what they held is gone

Ask = Callable[[Decision, Callable[[], None]], bool]
"""Shown a decision, says whether to move; calls the function again and again while it waits."""


def run_hardware_episode(
    scenario: Scenario,
    *,
    name: str,
    task: str,
    ask: Ask,
    dry_run: bool = False,
    meshcat: Meshcat | None = None,
) -> Episode:
    """Runs one episode on a real robot.

    Args:
        scenario: with a section ``hardware``.
        name: of the scenario, for the record.
        task: what a person said.
        ask: whether to carry a decision out.
        dry_run: sends no message, and asks nobody.
        meshcat: where to draw, if anywhere.

    Raises:
        InputError: the scenario or the task cannot be used, or a driver does not speak.
    """
    course = _Course()
    with ExitStack() as closing:
        try:
            robot = connect(scenario, silent=dry_run, meshcat=meshcat)
            closing.callback(robot.close)
            _run(robot, scenario, task, ask, dry_run, meshcat, course)
        except EpisodeError as error:
            course.decision.error = error
    record = new_record(course.decision, scenario.pipeline, task=task, seed=scenario.random_seed)
    record["scenario"] = name
    record["hardware"] = course.record(hardware_of(scenario).speed)
    if course.outcome is not None:
        record["outcome"], record["message"] = course.outcome
    if course.moved is not None:
        record["seconds"]["execute"] = course.moved
        record["attempts"][-1]["opening"] = course.opening_after
        record["grasp_success"] = record["outcome"] == "lifted"
    return Episode(record, course.decision, course.replay, recording=course.recording)


@dataclass
class _Course:
    """What happened."""

    decision: Decision = field(default_factory=Decision)
    outcome: tuple[str, str | None] | None = None  # and the message; None: as the decision says
    moved: float | None = None  # [s] of wall time; None: it did not
    rule: StopReason | None = None
    opening_open: float | None = None  # [m] when the fingers were told to close
    opening_closed: float | None = None  # [m] when the lift began
    opening_after: float | None = None  # [m] after the hold
    force: float | None = None  # [N] where the driver reports one
    late: float | None = None  # [s] see RealTime
    replay: str | None = None
    recording: Recording | None = None

    def record(self, speed: float) -> HardwareRecord:
        error = self.decision.error
        rule = error.rule if isinstance(error, Stopped) else self.rule
        return HardwareRecord(
            speed=speed,
            rule=None if rule is None else rule.value,
            opening_closed=self.opening_closed,
            opening_after=self.opening_after,
            force=self.force,
            late=self.late,
        )


def _run(
    robot: Robot,
    scenario: Scenario,
    task: str,
    ask: Ask,
    dry_run: bool,
    meshcat: Meshcat | None,
    course: _Course,
) -> None:
    """Looks, decides, asks and moves; enters in ``course`` what happened."""
    config = hardware_of(scenario)
    simulator = Simulator(robot.diagram)
    context = simulator.get_mutable_context()
    robot.diagram.GetInputPort("task").FixValue(context, task)
    simulator.Initialize()
    loop = RealTime(simulator, robot, meshcat)
    if meshcat is not None:
        meshcat.StartRecording()
    loop.stand(robot.pipeline.executor.look_time)
    robot.require_images()
    decision = course.decision = decide(robot.pipeline, context)
    looked = loop.time
    if meshcat is not None:
        draw(meshcat, decision, robot.planning_model.X_WL0)
    if decision.error is not None:
        return
    assert decision.motion is not None
    loop.catch_up()
    status = robot.bus.arm.newest
    assert status is not None
    motion = decision.motion.slowed(config.speed)
    check_motion(motion, status.q, config.safety)
    if dry_run or not ask(decision, loop.listen):
        course.outcome = "chosen", "a dry run" if dry_run else "the operator did not say yes"
        return
    recorder = Recorder(robot.station, known_world(scenario))
    try:
        _move(robot, loop, simulator, motion.duration, course, recorder)
    finally:
        sketch = sketch_of_decision(decision, robot.planning_model.X_WL0)
        course.recording = recorder.recording(sketch, decided=looked)
    if meshcat is not None:
        course.replay = _replay(robot, simulator, meshcat, looked)


def known_world(scenario: Scenario) -> Scenario:
    """Returns the scenario with what the robot knows of its world alone: no object is in it."""
    known = deepcopy(scenario)
    known.directives, known.asset = known.planning_directives, None
    return known


def _move(
    robot: Robot,
    loop: RealTime,
    simulator: Simulator,
    duration: float,
    course: _Course,
    recorder: Recorder,
) -> None:
    """Carries out what was decided, and judges how it ended."""
    context = simulator.get_context()

    def ended() -> bool:
        recorder.observe(robot.station.GetMyContextFromRoot(context))
        state, hand = robot.state(context), robot.bus.hand.newest
        if state.phase is Phase.MOVE and state.motion is not None and hand is not None:
            played, begin = loop.time - state.start_time, state.motion.phase_times
            if played >= begin["close"] and course.opening_open is None:
                course.opening_open = hand.opening
            if played >= begin["lift"] and course.opening_closed is None:
                course.opening_closed = hand.opening
        return state.phase in (Phase.DONE, Phase.FAILED)

    started = time.monotonic()
    loop.move(ended, longest=3 * duration + 10.0)
    course.moved, course.late = time.monotonic() - started, loop.late
    hand, state, guarded = robot.bus.hand.newest, robot.state(context), robot.guarded(context)
    course.force = hand.force if hand is not None and hand.force > 0 else None
    course.rule = guarded.broken[0] if guarded.broken else None
    course.opening_after = state.opening_after
    empty = robot.pipeline.executor.empty_opening
    openings = course.opening_open, course.opening_closed
    course.outcome = judge(guarded, state, openings, empty)


def judge(
    guarded: GuardState,
    state: ExecutorState,
    openings: tuple[float | None, float | None],
    empty: float,
) -> tuple[str, str | None]:
    """Returns outcome and message of a motion, by the width of the hand alone.

    Args:
        guarded: what the guard did.
        state: how the executor ended.
        openings: [m] between the pads when they were told to close, and when the lift began.
        empty: [m] a hand that is closed further holds nothing.
    """
    if guarded.broken is not None:
        rule, how = guarded.broken
        return "stopped", f"{how} (safety rule {rule.value}); nothing moves before it is run again"
    if state.phase is Phase.FAILED:
        return "collision", "the arm no longer followed its command and was stopped"
    (opened, closed), after = openings, state.opening_after
    if closed is None or after is None or closed < empty:
        return "empty", "the fingers closed on nothing"
    if opened is None or opened - closed < CLOSED:
        return "empty", "the fingers did not close: see the hand's driver"
    if after < empty or closed - after > LOST:
        return "dropped", (
            f"the fingers, {1e3 * closed:.1f} mm apart when the lift began, were "
            f"{1e3 * after:.1f} mm apart after it"
        )
    return "lifted", None


def _replay(robot: Robot, simulator: Simulator, meshcat: Meshcat, looked: float) -> str:
    context = simulator.get_context()
    robot.diagram.ForcedPublish(context)  # every track ends at the same time
    return replay_html(meshcat, duration=context.get_time(), decided=looked)
