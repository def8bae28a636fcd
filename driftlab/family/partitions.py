"""Units of a family in partitions that stay where they are, and passes over them.

A pass calls a function on each partition where that lies. What is added is added as a binary tree (`tree`) over parts
in their order, whoever worked on them: one process, a pool or a cluster come to the same, to the last bit. Results are
sums (arrays), samples or columns (lists), and these by name.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, chain, groupby, islice
from pathlib import Path
from secrets import token_hex
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from driftlab.family.unit_information import UnitInformation
from fusion_core.chunk import Integers

SIZE = 50  # units of a partition
A_FEW = 8  # of a partition of a sample, of which each takes its time
BLOCKS = 64  # of partitions, that a pass has at most: what a worker is given at once

R = TypeVar("R")
C = TypeVar("C", covariant=True)
UnitOfLot = tuple[UnitInformation, str]


def by_lot(lots: Iterable[str]) -> dict[str, Integers]:
    """Return the places of the units of each lot, in the order of the lots' first units; `lots` are of all units."""
    places: dict[str, list[int]] = {}
    for k, lot in enumerate(lots):
        places.setdefault(lot, []).append(k)
    return {lot: np.array(own, dtype=np.intp) for lot, own in places.items()}


class Engine(Protocol):
    """The results of a function of each item, in the items' order, as `map` has them; whoever computes them.

    The function is importable by its name, or a `functools.partial` of one, so that another process may call it.
    """

    def __call__(self, function: Callable[[Any], R], items: Iterable[Any]) -> Iterator[R]:
        """Yield the result of each item."""
        ...


serial: Engine = map  # type: ignore[assignment]  # in this process


class Partition(Protocol[C]):
    """The place of a partition, which may be sent to where it is read."""

    def __len__(self) -> int: ...

    def read(self) -> C:
        """Return its content: a sequence of units, or what is kept of them."""
        ...


@dataclass(frozen=True, eq=False)
class InMemory(Generic[C]):
    """A partition in memory."""

    content: C
    count: int

    def __len__(self) -> int:
        return self.count

    def read(self) -> C:
        """Return its content."""
        return self.content


class Scratch(Protocol):
    """A place for files that the passes of one command need, which all who work on them see."""

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        ...

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all: a worker may end, or two may do the same."""
        ...

    def files(self, names: Sequence[str]) -> AbstractContextManager[list[Path]]:
        """Give files paths here, until the end of the block."""
        ...


@dataclass(frozen=True)
class ScratchFolder:
    """Such a place in a file system."""

    path: Path

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        return (self.path / name).read_bytes()

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all."""
        new = self.path / f"{name}.{token_hex(6)}"
        new.write_bytes(content)
        os.replace(new, self.path / name)

    @contextmanager
    def files(self, names: Sequence[str]) -> Iterator[list[Path]]:
        """Give the paths of files."""
        yield [self.path / name for name in names]


@dataclass(frozen=True)
class InFile:
    """A partition in a file that a worker wrote."""

    scratch: Scratch
    name: str
    count: int

    def __len__(self) -> int:
        return self.count

    def read(self) -> Any:
        """Return its content."""
        return pickle.loads(self.scratch.read(self.name))


@dataclass(frozen=True, eq=False)
class ChosenUnits:
    """Some of the units of partitions: of each its partition, none of which is of chosen ones, and its place there."""

    units: tuple[tuple[Partition[Sequence[UnitOfLot]], int], ...]

    def __len__(self) -> int:
        return len(self.units)

    def read(self) -> list[UnitOfLot]:
        """Return the units; of those in folders no others are read."""
        units = list[UnitOfLot]()
        for _, some in groupby(self.units, lambda one: id(one[0])):  # of rising places: each partition once
            part, places = zip(*some, strict=True)
            content = part[0].read()
            units += [content[k] for k in places]
        return units


@dataclass(frozen=True, eq=False)
class Partitions(Generic[C]):
    """Partitions of units in their order, and who works on them.

    Attributes
    ----------
    parts : sequence of Partition
    engine : Engine
    scratch : Scratch or None
        Where workers keep what is to stay; None: in memory.
    """

    parts: Sequence[Partition[C]]
    engine: Engine = serial
    scratch: Scratch | None = None

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def map(self, function: Callable[..., R], *of_units: Any) -> Iterator[R]:
        """Yield the function's result of each partition, in their order.

        Parameters
        ----------
        function : callable
            Of the content of a partition, and of its units' part of each of `of_units`.
        of_units : sequences
            Of as many items as there are units.
        """
        return chain.from_iterable(self.engine(partial(_each, function), self._blocks(of_units)))

    def keep(self, name: str, function: Callable[..., R], *of_units: Any) -> Partitions[R]:
        """Return the function's results as partitions, which stay where they were made; see `map`."""
        if self.scratch is None:
            results = self.map(function, *of_units)
            held = [InMemory(result, len(part)) for part, result in zip(self.parts, results, strict=True)]
            return Partitions(held, self.engine)
        own = f"{name}-{token_hex(6)}"  # no worker of another pass, or of a command that has ended, writes these
        files = [InFile(self.scratch, f"{own}-{k}", len(part)) for k, part in enumerate(self.parts)]
        places = [[file] * len(file) for file in files]
        for _ in self.map(partial(_write, function), [*chain.from_iterable(places)], *of_units):
            pass
        return Partitions(files, self.engine, self.scratch)

    def chosen(self: Partitions[Sequence[UnitOfLot]], places: Iterable[int], size: int = SIZE) -> (
        Partitions[Sequence[UnitOfLot]]
    ):  # fmt: skip
        """Return the units at some places, in their order, in partitions of `size`."""
        left, parts = iter(sorted(places)), []
        starts = [*accumulate(map(len, self.parts), initial=0)]
        at = 0
        while some := list(islice(left, size)):
            units = []
            for place in some:
                while place >= starts[at + 1]:
                    at += 1
                part, k = self.parts[at], place - starts[at]
                units.append(part.units[k] if isinstance(part, ChosenUnits) else (part, k))
            parts.append(ChosenUnits(tuple(units)))
        return Partitions(parts, self.engine, self.scratch)

    def read(self: Partitions[Sequence[UnitOfLot]]) -> Iterator[UnitOfLot]:
        """Yield the units, read here one after the other."""
        for part in self.parts:
            yield from part.read()

    def _blocks(self, of_units: Sequence[Any]) -> Iterator[list[tuple[Any, ...]]]:
        """Yield the partitions with their units' part of `of_units`, in at most BLOCKS blocks."""
        size = max(1, -(-len(self.parts) // BLOCKS))
        starts = [*accumulate(map(len, self.parts), initial=0)]
        for first in range(0, len(self.parts), size):
            yield [
                (part, *(own[starts[first + k] : starts[first + k + 1]] for own in of_units))
                for k, part in enumerate(self.parts[first : first + size])
            ]


FamilyUnits = Partitions[Sequence[UnitOfLot]] | Sequence[UnitOfLot]
"""The units of a family with their lots, in partitions or in memory."""


def in_partitions(units: FamilyUnits, size: int = SIZE) -> Partitions[Sequence[UnitOfLot]]:
    """Return units in memory in partitions of `size`; those that are in some already as they are."""
    if isinstance(units, Partitions):
        return units
    cuts = range(0, len(units), size)
    return Partitions([InMemory(units[k : k + size], len(units[k : k + size])) for k in cuts])


def added(one: Any, other: Any) -> Any:
    """Return the sum of two results: arrays are added, lists one after the other, tuples and names each by itself."""
    if isinstance(one, tuple):
        return tuple(map(added, one, other))
    if isinstance(one, dict):
        both = {name: added(value, other[name]) if name in other else value for name, value in one.items()}
        return {**other, **both}
    return one + other


def tree(leaves: Iterable[R]) -> R:
    """Return the sum of at least one leaf, as a binary tree over them in their order."""
    held: list[tuple[int, R]] = []  # levels fall
    for leaf in leaves:
        level, value = 0, leaf
        while held and held[-1][0] == level:
            level, value = level + 1, added(held.pop()[1], value)
        held.append((level, value))
    _, value = held.pop()
    while held:
        value = added(held.pop()[1], value)
    return value


def _each(function: Callable[..., R], block: Sequence[tuple[Any, ...]]) -> list[R]:
    return [function(part.read(), *of_units) for part, *of_units in block]


def _write(function: Callable[..., Any], content: Any, places: Sequence[InFile], *of_units: Any) -> None:
    """Write the function's result of a partition into its file."""
    place, result = places[0], function(content, *of_units)
    place.scratch.write(place.name, pickle.dumps(result, pickle.HIGHEST_PROTOCOL))
