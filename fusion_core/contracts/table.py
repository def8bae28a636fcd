"""An open file as named columns, read block after block, and the channels of a recording: place, unit, usual names."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from fusion_core.budget import check_regular
from fusion_core.chunk import Array, Chunk
from fusion_core.errors import UnitConflict, UnitError, UnreadableFile, quote
from fusion_core.settings import Settings
from fusion_core.thermal.rate_estimators import CONDITIONED
from fusion_core.thermal.thermometer import READINGS
from fusion_core.units import convert, si_unit_of


def head(path: Path, most: int = 4096) -> bytes:
    """Return the first bytes of a file, `most` of them.

    Raises
    ------
    UnreadableFile
        If it is not there, not a file (a pipe or a device never ends), or empty.
    """
    try:
        check_regular(path)
        with path.open("rb") as file:
            first = file.read(most)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name an existing file") from None
    if not first:
        raise UnreadableFile(f"{path}: is empty (0 bytes); nothing was written to it, or a copy failed")
    return first


@dataclass(frozen=True)
class Block:
    """Some consecutive rows of a table: `read(path)` gives a column's values, (rows,) or (rows, d)."""

    rows: int
    read: Callable[[str], Array]


def row_blocks(rows: int, size: int, read: Callable[[slice, str], Array]) -> Iterator[Block]:
    """Yield blocks of `size` rows; `read` gives some rows of a column."""
    for start in range(0, rows, size):
        part = slice(start, min(start + size, rows))
        yield Block(part.stop - start, partial(read, part))


class Table(ABC):
    """An open file as named columns."""

    noun: ClassVar[str] = "column"  # what a path names in this kind of file

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Every path that can be read."""

    @abstractmethod
    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield the rows in order; `size` is how many the reader wants at a time, more or fewer are as good.

        A block gives float64, NaN where a value is missing. What it gives for a path is asked for once or not at all,
        before the next block is.
        """

    def has(self, path: str) -> bool:
        """Return True if `path` can be read."""
        return path in self.names

    def unit(self, path: str) -> str | None:
        """Return the unit that the file gives for `path`, as it is written there; None where it gives none."""
        return None

    def about(self, path: str) -> Mapping[str, str]:
        """Return the properties of the device of `path` that the file holds, by name (`device_id`); none by default."""
        return {}


@dataclass
class Window:
    """The rows from `start` up to `stop` seconds after the first one, found block by block."""

    start: float | None
    stop: float | None
    first: float = np.nan  # the first time stamp [s]
    last: float = np.nan  # the latest time stamp seen [s]
    rows: int = 0  # within the range, so far
    ended: bool = False

    def cut(self, t: Array) -> slice:
        """Return the rows of the next block that are within the range."""
        finite = t if np.isfinite(t).all() else t[np.isfinite(t)]
        if len(finite):
            self.first = finite[0] if np.isnan(self.first) else self.first
            self.last = finite[-1]
        begin = 0 if self.start is None or self.rows else _first(t - self.first >= self.start)
        end = len(t) if self.stop is None else begin + _first(t[begin:] - self.first >= self.stop)
        if self.ended:
            return slice(0, 0)
        self.ended = end < len(t)
        self.rows += end - begin
        return slice(begin, end)


def _first(flags: np.ndarray) -> int:
    return int(np.argmax(flags)) if np.any(flags) else len(flags)


class Usual(NamedTuple):
    """Unit and axes of a channel, known by its name alone.

    Attributes
    ----------
    si : str
        Its unit inside the program.
    example : str or None
        A unit as users write it; None where the channel has none.
    axes : int
        How many at most.
    """

    si: str
    example: str | None
    axes: int | None


USUAL: Mapping[str, Usual] = {
    "time": Usual("s", "s", 1),
    "gyro": Usual("rad/s", "deg/s", 3),
    "accel": Usual("m/s^2", "g", 3),
    "temperature": Usual("degC", "degC", 1),
    "valid": Usual("1", None, None),
}
"""The names that mean the same in every recording; any other name is a channel of the unit that it is given."""

DERIVED = frozenset({"dt", "tau", "residual", "excess", *CONDITIONED, *READINGS})
"""Channels that the program makes from others: a recording has none of these names."""

Name = Annotated[str, Field(min_length=1)]


def auxiliary(chunks: Iterable[Chunk]) -> list[str]:
    """Return the channels that all chunks have and that are neither a sensor's nor made by the program."""
    parts = list(chunks)
    return [
        name
        for name in (parts[0].channels if parts else ())
        if name not in DERIVED and all(name in part.channels and name not in part.sensors for part in parts)
    ]


class Channel(Settings):
    """The place of one channel in the file."""

    path: Name | Annotated[tuple[Name, ...], Field(min_length=1)]
    """The column or data set in the file; a list of them, one an axis."""
    unit: str | None = None
    """Unit as in the file, where the file does not say it; may carry a factor, as in `0.5 rad/s`."""

    @property
    def paths(self) -> tuple[str, ...]:
        """The columns or data sets of the channel."""
        return (self.path,) if isinstance(self.path, str) else self.path

    def check(self, name: str) -> None:
        """Raise UnitError where the unit is unknown or of the wrong dimension for channel `name`."""
        if self.unit is not None:
            si_of_channel(name, self.unit)

    def conversion(self, file: Path, name: str, path: str, in_file: str | None) -> tuple[str, str] | None:
        """Return the unit of `path` and the SI unit to convert it to; `found` is the unit in the file.

        Raises
        ------
        UnitError
            If channel `name` needs a unit and there is none that can be used.
        UnitConflict
            If config and file give units of the same dimension and different size.
        """
        usual = USUAL.get(name)
        si = usual.si if usual else _si(self.unit or in_file)
        theirs = None if in_file is None or si is None else _scale(in_file, si)
        if self.unit is not None and si is not None:
            if theirs is not None and not np.allclose(_scale(self.unit, si) or np.nan, theirs, rtol=1e-9, atol=0):
                ours, other = quote(self.unit), quote(in_file)
                raise UnitConflict(
                    f"{file}: channel {name} is in '{ours}' by the config and in '{other}' by the file ('{path}'); "
                    f"remove the wrong one, e.g. source.channels.{name}.unit"
                )
            return self.unit, si
        if usual and usual.example:
            advice = f"write unit: {usual.example} under source.channels.{name}"
            if in_file is None:
                raise UnitError(f"{file}: channel {name} has no unit, neither in the config nor in the file; {advice}")
            if theirs is None:
                raise UnitError(
                    f"{file}: channel {name} is in '{quote(in_file)}' by the file, which is no unit of {si}; {advice}"
                )
        return None if theirs is None or in_file is None or si is None else (in_file, si)


def si_of_channel(name: str, unit: str) -> str:
    """Return the SI unit of channel `name` given in `unit`; raises UnitError as `Channel.check`."""
    usual = USUAL.get(name)
    example = (usual and usual.example) or "hPa"
    try:
        si = si_unit_of(unit)
    except UnitError:
        raise UnitError(f"channel {name}: unit '{quote(unit)}' is not known; write it like '{example}'") from None
    if usual and _scale(unit, usual.si) is None:
        advice = f"write a unit like '{example}'" if usual.example else "it has no unit, remove it"
        raise UnitError(f"channel {name}: unit '{quote(unit)}' cannot be converted to {usual.si}; {advice}")
    return usual.si if usual else si


def _si(unit: str | None) -> str | None:
    try:
        return None if unit is None else si_unit_of(unit)
    except UnitError:
        return None


def _scale(unit: str, si: str) -> list[float] | None:
    """Return 0 and 1 `unit` in `si`, or None where the unit is unknown or of another dimension."""
    try:
        return [float(value) for value in convert([0.0, 1.0], unit, si)]
    except UnitError:
        return None
