"""Records of a log as arrays, and its streams on one time base.

A log keeps each sensor under its own time stamps, a filter wants rows.

::

    a stream about as fast as the rows, or faster:   the sample that is nearest in time   (its noise stays what it is)
    a slower one (a thermometer):                    a straight line between its samples

Where no sample is near enough a row has NaN, so that it is left out and counted like any other that lacks a value.
A table has one time for all columns; one of a thermometer that is empty in most rows is a slower stream all the same.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array, Bytes, Chunk, Flags, Integers, concatenate
from fusion_core.contracts import FileSource
from fusion_core.errors import UnreadableFile
from fusion_core.faults import RANGES, Faults

SLOWER = 2.0  # times the rows' interval: from there on a stream is drawn through, not picked from
NEAR = 1.5  # intervals of the slower of the two: farther away is no sample of that row
HOLE = 10.0  # intervals of a slow stream without a sample: no line is drawn across

FIRST, LEAST = 11, 5  # readings that tell how often a thermometer is read, and at least
HELD = 1 << 18  # rows in which they are looked for

SPAN, FEW = 1 << 23, 100  # bytes of a log in memory at once, and places for which none is given back
PATH = re.compile(r"(\w+?)(?:\[(\d+)\])?\.(.+)")


class FieldPath(NamedTuple):
    """A path `NAME.FIELD`, or `NAME[2].FIELD` of one of several sensors, taken apart."""

    name: str
    number: int | None
    field: str


def taken_apart(path: str) -> FieldPath | None:
    """Return the parts of a path, None where it is none."""
    match = PATH.fullmatch(path)
    return None if match is None else FieldPath(match[1], None if match[2] is None else int(match[2]), match[3])


def mapped(path: Path) -> Bytes:
    """Return the bytes of a log, read when they are asked for; raises UnreadableFile where they cannot be mapped."""
    try:
        return np.asarray(np.memmap(path, np.uint8, "r"))
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); free memory, or copy it again") from None


def release(data: Bytes | bytes) -> None:
    """Let the system have the memory back in which it holds what was read of a mapped file; it reads it again."""
    base: Any = data
    while base is not None and not isinstance(base, mmap.mmap):
        base = getattr(base, "base", None)
    if base is not None and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def joined(t: Array, sampled: Array, values: Array, step: float | None = None, spacing: float | None = None) -> Array:
    """Return the values of a stream at the times of other rows.

    Parameters
    ----------
    t : (N,) array
        Times of the rows, s, rising.
    sampled : (M,) array
        Times of the stream's samples, s, rising.
    values : (M,) or (M, d) array
        The samples.
    step : float, optional
        The rows' interval, s, where these are a few of many; that of `t` by default.
    spacing : float, optional
        The stream's interval, s, likewise.

    Returns
    -------
    (N,) or (N, d) array
        NaN where the stream has no sample near enough.
    """
    result = np.full((len(t), *values.shape[1:]), np.nan)
    if len(sampled) == 0 or len(t) == 0:
        return result
    step = interval(t) if step is None else step
    spacing = interval(sampled) if spacing is None else spacing
    after = np.clip(np.searchsorted(sampled, t), 1, max(len(sampled) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(sampled) - 1)
    nearest = np.where(t - sampled[before] <= sampled[after] - t, before, after)
    near = np.abs(sampled[nearest] - t) <= NEAR * max(step, spacing)
    if not spacing > SLOWER * step or len(sampled) == 1:
        result[near] = values[nearest[near]]
        return result
    width = sampled[after] - sampled[before]
    share = np.clip((t - sampled[before]) / np.where(width > 0, width, 1.0), 0.0, 1.0)  # the end's value beyond it
    share = np.where(width <= HOLE * spacing, share, np.round(share)).reshape(-1, *[1] * (values.ndim - 1))
    good = np.where((t < sampled[0]) | (t > sampled[-1]), near, (width <= HOLE * spacing) | near)
    result[good] = ((1 - share) * values[before] + share * values[after])[good]
    return result


class TableSource(FileSource):
    """A file of rows with one time; the temperature of one that few rows have is drawn between these."""

    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the range."""
        return bridged(super().chunks(size, faults), size, faults)


def bridged(chunks: Iterable[Chunk], size: int, faults: Faults) -> Iterator[Chunk]:
    """Pass on the chunks of a table, of `size` rows at most; a thermometer that few rows read is a stream of its own.

    Law: rows and values are the same however the rows are cut into chunks.
    """
    stream = iter(chunks)
    head: list[Chunk] = []
    rows = readings = 0
    for chunk in stream:
        head.append(chunk)
        if "temperature" not in chunk.channels:
            break
        rows, readings = rows + len(chunk), readings + int(np.sum(_readings(chunk)))
        if readings >= FIRST or rows >= HELD:
            break
    spacing = _spacing(head)
    if spacing is None:
        yield from head
        yield from stream
        return
    thermometer = _Thermometer(spacing, faults)
    done = (thermometer.take(stop) for chunk in chain(head, stream) if (stop := thermometer.hold(chunk)))
    for part in chain(done, thermometer.rest()):
        yield from (part.part(start, start + size) for start in range(0, len(part), size))


def _readings(chunk: Chunk) -> Flags:
    """Return the rows (N,) that have a reading of the thermometer."""
    low, high, _ = RANGES["temperature"]
    T = chunk["temperature"]
    return np.isfinite(chunk.t) & (low <= T) & (high >= T)


def _spacing(head: list[Chunk]) -> float | None:
    """Return the usual time between readings, s, by the first rows; None where there is one in nearly every row."""
    if not head or "temperature" not in head[-1].channels:
        return None
    rows = concatenate(head)
    at = np.flatnonzero(_readings(rows)[:HELD])[:FIRST]
    if len(at) < LEAST or not np.median(np.diff(at)) > 1:
        return None
    spacing = interval(rows.t[at])
    return spacing if spacing > 0 else None


class _Thermometer:
    """The rows since the last reading, which wait for the next one, and what is said of them all."""

    def __init__(self, spacing: float, faults: Faults) -> None:
        self.spacing, self.faults = spacing, faults
        self.held: list[Chunk] = []
        self.t = self.T = np.empty(0)  # of the last reading
        self.rows = self.readings = self.open = 0
        self.longest, self.note = 0.0, ""

    def hold(self, chunk: Chunk) -> int:
        """Keep the next rows; return how many of those that are held need not wait."""
        before = sum(map(len, self.held))
        self.held.append(chunk)
        at = np.flatnonzero(_readings(chunk))
        if len(at):
            return before + int(at[-1]) + 1
        now = float(chunk.t[-1])
        if len(self.t) and now - self.t[0] > HOLE * self.spacing:
            t = np.concatenate([rows.t for rows in self.held])
            return int(np.argmax(t >= now - NEAR * self.spacing))
        return before if before > 8 * HELD else 0  # of a time that does not go on

    def take(self, stop: int) -> Chunk:
        """Return the first rows that are held, with their temperature, but for those of a reading and nothing else."""
        rows = concatenate(self.held)
        self.held = [rest] if len(rest := rows.part(stop, len(rows))) else []
        rows = rows.part(0, stop)
        read = _readings(rows)
        t, T = np.append(self.t, rows.t[read]), np.append(self.T, rows["temperature"][read])
        values = rows["temperature"].copy()
        empty = np.isnan(values)
        values[empty] = joined(rows.t[empty], t, T, 0.0, self.spacing)
        widths = np.diff(t)
        self.longest = max(self.longest, float(np.max(widths[widths <= HOLE * self.spacing], initial=0.0)))
        self.t, self.T = t[-1:], T[-1:]
        self.rows, self.readings = self.rows + stop, self.readings + int(np.sum(read))
        self.open += int(np.sum(np.isnan(values)))
        self._say()
        others = [v.reshape(len(rows), -1) for name, v in rows.channels.items() if name != "temperature"]
        alone = read & np.all(np.isnan(np.hstack(others)), axis=1) if others else np.zeros(stop, dtype=bool)
        return rows.having(temperature=values).where(~alone)

    def rest(self) -> Iterator[Chunk]:
        """Yield the rows behind the last reading."""
        if self.held:
            yield self.take(sum(map(len, self.held)))

    def _say(self) -> None:
        self.faults.found.pop(self.note, None)
        left = f"; gaps of more than {HOLE * self.spacing:.4g} s are left as they are" if self.open else ""
        self.note = (
            f"temperature has a reading in {self.readings:,} of {self.rows:,} rows, every {self.spacing:.4g} s; "
            f"it is interpolated in time between them, over {self.longest:.4g} s at most{left}"
        )
        self.faults.note(self.note)


def interval(t: Array) -> float:
    """Return the usual time between samples, s; 0 where there is one."""
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0


def records(data: Bytes | bytes, at: Integers, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the values (N,), of arrays (N, k), that begin at places `at` (N,) of the bytes, which rise.

    What of a mapped file is held in memory for it is given back, piece by piece: a log is larger than what it takes,
    and the system may hold megabytes of it for one place.
    """
    size = dtype.itemsize
    # every place in the data where one could begin, without a copy
    windows = np.ndarray((max(len(data) - size + 1, 0),), f"V{size}", data, strides=(1,))
    values = np.empty(len(at), windows.dtype)
    for start, stop in pairwise([*np.flatnonzero(np.diff(at // SPAN, prepend=-1)), len(at)]):
        values[start:stop] = windows[at[start:stop]]
        if len(at) > FEW:
            release(data)
    return values.view(dtype.base).reshape(len(at), *dtype.shape)
