"""Work that is done on a Ray cluster: in processes of this machine, or of many.

Every machine of the cluster has the same program, and the objects and files that its episodes need:
one where any is other, or missing, is refused by its name. Relative paths are read from the folder
of the same name as where the run was begun; ``TOG_ASSETS``, ``TOG_WEIGHTS`` and ``TOG_PRICES``
travel as they are set there, and nothing else of the environment: a key belongs into the one that
``ray start`` is run in, for Ray would keep it in the open. What is made comes back to the one that
asks; a cassette that is recorded lies where it was asked, unless that folder is a shared one.

Ray listens on the network: it belongs on machines among themselves. Its usage statistics are not
sent.
"""

import os
import socket
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tog_drake import weights
from tog_drake.assets import library
from tog_drake.benchmark.processes import ATTEMPTS, LIFE, Broken, attempt
from tog_drake.errors import InputError
from tog_drake.selectors.vlm import prices
from tog_drake.selectors.vlm.keys import NoKey
from tog_drake.terminal import keep_drake_quiet

if TYPE_CHECKING:
    from tog_drake.benchmark.cells import Cell
    from tog_drake.benchmark.runner import CellWork

_PATIENCE = 10.0  # [s] for a machine to take a connection
INSTALL = "pip install 'tog_drake[cluster]'"
TRAVEL = (library.VARIABLE, weights.VARIABLE, prices.VARIABLE)
"""Variables of the environment, each a path, that hold on the whole cluster."""


@dataclass(frozen=True)
class Asker:
    """Where a run was begun."""

    folder: Path  # from which relative paths are read
    environment: dict[str, str]

    @staticmethod
    def here() -> "Asker":
        """Returns what is so in this process."""
        set_here = {name: os.environ.get(name, "") for name in TRAVEL}
        paths = {
            name: str(Path(path).expanduser().resolve()) for name, path in set_here.items() if path
        }
        return Asker(Path.cwd(), paths)

    def enter(self) -> None:
        """Makes this process one that reads the same files."""
        os.environ.update(self.environment)
        try:
            os.chdir(self.folder)
        except OSError as error:
            raise InputError(
                f"there is no folder {self.folder}, where the run was begun and relative paths are "
                "read from; valid: to begin it in a folder that every machine of the cluster has, "
                "if need be an empty one"
            ) from error


def on_cluster(
    address: str | None,
) -> Callable[[Callable[[Any], Any], Iterable[Any], int], Generator[tuple[Any, Any], None, None]]:
    """Returns what does on a cluster what ``in_processes`` does in processes.

    How many jobs are under way is the number of the cluster's processors, as it is at the time. A
    job whose worker or machine dies is done again elsewhere, ``ATTEMPTS`` times in all.

    Args:
        address: of a cluster, such as "10.0.0.1:6379"; None: the one that RAY_ADDRESS names or
            ``ray start`` has started on this machine, or else a new one of this machine alone.

    Raises:
        InputError: Ray is not installed, or nothing listens at the address.
    """
    ray = _ray()
    named = address or os.environ.get("RAY_ADDRESS")
    if named is not None:
        _knock(named)

    def run(
        work: Callable[[Any], Any], jobs: Iterable[Any], workers: int
    ) -> Generator[tuple[Any, Any], None, None]:
        with _cluster(ray, named):
            yield from _run(ray, work, iter(jobs))

    return run


def _ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise InputError(f"--workers ray needs Ray: {INSTALL}; valid: --workers 2") from error
    return ray


@contextmanager
def _cluster(ray: Any, named: str | None) -> Iterator[None]:
    """Joins a cluster, or starts one where none is named and none runs.

    Raises:
        InputError: it does not answer.
    """
    quiet = {"log_to_driver": False, "logging_level": "error"}
    try:
        try:
            ray.init(address=named or "auto", **quiet)
        except ConnectionError:
            if named is not None:
                raise
            ray.init(
                address="local",
                include_dashboard=False,
                _node_ip_address="127.0.0.1",
                **quiet,
            )
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:  # or no token
        raise _no_answer(named or "this machine", error) from error
    try:
        yield
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Raises InputError where nothing listens, for which Ray would wait minutes."""
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    try:
        if colon:  # else a name of Ray's, such as "auto"
            socket.create_connection((host, int(port)), timeout=_PATIENCE).close()
    except (OSError, ValueError) as error:
        raise _no_answer(address, error) from error


def _no_answer(where: str, error: Exception) -> InputError:
    return InputError(
        f"no Ray cluster answers at {where}: {' '.join(str(error).split())[:300]}; valid: "
        "--workers ray, or ray:ADDRESS with the address that `ray start --head` prints"
    )


def _run(
    ray: Any, work: Callable[[Any], Any], jobs: Iterator[Any]
) -> Generator[tuple[Any, Any], None, None]:
    remote = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1, max_calls=LIFE)(do)
    asker, shared = ray.put(Asker.here()), ray.put(work)
    under_way: dict[Any, Any] = {}  # the job of each reference
    left = True
    while left or under_way:
        room = int(ray.cluster_resources().get("CPU", 0))  # fewer, once a machine is lost
        while left and len(under_way) < max(room, 1):
            job = next(jobs, None)
            if left := job is not None:
                under_way[remote.remote(asker, shared, job)] = job
        if under_way:
            (ended, *_), _ = ray.wait(list(under_way))
            yield under_way.pop(ended), _result(ray, ended)


def _result(ray: Any, ended: Any) -> Any:
    try:
        result = ray.get(ended)
    except (
        ray.exceptions.WorkerCrashedError,
        ray.exceptions.NodeDiedError,
        ray.exceptions.OutOfMemoryError,
    ) as error:
        message = f"its worker died {ATTEMPTS} times: {' '.join(str(error).split())[:300]}"
        return Broken(message, f"{message}\n\n{traceback.format_exc()}")
    except ray.exceptions.RayError as error:  # of a machine that cannot do any job
        raise InputError(
            f"the cluster cannot work: {' '.join(str(error).split())[:500]}; valid: machines with "
            "this package and all that it needs"
        ) from error
    if isinstance(result, InputError):
        raise result
    return result


def do(asker: Asker, work: "CellWork", job: "Cell") -> Any:
    """Does a job in a worker of the cluster; what it raises comes back as a value."""
    keep_drake_quiet()
    here = os.uname().nodename
    try:
        asker.enter()
        if differs := work.others(job):
            raise InputError(
                f"it has other than the machine that asks: {', '.join(differs)}; valid: the same "
                "version, objects and files on every machine of the cluster"
            )
    except NoKey as error:
        return InputError(
            f"{here}: {error} where `ray start` is run there; keys do not travel in a cluster"
        )
    except InputError as error:
        return InputError(f"{here}: {error}")
    result = attempt(work, job)
    return InputError(f"{here}: {result}") if isinstance(result, InputError) else result
