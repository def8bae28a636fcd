"""What is done for each unit of a fleet when all are soaked, by several processes, in the units' order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from types import TracebackType
from typing import Any, Self, TypeVar

from driftlab.family.parallel import BATCH, serial
from driftlab.production.store import UnitRef, UnitStore
from driftlab.production.workers import Pool, WorkerLost
from fusion_core.errors import DataError, FusionError

T = TypeVar("T")
R = TypeVar("R")

ALONE = 100  # units for which no further process is begun


class OrderedPool:
    """Processes of this machine that go through units: an `Each` (`driftlab.family.parallel`), and a context manager.

    Units of a `UnitStore` are read where they are worked on.

    Parameters
    ----------
    units : int
        How many there are; up to ALONE of them no process is begun for.
    workers : int, optional
        Processes; as many as there are processors.
    """

    def __init__(self, units: int, workers: int | None = None) -> None:
        self._pool = Pool(workers) if units > ALONE else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.__exit__(kind, error, trace)

    def __call__(self, function: Callable[[T], R], items: Iterable[T], *, at_once: int = BATCH) -> Iterator[R]:
        """Yield what a function makes of each item, in their order.

        Raises
        ------
        FusionError, ValueError
            What the function raises.
        DataError
            If processes die of it, twice.
        """
        if self._pool is None:
            return serial(function, items)
        given: object = items
        if isinstance(given, UnitStore):
            return self._shared(self._pool, partial(_read_and, function), given.places(), at_once)
        return self._shared(self._pool, function, items, at_once)

    def _shared(self, pool: Pool, function: Callable[[Any], R], items: Iterable[Any], at_once: int) -> Iterator[R]:
        waiting: dict[int, list[R]] = {}
        upcoming, lost = 0, list[_Batch]()
        # who was killed for the memory of others need not be killed again: what is lost is tried a second time
        for batch, found in chain(pool.map(_do, _batches(function, items, at_once)), _again(pool, lost)):
            if isinstance(found, WorkerLost):
                if batch.again:
                    again = "give the same command again, what is done is not done again"
                    raise DataError(f"what the units have in common: {found.why}; {again}")
                lost.append(replace(batch, again=True))
                continue
            if isinstance(found, Exception):
                raise found
            waiting[batch.number] = found
            while upcoming in waiting:
                yield from waiting.pop(upcoming)
                upcoming += 1


def _again(pool: Pool, lost: list[_Batch]) -> Iterator[tuple[_Batch, Any]]:
    """Yield what comes of the batches that were lost until this is asked for."""
    yield from pool.map(_do, list(lost))


@dataclass(frozen=True)
class _Batch:
    number: int
    function: Callable[[Any], Any]
    items: list[Any]
    again: bool = False


def _batches(function: Callable[[Any], Any], items: Iterable[Any], at_once: int) -> Iterator[_Batch]:
    left, number = iter(items), 0
    while some := list(islice(left, at_once)):
        yield _Batch(number, function, some)
        number += 1


def _do(batch: _Batch) -> list[Any] | Exception:
    """Return what the function makes of a batch, or what it raises that has an answer."""
    try:
        return [batch.function(item) for item in batch.items]
    except (FusionError, ValueError) as error:
        return error


def _read_and(function: Callable[[Any], R], place: UnitRef) -> R:
    return function(place.read())
