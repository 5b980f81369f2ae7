"""One episode on a real robot: connect, look, decide standing still, ask, move, judge, record."""

import gc
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace

from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from tog_drake.decision import Decision, decide
from tog_drake.episode import Episode
from tog_drake.errors import EpisodeError, InputError, NoImage, Stopped
from tog_drake.executor import ExecutorState, Phase
from tog_drake.hardware.config import hardware_of
from tog_drake.hardware.real_time import STOP_BUTTON, RealTime
from tog_drake.look_planning import Once
from tog_drake.pipeline import GraspPipeline, connect_to_station, used_cameras
from tog_drake.planning_model import MakePlanningModel, PlanningModel
from tog_drake.record import HardwareRecord, new_record
from tog_drake.safety import PERIOD, SafetyConfig, StopReason, check_motion, limits_of
from tog_drake.scenario import Scenario, robot_directive
from tog_drake.stations.camera_feed import Feed
from tog_drake.stations.guard import GuardState, mode_name
from tog_drake.stations.hardware import HardwareStation, open_cameras
from tog_drake.stations.lcm_bus import RobotMode, make_lcm
from tog_drake.stations.panda_lcm import PandaBus
from tog_drake.visualization import draw_decision, replay_html

PATIENCE = 10.0  # [s] for whom to speak that is connected to
LOST = 0.003  # [m] that the fingers close further during the lift: what they held is gone

Ask = Callable[[Decision, Callable[[], None]], bool]
"""Shown a decision, says whether to move; calls the function again and again while it waits."""


@dataclass(frozen=True)
class Robot:
    """A connected robot, its station and the pipeline, in one Diagram."""

    diagram: Diagram
    station: HardwareStation
    pipeline: GraspPipeline
    planning_model: PlanningModel
    bus: PandaBus
    lcm: DrakeLcm
    camera_lcm: DrakeLcm
    feeds: dict[str, Feed]

    def close(self) -> None:
        for feed in self.feeds.values():
            feed.close()


def connect(scenario: Scenario, *, silent: bool = False, meshcat: Meshcat | None = None) -> Robot:
    """Connects to the drivers and cameras and builds the Diagram; commands nothing.

    Args:
        scenario: with a section ``hardware``.
        silent: it can send nothing, ever.
        meshcat: where to draw, if anywhere.

    Raises:
        InputError: the scenario cannot be used with a real robot, or a driver does not speak.
        NoImage: a camera brings none.
        Stopped: the arm is in no mode to move, or somebody else commands it.
    """
    config = hardware_of(scenario)
    limits_of(config.safety)  # hears what is wrong before anything is connected
    pipeline = scenario.pipeline
    if pipeline.retries or not isinstance(pipeline.look, Once):
        raise InputError(
            "a real robot looks once and moves once, for each motion is asked about; valid: "
            "pipeline: {retries: 0, look: !Once {}}"
        )
    lcm, camera_lcm = make_lcm(config.lcm_url), make_lcm(config.lcm_url)
    bus = PandaBus(lcm)
    _wait_for_drivers(bus, lcm)
    if not silent:
        _require_free(bus, lcm)
    feeds = open_cameras(scenario, camera_lcm, used_cameras(pipeline, scenario.cameras))
    try:
        _wait_for_images(feeds, camera_lcm, config.safety)
        return _build(scenario, bus, lcm, camera_lcm, feeds, silent, meshcat)
    except BaseException:
        for feed in feeds.values():
            feed.close()
        raise


def _listen_until(lcm: DrakeLcm, heard: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not heard() and time.monotonic() < end:
        lcm.HandleSubscriptions(20)
    return heard()


def _wait_for_drivers(bus: PandaBus, lcm: DrakeLcm) -> None:
    for name, inbox in (("arm", bus.arm), ("hand", bus.hand)):
        if not _listen_until(lcm, lambda inbox=inbox: inbox.newest is not None, PATIENCE):  # type: ignore[misc]
            refused = f"; what came was refused: {inbox.why_refused}" if inbox.refused else ""
            raise InputError(
                f"the {name}'s driver says nothing on {inbox.channel}{refused}; start it, or "
                "`tog hardware emulate` in its place, on this host, and see `tog hardware doctor`"
            )


def _require_free(bus: PandaBus, lcm: DrakeLcm) -> None:
    """Raises Stopped unless the arm waits for commands, and for those of this program alone."""
    _listen_until(lcm, lambda: bus.foreign, 0.3)
    if bus.foreign:
        raise Stopped(
            "somebody else commands the arm on PANDA_COMMAND; end that program first",
            StopReason.FOREIGN_COMMAND,
        )
    status = bus.arm.newest
    assert status is not None
    if status.robot_mode != RobotMode.MOVE:
        raise Stopped(
            f"the arm is in mode {mode_name(status.robot_mode)}, not MOVE; free the brakes, "
            "release the stop button, and restart its driver in position mode",
            StopReason.ROBOT_MODE,
        )


def _wait_for_images(feeds: dict[str, Feed], lcm: DrakeLcm, safety: SafetyConfig) -> None:
    for name, feed in feeds.items():
        if not _listen_until(lcm, lambda feed=feed: _age(feed) <= safety.image_age, PATIENCE):  # type: ignore[misc]
            raise NoImage(_no_image(name, feed, safety))


def _age(feed: Feed) -> float:
    """How old the newest images of a camera are [s]."""
    newest = feed.newest()
    return float("inf") if newest is None else time.time() - newest.utime / 1e6


def _no_image(name: str, feed: Feed, safety: SafetyConfig) -> str:
    problem = f"; {feed.problem()}" if feed.problem() else ""
    return (
        f"camera {name} has brought no image of the last {safety.image_age:g} s{problem}; "
        "see `tog hardware doctor`"
    )


def _build(
    scenario: Scenario,
    bus: PandaBus,
    lcm: DrakeLcm,
    camera_lcm: DrakeLcm,
    feeds: dict[str, Feed],
    silent: bool,
    meshcat: Meshcat | None,
) -> Robot:
    config = hardware_of(scenario)
    station = HardwareStation(scenario, bus=bus, feeds=feeds, silent=silent, meshcat=meshcat)
    planning_model = MakePlanningModel([robot_directive(scenario), *scenario.planning_directives])
    executor = replace(scenario.pipeline.executor, speed=config.speed)
    pipeline = GraspPipeline(
        replace(scenario.pipeline, executor=executor),
        cameras={name: feed.intrinsics for name, feed in feeds.items()},
        planning_model=planning_model,
        seed=scenario.random_seed,
        safety=config.safety,
    )
    builder = DiagramBuilder()
    builder.AddSystem(station)
    builder.AddSystem(pipeline)
    connect_to_station(builder, station, pipeline)
    diagram = builder.Build()
    diagram.set_name("tog_drake")
    return Robot(diagram, station, pipeline, planning_model, bus, lcm, camera_lcm, feeds)


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
    return Episode(record, course.decision, course.replay)


@dataclass
class _Course:
    """What happened."""

    decision: Decision = None  # type: ignore[assignment]
    outcome: tuple[str, str | None] | None = None  # and the message; None: as the decision says
    moved: float | None = None  # [s] of wall time; None: it did not
    rule: StopReason | None = None
    opening_closed: float | None = None  # [m] when the lift began
    opening_after: float | None = None  # [m] after the hold
    force: float | None = None  # [N] where the driver reports one
    late: float | None = None  # [s] see RealTime
    replay: str | None = None

    def __post_init__(self) -> None:
        self.decision = Decision()

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
    loop = RealTime(
        simulator,
        robot.station,
        robot.bus,
        lcm=robot.lcm,
        camera_lcm=robot.camera_lcm,
        safety=config.safety,
        meshcat=meshcat,
    )
    if meshcat is not None:
        meshcat.StartRecording()
    loop.stand(robot.pipeline.executor.look_time)
    for camera, feed in robot.feeds.items():
        if _age(feed) > config.safety.image_age:
            raise NoImage(_no_image(camera, feed, config.safety))
    decision = course.decision = decide(robot.pipeline, context)
    looked = loop.time
    if meshcat is not None:
        _draw(meshcat, decision, robot)
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
    _move(robot, loop, simulator, motion.duration, meshcat, course)
    if meshcat is not None:
        course.replay = _replay(robot, simulator, meshcat, looked)


def _move(
    robot: Robot,
    loop: RealTime,
    simulator: Simulator,
    duration: float,
    meshcat: Meshcat | None,
    course: _Course,
) -> None:
    """Carries out what was decided, and judges how it ended."""
    executor, station = robot.pipeline.executor, robot.station
    context = executor.GetMyContextFromRoot(simulator.get_context())

    def done() -> bool:
        state = executor.state(context)
        lifting = (
            state.phase is Phase.MOVE
            and state.motion is not None
            and (loop.time >= state.start_time + state.motion.phase_times["lift"])
        )
        if lifting and course.opening_closed is None and robot.bus.hand.newest is not None:
            course.opening_closed = robot.bus.hand.newest.opening
        return state.phase in (Phase.DONE, Phase.FAILED)

    if meshcat is not None:
        meshcat.AddButton(STOP_BUTTON, "Escape")
    gc.collect()
    gc.freeze()  # or the collector would go through the whole program while the arm moves
    loop.catch_up()
    # The executor first takes over the motion, so that the first command is where that begins.
    loop.stand(loop.time + PERIOD)
    station.operator.arm()
    started = time.monotonic()
    try:
        loop.move(done, longest=3 * duration + 10.0)
    finally:
        gc.unfreeze()
        if meshcat is not None:
            meshcat.DeleteButton(STOP_BUTTON)
    course.moved, course.late = time.monotonic() - started, loop.late
    hand = robot.bus.hand.newest
    course.force = hand.force if hand is not None and hand.force > 0 else None
    guarded = station.guard.state(station.guard.GetMyContextFromRoot(simulator.get_context()))
    course.rule = guarded.broken[0] if guarded.broken else None
    state = executor.state(context)
    course.opening_after = state.opening_after
    empty = robot.pipeline.executor.empty_opening
    course.outcome = judge(guarded, state, course.opening_closed, empty)


def judge(
    guarded: GuardState, state: ExecutorState, opening_closed: float | None, empty: float
) -> tuple[str, str | None]:
    """Returns outcome and message of a motion, by the width of the hand alone.

    Args:
        guarded: what the guard did.
        state: how the executor ended.
        opening_closed: [m] between the pads when the lift began.
        empty: [m] a hand that is closed further holds nothing.
    """
    if guarded.broken is not None:
        rule, how = guarded.broken
        return "stopped", f"{how} (safety rule {rule.value}); nothing moves before it is run again"
    if state.phase is Phase.FAILED:
        return "collision", "the arm no longer followed its command and was stopped"
    after = state.opening_after
    if opening_closed is None or after is None or opening_closed < empty:
        return "empty", "the fingers closed on nothing"
    if after < empty or opening_closed - after > LOST:
        return "dropped", (
            f"the fingers, {1e3 * opening_closed:.1f} mm apart when the lift began, were "
            f"{1e3 * after:.1f} mm apart after it"
        )
    return "lifted", None


def _draw(meshcat: Meshcat, decision: Decision, robot: Robot) -> None:
    draw_decision(
        meshcat,
        cloud=decision.cloud,
        grasps=decision.grasps,
        candidates=decision.candidates,
        choice=decision.choice,
        motion=decision.motion,
        X_WL0=robot.planning_model.X_WL0,
    )


def _replay(robot: Robot, simulator: Simulator, meshcat: Meshcat, looked: float) -> str:
    context = simulator.get_context()
    robot.diagram.ForcedPublish(context)  # every track ends at the same time
    return replay_html(meshcat, duration=context.get_time(), decided=looked)
