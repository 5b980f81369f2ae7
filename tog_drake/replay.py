"""Shows a recorded episode again: live in Meshcat, or as a page that needs nothing else.

The Meshcat here is Drake's own, as for every live scene and in every report; ``inline_replay``
shows the same in a notebook by the PyPI package of that name.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from tog_drake.errors import InputError
from tog_drake.recording import Recording, load_recording, positions_at, world_of
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import Array
from tog_drake.visualization import (
    draw_sketch,
    make_meshcat,
    publish_recording,
    record_decision,
)

FRAME_RATE = 30  # [1/s]


@dataclass(frozen=True)
class Stage:
    """The world of a recording, which takes any pose of it."""

    station: SimulationStation
    context: Context  # of the station
    times: Array  # (N,) [s] of the frames, from 0
    positions: Array  # (N, Q) of the plant at each

    def frames(self) -> Iterator[Context]:
        """Yields the context of the station at each frame in turn."""
        plant = self.station.plant
        for time, q in zip(self.times, self.positions, strict=True):
            self.context.SetTime(time)
            plant.SetPositions(plant.GetMyMutableContextFromRoot(self.context), q)
            yield self.context


def set_stage(
    recording: Recording,
    *,
    rate: float = FRAME_RATE,
    meshcat: Meshcat | None = None,
) -> Stage:
    """Builds the world of a recording anew; nothing in it is simulated.

    Args:
        recording: what to show.
        rate: frames a second.
        meshcat: where it is drawn, if anywhere.

    Raises:
        InputError: a model is missing, or was changed since.
    """
    try:
        station = SimulationStation(world_of(recording), meshcat)
    except RuntimeError as error:  # so Drake refuses a file, joint or setting
        raise InputError(f"the recorded world cannot be built: {error}") from error
    begin, end = recording.times[0], recording.times[-1]
    times = np.arange(begin, end + 0.5 / rate, 1.0 / rate)
    positions = positions_at(recording, station.plant, times)
    return Stage(station, station.CreateDefaultContext(), times - begin, positions)


def show_recording(recording: Recording) -> Meshcat:
    """Starts Meshcat on localhost, with the recording as an animation that repeats."""
    meshcat = make_meshcat()
    stage = set_stage(recording, meshcat=meshcat)
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    for context in stage.frames():
        stage.station.ForcedPublish(context)
    begin, closed = recording.times[0], recording.closed
    draw_sketch(meshcat, recording.sketch)
    record_decision(
        meshcat,
        duration=stage.times[-1],
        decided=max(recording.decided - begin, 0.0),
        closed=None if closed is None else closed - begin,
    )
    publish_recording(meshcat)
    return meshcat


def replay_page(folder: Path) -> str:
    """Returns a page that plays an episode over and over, without a server: some 3 MB.

    Raises:
        InputError: as ``load_recording`` and ``set_stage``.
    """
    return str(show_recording(load_recording(folder)).StaticHtml())
