"""The workers of a Dask cluster, where one machine is not enough; of the extra `driftlab[dask]`."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib import metadata
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, Self, TypeVar

from driftlab import __version__
from driftlab.errors import WorkersError
from driftlab.production.workers import WorkerLost, Workers, failure
from fusion_core.errors import describe_error, quote

T = TypeVar("T")
R = TypeVar("R")

AHEAD = 2  # items a thread of a worker: one in work, one that waits beside it
LOOK = 2.0  # s between looks at who is there


class Blamed(WorkerLost):
    """The place of a result that was in work or waited each time that a worker died, until Dask gave up."""


class Scheduler(Workers):
    """The workers of a Dask cluster; see `driftlab.production.workers.Workers`.

    An item whose worker is killed goes to another one, as often as the scheduler's `allowed-failures` says. Dask blames
    an item that waited on the same workers as well; where it blames several, each is tried once more, alone, and only
    an item that kills its workers then is `WorkerLost`. Workers may come and go; each says its versions before it is
    asked for anything else.

    Parameters
    ----------
    address : str
        Of the scheduler, as `tcp://10.0.0.1:8786`.
    patience : float
        Seconds to wait for the scheduler, and for a worker where there is none.

    Raises
    ------
    WorkersError
        If `distributed` is not installed, nobody answers at the address, no worker is there, or one has other versions
        of Python or driftlab than this process.
    """

    def __init__(self, address: str, patience: float = 60.0) -> None:
        self.address, self.patience = address, patience
        self._checked: set[str] = set()  # addresses of workers whose versions are those of this process

    def __enter__(self) -> Self:
        try:
            from distributed import Client
        except ImportError:
            raise WorkersError(
                f"--scheduler {self.address}: the package distributed is not installed, it was expected for Dask; "
                "pip install 'driftlab[dask]'"
            ) from None
        try:
            self._client = Client(self.address, timeout=self.patience, set_as_default=False)
        except (OSError, ValueError) as error:
            raise WorkersError(
                f"--scheduler {quote(self.address, 200)}: no Dask scheduler answers there "
                f"({describe_error(error)}); start one "
                "with dask scheduler, and give the address that it says, as tcp://10.0.0.1:8786"
            ) from None
        return self

    def close(self) -> None:
        """Leave the cluster; its workers stay."""
        self._client.close()

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | WorkerLost]]:
        """Yield each item with the function's result of it, as they are done; see `Workers.map`."""
        blamed: list[tuple[T, Blamed]] = []
        for item, result in self._map(function, items):
            if isinstance(result, Blamed):
                blamed.append((item, result))
            else:
                yield item, result
        if len(blamed) == 1:
            yield from blamed
            return
        for item, _ in blamed:
            yield from self._map(function, [item])

    def _map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | WorkerLost]]:
        """Yield each item with the function's result of it; those that Dask gives up are `Blamed`."""
        left, done = iter(items), SimpleQueue[Any]()
        flying: dict[str, tuple[Any, T]] = {}
        room = AHEAD * self._threads()
        looked = time.monotonic()
        try:
            while True:
                for item in islice(left, max(0, room - len(flying))):
                    future = self._client.submit(function, item, pure=False)
                    flying[future.key] = future, item
                    future.add_done_callback(done.put)
                if not flying:
                    return
                with suppress(Empty):
                    future, item = flying.pop(done.get(timeout=LOOK).key)
                    yield item, self._result(future)
                    future.release()
                if time.monotonic() - looked > LOOK:
                    room = AHEAD * self._threads()
                    looked = time.monotonic()
        finally:
            for future, _ in flying.values():
                future.release()

    def _result(self, future: Any) -> Any:
        """Return the result of a future that is done."""
        from distributed import CancelledError, KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            return Blamed(
                f"{error.allowed_failures + 1} workers died one after the other while they had it (the last one at "
                f"{error.last_worker.address}): they were killed, crashed, or met their --memory-limit"
            )
        except CancelledError:
            raise self._gone() from None
        except MemoryError:
            return WorkerLost("its worker had not enough memory; use fewer threads a worker")
        except Exception as error:
            return WorkerLost(failure(error))

    def all_say(self, question: Callable[[], bool]) -> bool:
        """Return True if every worker that is there answers a question with True."""
        self._threads()
        return all(answer is True for answer in self._client.run(question, on_error="return").values())

    def _threads(self) -> int:
        """Return the number of threads of the workers, as soon as there is one; each new worker says its versions."""
        end = time.monotonic() + self.patience
        while True:
            try:
                threads = self._client.nthreads()
                self._compare(set(threads) - self._checked)
            except OSError:
                raise self._gone() from None
            if threads:
                return sum(threads.values())
            if time.monotonic() > end:
                raise WorkersError(
                    f"--scheduler {self.address}: has had no worker for {self.patience:g} s, at least one was "
                    f"expected; start some with dask worker {self.address} --nworkers auto"
                )
            time.sleep(0.1)

    def _compare(self, addresses: set[str]) -> None:
        """Ask workers for their versions, by functions that every Python has."""
        if not addresses:
            return
        here = (platform.python_version().rpartition(".")[0], __version__)
        ask: dict[str, Any] = {"workers": sorted(addresses), "on_error": "return"}
        pythons = self._client.run(platform.python_version, **ask)
        driftlabs = self._client.run(metadata.version, "driftlab", **ask)
        for address in sorted(set(pythons) & set(driftlabs)):
            python, version = pythons[address], driftlabs[address]
            if isinstance(python, OSError) or isinstance(version, OSError):
                continue  # it has gone meanwhile
            theirs = (str(python).rpartition(".")[0], None if isinstance(version, Exception) else version)
            if theirs != here:
                raise WorkersError(
                    f"--scheduler {self.address}: the worker {address} has Python {theirs[0]} and "
                    f"{f'driftlab {theirs[1]}' if theirs[1] else 'no driftlab'}, Python {here[0]} and driftlab "
                    f"{here[1]} were expected, as they are here; install the same in both places"
                )
            self._checked.add(address)

    def _gone(self) -> WorkersError:
        return WorkersError(
            f"--scheduler {self.address}: does not answer any more; start it and its workers again, and the same "
            "command: what is done is not done again"
        )
