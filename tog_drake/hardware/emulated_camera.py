"""The cameras of the emulated robot: they render in a process of their own and send over LCM."""

from dataclasses import dataclass

import numpy as np

from tog_drake.hardware.config import hardware_of
from tog_drake.hardware.faults import FaultyLine, Schedule
from tog_drake.scenario import Scenario
from tog_drake.stations.lcm_bus import images_message, make_lcm
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import Array


@dataclass(frozen=True)
class Scene:
    """Where everything was, and when."""

    positions: Array  # of the plant
    time: float  # Unix time [s]
    # For the faults: when the emulator started, and when the arm was first told to move [s].
    begin: float | None
    moved: float | None


class EmulatedCameras:
    """Renders what the cameras of a scenario see, and sends it.

    Args:
        scenario: of the world.
        channels: of LCM, by camera.
        schedule: the faults.

    Raises:
        InputError: the scenario cannot be built.
    """

    def __init__(self, scenario: Scenario, channels: dict[str, str], schedule: Schedule):
        self._station = SimulationStation(scenario)
        self._context = self._station.CreateDefaultContext()
        self._channels = channels
        self._schedule = schedule
        self._lines = {
            channel: FaultyLine(channel, schedule, scenario.random_seed)
            for channel in channels.values()
        }
        self._lcm = make_lcm(hardware_of(scenario).lcm_url)

    def __call__(self, scene: Scene) -> None:
        self._schedule.begin, self._schedule.moved = scene.begin, scene.moved
        plant = self._station.plant
        mine = plant.GetMyContextFromRoot(self._context)
        # Drake keeps the images as long as nothing is set: a world at rest is rendered once.
        if not np.array_equal(plant.GetPositions(mine), scene.positions):
            plant.SetPositions(mine, scene.positions)
        for camera, channel in self._channels.items():
            line = self._lines[channel]
            line.send(self._render(camera, round(1e6 * scene.time)), scene.time)
            for message in line.due(scene.time):
                self._lcm.Publish(channel, message)

    def _render(self, camera: str, utime: int) -> bytes:
        rgb, depth = (
            self._station.GetOutputPort(f"{camera}.{image}").Eval(self._context).data
            for image in ("rgb_image", "depth_image")
        )
        return images_message(rgb[..., :3], depth[..., 0], utime)
