"""Recordings as evidence: what was measured at rest, in means of some seconds, and in rows of them for regression.

A bias that moves over minutes is as well seen in means of seconds as in the updates themselves. Effects are computed
on means of at most 10 s, so that their memories are as they run; regressions are made on rows of one or more of these.

What keeps recordings from telling explanations apart, in sentences that one understands at the bench.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from driftlab.config import Config, with_recording
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, RunSegment
from driftlab.filtering.setup import turned
from driftlab.identification.config_edit import clamped
from driftlab.recordings.epochs import epochs
from driftlab.soak.sweeps import rise_and_fall
from driftlab.soak.temperature import soak_temperatures
from driftlab.units import BiasUnit, unit_of
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts.table import DERIVED
from fusion_core.errors import ConfigError, EmptyRecording

FINE = 10.0  # s: longest mean that effects are computed on
ROWS = 3000  # of a recording, at most
MEANS = 6000  # of a recording, where it is short

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Record:
    """One recording in N means, and rows of them.

    Attributes
    ----------
    name : str
        What the recording is called.
    calibration, train : bool
        What it is for; it may be for both.
    chunk : Chunk
        The sensor's channel (N, d) is its reading less the reference, in SI; `temperature` (N,) is without the
        thermometer's steps; and the other channels.
    starts : (n,) array of int
        The first mean of each row.
    seen : mapping of str to (columns, 2) array
        Smallest and largest value of each channel, update by update.
    """

    name: str
    calibration: bool
    train: bool
    chunk: Chunk
    starts: NDArray[np.int64]
    seen: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.starts)

    def rows(self, values: Array) -> Array:
        """Return the means (n, ...) over rows of values (N, ...)."""
        sizes = np.diff(np.append(self.starts, len(self.chunk)))
        total = np.add.reduceat(values, self.starts, axis=0)
        return np.asarray(total / sizes.reshape(-1, *[1] * (values.ndim - 1)))

    @cached_property
    def t(self) -> Array:
        """Times (n,) of the rows, s."""
        return self.rows(self.chunk.t)

    def ends(self, channel: str) -> Array:
        """Return the ends (columns, 2) of what was seen of a channel."""
        return self.seen[channel] if channel in self.seen else _ends(self.chunk[channel])


@dataclass(frozen=True)
class Evidence:
    """R recordings with n rows in all, of the d axes of the sensor whose bias is looked at.

    Attributes
    ----------
    records : tuple of Record
        The recordings, those of the calibration first.
    channel : str
        Of the tracked sensor.
    axes : tuple of str
        Its axes.
    unit : BiasUnit
        Of its bias.
    interval : float
        Of a row, s.
    align : float
        How long a unit is aligned, s.
    noise : (d,) array or None
        Declared white-noise density, SI/sqrt(Hz); None: as the model leaves it.
    """

    records: tuple[Record, ...]
    channel: str
    axes: tuple[str, ...]
    unit: BiasUnit
    interval: float
    align: float
    noise: Array | None = None

    def __len__(self) -> int:
        return sum(len(record) for record in self.records)

    @cached_property
    def rate(self) -> Array:
        """Reading less reference (n, d), SI."""
        return self.rows([record.chunk[self.channel] for record in self.records])

    @property
    def chunks(self) -> list[Chunk]:
        """The recordings' means."""
        return [record.chunk for record in self.records]

    def ends(self, channel: str) -> Array:
        """Return the ends (columns, 2) of what all recordings show of a channel, SI."""
        each = np.stack([record.ends(channel) for record in self.records])
        return np.stack([each[..., 0].min(axis=0), each[..., 1].max(axis=0)], axis=1)

    @cached_property
    def slices(self) -> list[slice]:
        """The rows of each recording."""
        ends = np.cumsum([0, *(len(record) for record in self.records)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def rows(self, values: Sequence[Array]) -> Array:
        """Return the rows (n, ...) of values over each recording's means."""
        return np.concatenate([record.rows(part) for record, part in zip(self.records, values, strict=True)])


def gather(config: Config, calibration: Sequence[str], train: Sequence[str], progress: Progress) -> Evidence:
    """Run the declared model over the recordings, and return what was measured at rest.

    Raises
    ------
    DataError, ConfigError
        If a recording cannot be used.
    """
    config = clamped(config)
    settings = config.filter
    assert settings is not None
    least = max(1.0, float(settings.update_interval))
    found: list[tuple[str, bool, Chunk]] = []
    seen = []
    # one that serves as both is evidence once
    for name, training in {name: name in train for name in (*calibration, *train)}.items():
        progress(f"reading {name}")
        journal = RunLog()
        run = Run(with_recording(config, name), journal)
        passing = _Seen(run)
        found.append((name, training, _joined(epochs(_at_rest(passing, settings.tracked.channel), least), name)))
        seen.append(passing.ends)
        first, *later = journal.alignments
        unknown = settings.length_of_input(config.site) is not None
        if unknown and any(turned(first, other, settings.tracked.channel) for other in later):
            raise ConfigError(
                f"{name}: the unit was turned over in it, and what its {settings.tracked.channel} shows has another "
                "level since; give each placement as PATH::START:STOP"
            )
    _same_channels([(name, chunk) for name, _, chunk in found])
    if "temperature" in found[0][2].channels:
        smooth, _ = soak_temperatures([(chunk.t, chunk["temperature"]) for *_, chunk in found])
        found = [
            (name, training, chunk.having(temperature=T))
            for (name, training, chunk), T in zip(found, smooth, strict=True)
        ]
    fine, interval = lengths(max(float(chunk.t[-1] - chunk.t[0]) for *_, chunk in found), least)
    records = []
    for (name, training, chunk), own in zip(found, seen, strict=True):
        whole = _joined(epochs([_without(chunk, "tau")], fine), name)
        # means lie in the middle of what they are over, as far as the updates of a run do
        whole = Chunk(whole.t - (fine - least) / 2, whole.channels, whole.previous, whole.sensors)
        number = np.floor((whole.t - whole.t[0] + 1e-6) / interval)
        starts = np.flatnonzero(np.diff(number, prepend=-1.0))
        records.append(Record(name, name in calibration, training, _without(whole, "tau"), starts, own))
    tracked = settings.tracked
    align, noise = float(settings.align), np.asarray(tracked.noise, dtype=np.float64)
    return Evidence(tuple(records), tracked.channel, tracked.axes, unit_of(tracked), interval, align, noise)


def lengths(longest: float, least: float) -> tuple[float, float]:
    """Return how long means and rows are, in s, where the longest recording lasts `longest` and epochs `least`.

    They are whole multiples, so that all means are alike.
    """
    fine = least * max(1.0, np.floor(min(FINE, longest / MEANS) / least))
    return float(fine), float(fine * max(1.0, np.ceil(longest / fine / ROWS)))


def _at_rest(stretches: Iterable[RunSegment], channel: str) -> Iterator[Chunk]:
    """Yield the epochs at which the unit stood still."""
    previous: Chunk | None = None
    for stretch in stretches:
        rows = stretch.epochs
        channels = {k: v for k, v in rows.channels.items() if k not in ("dt", "tau", "temperature_raw")}
        channels[channel] = stretch.rate
        if "temperature_raw" in rows.channels:
            channels["temperature"] = rows["temperature_raw"]  # no lag of ours may enter what is fitted
        kept = Chunk(rows.t, channels, previous, rows.sensors).where(stretch.still)
        if len(kept):
            yield kept
            previous = kept.last()


class _Seen:
    """Stretches as they pass, and the ends (columns, 2) of each channel in all of them.

    Means draw these in. What the declared model refuses is often what the effect does: its inputs were seen.
    """

    def __init__(self, stretches: Iterable[RunSegment]) -> None:
        self.stretches = stretches
        self.ends: dict[str, Array] = {}

    def __iter__(self) -> Iterator[RunSegment]:
        for stretch in self.stretches:
            channels = dict(stretch.epochs.channels)
            channels["temperature"] = channels.get("temperature_raw", channels.get("temperature", np.zeros(1)))
            for name, values in channels.items():
                own = _ends(values)
                both = np.stack([self.ends.get(name, own), own])
                self.ends[name] = np.stack([both[..., 0].min(axis=0), both[..., 1].max(axis=0)], axis=1)
            yield stretch


def _ends(values: Array) -> Array:
    """Return the smallest and the largest value of each column (columns, 2)."""
    columns = values.reshape(len(values), -1)
    return np.stack([columns.min(axis=0), columns.max(axis=0)], axis=1)


def _without(chunk: Chunk, name: str) -> Chunk:
    kept = {k: v for k, v in chunk.channels.items() if k != name}
    return Chunk(chunk.t, kept, chunk.previous, chunk.sensors)


def _joined(chunks: Iterable[Chunk], name: str) -> Chunk:
    found = list(chunks)
    if sum(map(len, found)) < 2:
        raise EmptyRecording(f"{name}: is nowhere at rest for long enough; check the declared noise and the units")
    return concatenate(found)


def _same_channels(found: Sequence[tuple[str, Chunk]]) -> None:
    first, reference = found[0]
    for name, chunk in found[1:]:
        missing = sorted(set(reference.channels) ^ set(chunk.channels))
        if missing:
            raise ConfigError(
                f"channel '{missing[0]}' is in only one of {first} and {name}; "
                "name under source.channels what all recordings have"
            )


TURN = 0.1  # of the whole swing: a smaller way back is no turning point
ONE_WAY = 0.1  # of the way up (or down) that the other way must have at least
STILL = 2.0  # K; a smaller swing shows nothing of temperature
TOGETHER = 0.97  # correlation beyond which two channels are one


def missing_excitation(evidence: Evidence) -> Iterator[str]:
    """Yield what the recordings do not show: a temperature that goes one way, a channel that moves with it."""
    chunks = [chunk for chunk in evidence.chunks if "temperature" in chunk.channels]
    if not chunks:
        return
    T = [np.asarray(chunk["temperature"], dtype=np.float64) for chunk in chunks]
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
    level: Array = np.concatenate(T)
    for name in sorted(name for name in names if all(chunk[name].ndim == 1 for chunk in chunks)):
        r = _correlation(level, np.concatenate([chunk[name] for chunk in chunks]))
        if abs(r) > TOGETHER:
            yield (
                f"in your recordings {name} moves with temperature alone (correlation {r:.2f}): what one does cannot "
                "be told from what the other does; move one of them by itself"
            )


def _correlation(one: Array, other: Array) -> float:
    one, other = one - np.mean(one), other - np.mean(other)
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / size if size > 0 else 0.0


def ways(recordings: Sequence[Array]) -> tuple[float, float]:
    """Return by how much temperatures (N,) rise in all, and by how much they fall, between their turning points."""
    least = TURN * (max(map(np.max, recordings)) - min(map(np.min, recordings)))
    each = [rise_and_fall(T, least) for T in recordings]
    return sum(up for up, _ in each), sum(down for _, down in each)


def one_way(recordings: Sequence[Array]) -> str:
    """Return what temperatures (N,) do where they hardly ever come back: `warms up` or `cools down`; else nothing."""
    up, down = ways(recordings)
    if min(up, down) >= ONE_WAY * max(up, down):
        return ""
    return "warms up" if up > down else "cools down"
