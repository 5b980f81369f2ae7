"""What episodes share, kept on disk by its content: looks and executions.

Episodes of the same scene and seed differ in who chooses, not in what is seen and could be grasped;
and the same motion from the same state of the world ends the same way. All of it is deterministic.
So it is computed once, and kept under the SHA-256 of what it depends on: the state of the
simulated world, the scenario, the files of its models, settings and weights of the stages, this
program, Drake, numpy and scipy. What is damaged or gone is computed again. Nothing is pickled.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydrake.common.yaml import yaml_dump_typed
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.framework import Context

from tog_drake.decision import Decision, Look, decide
from tog_drake.files import write_atomically
from tog_drake.judge import Verdict
from tog_drake.pipeline import GraspPipeline, PipelineConfig
from tog_drake.proposer import Proposer, weights_of
from tog_drake.proposers.antipodal import AntipodalProposer
from tog_drake.resources import resource_dir
from tog_drake.scenario import Scenario, model_files
from tog_drake.values import FeasibleGrasps, GraspMotion, Grasps, Intrinsics, View

T = TypeVar("T")

MAX_BYTES = 2_000_000_000
"""Of all that a run keeps of what its episodes share; a look has 2.6 MB."""
_STEP = 0.005  # [s] between the samples by which motions are told apart
_RESOURCES = frozenset({"models", "diagrams"})  # in a wheel; scenarios count as they are read


@dataclass(frozen=True)
class Execution:
    """What came of a motion, whatever the task was that it was meant for."""

    verdict: Verdict  # its task_compliance is that of the task it was first carried out for
    opening: float | None  # [m] between the pads after the hold
    executed: float  # [s] simulated, from the look to the end
    wall: float  # [s] that it took
    end: float  # [s] time of the simulation


class SharedWork:
    """Looks and executions in a folder; several processes may use the same one at once."""

    def __init__(self, folder: Path, program: str):
        """Args: ``program``: the ``program_digest`` of those who use the folder.

        It is told and not found out here: the files of a program may be edited while it runs.
        """
        self._folder = folder
        self.program = program

    def look(self, key: str) -> Look | None:
        """Returns the look that is kept under a key, if any."""
        return _read(self._folder / f"{key}.npz", _look_of)

    def keep_look(self, key: str, look: Look) -> None:
        """Keeps a look, in place of the oldest where there is too much.

        Raises OSError where the folder cannot be written to.
        """
        data = io.BytesIO()
        np.savez(data, **_arrays_of(look))
        write_atomically(self._folder / f"{key}.npz", data.getvalue())
        self.prune(MAX_BYTES)  # some ten milliseconds, where a look takes seconds

    def execution(self, key: str) -> Execution | None:
        """Returns the execution that is kept under a key, if any."""
        return _read(self._folder / f"{key}.json", _execution_of)

    def keep_execution(self, key: str, execution: Execution) -> None:
        """Keeps an execution. Raises OSError where the folder cannot be written to."""
        write_atomically(self._folder / f"{key}.json", json.dumps(asdict(execution)))

    def prune(self, limit: int) -> None:
        """Deletes what was written longest ago until the rest has at most ``limit`` bytes."""
        kept = []
        for path in self._folder.glob("*.[nj]*"):
            with suppress(FileNotFoundError):  # another process may be at it
                kept.append((path.stat(), path))
        for status, path in sorted(kept, key=lambda item: -item[0].st_mtime):
            limit -= status.st_size
            if limit < 0:
                path.unlink(missing_ok=True)


class KeptWorld:
    """What is kept of the episodes in one world: decides and finds executions with its help."""

    def __init__(
        self,
        shared: SharedWork,
        scenario: Scenario,
        context: Context,
        pipeline: GraspPipeline,
        target: str,
    ):
        """Begins with the world as it is now.

        Args:
            shared: where things are kept.
            scenario: that the world was made of.
            context: the root Context of the diagram, at the time of the look.
            pipeline: that looks and decides.
            target: what executions are judged for.
        """
        self._shared, self._config = shared, scenario.pipeline
        self._pipeline, self._target = pipeline, target
        self._world = world_key(shared.program, scenario, context)
        seed = scenario.random_seed
        self._look = look_key(self._world, scenario.pipeline, pipeline.proposer, seed)

    def decide(self, context: Context) -> Decision:
        """Decides, from a look that is kept if there is one; keeps it if there is none."""
        found = None if self._look is None else self._shared.look(self._look)
        decision = decide(self._pipeline, context, found)
        if self._look is not None and found is None and decision.look is not None:
            with suppress(OSError):  # a full disk, say: then others compute it again
                self._shared.keep_look(self._look, decision.look)
        return decision

    def execution(self, decision: Decision) -> Execution | None:
        """Returns what came of the decision's motion, if that is kept."""
        return self._shared.execution(self._execution_key(decision))

    def keep(self, decision: Decision, execution: Execution) -> None:
        """Keeps what came of the decision's motion, where it can be kept."""
        with suppress(OSError):
            self._shared.keep_execution(self._execution_key(decision), execution)

    def _execution_key(self, decision: Decision) -> str:
        assert decision.motion is not None
        return execution_key(self._world, self._config, decision.motion, self._target)


def world_key(program: str, scenario: Scenario, context: Context) -> str:
    """Returns what tells a simulated world, as it is now, from every other.

    Args:
        program: that simulates it, see ``program_digest``.
        scenario: that it was made of; the settings of its pipeline do not count.
        context: the root Context of the diagram.
    """
    world = deepcopy(scenario)
    world.pipeline = PipelineConfig(camera=scenario.pipeline.camera)
    state = context.get_discrete_state()
    return _digest(
        [
            program,
            yaml_dump_typed(world),
            *(_contents(file.parent) for file in model_files(scenario).values()),
            *(state.get_vector(i).value().tobytes() for i in range(state.num_groups())),
            context.get_continuous_state_vector().CopyToVector().tobytes(),
            repr(context.get_time()),
        ]
    )


def look_key(world: str, config: PipelineConfig, proposer: Proposer, seed: int) -> str | None:
    """Returns what tells a look at a world; None where nobody can say what grasps are proposed.

    That is so of servers, files and plug-ins: what they say tomorrow is not known today.
    """
    weights = weights_of(proposer)
    if not isinstance(proposer, AntipodalProposer) and (weights or {}).get("sha256") is None:
        return None
    seeing = PipelineConfig(
        camera=config.camera,
        workspace=config.workspace,
        cloud=config.cloud,
        proposer=config.proposer,
        feasibility=config.feasibility,
        opens_fully=config.opens_fully,
    )
    return _digest(["look", world, yaml_dump_typed(seeing), json.dumps(weights), str(seed)])


def execution_key(world: str, config: PipelineConfig, motion: GraspMotion, target: str) -> str:
    """Returns what tells the carrying out of a motion in a world, judged for ``target``."""
    times = np.append(np.arange(0.0, motion.duration, _STEP), motion.duration)
    return _digest(
        [
            "execution",
            world,
            yaml_dump_typed(PipelineConfig(executor=config.executor)),
            target,
            json.dumps(motion.phase_times),
            motion.arm.vector_values(times).tobytes(),
            motion.hand.vector_values(times).tobytes(),
        ]
    )


def _digest(parts: Iterable[str | bytes]) -> str:
    total = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        total.update(len(data).to_bytes(8, "little") + data)
    return total.hexdigest()


@lru_cache
def program_digest() -> str:
    """Returns what tells this program from another state of it, and from it on another Drake.

    SHA-256 of its files, as they are at the first call in this process, and of the versions. A
    wheel, which carries its models inside the package, has that of the checkout beside them.
    """
    return _digest(
        [
            _contents(Path(__file__).parent, without=_RESOURCES),
            _contents(resource_dir("models")),
            *(version(name) for name in ("drake", "numpy", "scipy")),
        ]
    )


@lru_cache(maxsize=256)
def _contents(folder: Path, without: frozenset[str] = frozenset()) -> str:
    """Digest of the names and contents of a folder's files; files that Python makes aside.

    ``without`` are folders in it that do not count.
    """
    files = (path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file())
    return _digest(
        part
        for file in files
        if "__pycache__" not in file.parts and file.parts[0] not in without
        for part in (file.as_posix(), (folder / file).read_bytes())
    )


def _read(path: Path, parse: Callable[[bytes], T]) -> T | None:
    """What a kept file says; None where it is not there or damaged."""
    try:
        return parse(path.read_bytes())
    except (OSError, EOFError, ValueError, LookupError, TypeError, AttributeError):
        return None
    except (RuntimeError, NotImplementedError, zipfile.BadZipFile):  # of an archive's header
        return None


def _arrays_of(look: Look) -> dict[str, Any]:
    """A look as named arrays; what is no array is JSON in one of them."""
    cloud, grasps, feasible = look.cloud, look.grasps, look.feasible_grasps
    said = {
        "intrinsics": asdict(look.view.intrinsics),
        "rejected": feasible.rejected,
        "seconds": dict(look.seconds),
    }
    arrays = {
        "view.rgb": look.view.rgb,
        "view.depth": look.view.depth,
        "view.X_WC": look.view.X_WC,
        "cloud.xyzs": cloud.xyzs(),
        "cloud.normals": cloud.normals(),
        "cloud.rgbs": cloud.rgbs(),
        "said": np.frombuffer(json.dumps(said).encode(), np.uint8),
    }
    for name, value in (("grasps", grasps), ("feasible", feasible)):
        arrays |= {f"{name}.{f}": getattr(value, f) for f in _per_grasp(type(value))}
    return arrays


def _look_of(data: bytes) -> Look:
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        said = json.loads(arrays["said"].tobytes())
        view = View(
            arrays["view.rgb"],
            arrays["view.depth"],
            Intrinsics(**said["intrinsics"]),
            arrays["view.X_WC"],
        )
        xyzs = arrays["cloud.xyzs"]
        every = BaseField.kXYZs | BaseField.kNormals | BaseField.kRGBs
        cloud = PointCloud(xyzs.shape[1], Fields(every))
        cloud.mutable_xyzs()[:] = xyzs
        cloud.mutable_normals()[:] = arrays["cloud.normals"]
        cloud.mutable_rgbs()[:] = arrays["cloud.rgbs"]
        grasps, feasible = (
            {f: arrays[f"{name}.{f}"] for f in _per_grasp(kind)}
            for name, kind in (("grasps", Grasps), ("feasible", FeasibleGrasps))
        )
    return Look(
        view,
        cloud,
        Grasps(**grasps),
        FeasibleGrasps(**feasible, rejected=said["rejected"]),
        said["seconds"],
    )


def _per_grasp(kind: type[Grasps]) -> list[str]:
    return [f.name for f in fields(kind) if not f.metadata.get("whole", False)]


def _execution_of(data: bytes) -> Execution:
    said: dict[str, Any] = json.loads(data)
    verdict: Mapping[str, Any] = said.pop("verdict")
    return Execution(Verdict(**verdict), **said)
