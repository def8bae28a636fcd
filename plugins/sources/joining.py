"""Records of a log as arrays, and its streams on one time base.

A log keeps each sensor under its own time stamps, a filter wants rows.

::

    a stream about as fast as the rows, or faster:   the sample that is nearest in time   (its noise stays what it is)
    a slower one (a thermometer):                    a straight line between its samples

Where no sample is near enough a row has NaN, so that it is left out and counted like any other that lacks a value.
A table has one time for all columns; one that is empty in most of the gyro's rows is a stream of its own all the same.
"""

from __future__ import annotations

import mmap
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array, Bytes, Chunk, Flags, Integers, concatenate
from fusion_core.contracts import FileSource
from fusion_core.errors import UnreadableFile
from fusion_core.faults import LARGEST, RANGES, Faults

SLOWER = 2.0  # times the rows' interval: from there on a stream is drawn through, not picked from
NEAR = 1.5  # intervals of the slower of the two: farther away is no sample of that row
HOLE = 10.0  # intervals of a slow stream without a sample: no line is drawn across

FIRST, LEAST = 11, 3  # readings that tell how often a channel of a table is read, and at least
HELD = 1 << 18  # rows in which they are looked for

SPAN, FEW = 1 << 21, 100  # bytes of a log in memory at once, and places for which none is given back
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
    """A file of rows with one time; channels that few of its rows have are drawn between these."""

    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the range."""
        return bridged(super().chunks(size, faults), size, faults)


def bridged(chunks: Iterable[Chunk], size: int, faults: Faults) -> Iterator[Chunk]:
    """Pass on the chunks of a table, of `size` rows at most; a channel that few rows have is a stream of its own.

    The rows are those of the gyro, else of the accelerometers, else of the first channel that is no temperature. That
    channel is no stream: where its cells are empty, nothing was measured.

    Law: rows and values are the same however the rows are cut into chunks.
    """
    rest = iter(chunks)
    head = _head(rest)
    streams = _streams(head, faults)
    if not streams:
        yield from head
        yield from rest
        return
    waiting = _Waiting(streams)
    done = (waiting.take(stop) for chunk in chain(head, rest) if (stop := waiting.hold(chunk)))
    for part in chain(done, waiting.rest()):
        yield from (part.part(start, start + size) for start in range(0, len(part), size))


def _leading(chunk: Chunk) -> str | None:
    """Return the channel whose rows these are; None where there is none but a temperature."""
    names = [name for name in chunk.channels if name not in ("temperature", "valid")]
    return next((name for name in ("gyro", "accel", *names) if name in names), None)


def _others(chunk: Chunk) -> list[str]:
    """Return the channels that may be streams of their own."""
    return [name for name in chunk.channels if name not in (_leading(chunk), "valid")]


def _readings(chunk: Chunk, name: str) -> Flags:
    """Return the rows (N,) that have a reading of a channel."""
    low, high, _ = RANGES.get(name, (-LARGEST, LARGEST, ""))
    good = (low <= chunk[name]) & (high >= chunk[name])
    valid = np.all(chunk["valid"].reshape(len(chunk), -1) != 0, axis=1) if "valid" in chunk.channels else True
    return np.isfinite(chunk.t) & (good if good.ndim == 1 else np.all(good, axis=1)) & valid


def _head(stream: Iterator[Chunk]) -> list[Chunk]:
    """Return the first chunks: those that show how often each channel has a reading."""
    head: list[Chunk] = []
    rows, count = 0, Counter[str]()
    for chunk in stream:
        head.append(chunk)
        others = _others(chunk)
        names = {*others, _leading(chunk) or others[0]} if others else set()
        rows += len(chunk)
        count.update({name: int(np.sum(_readings(chunk, name))) for name in names if count[name] < FIRST})
        if rows >= HELD or all(count[name] >= FIRST for name in names):
            break
    return head


def _streams(head: list[Chunk], faults: Faults) -> list[_Stream]:
    """Return the channels that few of the first rows have."""
    if not head or not _others(head[0]):
        return []
    rows, streams = concatenate(head).part(0, HELD), []
    leading = _leading(rows)
    own = np.isfinite(rows.t) if leading is None else _readings(rows, leading)
    own = own if np.any(own) else np.isfinite(rows.t)
    first = np.flatnonzero(own)[:FIRST]
    for name in _others(rows):
        read = _readings(rows, name)
        at = np.flatnonzero(read)[:FIRST]
        if len(at) < LEAST or len(first) < LEAST:
            continue
        shown = max(at[-1], first[-1]) + 1
        together = np.flatnonzero(read[:shown][own[:shown]])
        spacing = interval(rows.t[at])
        apart = len(together) < 2
        if spacing > 0 and (apart or np.median(np.diff(together)) >= 2):
            # the noise of a sensor about as fast as the rows stays what it is; anything else is drawn through
            step = interval(rows.t[first]) if rows[name].ndim > 1 else 0.0
            streams.append(_Stream(name, rows[name][:0], step, spacing, faults, apart=apart))
    return streams


class _Stream:
    """A channel that few rows have: its last reading, and what is said of all of them."""

    def __init__(self, name: str, none: Array, step: float, spacing: float, faults: Faults, *, apart: bool) -> None:
        self.name, self.step, self.spacing, self.faults = name, step, spacing, faults
        self.apart = apart  # whether its readings have rows of their own
        self.t, self.values = np.empty(0), none  # of the last reading in a row that was taken
        self.last = np.nan  # time of the last reading
        self.ready = 0  # how many of the rows that are held need not wait for another one
        self.rows = self.readings = self.open = 0
        self.longest, self.note = 0.0, ""

    def look(self, chunk: Chunk, held: list[Chunk]) -> int:
        """Look at the chunk that is held last; return how many rows need not wait."""
        before = sum(map(len, held)) - len(chunk)
        at = np.flatnonzero(_readings(chunk, self.name))
        now = float(chunk.t[-1])
        if len(at):
            self.ready, self.last = before + int(at[-1]) + 1, float(chunk.t[at[-1]])
        elif now - self.last > HOLE * self.spacing:
            t = np.concatenate([rows.t for rows in held])
            self.ready = max(self.ready, int(np.argmax(t >= now - NEAR * self.spacing)))
        elif before > 8 * HELD:  # of a time that does not go on
            self.ready = before
        return self.ready

    def filled(self, rows: Chunk, stop: int) -> Array:
        """Return the values of the first rows that are held, and count these."""
        read = _readings(rows, self.name)
        t, known = np.append(self.t, rows.t[read]), np.concatenate([self.values, rows[self.name][read]])
        values = rows[self.name][:stop].copy()
        empty = np.isnan(values) if values.ndim == 1 else np.any(np.isnan(values), axis=1)
        drawn = joined(rows.t[:stop][empty], t, known, self.step, self.spacing)
        values[empty] = np.where(np.isnan(values[empty]), drawn, values[empty])
        readings = int(np.sum(read[:stop]))
        done = len(self.t) + readings
        widths = np.diff(t[:done])
        self.longest = max(self.longest, float(np.max(widths[widths <= HOLE * self.spacing], initial=0.0)))
        self.t, self.values = t[:done][-1:], known[:done][-1:]
        self.rows, self.readings, self.ready = self.rows + stop, self.readings + readings, self.ready - stop
        self.open += int(np.sum(np.isnan(values).reshape(stop, -1).any(axis=1)))
        self._say()
        return values

    def _say(self) -> None:
        self.faults.found.pop(self.note, None)
        if self.spacing > SLOWER * self.step:
            done = f"it is interpolated in time between them, over {self.longest:.4g} s at most"
            left = f"gaps of more than {HOLE * self.spacing:.4g} s are left as they are"
        else:
            done = "each row takes the nearest of them"
            left = f"rows more than {NEAR * max(self.step, self.spacing):.4g} s from one are left as they are"
        self.note = (
            f"{self.name} has a reading in {self.readings:,} of {self.rows:,} rows, every {self.spacing:.4g} s; {done}"
            + (f"; {left}" if self.open else "")
        )
        self.faults.note(self.note)


class _Waiting:
    """The rows since the last readings of all streams, which wait for the next ones."""

    def __init__(self, streams: list[_Stream]) -> None:
        self.streams, self.held = streams, list[Chunk]()

    def hold(self, chunk: Chunk) -> int:
        """Keep the next rows; return how many of those that are held need not wait."""
        self.held.append(chunk)
        return min(stream.look(chunk, self.held) for stream in self.streams)

    def take(self, stop: int) -> Chunk:
        """Return the first rows that are held, filled, but for those of a stream's reading and nothing else.

        Where sensors have rows of their own, a row without a number is taken for one of a sensor that nobody asked for.
        """
        rows = concatenate(self.held)
        self.held = [rest] if len(rest := rows.part(stop, len(rows))) else []
        filled = {stream.name: stream.filled(rows, stop) for stream in self.streams}
        rows, known = rows.part(0, stop), {*filled, "valid"}
        others = [v.reshape(len(rows), -1) for name, v in rows.channels.items() if name not in known]
        read = np.any([_readings(rows, stream.name) for stream in self.streams], axis=0)
        apart = read | any(stream.apart for stream in self.streams)
        alone = apart & np.all(np.isnan(np.hstack(others)), axis=1) if others else np.zeros(stop, dtype=bool)
        if count := int(np.sum(alone & ~read)):
            faults, first = self.streams[0].faults, float(rows.t[np.argmax(alone & ~read)])
            faults.add("rows without a number, taken for those of other sensors", count, f"at {faults.when(first)}")
        return rows.having(**filled).where(~alone)

    def rest(self) -> Iterator[Chunk]:
        """Yield the rows behind the last readings."""
        if self.held:
            yield self.take(sum(map(len, self.held)))


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
    spans = np.arange(SPAN, int(at[-1]) + 1 if len(at) else 0, SPAN).astype(at.dtype)  # of another type, `at` is copied
    for start, stop in pairwise([0, *np.searchsorted(at, spans), len(at)]):
        values[start:stop] = windows[at[start:stop]]
        if len(at) > FEW:
            release(data)
    return values.view(dtype.base).reshape(len(at), *dtype.shape)
