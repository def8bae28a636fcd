"""Recordings as evidence: the readings at rest, in means of some seconds, and in rows of them for regression.

A bias that moves over minutes is as well seen in means of seconds as in the updates themselves. Effects are computed
on means of at most 10 s, so that their memories are as they run; regressions are made on rows of one or more of these.

Missing excitation, in sentences for the test engineer: a temperature that only goes one way, and a channel
that moves with it, keep recordings from distinguishing explanations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from driftlab.config import Config, with_recording
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, RunSegment
from driftlab.filtering.setup import turned
from driftlab.identification.config_edit import clamped
from driftlab.noise.local_level import walk_of
from driftlab.recordings.epochs import epochs
from driftlab.soak.blocks import means
from driftlab.soak.temperature import soak_temperatures
from driftlab.units import BiasUnit, unit_of
from fusion_core.chunk import Array, Chunk, Integers, concatenate
from fusion_core.contracts import Effect
from fusion_core.contracts.table import DERIVED
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.thermal.sweeps import one_way, ways

FINE = 10.0  # s: longest mean that effects are computed on
ROWS = 3000  # of a recording, at most
MEANS = 6000  # of a recording, where it is short

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Record:
    """One recording in N means, and rows of them."""

    name: str  # of the recording
    calibration: bool  # whether it has this role
    train: bool  # whether it has this one; it may have both
    # N means in SI; `temperature` without steps, `excess` (N, d): the sensor's reading less its known input, or its
    # channel where there is none
    chunk: Chunk
    starts: Integers  # (n,) the first mean of each row
    # (columns, 2) smallest and largest value of each channel, update by update
    ranges: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.starts)

    def rows(self, values: Array) -> Array:
        """Return the means (n, ...) over rows of values (N, ...)."""
        return means(values, self.starts)

    @cached_property
    def t(self) -> Array:
        """Times (n,) of the rows, s."""
        return self.rows(self.chunk.t)

    def ends(self, channel: str) -> Array:
        """Return the range (columns, 2) of a channel."""
        return self.ranges[channel] if channel in self.ranges else _ends(self.chunk[channel])


@dataclass(frozen=True)
class Evidence:
    """R recordings with n rows in all, of the d axes of the sensor whose bias is looked at."""

    records: tuple[Record, ...]  # those of the calibration first
    channel: str  # of the tracked sensor
    axes: tuple[str, ...]  # of the sensor
    unit: BiasUnit  # of its bias
    interval: float  # of a row, s
    align: float  # how long a unit is aligned, s
    noise: Array | None = None  # (d,) declared density of white noise, SI/sqrt(Hz); None: as the model leaves it
    walk: Array | None = None  # (d,) declared density of the random walk, SI/sqrt(s); None: as the model leaves it

    def __len__(self) -> int:
        return sum(len(record) for record in self.records)

    @cached_property
    def rate(self) -> Array:
        """Reading less reference (n, d), SI."""
        return self.rows([self.excess(record.chunk) for record in self.records])

    def excess(self, chunk: Chunk) -> Array:
        """Return the sensor's reading less its known input (N, d)."""
        return chunk["excess" if "excess" in chunk.channels else self.channel]

    @property
    def chunks(self) -> list[Chunk]:
        """The recordings' means."""
        return [record.chunk for record in self.records]

    def ends(self, channel: str) -> Array:
        """Return the range (columns, 2) of a channel in all recordings, SI."""
        return _ends(np.hstack([record.ends(channel) for record in self.records]).T)

    @cached_property
    def slices(self) -> list[slice]:
        """The rows of each recording."""
        ends = np.cumsum([0, *(len(record) for record in self.records)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def rows(self, values: Sequence[Array]) -> Array:
        """Return the rows (n, ...) of values over each recording's means."""
        return np.concatenate([record.rows(part) for record, part in zip(self.records, values, strict=True)])

    def split(self, values: Array) -> list[Array]:
        """Return the part of rows (n, ...) that is each recording's."""
        return [values[rows] for rows in self.slices]


def map_inputs(chunks: Iterable[Chunk], effects: Iterable[Effect]) -> list[Array]:
    """Return the temperature that the map sees of each recording behind effects, some of which act on its input."""
    acting, inputs = [effect for effect in effects if effect.acts_on_input], []
    for chunk in chunks:
        for effect in acting:
            chunk = chunk.having(temperature=effect.input(chunk, None)[0])
        inputs.append(chunk["temperature"])
    return inputs


def with_residuals(chunks: Sequence[Chunk], residuals: Sequence[Array]) -> list[Chunk]:
    """Return recordings with their residuals (N, d) as channel `residual`, in its own deviation."""
    spread = np.maximum(np.std(np.concatenate(residuals), axis=0), 1e-300)
    return [chunk.having(residual=one / spread) for chunk, one in zip(chunks, residuals, strict=True)]


def gather(config: Config, calibration: Sequence[str], train: Sequence[str], progress: Progress) -> Evidence:
    """Return readings at rest by the declared model; raises DataError or ConfigError if a recording cannot be used."""
    config = clamped(config)
    settings = config.filter
    assert settings is not None
    least = max(1.0, float(settings.update_interval))
    tracked = settings.tracked
    names = list(dict.fromkeys((*calibration, *train)))  # a recording that serves as both is evidence once
    chunks: list[Chunk] = []
    ranges: list[dict[str, Array]] = []
    for name in names:
        progress(f"reading {name}")
        journal, ends = RunLog(), dict[str, Array]()
        run = Run(with_recording(config, name), journal)
        chunks.append(_joined(epochs(_at_rest(run, ends), least), name))
        ranges.append(ends)
        first, *later = journal.alignments
        unknown = settings.length_of_input(config.site) is not None
        if unknown and any(turned(first, other, tracked.channel) for other in later):
            raise ConfigError(
                f"{name}: the unit was turned over in it, and what its {tracked.channel} shows has another "
                "level since; give each placement as PATH::START:STOP"
            )
    _check_same_channels(names, chunks)
    if "temperature" in chunks[0].channels:
        smooth, _ = soak_temperatures([(chunk.t, chunk["temperature"]) for chunk in chunks])
        chunks = [chunk.having(temperature=T) for chunk, T in zip(chunks, smooth, strict=True)]
    fine, interval = lengths(max(float(chunk.t[-1] - chunk.t[0]) for chunk in chunks), least)
    records = []
    for name, chunk, ends in zip(names, chunks, ranges, strict=True):
        whole = _joined(epochs([_without(chunk, "tau")], fine), name)
        # means lie in the middle of what they are over, as far as the updates of a run do
        whole = replace(whole, t=whole.t - (fine - least) / 2)
        starts = row_starts(whole.t, interval)
        records.append(Record(name, name in calibration, name in train, _without(whole, "tau"), starts, ends))
    align, unit, walk = float(settings.align), unit_of(tracked), walk_of(tracked)
    noise = np.asarray(tracked.noise, dtype=np.float64)
    return Evidence(tuple(records), tracked.channel, tracked.axes, unit, interval, align, noise, walk)


def row_starts(t: Array, interval: float) -> Integers:
    """Return the first mean of each row of `interval` s, the means at t (N,)."""
    return np.flatnonzero(np.diff(np.floor((t - t[0] + 1e-6) / interval), prepend=-1.0))


def lengths(longest: float, least: float) -> tuple[float, float]:
    """Return the lengths of means and rows, in s, where the longest recording lasts `longest` and epochs `least`.

    They are whole multiples, so that all means are alike.
    """
    fine = least * max(1.0, np.floor(min(FINE, longest / MEANS) / least))
    return float(fine), float(fine * max(1.0, np.ceil(longest / fine / ROWS)))


def _at_rest(segments: Iterable[RunSegment], ends: dict[str, Array]) -> Iterator[Chunk]:
    """Yield the epochs at which the unit stood still; `ends` takes the range (columns, 2) of each channel in all.

    Means draw these in. The model may refuse just what the effect does: its inputs were measured all the same.
    """
    previous: Chunk | None = None
    for segment in segments:
        rows = segment.epochs
        channels = dict(rows.channels)
        if "temperature_raw" in channels:
            channels["temperature"] = rows["temperature_raw"]  # no lag of ours may enter what is fitted
        for name, values in {"temperature": np.zeros(1), **channels}.items():
            own = _ends(values)
            ends[name] = _ends(np.hstack([ends.get(name, own), own]).T)
        channels = {k: v for k, v in channels.items() if k not in ("dt", "tau", "temperature_raw")}
        channels["excess"] = segment.rate
        still = Chunk(rows.t, channels, previous, rows.sensors).where(segment.still)
        if len(still):
            yield still
            previous = still.last()


def _ends(values: Array) -> Array:
    """Return the smallest and the largest value of each column (columns, 2)."""
    columns = values.reshape(len(values), -1)
    return np.stack([columns.min(axis=0), columns.max(axis=0)], axis=1)


def _without(chunk: Chunk, name: str) -> Chunk:
    return replace(chunk, channels={k: v for k, v in chunk.channels.items() if k != name})


def _joined(chunks: Iterable[Chunk], name: str) -> Chunk:
    parts = list(chunks)
    if sum(map(len, parts)) < 2:
        raise EmptyRecording(f"{name}: is nowhere at rest for long enough; check the declared noise and the units")
    return concatenate(parts)


def _check_same_channels(names: Sequence[str], chunks: Sequence[Chunk]) -> None:
    for name, chunk in zip(names, chunks, strict=True):
        missing = sorted(set(chunks[0].channels) ^ set(chunk.channels))
        if missing:
            raise ConfigError(
                f"channel '{missing[0]}' is in only one of {names[0]} and {name}; "
                "name under source.channels what all recordings have"
            )


STILL = 2.0  # K; a smaller swing shows nothing of temperature
TOGETHER = 0.97  # correlation beyond which two channels are one


def missing_excitation(evidence: Evidence) -> Iterator[str]:
    """Yield the excitation that the recordings lack: a temperature that goes one way, a channel that moves with it."""
    chunks = [chunk for chunk in evidence.chunks if "temperature" in chunk.channels]
    if not chunks:
        return
    T = [chunk["temperature"] for chunk in chunks]
    up, down = ways(T)
    swing = float(max(map(np.max, T)) - min(map(np.min, T)))
    if swing < STILL:
        yield f"your recordings hardly move in temperature ({swing:.2g} K); record a soak"
    elif way := one_way(T):
        way, other = ("warm up", "cooling down") if way == "warms up" else ("cool down", "warming up")
        yield (
            f"your recordings only ever {way} ({max(up, down):.3g} K in all, {min(up, down):.2g} K the other way): a "
            f"lag, a hysteresis, a drift and the map itself look alike on them; record {other} too"
        )
    names = set.intersection(*(set(chunk.channels) for chunk in chunks)) - DERIVED - {"temperature", evidence.channel}
    for name in sorted(name for name in names if all(chunk[name].ndim == 1 for chunk in chunks)):
        r = _correlation(chunks, "temperature", name)
        if abs(r) > TOGETHER:
            yield (
                f"in your recordings {name} moves with temperature alone (correlation {r:.2f}): their "
                "effects cannot be distinguished; move one of them by itself"
            )


def move_together(chunks: Sequence[Chunk], one: str, other: str) -> bool:
    """Return True if two channels are hardly to be distinguished, being nearly in proportion over all recordings."""
    return all(chunks[0][name].ndim == 1 for name in (one, other)) and abs(_correlation(chunks, one, other)) > TOGETHER


def _correlation(chunks: Sequence[Chunk], *names: str) -> float:
    one, other = (values - np.mean(values) for values in (np.concatenate([c[name] for c in chunks]) for name in names))
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / size if size > 0 else 0.0
