"""Threads that share the network's work."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import RLock
from types import TracebackType
from typing import TypeVar

import torch
from torch import Tensor
from typing_extensions import Self

In = TypeVar("In")
Out = TypeVar("Out")


_ONE_AT_A_TIME = RLock()  # within a thread there may be more


class Workers:
    """A context in which ``count`` threads work on parts of the same thing, each by itself.

    torch's own threads wait for each other after every operation, and the network has thousands of
    them: beside another busy program that takes up to fifty times as long. So while more than one
    work here, torch operates on one thread; afterwards it has as many as before. How many it has
    concerns the whole process: so there is one such context at a time, and others wait for it.

    ``count`` is None: as many as torch has threads.
    """

    def __init__(self, count: int | None = None):
        self._wanted = count

    def __enter__(self) -> Self:
        _ONE_AT_A_TIME.acquire()
        self._before = torch.get_num_threads()  # asked here, where nobody else has lowered it
        self.count = self._before if self._wanted is None else self._wanted
        self._pool = ThreadPoolExecutor(self.count)
        if self.count > 1:
            torch.set_num_threads(1)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._pool.shutdown()
            torch.set_num_threads(self._before)
        finally:
            _ONE_AT_A_TIME.release()

    def map(self, work: Callable[[In], Out], things: Iterable[In]) -> list[Out]:
        """What ``work`` makes of each of the things."""
        return list((self._pool.map if self.count > 1 else map)(work, things))

    def share(self, work: Callable[[Iterator[In]], None], things: Iterable[In]) -> None:
        """Has each thread ``work`` on the things that it takes, one by one, from all of them."""
        left = iter(list(things))
        self.map(work, [left] * self.count)

    def start(self, work: Callable[[], Out]) -> Callable[[], Out]:
        """Has ``work`` done beside what follows; what comes back waits for what it makes."""
        if self.count > 1:
            return self._pool.submit(work).result
        made = work()
        return lambda: made

    def by_rows(self, work: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
        """What ``work`` makes of the rows of ``x``."""
        return torch.cat(self.map(work, x.chunk(self.count)))
