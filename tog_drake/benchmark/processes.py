"""Work that is done in several processes."""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import TypeVar

from tog_drake.errors import TogError
from tog_drake.terminal import keep_drake_quiet

Job = TypeVar("Job")
T = TypeVar("T")
_BATCH = 20  # jobs between two renewals of the workers


def in_processes(
    work: Callable[[Job], T], jobs: Sequence[Job], workers: int
) -> Generator[T, None, None]:
    """Returns what ``work`` makes of each job, in their order.

    Raises:
        TogError: a process died; and whatever ``work`` raises.
    """
    for start in range(0, len(jobs), _BATCH):
        yield from _run_batch(work, jobs[start : start + _BATCH], workers)


def _run_batch(
    work: Callable[[Job], T], jobs: Sequence[Job], workers: int
) -> Generator[T, None, None]:
    """Works in new processes: a diagram's memory is not all given back."""
    context = get_context("forkserver")
    with ProcessPoolExecutor(workers, context, initializer=keep_drake_quiet) as pool:
        try:
            yield from pool.map(work, jobs)
        except BrokenProcessPool as error:
            raise TogError(
                "a worker process died, perhaps for want of memory; try fewer --workers"
            ) from error
        except BaseException:  # Ctrl-C too: else the pool would wait for episodes under way
            for process in active_children():
                process.terminate()
            raise
