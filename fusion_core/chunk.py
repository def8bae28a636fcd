"""A stretch of samples as arrays: what sources give and plugins get.

A chunk also carries the one sample that came just before it, so that a step is the same wherever the
recording was cut.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import ulp
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.errors import MissingChannel

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Chunk:
    """N consecutive samples; nobody can write to them.

    Attributes
    ----------
    t : (N,) array
        Time stamps in s, not decreasing.
    channels : mapping of str to (N,) or (N, d) array
        Named channels in SI units.
    previous : Chunk or None
        The sample just before the first one (N = 1); None at the start of a recording.
    sensors : frozenset of str
        The channels whose biases are looked for: what lasts for the time of a sample, and is integrated over it.
    """

    t: Array
    channels: Mapping[str, Array] = field(default_factory=dict)
    previous: Chunk | None = None
    sensors: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", read_only(self.t))
        object.__setattr__(self, "channels", MappingProxyType({k: read_only(a) for k, a in self.channels.items()}))

    def __reduce__(self) -> tuple[type[Chunk], tuple[Array, dict[str, Array], Chunk | None]]:
        return Chunk, (self.t, dict(self.channels), self.previous)

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, name: str) -> Array:
        try:
            return self.channels[name]
        except KeyError:
            have = ", ".join(sorted(self.channels)) or "none"
            raise MissingChannel(
                f"channel '{name}' is needed and the recording has {have}; name it under source.channels"
            ) from None

    @property
    def dt(self) -> Array:
        """Duration of the step to each sample in s: a 0-d array where all are the same, else (N,).

        The first sample of a recording has no step before it: its dt is 0. Steps that are equal within the rounding
        of the time stamps are the same (`nominal`). A channel named `dt` takes the place of the differences of t.

        Law: cut anywhere, a recording with regular time stamps has the same steps to the bit. Where its step is
        neither one over a whole number nor a short decimal, or it has gaps, they may differ by the rounding of t.
        """
        known: Array | None = self.__dict__.get("_dt")  # no `cached_property`: its lock takes longer than the rest
        if known is None:
            known = self.__dict__["_dt"] = constant(self.channels["dt"]) if "dt" in self.channels else self._steps()
        return known

    def _steps(self) -> Array:
        """Return the duration of the step to each sample in s from the time stamps: 0-d, or (N,)."""
        before, t = self.t[:1] if self.previous is None else self.previous.t[-1:], self.t
        if len(t) == 1:
            step = float(t[0]) - float(before[0])
            usual = nominal(step, step, abs(float(t[0])))
            return np.array(step if usual is None else usual)
        steps = t - np.concatenate([before, t[:-1]])
        begins = 1 if self.previous is None else 0
        if len(t) > begins:
            usual = nominal(*extremes(steps[begins:]), max(abs(float(t[0])), abs(float(t[-1]))))
            if usual is not None:
                steps[begins:] = usual
        return constant(steps)

    @property
    def each_dt(self) -> Array:
        """Duration of the step to each sample (N,) in s, also where all are the same."""
        return self.dt.repeat(len(self.t)) if self.dt.ndim == 0 else self.dt.copy()

    def part(self, start: int, stop: int) -> Chunk:
        """Return the samples from `start` up to `stop`, with the one before them as `previous`."""
        if start <= 0 and stop >= len(self.t):
            return self
        before = self._rows(slice(start - 1, start), None) if start else self.previous
        return self._rows(slice(start, stop), before)

    def last(self) -> Chunk:
        """Return the last sample alone, as the `previous` of the next chunk."""
        return self.following(None) if len(self.t) == 1 else self._rows(slice(len(self.t) - 1, len(self.t)), None)

    def following(self, previous: Chunk | None, sensors: frozenset[str] | None = None) -> Chunk:
        """Return the same samples after another one, and with other channels for its `sensors` where they are given."""
        return made(self.t, self.channels, previous, self.sensors if sensors is None else sensors)

    def _rows(self, rows: slice, previous: Chunk | None) -> Chunk:
        # parts of what is locked are locked
        return made(self.t[rows], {key: a[rows] for key, a in self.channels.items()}, previous, self.sensors)

    def having(self, **channels: Array) -> Chunk:
        """Return the same samples with channels added or replaced."""
        known: Any = self.channels  # a proxy: to be unpacked it takes six times as long as its dict
        same = made(self.t, known | {k: read_only(a) for k, a in channels.items()}, self.previous, self.sensors)
        if "dt" not in channels and "_dt" in self.__dict__:
            same.__dict__["_dt"] = self.dt
        return same

    def where(self, keep: Flags) -> Chunk:
        """Return the samples where `keep` (N,) is true; `previous` stays."""
        channels = {key: locked(a[keep]) for key, a in self.channels.items()}
        return made(locked(self.t[keep]), channels, self.previous, self.sensors)


def made(t: Array, channels: Mapping[str, Array], previous: Chunk | None, sensors: frozenset[str]) -> Chunk:
    """Return a chunk of arrays that are locked already: they are not looked at again."""
    chunk = object.__new__(Chunk)
    own = chunk.__dict__
    own["t"], own["previous"], own["sensors"] = t, previous, sensors
    own["channels"] = channels if type(channels) is MappingProxyType else MappingProxyType(channels)
    return chunk


def locked(values: Array) -> Array:
    """Return an array that nobody else holds, which cannot be written to any more."""
    values.setflags(write=False)
    return values


def read_only(values: Array) -> Array:
    """Return the same values as an array that cannot be written to."""
    return locked(values.view()) if values.flags.writeable else values


def every(flags: Flags) -> bool:
    """Return True if all flags are true; of few sooner than NumPy does, of many as soon."""
    return b"\0" not in flags.tobytes()


def constant(values: Array) -> Array:
    """Return values (N,) as a 0-d array where all are the same."""
    return values[:1].reshape(()) if len(values) == 1 or (len(values) and np.all(values == values[0])) else values


def extremes(values: Array) -> tuple[float, float]:
    """Return the smallest and the largest of values (N,), NaN where one is."""
    if len(values) == 1:
        return float(values[0]), float(values[0])
    return float(values.min()), float(values.max())


def nominal(least: float, most: float, t: float) -> float | None:
    """Return the one step that steps from `least` to `most` of time stamps up to t in s are but for rounding, or None.

    Of what the rounding leaves open, it is one over a whole number of samples a second, or else the shortest decimal:
    the same whatever part of a recording is looked at.
    """
    rounding = 2 * ulp(t)  # of two time stamps, each read or multiplied
    low, high = most - rounding, least + rounding
    middle = (low + high) / 2
    if not low <= high or middle <= rounding:
        return None
    rate = round(1 / middle)
    if rate and low <= 1 / rate <= high:
        return 1 / rate
    return next((short for short in (round(middle, digits) for digits in range(17)) if low <= short <= high), middle)


def concatenate(chunks: Iterable[Chunk]) -> Chunk:
    """Join consecutive chunks that have the same channels into one."""
    parts = list(chunks)
    if len(parts) == 1:
        return parts[0]
    names = parts[0].channels.keys()
    return Chunk(
        np.concatenate([part.t for part in parts]),
        {name: np.concatenate([part[name] for part in parts]) for name in names},
        parts[0].previous,
        parts[0].sensors,
    )
