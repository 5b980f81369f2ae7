"""Where everything was during an episode: kept beside its record, to show it without simulating.

``recording.npz`` is complete in itself. It holds the world as a scenario's YAML, the positions of
all its joints and free bodies over time (a second of one object takes some 3 kB), and what was seen
and decided at the last look, as it is drawn.
"""

import io
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pydrake.common.yaml import yaml_dump_typed
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.npz import AnyArray, BadNpz, read_npz
from tog_drake.pipeline import PipelineConfig
from tog_drake.scenario import MAX_SCENARIO_BYTES, Scenario, parse_scenario
from tog_drake.values import Array
from tog_drake.visualization import Sketch

RECORDING = "recording.npz"
_APART = 0.0099  # [s]
LONGEST = 600.0  # [s] of an episode; one with three attempts takes a minute
_MAX_ARRAY_BYTES = 64_000_000  # 100 positions, 50 times a second, for ten minutes: 12 MB
_FARTHEST = 100.0  # [rad] or [m] of any position: beyond it nothing is to be seen
# Of a sketch: the kind of each array and the shape of a row.
_SKETCH: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "cloud": ("f", (3,)),
    "cloud_rgb": ("u", (3,)),
    "grasps": ("f", (2, 3)),
    "candidates": ("f", (4, 2, 3)),
    "choice": ("f", (2, 3)),
    "contact": ("f", (3,)),
    "choice_rgb": ("u", ()),
    "path": ("f", (3,)),
}
MAX_CANDIDATES = 100  # each is an object in Meshcat
_VALID = f"an episode's {RECORDING}, as `tog run` writes it"


@dataclass(frozen=True)
class Recording:
    """The positions of a world over time."""

    world: str
    """The scenario, as YAML: what there is. Who looks and decides is left out."""
    names: tuple[str, ...]  # of the Q positions, in the order of the plant
    times: Array  # (T,) [s] of the simulation, rising
    positions: Array  # (T, Q) [rad], [m], quaternions (w, x, y, z)
    sketch: Sketch
    decided: float  # [s] when the decision was made that is sketched
    closed: float | None = None  # [s] when the hand began to close, if it came to that


class Recorded(Protocol):
    """A station whose plant is recorded."""

    plant: MultibodyPlant

    def positions(self, context: Context) -> Array:
        """Returns the positions (Q,) of the plant, by the station's ``context``."""
        ...


class Recorder:
    """Takes down the positions of a station's plant, at most every 10 ms.

    Args:
        station: simulated or real.
        scenario: of the world that the plant is of.
    """

    def __init__(self, station: Recorded, scenario: Scenario):
        self._station = station
        self._world = world_text(scenario)
        self._times: list[float] = []
        self._positions: list[Array] = []

    def observe(self, station_context: Context) -> None:
        """Takes down the positions as they are, unless that was done just before."""
        time = station_context.get_time()
        if not self._times or time > self._times[-1] + _APART:
            self._times.append(time)
            self._positions.append(self._station.positions(station_context))

    def recording(
        self, sketch: Sketch, *, decided: float, closed: float | None = None
    ) -> Recording | None:
        """Returns what was taken down, with the last decision; None: nothing has moved."""
        if len(self._times) < 2:
            return None
        return Recording(
            self._world,
            tuple(self._station.plant.GetPositionNames()),
            np.array(self._times),
            np.stack(self._positions),
            sketch,
            decided,
            closed,
        )


def world_text(scenario: Scenario) -> str:
    """Returns the world of a scenario as YAML.

    The poses at the beginning are in the recording, so nothing needs to fall again (``settle``);
    the pipeline may name servers, files and models, which are nobody's business here.
    """
    world = deepcopy(scenario)
    world.pipeline, world.hardware, world.settle, world.cameras = PipelineConfig(), None, None, {}
    return str(yaml_dump_typed(world, defaults=Scenario()))


def world_of(recording: Recording) -> Scenario:
    """Returns the scenario of a recording, without cameras. Raises InputError if it is none."""
    scenario = parse_scenario(recording.world, f"the world of {RECORDING}", Scenario())
    scenario.cameras, scenario.settle, scenario.hardware = {}, None, None
    return scenario


def save_recording(folder: Path, recording: Recording | None) -> None:
    """Writes ``recording.npz``, whole or not at all; None: removes that of an earlier episode."""
    path = folder / RECORDING
    if recording is None:
        path.unlink(missing_ok=True)
        return
    closed = np.nan if recording.closed is None else recording.closed
    arrays: dict[str, Any] = {
        "world": np.frombuffer(recording.world.encode(), np.uint8),
        "names": np.array(recording.names),
        "times": recording.times,
        "positions": recording.positions.astype(np.float32),
        "decided": np.array([recording.decided, closed]),
    }
    for name, (kind, _) in _SKETCH.items():
        array = getattr(recording.sketch, name)
        arrays[f"sketch_{name}"] = array.astype(np.uint8 if kind == "u" else np.float32)
    data = io.BytesIO()
    np.savez_compressed(data, **arrays)
    write_atomically(path, data.getvalue())


def load_recording(folder: Path) -> Recording:
    """Returns the recording of an episode.

    Args:
        folder: of the episode, as given to ``tog run --out``.

    Raises:
        InputError: there is none, saying why that may be, or it is damaged.
    """
    path = folder / RECORDING
    if not path.is_file():
        raise InputError(_missing(folder))
    try:
        arrays = read_npz(path, max_array_bytes=_MAX_ARRAY_BYTES, valid=_VALID)
        return _checked(arrays)
    except (BadNpz, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be replayed: {error}; valid: {_VALID}") from error


def _missing(folder: Path) -> str:
    if not folder.is_dir():
        return f"there is no folder {folder}; valid: that of an episode, such as out/run"
    if not (folder / "episode.json").is_file():
        return (
            f"{folder} holds no episode; valid: the folder given to `tog run --out`, such as "
            "out/run, or one of `tog demo`, such as out/demo/use"
        )
    return (
        f"{folder} holds an episode without motion: it has no {RECORDING}. So it is where nothing "
        "was executed (a saved view, or no grasp or plan was found: see outcome and message in "
        "episode.json) and with versions that recorded none; `tog run` with the same scenario, "
        "task and seed records it anew"
    )


def _checked(arrays: Mapping[str, AnyArray | None]) -> Recording:
    """The recording that the arrays of a file are, if they are one. Raises BadNpz."""
    world, names = _array(arrays, "world", "u", 1), _array(arrays, "names", "U", 1)
    times, positions = _array(arrays, "times", "f", 1), _array(arrays, "positions", "f", 2)
    if len(world) > MAX_SCENARIO_BYTES:
        raise BadNpz(f"its world has {len(world)} bytes, at most {MAX_SCENARIO_BYTES}")
    if positions.shape != (len(times), len(names)) or len(times) < 2:
        raise BadNpz(
            f"it has {len(times)} times, {len(names)} names and positions of shape "
            f"{positions.shape}; two times at least, and a row for each, a column for each name"
        )
    if not (np.isfinite(times).all() and np.isfinite(positions).all()):
        raise BadNpz("a time or position is not finite")
    if times[0] < 0.0 or times[-1] > LONGEST or not (np.diff(times) > 0.0).all():
        raise BadNpz(f"its times do not rise from 0 s or later to {LONGEST:g} s or earlier")
    if np.abs(positions).max(initial=0.0) > _FARTHEST:
        raise BadNpz(f"a position is beyond {_FARTHEST:g} rad or m")
    decided = _array(arrays, "decided", "f", 1)
    within = (decided >= 0.0) & (decided <= LONGEST)
    if decided.shape != (2,) or not within[0] or not (within[1] or np.isnan(decided[1])):
        raise BadNpz(f"'decided' is {decided.tolist()!s:.60}; two times, the second may be nan")
    return Recording(
        world.astype(np.uint8).tobytes().decode(),
        tuple(map(str, names)),
        times.astype(float),
        positions.astype(float),
        _sketch(arrays),
        float(decided[0]),
        None if np.isnan(decided[1]) else float(decided[1]),
    )


def _sketch(arrays: Mapping[str, AnyArray | None]) -> Sketch:
    """The sketch that the arrays of a file are, if they are one. Raises BadNpz."""
    found = {}
    for name, (kind, row) in _SKETCH.items():
        array = _array(arrays, f"sketch_{name}", kind, 1 + len(row))
        if array.shape[1:] != row:
            raise BadNpz(f"'sketch_{name}' has the shape {array.shape}, not rows of {row}")
        if not (np.abs(array) <= (255 if kind == "u" else _FARTHEST)).all():
            raise BadNpz(f"'sketch_{name}' holds what is not finite, or beyond {_FARTHEST:g} m")
        found[name] = array.astype(np.uint8 if kind == "u" else float)
    sketch = Sketch(**found)
    if (
        len(sketch.cloud_rgb) not in (0, len(sketch.cloud))
        or len(sketch.choice_rgb) != 3
        or len(sketch.contact) != min(len(sketch.choice), 1)
        or len(sketch.candidates) > MAX_CANDIDATES
    ):
        raise BadNpz("the parts of its sketch do not fit together")
    return sketch


def _array(
    arrays: Mapping[str, AnyArray | None],
    name: str,
    kind: str,
    dimensions: int,
) -> Array:
    array = arrays.get(name)
    if array is None or array.dtype.kind != kind or array.ndim != dimensions:
        raise BadNpz(f"it has no array {name!r} of kind {kind!r} and {dimensions} dimension(s)")
    return array


def positions_at(recording: Recording, plant: MultibodyPlant, times: Array) -> Array:
    """Returns the positions (N, Q) at any ``times`` (N,) [s], as the plant has them.

    Between two samples they change evenly, rotations by the shorter way; before the first and
    after the last they stand still.

    Raises:
        InputError: the recording is of another plant, or a quaternion of it is none.
    """
    names = tuple(plant.GetPositionNames())
    if names != recording.names:
        other = sorted(set(names) ^ set(recording.names))[:4]
        raise InputError(
            f"{RECORDING} has {len(recording.names)} positions and the models that it names have "
            f"{len(names)}; not in both: {', '.join(other) or 'none, but in another order'}. They "
            "were changed since: replay it with the version and objects that it was made with"
        )
    q = recording.positions.copy()
    turned = [
        slice(start, start + 4)
        for body in map(plant.get_body, plant.GetFloatingBaseBodies())
        if body.has_quaternion_dofs()
        for start in [body.floating_positions_start()]
    ]
    for each in turned:
        length = np.linalg.norm(q[:, each], axis=1)
        if (np.abs(length - 1.0) > 0.01).any():
            raise InputError(f"{RECORDING}: {names[each.start]} .. is no unit quaternion")
        turns_over = (q[1:, each] * q[:-1, each]).sum(axis=1) < 0.0
        q[1:, each] *= np.where(np.cumsum(turns_over) % 2, -1.0, 1.0)[:, None]
    found = np.stack([np.interp(times, recording.times, column) for column in q.T], axis=1)
    for each in turned:
        found[:, each] /= np.linalg.norm(found[:, each], axis=1, keepdims=True)
    return found
