"""Who goes through units: the process that asks, or several for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")

BATCH = 10  # items that a process is given at once


class ParallelMap(Protocol):
    """Yields what a function makes of each item, in their order, as `map` does.

    The function is importable by its name, or a `functools.partial` of one, so that another process may call it; at
    most a few batches of `at_once` items a process are in memory.
    """

    def __call__(self, function: Callable[[T], R], items: Iterable[T], *, at_once: int = BATCH) -> Iterator[R]:
        """Yield what the function makes of each item."""
        ...


def serial(function: Callable[[T], R], items: Iterable[T], *, at_once: int = BATCH) -> Iterator[R]:
    """Yield what a function makes of each item, all in this process: an `ParallelMap`."""
    return map(function, items)
