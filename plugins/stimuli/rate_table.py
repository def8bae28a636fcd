"""A turntable: the rates of a triad of gyros, as a table of segments or as a channel.

N samples, S segments.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import KnownRates, Site, Stimulus, TriadInput
from fusion_core.errors import ConfigError, DataError
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.earth import RATE, STANDARD_GRAVITY, gravity
from fusion_plugins.stimuli.tables import Directions, Files, direction, file_of, halved, rows_of, segments

STEADY = 0.05  # of the largest, within a segment: a commanded rate that changes by more is left out


class _Turn(NamedTuple):
    """Rows of a recording in which the unit turns about an axis at a rate, rad/s."""

    rows: tuple[int, int]
    axis: Array
    rate: float


@hookimpl
class RateTable(Stimulus):
    """A turntable: its rates as a table of segments, or as a channel of the recording."""

    kind: Literal["rate_table"] = "rate_table"
    segments: Files | None = None
    """Table of segments (start, stop, axis, rate), CSV; one for each recording."""
    channel: str | None = None
    """Channel of the table's rate, about `axes`."""
    axes: Directions = ()
    """Axis of the unit that the table turns about: x, -x, ..., or three numbers; one for all or for each recording."""
    settle: Annotated[float, Unit("s", least=0, example="2 s")] = Quantity(2.0, "2 s")
    """Time at the start of a segment that is left out."""
    length: Annotated[float, Unit("s", positive=True, example="10 s")] = Quantity(10.0, "10 s")
    """Length of the parts into which a channel is cut."""

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return a table whose rate is a channel, with six orientations."""
        return (cls.model_validate({"channel": "table_rate", "axes": ["x", "-x", "y", "-y", "z", "-z"]}),)

    def inputs(
        self, recordings: Sequence[Chunk], channel: str, site: Site, length: tuple[float, float] | None
    ) -> TriadInput:
        """Return the rates of the segments, the Earth's among them where the latitude says that the axis is vertical.

        The specific force is that of the accelerometers, or gravity along a vertical axis.
        """
        if channel != "gyro":
            raise ConfigError(f"stimulus: rate_table tells of a gyro, not of {channel}; use kind positions")
        if (self.segments is None) == (self.channel is None):
            raise ConfigError("stimulus: rate_table needs segments, a table, or channel, its rate; give one of them")
        turns = [self._turns(chunk, k, len(recordings)) for k, chunk in enumerate(recordings)]
        parts = [[_Turn(rows, turn.axis, turn.rate) for turn in own for rows in halved([turn.rows])] for own in turns]
        return replace(_known_rates(recordings, turns, site), parts=_known_rates(recordings, parts, site))

    def _turns(self, chunk: Chunk, k: int, count: int) -> list[_Turn]:
        if self.segments is not None:
            table, settle = segments(file_of(self.segments, k), rates=True), float(self.settle)
            return [_Turn(rows_of(chunk.t, s.start + settle, s.stop), np.array(s.axis), s.rate) for s in table]
        if not (found := list(self._commanded(chunk, k, count))):
            raise DataError("stimulus: no segment with a steady rate was found; check stimulus.channel and its unit")
        return found

    def _commanded(self, chunk: Chunk, k: int, count: int) -> Iterator[_Turn]:
        """Yield segments of the commanded rate that are steady."""
        name = str(self.channel)
        rate, t = chunk[name], chunk.t
        if len(self.axes) not in (1, count) or rate.ndim != 1:
            raise ConfigError(
                f"stimulus: channel {name} has {1 if rate.ndim == 1 else rate.shape[1]} columns and axes names "
                f"{len(self.axes)} of {count} recordings; give one column, and one axis, or one a recording"
            )
        axis = np.array(direction(self.axes[k if len(self.axes) > 1 else 0]))
        edges = np.arange(t[0], t[-1], float(self.length))
        largest = float(np.max(np.abs(rate)))
        for start, stop in pairwise(edges):
            a, b = np.searchsorted(t, [start, stop])
            if b - a > 1 and np.ptp(rate[a:b]) <= STEADY * largest:
                yield _Turn((int(a), int(b)), axis, float(rate[a:b].mean()))

    def simulated(self, channel: str, values: Array, rng: np.random.Generator) -> Sequence[Chunk]:
        """Return a recording for each axis, turned at four rates, as a channel shows them."""
        if channel != "gyro" or self.channel is None:
            return super().simulated(channel, values, rng)
        dt, made = 0.1, []
        rate = np.repeat([1.0, -1.0, 0.5, -0.5], round(3 * float(self.length) / dt))
        M, G = values[3:12].reshape(3, 3), np.resize(values[12:], 9).reshape(3, 3) if len(values) > 12 else np.zeros(9)
        for axis in map(direction, self.axes):
            force = STANDARD_GRAVITY * np.tile(axis, (len(rate), 1))
            u = rate[:, None] * axis
            y = u + u @ M.T + values[:3] + force @ G.reshape(3, 3).T + rng.normal(0, 1e-7, u.shape)
            channels = {"gyro": y, "accel": force, self.channel: rate, "temperature": np.full(len(rate), 20.0)}
            made.append(Chunk(dt * np.arange(1.0, len(rate) + 1), channels))
        return made


def _known_rates(recordings: Sequence[Chunk], turns: Sequence[Sequence[_Turn]], site: Site) -> KnownRates:
    """Return the rates of the turns of each recording."""
    known = all("accel" in chunk.channels for chunk in recordings)
    vertical = 0.0 if site.latitude is None else RATE * float(np.sin(site.latitude))
    u, y, T, t, force, own = [], [], [], [], [], []
    for k, chunk in enumerate(recordings):
        for (a, b), axis, rate in turns[k]:
            u.append((rate + vertical) * axis)
            y.append(chunk["gyro"][a:b].mean(axis=0))
            T.append(chunk["temperature"][a:b].mean())
            t.append(chunk.t[a:b].mean())
            own.append(k)
            force.append(chunk["accel"][a:b].mean(axis=0) if known else gravity(site.latitude) * axis)
    pulled = np.stack(force) if known or site.latitude is not None else None
    return KnownRates(np.stack(u), np.stack(y), np.array(T), np.array(t), pulled, np.array(own))
