"""Serial and parallel map over units."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")

BATCH = 10  # items that a process is given at once


class ParallelMap(Protocol):
    """Yields the results of a function of each item, in their order, as `map` does.

    The function is importable by its name, or a `functools.partial` of one, so that another process may call it; at
    most a few batches of `at_once` items a process are in memory.
    """

    def __call__(self, function: Callable[[T], R], items: Iterable[T], *, at_once: int = BATCH) -> Iterator[R]:
        """Yield the result of each item."""
        ...


def serial(function: Callable[[T], R], items: Iterable[T], *, at_once: int = BATCH) -> Iterator[R]:
    """Yield the results of a function of each item, all in this process: a `ParallelMap`."""
    return map(function, items)
