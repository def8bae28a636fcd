"""An open file as named columns that are read block after block: what a kind of file gives to its `FileSource`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from fusion_core.budget import check_regular
from fusion_core.chunk import Array
from fusion_core.errors import UnreadableFile


def head(path: Path, named: Path | None = None, most: int = 4096) -> bytes:
    """Return the first bytes of a file, `most` of them, which messages call `named` (the path by default).

    Raises
    ------
    UnreadableFile
        If it is not there, not a file (a pipe or a device never ends), or empty.
    """
    named = named or path
    try:
        check_regular(path)
        with path.open("rb") as file:
            first = file.read(most)
    except OSError as error:
        raise UnreadableFile(f"{named}: cannot be read ({error.strerror}); name an existing file") from None
    if not first:
        raise UnreadableFile(f"{named}: is empty (0 bytes); nothing was written to it, or a copy failed")
    return first


@dataclass(frozen=True)
class Block:
    """Some consecutive rows of a table: `read(path)` gives a column's values, (rows,) or (rows, d)."""

    rows: int
    read: Callable[[str], Array]


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
        """Whether `path` can be read."""
        return path in self.names

    def unit(self, path: str) -> str | None:
        """Return the unit that the file gives for `path`, as it is written there; None where it gives none."""
        return None

    def about(self, path: str) -> Mapping[str, str]:
        """Return what the file says of the device that `path` is of, by name (`device_id`); nothing by default."""
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
        finite = t[np.isfinite(t)]
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


def _first(found: np.ndarray) -> int:
    return int(np.argmax(found)) if np.any(found) else len(found)
