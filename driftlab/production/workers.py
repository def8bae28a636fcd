"""Pools of workers: processes of this machine, each with one item in work, whose death loses that item alone.

`Workers` is what a fleet asks for: results as they are done (`map`) or in the items' order (`ordered`). `Pool` has it
from this machine, `driftlab.production.dask.Scheduler` from a cluster. Each process uses one thread, and ends with the
process that has begun it, however that ends.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import islice
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Self, TypeVar

from driftlab.errors import WorkersError
from driftlab.storage.system import has_posix_locks, keep_freed_memory
from fusion_core.errors import DataError, FusionError, describe_error

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext

__all__ = ["Pool", "WorkerLost", "Workers", "available"]

T = TypeVar("T")
R = TypeVar("R")

STARTS = 3  # workers in a row that end before they begin, until the pool gives up
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"), "1"
)


@dataclass(frozen=True)
class WorkerLost:
    """The place of a result where the worker died or failed: `why`, in words."""

    why: str


class Worker:
    """One process, and the item that it works on; `result` when it has ended."""

    def __init__(self, module: str) -> None:
        context: Any = multiprocessing.get_context(_start_method())
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _without_main(), _one_thread():
            if _start_method() == "forkserver":
                _start_server(context, module)
            self.process.start()
        theirs.close()
        self.ready, self.alive = False, True
        self.item: Any = None
        self.result: Any = None
        self.died = ""

    def take(self, function: Callable[..., Any], item: Any) -> None:
        """Begin an item."""
        self.item, self.result = item, None
        self.pipe.send_bytes(pickle.dumps((function, item)))

    def hear(self) -> bool:
        """Read a message of the process; return whether its item has ended, well or not."""
        try:
            message = self.pipe.recv_bytes()
        except (EOFError, OSError):
            self.end(1.0)  # its exit status may still be on the way
            self.result = WorkerLost(f"its worker {self.died}")
            return True
        if not self.ready:
            self.ready = True
            return False
        self.result = pickle.loads(message)
        return True

    def end(self, patience: float = 0.0) -> None:
        """Kill the process, if it still runs after so many seconds, and note how it ended; once is enough."""
        if not self.alive:
            return
        self.alive = False
        self.process.join(patience)
        self.process.kill()
        self.process.join()
        self.died = _death(self.process.exitcode or 0)
        self.pipe.close()
        self.process.close()


def _death(status: int) -> str:
    """Return the end of a process in words."""
    if status >= 0:
        return f"ended with exit status {status}"
    if -status == signal.SIGKILL:
        return "was killed (SIGKILL), as the system does where memory runs out; use fewer workers if it was that"
    with suppress(ValueError):
        return f"crashed ({signal.Signals(-status).name})"
    return f"was ended by signal {-status}"


def _start_method() -> str:
    """Return the way in which processes begin: forked from one that has what they need; on Windows on their own."""
    return "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"


def _start_server(context: ForkServerContext, module: str) -> None:
    """Start the process that workers are forked from, with what they need already loaded."""
    from multiprocessing import forkserver

    context.set_forkserver_preload([__name__, module])
    forkserver.ensure_running()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Start a process whose libraries have one thread; here they are loaded already."""
    before = dict(os.environ)
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name in ONE_THREAD:
            if name in before:
                os.environ[name] = before[name]
            else:
                del os.environ[name]


@contextmanager
def _without_main() -> Iterator[None]:
    """Start a process that does not run the main script again, which need not be written for that."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _serve(pipe: Connection) -> None:
    """Work on items until there are no more: the main function of a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the one who began this one ends it
    os.environ.update(ONE_THREAD)
    keep_freed_memory()
    _end_with_parent()
    with suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("500")  # where memory runs out, the system takes a worker before the one who has all results
    pipe.send_bytes(b"ready")
    gc.freeze()  # what all workers share is not written to, so it stays shared
    with suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(_answer(pipe.recv_bytes()))
            _keep_loaded()


def _answer(asked: bytes) -> bytes:
    """Return the pickled result of a pickled function and item."""
    try:
        function, item = pickle.loads(asked)
        _limit_threads()
        return pickle.dumps(function(item), pickle.HIGHEST_PROTOCOL)
    except MemoryError:
        return pickle.dumps(WorkerLost("its worker had not enough memory; use fewer workers"))
    except Exception as error:
        return pickle.dumps(WorkerLost(failure(error)))


def failure(error: BaseException) -> str:
    """Return an error and its place, in words."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{describe_error(error)} ({'/'.join(Path(place.filename).parts[-2:])}, line {place.lineno})"


@cache
def _keep_loaded() -> None:
    """Leave what the first item has loaded out of every later search for garbage, which takes a tenth of a unit."""
    gc.collect()
    gc.freeze()


@cache
def _limit_threads() -> None:
    """Give the libraries that are loaded already one thread, which had been begun by another's server."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    threadpool_limits(1)


def _end_with_parent() -> None:
    """Have the system end this process when the one ends that has begun it, whatever this one is doing then."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "this is a worker"
    held = parent.sentinel  # of a pipe whose other end the parent alone has
    if not has_posix_locks():
        threading.Thread(target=_end_after, args=(held,), daemon=True).start()
        return
    import fcntl

    signal.signal(signal.SIGIO, signal.SIG_DFL)
    fcntl.fcntl(held, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(held, fcntl.F_SETFL, fcntl.fcntl(held, fcntl.F_GETFL) | os.O_ASYNC)
    if not parent.is_alive():
        os._exit(1)


def _end_after(parent: int) -> None:
    """End this process when the sentinel of the parent says that it has ended, once compiled code lets threads run."""
    wait([parent])
    os._exit(1)


class Workers(ABC):
    """A pool of workers. Leaving the context ends all of them, also after an interrupt."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """End the workers."""

    @abstractmethod
    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | WorkerLost]]:
        """Yield each item with the function's result of it, as they are done.

        Parameters
        ----------
        function : callable
            Importable by its name, and not from the main script. What it raises is a `WorkerLost` of that item.
        items : iterable
            Drawn as they are needed: there are never more than a few a worker in memory.

        Yields
        ------
        item, result
            In the order in which they end.

        Raises
        ------
        WorkersError
            If no worker can be had.
        """

    def ordered(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield the function's result of each item, in their order: a `driftlab.family.partitions.Engine`.

        Raises
        ------
        FusionError, ValueError
            Of the function.
        DataError
            If workers die of an item, twice.
        """
        waiting: dict[int, R] = {}
        upcoming = 0
        todo: Iterable[_Job] = ((number, function, item) for number, item in enumerate(items))
        # a worker that was killed for the memory of others need not be killed again: a lost item is tried once more
        for last in (False, True):
            lost = []
            for job, result in self.map(_outcome, todo):
                if isinstance(result, Exception):
                    raise result
                if isinstance(result, WorkerLost):
                    lost.append(job)
                    if last:
                        again = "give the same command again, what is done is not done again"
                        raise DataError(f"what the units have in common: {result.why}; {again}")
                    continue
                waiting[job[0]] = result
                while upcoming in waiting:
                    yield waiting.pop(upcoming)
                    upcoming += 1
            todo = lost

    def all_say(self, question: Callable[[], bool]) -> bool:
        """Return True if every worker that is there answers a question with True."""
        return question()


_Job = tuple[int, Callable[[Any], Any], Any]  # number, function and item


def _outcome(job: _Job) -> Any:
    """Return the function's result of an item, or its error if that is one of the data."""
    _, function, item = job
    try:
        return function(item)
    except (FusionError, ValueError) as error:
        return error


class Pool(Workers):
    """Processes of this machine, each with one item in work.

    A process that crashes or is killed loses its item, and another takes its place. Each uses one thread, since they
    share the processors; all end with the process that has begun them, however that ends.

    Parameters
    ----------
    workers : int, optional
        Number of processes; that of the processors that this process may use (affinity and control groups count).
    """

    def __init__(self, workers: int | None = None) -> None:
        self.workers = workers or available()
        self._idle: list[Worker] = []
        self._failed = 0

    def close(self) -> None:
        """End the processes."""
        while self._idle:
            self._idle.pop().end()

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | WorkerLost]]:
        """Yield each item with the function's result of it, as they are done; see `Workers.map`."""
        left, busy = iter(items), list[Worker]()
        try:
            busy += [self._begin(function, item) for item in islice(left, self.workers)]
            while busy:
                done = []
                for worker in _ended(busy):
                    busy.remove(worker)
                    if worker.ready:
                        done.append((worker.item, worker.result))
                        self._failed = 0
                        following = list(islice(left, 1))
                    else:
                        self._count_failure(worker)
                        following = [worker.item]
                    self._idle += [worker] if worker.alive else []
                    busy += [self._begin(function, item) for item in following]  # before its results are worked on
                yield from done
        finally:
            for worker in busy:
                worker.end()

    def _begin(self, function: Callable[..., Any], item: Any) -> Worker:
        """Return a worker that has the item in work."""
        while True:
            worker = (
                self._idle.pop() if self._idle else Worker(getattr(function, "func", function).__module__)
            )  # of a partial
            try:
                worker.take(function, item)
            except OSError:  # it died while it had nothing to do
                worker.end()
                self._count_failure(worker)
                continue
            return worker

    def _count_failure(self, worker: Worker) -> None:
        self._failed += 1
        if self._failed >= STARTS:
            raise WorkersError(
                f"pool: {STARTS} worker processes in a row ended before they began (the last one {worker.died}), "
                "running ones were expected; see what they say above, and whether memory is left"
            )


def _ended(busy: list[Worker]) -> list[Worker]:
    """Wait for at least one result; return the workers that have theirs, or are no more."""
    ended: list[Worker] = []
    while not ended:
        ready = wait([worker.pipe for worker in busy])
        ended = [worker for worker in busy if worker.pipe in ready and worker.hear()]
    return ended


def available() -> int:
    """Return the number of processors that this process may use."""
    from joblib import cpu_count  # type: ignore[import-untyped]

    return int(cpu_count())
