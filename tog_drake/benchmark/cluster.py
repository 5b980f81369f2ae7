"""Work that is done on a Ray cluster: in processes of this machine, or of many.

Every machine of the cluster has this package, in the same version, and the same imported objects;
what is made there comes back to the one that asks. Ray listens on the network: it belongs on
machines among themselves. Its usage statistics are not sent.
"""

import os
import socket
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

from tog_drake.benchmark.processes import ATTEMPTS, LIFE, Broken, attempt
from tog_drake.errors import InputError
from tog_drake.terminal import keep_drake_quiet

_PATIENCE = 10.0  # [s] for a machine to take a connection
INSTALL = "pip install 'tog_drake[cluster]'"


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
    except (OSError, RuntimeError, ValueError) as error:
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
    remote = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1, max_calls=LIFE)(_do)
    shared, mine = ray.put(work), version("tog_drake")
    under_way: dict[Any, Any] = {}  # the job of each reference
    left = True
    while left or under_way:
        room = int(ray.cluster_resources().get("CPU", 0))  # fewer, once a machine is lost
        while left and len(under_way) < max(room, 1):
            job = next(jobs, None)
            if left := job is not None:
                under_way[remote.remote(shared, job, mine)] = job
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


def _do(work: Callable[[Any], Any], job: Any, wanted: str) -> Any:
    """Does a job in a worker of the cluster."""
    keep_drake_quiet()
    if (mine := version("tog_drake")) != wanted:
        return InputError(
            f"{os.uname().nodename} has tog_drake {mine}, and {wanted} asks; valid: the same "
            "version on every machine of the cluster"
        )
    return attempt(work, job)
