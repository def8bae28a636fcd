"""Stimuli as recordings hold them: turntable segments, commanded rates, and placements of one or more recordings.

A table of segments is CSV with the units of its columns in its head, one segment a line, in seconds from the first row
of the recording::

    start [s],stop [s],axis,rate [deg/s]
    60,90,z,100
    92,122,-z,100

`axis` is x, y or z of the unit, with - the other way, or the three parts of a vector; the rate turns right-handed about
it. A table of placements has start and stop alone. N samples.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from driftlab.config import Config, KnownRate, Placed, with_recording
from driftlab.filtering.setup import corrected, other_calibrations
from driftlab.recordings.screening import read
from driftlab.triad.model import AXES
from driftlab.triad.stimuli import KnownRates, PlacedForces, Stimulus, placed_rates, rests
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Sensor
from fusion_core.errors import ConfigError, DataError, MissingChannel, UnitError, quote
from fusion_core.faults import Faults
from fusion_core.units import convert

EARTH_RATE = 7.292115e-5  # rad/s
ROOM = 25.0  # degC, where there is no thermometer
STEADY = 0.05  # of its mean, within a segment: a commanded rate that changes by more is left out
HEAD = re.compile(r"\s*(\w+)\s*(?:\[([^\]]+)\])?\s*")
UNITS = {"start": "s", "stop": "s", "rate": "rad/s"}


class TurntableSegment(NamedTuple):
    """A part of a recording, s from its first row, and the rate of the unit there (3,), rad/s."""

    start: float
    stop: float
    axis: tuple[float, float, float]
    rate: float


@dataclass(frozen=True)
class Gathered:
    """A stimulus, its number of samples, and the sensor that it is of."""

    stimulus: Stimulus
    rows: int
    sensor: Sensor


def stimulus_of(config: Config, recordings: Sequence[str], faults: Faults) -> Gathered:
    """Return the stimulus that a config describes, as its recordings hold it.

    Raises
    ------
    ConfigError, DataError
        If the config describes none, a table cannot be read, or the recordings do not hold it.
    """
    model, settings = config.filter, config.stimulus
    if model is None or len(model.tracked.axes) != 3:
        raise ConfigError("--terms: scale and misalignment are those of a triad; describe one under filter")
    if settings is None:
        raise ConfigError(
            "stimulus: is missing, so the input of the triad is not known; add `stimulus: {kind: positions}` to the "
            "config, or rate_table with its segments, or name one with --stimulus"
        )
    sensor, rows, parts = model.tracked, 0, []
    configs = [with_recording(config, item) for item in recordings] or [config]
    for k, own in enumerate(configs):
        chunk = _samples(own, faults)
        rows += len(chunk)
        if isinstance(settings, Placed):
            parts.append(_placed(chunk, own, settings, k))
        else:
            parts.append(_turned(chunk, own, settings, k, len(configs)))
    return Gathered(_joined(parts), rows, sensor)


def _samples(config: Config, faults: Faults) -> Chunk:
    """Return all samples of a recording, the other sensors calibrated; without a thermometer at room temperature."""
    model = config.filter
    assert model is not None, "stimulus_of has seen to it"
    chunks = list(read(config, faults))
    names = set(chunks[0].channels)
    if model.tracked.channel not in names:
        have = ", ".join(sorted(names))
        raise MissingChannel(
            f"channel '{model.tracked.channel}' is needed and the recording has {have}; name it under source.channels"
        )
    t = np.concatenate([chunk.t for chunk in chunks])
    whole = Chunk(t, {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names})
    others = {name: fitted for name, fitted in other_calibrations(model).items() if name in names}
    if "temperature" not in names:
        faults.note(f"no thermometer: all samples are taken to be at {ROOM:g} °C, and the map holds there alone")
        whole = whole.having(temperature=np.full(len(t), ROOM))
    return corrected(whole, others)


def _placed(chunk: Chunk, config: Config, settings: Placed, k: int) -> Stimulus:
    """Return the placements of a recording, as its accelerometer or its gyro shows them."""
    assert config.filter is not None
    channel, T = config.filter.tracked.channel, chunk["temperature"]
    y = chunk[channel]
    if settings.placements:
        table = segments(_file(settings.placements, k), rates=False)
        places = [_rows(chunk.t, part.start, part.stop) for part in table]
    else:
        triads = [chunk[name] for name in ("accel", "gyro") if name in chunk.channels]
        places = rests(chunk.t, *triads, least=float(settings.rest))
    means, times = (np.stack([values[a:b].mean() for a, b in places]) for values in (T, chunk.t))
    if channel == "gyro":
        if "accel" not in chunk.channels:
            raise MissingChannel(
                "channel 'accel' is needed: a gyro's placements are known by its accelerometers; name it under "
                "source.channels, or use stimulus kind rate_table"
            )
        force = np.stack([chunk["accel"][a:b].mean(axis=0) for a, b in places])
        return placed_rates(chunk.t, y, T, places, force / np.linalg.norm(force, axis=1)[:, None])
    known = config.filter.length_of_input(config.site)
    if known is None:
        raise ConfigError(f"stimulus: kind {settings.kind} is for an accelerometer or a gyro, not for {channel}")
    length, unsure = known if settings.gravity is None else (float(settings.gravity), 0.0)
    return PlacedForces(np.stack([y[a:b].mean(axis=0) for a, b in places]), means, times, length, unsure / length)


def _turned(chunk: Chunk, config: Config, settings: KnownRate, k: int, count: int) -> KnownRates:
    """Return the turntable's segments of a recording."""
    assert config.filter is not None
    channel, T, t = config.filter.tracked.channel, chunk["temperature"], chunk.t
    if channel != "gyro":
        raise ConfigError(f"stimulus: rate_table tells of a gyro, not of {channel}; use kind positions")
    if (settings.segments is None) == (settings.channel is None):
        raise ConfigError("stimulus: rate_table needs segments, a table, or channel, its rate; give one of them")
    vertical = 0.0 if config.latitude is None else EARTH_RATE * float(np.sin(config.latitude))
    if settings.segments is not None:
        table = segments(_file(settings.segments, k), rates=True)
        found = [(_rows(t, s.start + float(settings.settle), s.stop), np.array(s.axis), s.rate) for s in table]
    else:
        found = list(_commanded(chunk, settings, k, count))
    if not found:
        raise DataError("stimulus: no segment with a steady rate was found; check stimulus.channel and its unit")
    u = np.stack([(rate + vertical) * axis for _, axis, rate in found])
    columns = (chunk[channel], T, t)
    y, means, times = (np.stack([values[a:b].mean(axis=0) for (a, b), _, _ in found]) for values in columns)
    return KnownRates(u, y, means, times)


def _commanded(chunk: Chunk, settings: KnownRate, k: int, count: int) -> Iterator[tuple[tuple[int, int], Array, float]]:
    """Yield rows, axis and mean rate of segments of the commanded rate that are steady."""
    name = str(settings.channel)
    rate, t = chunk[name], chunk.t
    if len(settings.axes) not in (1, count) or rate.ndim != 1:
        raise ConfigError(
            f"stimulus: channel {name} has {1 if rate.ndim == 1 else rate.shape[1]} columns and axes names "
            f"{len(settings.axes)} of {count} recordings; give one column, and one axis, or one a recording"
        )
    axis = np.array(direction(settings.axes[k if len(settings.axes) > 1 else 0]))
    edges = np.arange(t[0], t[-1], float(settings.length))
    largest = float(np.max(np.abs(rate)))
    for start, stop in pairwise(edges):
        a, b = np.searchsorted(t, [start, stop])
        if b - a > 1 and np.ptp(rate[a:b]) <= STEADY * largest:
            yield (int(a), int(b)), axis, float(rate[a:b].mean())


def _joined(parts: Sequence[Stimulus]) -> Stimulus:
    """Return the stimulus of all recordings."""
    first = parts[0]
    if len(parts) == 1:
        return first
    names = ("y", "temperatures", "times")
    y, T, t = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    if isinstance(first, KnownRates):
        return KnownRates(np.concatenate([part.u for part in parts if isinstance(part, KnownRates)]), y, T, t)
    if isinstance(first, PlacedForces):
        return PlacedForces(y, T, t, first.gravity, first.unsure)
    raise ConfigError("positions of a gyro: are of one recording, in which it is turned; name one with --input")


def _file(files: tuple[Path, ...], k: int) -> Path:
    if k >= len(files):
        raise ConfigError(f"stimulus: has {len(files)} tables for more recordings; name one for each, in their order")
    return files[k]


def _rows(t: Array, start: float, stop: float) -> tuple[int, int]:
    a, b = np.searchsorted(t, [t[0] + start, t[0] + stop])
    if b - a < 2:
        raise DataError(
            f"segment from {start:g} to {stop:g} s: the recording has {b - a} samples there, and lasts "
            f"{t[-1] - t[0]:.1f} s; count seconds from its first row, and see that stimulus.settle leaves some"
        )
    return int(a), int(b)


def direction(text: str) -> tuple[float, float, float]:
    """Return the unit vector of `x`, `-y` or `0.6 0.8 0`; raises ConfigError."""
    plain = text.strip().lower()
    try:
        if plain.lstrip("+-") in tuple(AXES):
            parts = [(-1.0 if plain[0] == "-" else 1.0) * (name == plain[-1]) for name in AXES]
        else:
            parts = [float(part) for part in plain.replace(";", " ").split()]
        size = float(np.linalg.norm(parts))
        if len(parts) == 3 and np.isfinite(size) and size > 0:
            return parts[0] / size, parts[1] / size, parts[2] / size
    except ValueError:
        pass
    raise ConfigError(f"axis '{quote(text)}': is no direction; write x, y, z, -x, -y, -z, or three numbers")


def segments(path: Path, *, rates: bool) -> list[TurntableSegment]:
    """Read a table of segments, with `rates`, or of placements; raises ConfigError or DataError."""
    needed = ("start", "stop", "axis", "rate") if rates else ("start", "stop")
    example = "start [s],stop [s]" + ",axis,rate [deg/s]" * rates
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            head, *lines = [line for line in csv.reader(file) if any(map(str.strip, line))] or [[]]
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read ({error}); name a table in CSV") from None
    named = [match.groups() if (match := HEAD.fullmatch(cell)) else ("", None) for cell in head]
    columns = {name: (k, unit) for k, (name, unit) in enumerate(named)}
    if not set(needed) <= set(columns):
        raise DataError(f"{path}: its head is '{quote(','.join(head))}'; write `{example}`")
    found = []
    for number, line in enumerate(lines, 2):
        try:
            values = {name: _value(line, *columns[name], name) for name in needed if name != "axis"}
            axis = direction(line[columns["axis"][0]]) if rates else (0.0, 0.0, 1.0)
        except (ValueError, IndexError, UnitError, ConfigError) as error:
            raise DataError(f"{path}: line {number}: {error}; write lines as `{example}` says") from None
        found.append(TurntableSegment(values["start"], values["stop"], axis, values.get("rate", 0.0)))
    if not found:
        raise DataError(f"{path}: has no line under its head; write one for each segment")
    return found


def _value(line: Sequence[str], k: int, unit: str | None, name: str) -> float:
    if unit is None:
        raise ValueError(f"column {name} has no unit in the head")
    value = float(convert(float(line[k]), unit, UNITS[name]))
    if not np.isfinite(value):
        raise ValueError(f"{name} is {line[k]}, a finite number was expected")
    return value
