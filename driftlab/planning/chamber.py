"""Chamber profiles that can be planned: set points over time, and the temperature of the body that follows them.

Set points are joined by straight lines. A body with a lag of first order follows the chamber
(`fusion_core.recursions.LaggedLines`), so a fast ramp turns before the body is there: a profile covers what its body
covers. M set points, N times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion_core.chunk import Array
from fusion_core.recursions import LaggedLines

ProfileShape = Literal["staircase", "ramps", "mixed"]

REACHED = 0.01  # of the range: as near as the body is to be to both ends
SHORTEST = 300.0  # s, that a staircase holds a level


@dataclass(frozen=True)
class Chamber:
    """Abilities of the chamber, and the range that is asked of it."""

    low: float  # lowest temperature that the map is for, degC
    high: float  # highest, degC
    start: float  # temperature of chamber and body at the beginning, degC
    rate: float  # fastest change, K/s
    lag: float  # time constant with which the unit's body follows, s

    @property
    def swing(self) -> float:
        """Width of the range in K."""
        return self.high - self.low

    def settling(self, rate: float) -> float:
        """Return the hold of an end in s, after a ramp of `rate` in K/s, until the body is there."""
        behind = rate * self.lag / (REACHED * self.swing)
        return self.lag * float(np.log(behind)) if behind > 1 else 0.0


@dataclass(frozen=True, eq=False)
class Profile:
    """Set points of a chamber."""

    name: str  # a description in words
    family: ProfileShape  # `staircase`, `ramps` or `mixed`
    time: Array  # (M,): of the set points, from 0 on, s
    temperature: Array  # (M,): set points, degC; straight lines in between

    @property
    def duration(self) -> float:
        """Length in s."""
        return float(self.time[-1])

    @property
    def hours(self) -> float:
        """Length in h."""
        return self.duration / 3600

    @cached_property
    def rates(self) -> Array:
        """Rate of each straight line (M - 1,), K/s."""
        return np.asarray(np.diff(self.temperature) / np.diff(self.time))

    @property
    def reversals(self) -> int:
        """Number of turns from warming to cooling or back."""
        moving = np.sign(self.rates[self.rates != 0])
        return int(np.sum(np.diff(moving) != 0))

    def chamber(self, t: ArrayLike) -> Array:
        """Return the set point (N,) in degC at t (N,) in s; the last one is held."""
        return np.asarray(np.interp(np.asarray(t), self.time, self.temperature), dtype=np.float64)

    def body(self, t: ArrayLike, lag: float) -> Array:
        """Return the temperature (N,) in degC at t (N,) in s of a body that follows after `lag` s, in balance at 0."""
        at = np.asarray(t, dtype=np.float64)
        return LaggedLines.behind(self.time, self.temperature, lag).lagged(at) if lag else self.chamber(at)

    def samples(self, lag: float, count: int) -> tuple[Array, Array]:
        """Return `count` times (N,) in s, each in the middle of an even part of the profile, and the body's T (N,)."""
        t = np.asarray((np.arange(count) + 0.5) * (self.duration / count), dtype=np.float64)
        return t, self.body(t, lag)


def staircase(chamber: Chamber, hours: float, step: float, *, down: bool = False) -> Profile | None:
    """Return levels every `step` K from low to high, each held alike; with `down` the same ones back.

    None where the hours are too short to hold each for SHORTEST: it would be a ramp by another name.
    """
    count = max(1, round(chamber.swing / step))
    levels = np.linspace(chamber.low, chamber.high, count + 1)
    levels = np.concatenate([levels, levels[::-1]]) if down else levels
    moves = _moves(chamber, levels)
    hold = (hours * 3600 - np.sum(moves)) / len(levels)
    if hold < SHORTEST:
        return None
    way = "up and down" if down else "one way"
    name = f"staircase {way}, {chamber.swing / count:.3g} K steps of {_long(hold)}"
    return _joined(name, "staircase", chamber, levels, np.full(len(levels), hold), moves)


def ramps(chamber: Chamber, hours: float, cycles: int) -> Profile | None:
    """Return straight ramps, `cycles` times up and down, each end held until the body is there.

    They are as slow as the hours leave them; None where the chamber cannot be so fast.
    """
    levels = np.append(np.tile([chamber.low, chamber.high], cycles), chamber.low)
    if (rate := _rate(chamber, hours, levels)) is None:
        return None
    hold = chamber.settling(rate)
    moves = np.append(_moves(chamber, levels)[:1], np.full(2 * cycles, chamber.swing / rate))
    times = "once" if cycles == 1 else f"{cycles} times"
    held = f", {_long(hold)} at the ends" if hold > 0 else ""
    name = f"ramps {times} up and down, {60 * rate:.2g} K/min{held}"
    return _joined(name, "ramps", chamber, levels, np.full(len(levels), hold), moves)


def quickest(chamber: Chamber, cycles: int) -> float:
    """Return the hours below which `ramps` are None: as fast as chamber and body can."""
    ends = 2 * cycles + 1
    rate = _fastest(chamber, ends)
    moves = abs(chamber.start - chamber.low) / chamber.rate + (ends - 1) * chamber.swing / rate
    return (1 + 1e-9) * (moves + ends * chamber.settling(rate)) / 3600


def mixed(chamber: Chamber, hours: float, cycles: int, step: float) -> Profile | None:
    """Return ramps for half of the hours, then levels up and down: rates and holds that tell effects apart."""
    first = ramps(chamber, hours / 2, cycles)
    held = first and staircase(replace(chamber, start=chamber.low), hours / 2, step, down=True)
    if first is None or held is None:
        return None
    name = f"{first.name}; then a {held.name}"
    time = np.concatenate([first.time, first.duration + held.time[1:]])
    return Profile(name, "mixed", time, np.concatenate([first.temperature, held.temperature[1:]]))


def _rate(chamber: Chamber, hours: float, levels: Array) -> float | None:
    """Return the slowest rate with which ramps between levels, and holds at them, fill the hours; None: none does."""
    from scipy.optimize import brentq

    left, count = hours * 3600 - abs(chamber.start - levels[0]) / chamber.rate, len(levels)
    way = (count - 1) * chamber.swing

    def spare(log: float) -> float:
        rate = float(np.exp(log))
        return float(left - way / rate - count * chamber.settling(rate))

    fastest = _fastest(chamber, count)
    if spare(np.log(fastest)) < 0:
        return None
    return float(np.exp(brentq(spare, np.log(chamber.swing / (hours * 3600)) - 1.0, np.log(fastest))))


def _fastest(chamber: Chamber, ends: int) -> float:
    """Return the rate, K/s, beyond which the body needs longer at the ends than the ramps between are shorter."""
    if chamber.lag == 0:
        return chamber.rate
    return min(chamber.rate, (ends - 1) * chamber.swing / (ends * chamber.lag))


def _moves(chamber: Chamber, levels: Array) -> Array:
    """Return the time of the chamber to each level from the one before, at its fastest, s."""
    return np.asarray(np.abs(np.diff(levels, prepend=chamber.start)) / chamber.rate)


def _joined(name: str, family: ProfileShape, chamber: Chamber, levels: Array, holds: Array, moves: Array) -> Profile:
    """Return the profile of levels (L,), each reached in `moves` (L,) and held for `holds` (L,) s."""
    begin = np.cumsum(moves) + np.append(0.0, np.cumsum(holds)[:-1])
    time = np.concatenate([[0.0], np.column_stack([begin, begin + holds]).ravel()])
    temperature = np.concatenate([[chamber.start], np.repeat(levels, 2)])
    keep = np.append(True, np.diff(time) > 1e-6)
    return Profile(name, family, time[keep], temperature[keep])


def _long(seconds: float) -> str:
    return f"{seconds / 3600:.3g} h" if seconds >= 5400 else f"{max(seconds / 60, 0.1):.2g} min"
