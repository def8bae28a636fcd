"""From a source to samples that can be trusted: stuck and saturated sensors are left out and reported."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Iterator, Mapping

import numpy as np

from driftlab.config import Config
from driftlab.recordings.plausibility import Copies, Lone, Rails, Rounding, Thermometer, axes_in
from fusion_core.checks import all_finite
from fusion_core.chunk import Array, Chunk, Flags, concatenate, read_only
from fusion_core.contracts import FileSource, Sensor
from fusion_core.contracts.table import DERIVED, USUAL
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.fast import compiled
from fusion_core.faults import Faults, usable

ROWS = 65_536  # of a chunk read at once
FIRST = 11  # rows that show the usual step
LONG, RARE = 1.0, 10.0  # s between rows that are a gap, and times the usual step where that is more
STUCK = 100  # equal samples in a row that make a sensor stuck; noise does not repeat itself that often


def read(
    config: Config, faults: Faults, rows: int = ROWS, stream: Iterable[Chunk] | None = None, *, few: bool = False
) -> Generator[Chunk]:
    """Yield the samples of the config's source (or of `stream`, in its place) that can be used.

    Of a `few` that are all that is wanted, nothing is compiled: loading the compiler would take longer.
    """
    if config.source is None:
        raise ConfigError("source: is missing; say how the recording is read: its kind and its channels")
    sensors = {sensor.channel: sensor for sensor in config.filter.sensors} if config.filter else None
    start = 0.0 if stream is not None else (isinstance(config.source, FileSource) and config.source.start) or 0.0
    gaps, screen = Gaps(faults), _Screen(faults, sensors or {}, few=few)
    raw = screen.thermometer.along(gaps.along(stream or config.source.chunks(rows, faults)))
    empty, previous = True, None
    for chunk in usable(raw, faults, config.source.name, start):
        if not DERIVED.isdisjoint(chunk.channels):
            taken = min(DERIVED & set(chunk.channels))
            raise ConfigError(f"channel '{taken}': the program uses this name itself; rename it under source.channels")
        chunk = _with_sensors(chunk, sensors, previous)
        keep = screen.keep(chunk)
        kept = chunk if keep is None else chunk.where(keep)
        try:
            if len(kept):
                empty = False
                faults.usable += len(kept)
                yield kept
        finally:  # also where no more is asked for; until then nobody waits for it
            previous = chunk.last()
            screen.thermometer.look(chunk)
    screen.thermometer.flush()
    for looks in (screen.rails, screen.roundings, screen.lone):
        for look in looks.values():
            look.judge(faults)
    if empty:
        raise EmptyRecording(
            f"{config.source.name}: every row is left out ({'; '.join(faults.lines())}); check the units"
        )


class _Screen:
    """A look at the sensors' samples: stuck and saturated ones are left out, what no sensor gives is a doubt."""

    def __init__(self, faults: Faults, sensors: Mapping[str, Sensor], *, few: bool) -> None:
        self.faults, self.sensors, self.few = faults, sensors, few
        self.copies, self.thermometer = Copies(faults), Thermometer(faults)
        self.runs: dict[str, Array] = {}  # length of the repetition of each axis
        self.rails: dict[str, Rails] = {}
        self.roundings: dict[str, Rounding] = {}
        self.lone: dict[str, Lone] = {}

    def keep(self, chunk: Chunk) -> Flags | None:
        """Return the rows (N,) that can be used; None where all can."""
        keep = None
        suspect = getattr(_suspect, "py_func", _suspect) if self.few else _suspect
        for name, values in ((name, a) for name, a in chunk.channels.items() if name in chunk.sensors):
            sensor, d = self.sensors.get(name), values.shape[1]
            self.copies.look(chunk, name, sensor)
            limit = 0.999 * ((sensor and sensor.range) or np.inf)
            if name not in self.runs:
                self.runs[name], self.rails[name] = np.zeros(d), Rails(name, sensor, d)
                self.roundings[name], self.lone[name] = Rounding(name, sensor, d), Lone(name, sensor, d)
            self.roundings[name].look(chunk)
            before, self.runs[name], table = self.runs[name], np.empty(d), self.rails[name].table
            last, leaps = read_only(_value_before(chunk, name)), np.zeros(d)
            suspected = suspect(values, last, before, self.runs[name], limit, table, leaps)
            self.lone[name].look(chunk, leaps, limit, self.faults)
            if not suspected:
                continue
            repeats = _repeats(chunk, name, before)
            for what, bad in (("stuck", repeats >= STUCK), ("saturated", np.abs(values) >= limit)):
                good = ~_report(chunk, name, sensor, what, bad, self.faults)
                keep = good if keep is None else keep & good
        return keep


def _with_sensors(chunk: Chunk, declared: Collection[str] | None, previous: Chunk | None) -> Chunk:
    """Return the chunk with its sensors named, each of them (N, d), as that of the sample before it are.

    Where no filter says which channels they are, those of several axes are taken for sensors.
    """
    several = (name for name, values in chunk.channels.items() if values.ndim == 2)
    sensors = frozenset(several if declared is None else (name for name in declared if name in chunk.channels))
    columns = {name: chunk[name].reshape(len(chunk), -1) for name in sensors if chunk[name].ndim != 2}
    return (chunk.having(**columns) if columns else chunk).following(previous, sensors)


class Gaps:
    """Notes the long gaps between the rows of a recording: how many, how long in all, and the longest."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        self.first = np.empty(0)  # times of the rows that show how long a gap is [s]
        self.last = self.least = np.nan  # time of the last row so far, and of a step that is no gap [s]
        self.total = self.longest = 0.0
        self.begin, self.where = "", ""  # of the first, and of the longest

    def along(self, chunks: Iterable[Chunk]) -> Iterator[Chunk]:
        """Pass the rows of a source on, and look at them: what is left out of them is counted by itself."""
        for chunk in chunks:
            yield chunk
            t = chunk.t if all_finite(chunk.t) else chunk.t[np.isfinite(chunk.t)]
            if len(t):
                self.look(t)

    def look(self, t: Array) -> None:
        """Look at the times (N,) of the next rows."""
        if self.last != self.last:  # NaN
            self.first = t = np.append(self.first, t)
            if len(t) < FIRST:
                return
            self.last, self.least = float(t[0]), max(LONG, RARE * float(np.median(np.diff(t[:FIRST]))))
        last = float(t[-1])
        if last - self.last > self.least:  # a gap is no longer than all of it
            steps = np.diff(t, prepend=self.last)
            long = steps > self.least
            if np.any(long):
                self._add((t - steps)[long], steps[long])
        self.last = last

    def _add(self, begins: Array, lengths: Array) -> None:
        what = f"gaps of more than {self.least:.4g} s, predicted across"
        k = int(np.argmax(lengths))
        self.begin = self.begin or f"at {self.faults.when(begins[0])}"
        if lengths[k] > self.longest:
            self.longest, self.where = float(lengths[k]), f"{self.faults.since(begins[k]):.6g} s"
        self.total += float(np.sum(lengths))
        self.faults.add(what, len(lengths), "")
        found = self.faults.found[what]
        found.first = f"{self.begin}, {self.total:.6g} s "
        found.first += f"in all, the longest {self.longest:.6g} s at {self.where}" if found.count > 1 else "long"


@compiled
def _suspect(values: Array, last: Array, carried: Array, runs: Array, limit: float, rails: Array, leaps: Array) -> bool:
    """Return True if any value (N, d) is stuck or beyond the limit.

    `runs` (d,) are to be the lengths of the repetitions at the end, `leaps` (d,) the largest changes from row to row.

    One pass over what is nearly always good; `_repeats` says where it is not, in NumPy. `rails` (2, d, 4) goes on: the
    largest value and how often it was there, the next one and how often, of the readings and with their sign reversed.
    """
    suspect = False
    for j in range(values.shape[1]):
        run, before, leap = carried[j], last[j], 0.0
        low, high = max(-rails[1, j, 2], -limit), min(rails[0, j, 2], limit)
        for k in range(len(values)):
            value = values[k, j]
            if abs(value - before) > leap:  # not NaN
                leap = abs(value - before)
            if value != before and low < value < high:  # nearly always
                run, before = 1.0, value
                continue
            run, before = run + 1.0 if value == before else 1.0, value
            suspect |= run >= STUCK or abs(value) >= limit
            for side in range(2):
                reading = value if side == 0 else -value
                if reading < rails[side, j, 2]:
                    continue
                if reading > rails[side, j, 0]:
                    rails[side, j, 2], rails[side, j, 3] = rails[side, j, 0], rails[side, j, 1]
                    rails[side, j, 0], rails[side, j, 1] = reading, 1.0
                elif reading == rails[side, j, 0]:
                    rails[side, j, 1] += 1.0
                elif reading > rails[side, j, 2]:
                    rails[side, j, 2], rails[side, j, 3] = reading, 1.0
                else:
                    rails[side, j, 3] += 1.0
            low, high = max(-rails[1, j, 2], -limit), min(rails[0, j, 2], limit)
        runs[j], leaps[j] = run, leap
    return suspect


def _value_before(chunk: Chunk, name: str) -> Array:
    """Return the value (d,) before the first sample; NaN, which equals nothing, at the start of a recording."""
    return np.asarray(chunk[name][0] * np.nan if chunk.previous is None else chunk.previous[name][-1])


def _repeats(chunk: Chunk, name: str, carried: Array) -> Array:
    """Return (N, d): how many samples in a row, up to this one, had this very value."""
    values = chunk[name]
    same = np.diff(values, axis=0, prepend=_value_before(chunk, name)[None]) == 0
    at = np.arange(1, len(values) + 1)[:, None]
    broken = np.maximum.accumulate(np.where(same, 0, at), axis=0)
    return np.asarray(np.where(broken == 0, at + carried, at - broken + 1), dtype=np.float64)


def _report(chunk: Chunk, name: str, sensor: Sensor | None, what: str, bad: Flags, faults: Faults) -> Flags:
    """Count the rows that have a bad value (N, d), and return which they are."""
    rows, axes = np.asarray(np.any(bad, axis=1), dtype=np.bool_), axes_in(sensor, bad.shape[1])
    if np.any(rows):
        k = int(np.argmax(rows))
        axis = int(np.argmax(bad[k]))
        where = f"{axes[axis]} at {faults.when(chunk.t[k])}, value {chunk[name][k, axis]:.6g} in SI"
        faults.add(f"rows where {name} is {what}, left out", int(np.sum(rows)), where)
    return rows


def head(config: Config) -> tuple[Chunk | None, list[str]]:
    """Return the first rows of the config's source, and a line for each channel and each thing to know of it.

    Neither where no file is named.
    """
    source = config.source
    if source is None or source.live or (isinstance(source, FileSource) and source.path is None):
        return None, []
    faults = Faults()
    rows = read(config, faults, rows=1000, few=True)
    first = next(rows)
    while len(first) < FIRST and (more := next(rows, None)) is not None:
        first = concatenate([first, more])
    rows.close()
    for name in first.sensors:
        look = Rounding(name, None, first[name].shape[1])
        look.look(first)
        look.judge(faults)
    rate = 1 / float(np.median(np.diff(first.t))) if len(first) > 1 else float("nan")
    lines = [f"recording: {source.name}, {rate:.6g} Hz at its start"]
    for name, values in first.channels.items():
        shape = f"(N, {values.shape[1]})" if values.ndim > 1 else "(N,)"
        said = ", ".join(f"{value:.6g}" for value in np.atleast_1d(values[0]))
        lines.append(f"channel {name}: shape {shape}, first {said} {_unit(config, name)}".rstrip())
    lines += [f"note: {line}" for line in faults.lines()]
    return first, lines


def _unit(config: Config, channel: str) -> str:
    """Return the SI unit of a channel; "in SI" where nothing names it."""
    if channel in USUAL:
        return USUAL[channel].si
    sensors = () if config.filter is None else config.filter.sensors
    return next((sensor.unit for sensor in sensors if sensor.channel == channel), "in SI")
