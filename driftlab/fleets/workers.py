"""Who does the work, an item at a time each: processes of this machine, whose death loses the item in work alone.

`Workers` is what a fleet asks for; `Pool` has it from this machine, `driftlab.fleets.dask.Scheduler` from a cluster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from multiprocessing.connection import wait
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from driftlab.errors import WorkersError
from driftlab.fleets.process import Lost, Worker

__all__ = ["Lost", "Pool", "Workers", "available"]

T = TypeVar("T")
R = TypeVar("R")

STARTS = 3  # workers in a row that end before they begin, until it is said that none can be had


class Workers(Protocol):
    """Those who do the work, as a context manager: at its end, also by Ctrl-C, nobody works any more."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Lost]]:
        """Yield each item with what the function made of it, as they are done.

        Parameters
        ----------
        function : callable
            Importable by its name, and not from the main script. What it raises is a `Lost` of that item.
        items : iterable
            Drawn as they are needed: there are never more than a few a worker in memory.

        Yields
        ------
        item, result
            In the order in which they end.

        Raises
        ------
        WorkersError
            If nobody is there to do it.
        """
        ...


class Pool:
    """Processes of this machine, each with one item in work.

    A process that crashes or is killed loses its item, and another takes its place. Each uses one thread, since they
    share the processors; all end with the process that has begun them, however that ends.

    Parameters
    ----------
    workers : int, optional
        How many; as many as there are processors that this process may use (affinity and control groups count).
    timeout : float, optional
        Seconds after which an item is given up and its worker is replaced; by default an item may take any time.
    """

    def __init__(self, workers: int | None = None, timeout: float | None = None) -> None:
        self.workers, self.timeout = workers or available(), timeout
        self._idle: list[Worker] = []
        self._failed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        while self._idle:
            self._idle.pop().end()

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Lost]]:
        """Yield each item with what the function made of it, as they are done; see `Workers.map`."""
        left, busy = iter(items), list[Worker]()
        try:
            for item in islice(left, self.workers):
                busy.append(self._give(function, item))
            while busy:
                ended = self._ended(busy)
                found = []
                for worker in ended:
                    busy.remove(worker)
                    if worker.ready:
                        found.append((worker.item, worker.result))
                        self._failed = 0
                        following = list(islice(left, 1))
                    else:
                        self._count_failure(worker)
                        following = [worker.item]
                    self._idle += [worker] if worker.alive else []
                    busy += [self._give(function, item) for item in following]  # nobody waits for what is done with it
                yield from found
        finally:
            for worker in busy:
                worker.end()

    def _give(self, function: Callable[..., Any], item: Any) -> Worker:
        """Return a worker that has the item in work."""
        while True:
            worker = self._idle.pop() if self._idle else Worker(function.__module__)
            try:
                worker.take(function, item)
            except OSError:  # it died while it had nothing to do
                worker.end()
                self._count_failure(worker)
                continue
            return worker

    def _ended(self, busy: list[Worker]) -> list[Worker]:
        """Wait for at least one result; return the workers that have theirs, or are no more."""
        while True:
            patience = None
            if self.timeout is not None:
                patience = max(0.0, min(worker.since for worker in busy) + self.timeout - time.monotonic())
            heard = wait([worker.pipe for worker in busy], patience)
            ended = [worker for worker in busy if worker.pipe in heard and worker.hear()]
            if self.timeout is not None:
                late = time.monotonic() - self.timeout
                for worker in busy:
                    if worker not in ended and worker.since <= late:
                        worker.give_up(self.timeout)
                        ended.append(worker)
            if ended:
                return ended

    def _count_failure(self, worker: Worker) -> None:
        self._failed += 1
        if self._failed >= STARTS:
            raise WorkersError(
                f"pool: {STARTS} worker processes in a row ended before they began (the last one {worker.died}), "
                "running ones were expected; see what they say above, and whether memory is left"
            )


def available() -> int:
    """Return how many processors this process may use."""
    from joblib import cpu_count  # type: ignore[import-untyped]

    return int(cpu_count())
