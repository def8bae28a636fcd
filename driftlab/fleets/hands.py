"""What is done for each unit of a fleet when all are soaked, by several processes, in the units' order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from types import TracebackType
from typing import Any, Self, TypeVar

from driftlab.family.each import BATCH, alone
from driftlab.fleets.kept import Kept, Place
from driftlab.fleets.workers import Lost, Pool
from fusion_core.errors import DataError, FusionError

T = TypeVar("T")
R = TypeVar("R")

ALONE = 100  # units for which no further process is begun


class Hands:
    """Processes of this machine that go through units: an `Each` (`driftlab.family.each`), and a context manager.

    Units of a `Kept` are read where they are worked on.

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
            If a process dies.
        """
        if self._pool is None:
            return alone(function, items)
        given: object = items
        if isinstance(given, Kept):
            return self._shared(self._pool, partial(_read_and, function), given.places(), at_once)
        return self._shared(self._pool, function, items, at_once)

    def _shared(self, pool: Pool, function: Callable[[Any], R], items: Iterable[Any], at_once: int) -> Iterator[R]:
        waiting: dict[int, list[R]] = {}
        upcoming = 0
        for batch, found in pool.map(_do, _batches(function, items, at_once)):
            if isinstance(found, Lost):
                again = "give the same command again, what is done is not done again"
                raise DataError(f"what the units have in common: {found.why}; {again}")
            if isinstance(found, Exception):
                raise found
            waiting[batch.number] = found
            while upcoming in waiting:
                yield from waiting.pop(upcoming)
                upcoming += 1


@dataclass(frozen=True)
class _Batch:
    number: int
    function: Callable[[Any], Any]
    items: list[Any]


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


def _read_and(function: Callable[[Any], R], place: Place) -> R:
    return function(place.read())
