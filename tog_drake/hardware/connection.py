"""Connects to a real robot: its drivers, its cameras, and the Diagram around them."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from tog_drake.errors import InputError, NoImage, Stopped
from tog_drake.executor import ExecutorState
from tog_drake.hardware.config import hardware_of
from tog_drake.look_planning import Once
from tog_drake.pipeline import GraspPipeline, connect_to_station, used_cameras
from tog_drake.planning_model import MakePlanningModel, PlanningModel
from tog_drake.safety import SafetyConfig, StopReason, limits_of
from tog_drake.scenario import Scenario, robot_directive
from tog_drake.stations.camera_feed import Feed
from tog_drake.stations.guard import GuardState, mode_name
from tog_drake.stations.hardware import HardwareStation, open_cameras
from tog_drake.stations.lcm_bus import RobotMode, make_lcm
from tog_drake.stations.panda_lcm import PandaBus

PATIENCE = 10.0  # [s] for whom to speak that is connected to
HAND_PATIENCE = 5.0  # [s] for fingers that close: at 0.1 m/s they take 0.8 s at most


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
    safety: SafetyConfig

    def state(self, context: Context) -> ExecutorState:
        """Returns what the executor remembers, in the root ``context``."""
        return self.pipeline.executor.state(self.pipeline.executor.GetMyContextFromRoot(context))

    def guarded(self, context: Context) -> GuardState:
        """Returns what the guard lets pass, in the root ``context``."""
        return self.station.guard.state(self.station.guard.GetMyContextFromRoot(context))

    def require_images(self) -> None:
        """Raises NoImage where a camera's newest image is too old to decide on."""
        for name, feed in self.feeds.items():
            if _age(feed) > self.safety.image_age:
                raise NoImage(_no_image(name, feed, self.safety))

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
    if not pipeline.opens_fully:
        raise InputError(
            "a real hand arrives fully open, for its driver grasps when it is told a narrower "
            "width; valid: pipeline: {opens_fully: true}, as in panda_lcm"
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
    executor = replace(scenario.pipeline.executor, speed=config.speed, hand_patience=HAND_PATIENCE)
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
    return Robot(
        diagram, station, pipeline, planning_model, bus, lcm, camera_lcm, feeds, config.safety
    )
