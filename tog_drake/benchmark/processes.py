"""Work that is done in several processes of this machine."""

import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from os import _exit
from pickle import PicklingError
from typing import Any, Generic, TypeVar

from tog_drake.errors import InputError, TogError
from tog_drake.terminal import keep_drake_quiet

Job = TypeVar("Job")
T = TypeVar("T")
ATTEMPTS = 3  # of a job whose worker dies
_PRELOADED = ["tog_drake.benchmark.episodes"]
"""2 s of imports, which a new worker need not repeat; and whatever is edited meanwhile, all workers
are of the same state of the program."""
LIFE = 10  # jobs of a worker: not all memory of a diagram is given back, about 40 MB an episode


@dataclass(frozen=True)
class Broken:
    """What a job ended in that raised what is no InputError, or whose workers died."""

    message: str  # the end of the traceback, on one line
    traceback: str


def in_processes(
    work: Callable[[Job], T], jobs: Iterable[Job], workers: int
) -> Generator[tuple[Job, T | Broken], None, None]:
    """Yields each job with what ``work`` makes of it, in the order in which they end.

    A job is taken from ``jobs`` when a worker is free for it, so that an iterator that gives no
    more ends the work with what is under way. A worker that dies takes no job but its own with it:
    that one is tried again at the end, alone, in case there was too little memory for two.

    Args:
        work: runs in a process of its own, and so is, as its jobs are, what can be pickled.
        jobs: any number.
        workers: processes.

    Raises:
        InputError: as ``work`` raises it; what is under way is ended.
    """
    pool = _Pool(work, iter(jobs), workers)
    try:
        yield from pool.run()
    finally:  # Ctrl-C too
        pool.end()


def in_job_order(
    jobs: Sequence[Job], ended: Iterable[tuple[Job, T | Broken]]
) -> Generator[T, None, None]:
    """Yields the results in the order of the jobs.

    Raises:
        TogError: a job is broken.
    """
    results: dict[int, T] = {}  # by the identity of the job
    awaited = 0
    for job, result in ended:
        if isinstance(result, Broken):
            raise TogError(f"{result.message}; with fewer --workers there is more memory for each")
        results[id(job)] = result
        while awaited < len(jobs) and id(jobs[awaited]) in results:
            yield results.pop(id(jobs[awaited]))
            awaited += 1


@dataclass
class _Task(Generic[Job]):
    job: Job
    deaths: int = 0


class _Worker:
    """A process that does one job after another."""

    def __init__(self, work: Callable[[Any], Any]):
        context = get_context("forkserver")
        context.set_forkserver_preload(_PRELOADED)
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        self.process.start()
        theirs.close()  # so that the death of the process ends the pipe
        self.jobs = 0
        self.task: _Task[Any] | None = None

    def begin(self, task: _Task[Any]) -> None:
        self.task = task
        self.jobs += 1
        with suppress(OSError):  # it is dead, as the end of the pipe will tell
            self.pipe.send(task.job)

    def end(self) -> None:
        self.process.terminate()
        self.pipe.close()
        self.process.join()


class _Pool(Generic[Job, T]):
    def __init__(self, work: Callable[[Job], T], jobs: Iterator[Job], workers: int):
        self._work = work
        self._jobs = jobs
        self._count = workers
        self._again: deque[_Task[Job]] = deque()  # whose worker has died
        self._busy: dict[Connection, _Worker] = {}
        self._free: list[_Worker] = []

    def run(self) -> Iterator[tuple[Job, T | Broken]]:
        while True:
            while len(self._busy) < self._count and (task := self._next()) is not None:
                self._start(task)
            if not self._busy:
                return
            for pipe in wait(list(self._busy)):
                assert isinstance(pipe, Connection)
                yield from self._hear(self._busy.pop(pipe))

    def end(self) -> None:
        for worker in [*self._busy.values(), *self._free]:
            worker.end()

    def _next(self) -> _Task[Job] | None:
        for job in self._jobs:
            return _Task(job)
        return self._again.popleft() if self._again and not self._busy else None

    def _start(self, task: _Task[Job]) -> None:
        worker = self._free.pop() if self._free else _Worker(self._work)
        self._busy[worker.pipe] = worker
        worker.begin(task)

    def _hear(self, worker: _Worker) -> Iterator[tuple[Job, T | Broken]]:
        """Takes what a worker sends, or its death."""
        task = worker.task
        assert task is not None
        try:
            result = worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join()
            task.deaths += 1
            if task.deaths < ATTEMPTS:
                self._again.append(task)
            else:
                message = f"its worker process died {ATTEMPTS} times, {_death(worker)}"
                yield task.job, Broken(message, message + "\n")
            return
        if isinstance(result, InputError):
            worker.end()
            raise result
        if worker.jobs < LIFE:
            self._free.append(worker)
        else:
            worker.end()
        yield task.job, result


def _death(worker: _Worker) -> str:
    status = worker.process.exitcode
    if status is None or status >= 0:
        return f"at last with exit status {status}"
    name = signal.Signals(-status).name
    memory = ", perhaps for want of memory" if -status == signal.SIGKILL else ""
    return f"at last by {name}{memory}"


def _serve(pipe: Connection, work: Callable[[Job], T]) -> None:
    """Does the jobs that come through the pipe, until it ends or the parent does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=die_with_parent, daemon=True).start()
    keep_drake_quiet()
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        result = attempt(work, job)
        try:
            pipe.send(result)
        except (AttributeError, TypeError, ValueError, PicklingError) as error:
            pipe.send(broken_by(error))


def attempt(work: Callable[[Job], T], job: Job) -> T | InputError | Broken:
    """Does a job in a worker; what it raises comes back as a value."""
    try:
        return work(job)
    except InputError as error:
        return InputError(str(error))
    except (Exception, SystemExit) as error:  # by the latter Drake ends, or what it calls
        return broken_by(error)


def broken_by(error: BaseException) -> Broken:
    """Returns what a job ended in that raised this."""
    last = traceback.format_exception_only(type(error), error)[-1]
    return Broken(" ".join(last.split()), traceback.format_exc())


def die_with_parent() -> None:
    """Waits for the end of the process that started this one, and then ends this one."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        _exit(1)
