"""What an effect is made of: signals of channels and of time that a firmware can run too.

A signal has one value a sample; Reading, Elapsed and Fading begin one, the others are of signals:

::

    Behind    r = u - lag(u),    lag' = (u - lag) / tau, from equilibrium
    Play      r = y - u,         y follows u once u has crossed the width; from the middle
    Weighted  w_1 u_1 + w_2 u_2 + ... + offset
    Product   u v
    Limited   u, and beyond two limits the nearer one
    Function  f(u), within a range of u and continued beyond it

`Effect.realisation` and `Effect.realised_input` say what an effect is in these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from fusion_core.chunk import Array

_SLOPE = 1e-4  # of a function's range: the step over which its slope at the ends is taken


@dataclass(frozen=True)
class Reading:
    """A column of a channel that has so many columns."""

    channel: str
    column: int = 0
    columns: int = 1


@dataclass(frozen=True)
class Elapsed:
    """The time since the first sample, s."""


@dataclass(frozen=True)
class Fading:
    """exp(-t / tau), with t since the first sample."""

    tau: float  # s


@dataclass(frozen=True)
class Behind:
    """What of a signal a first-order lag has not followed yet; the signal is straight between its samples."""

    of: Signal
    tau: float  # s


@dataclass(frozen=True)
class Play:
    """Where in its loop a play operator stands: its output less its input, from -width / 2 to width / 2."""

    of: Signal
    width: float


@dataclass(frozen=True)
class Weighted:
    """A weighted sum of signals, and a constant."""

    terms: tuple[tuple[float, Signal], ...]
    offset: float = 0.0


@dataclass(frozen=True)
class Product:
    """The product of two signals."""

    a: Signal
    b: Signal


@dataclass(frozen=True)
class Limited:
    """A signal between two limits."""

    of: Signal
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Function:
    """A smooth function of a signal u (N,) -> (N,) on a range; beyond, its value at the end or its tangent there."""

    of: Signal
    values: Callable[[Array], Array]
    low: float
    high: float
    beyond: Literal["constant", "tangent"] = "constant"

    def at(self, u: Array) -> Array:
        """Return the function of u (N,), also beyond its range."""
        low, high = self.low, self.high
        edge = np.clip(u, low, high)
        values = np.asarray(self.values(edge))
        if self.beyond == "constant" or np.all(edge == u):
            return values
        step = _SLOPE * (high - low)
        k = np.arange(3)
        f, g = np.asarray(self.values(np.concatenate([low + step * k, high - step * k]))).reshape(2, 3)
        ends = np.array([-1.5, 2.0, -0.5]) / step  # one-sided differences of second order
        slope = np.where(u < low, ends @ f, -ends @ g)
        return np.asarray(values + slope * (u - edge))


Signal: TypeAlias = Reading | Elapsed | Fading | Behind | Play | Weighted | Product | Limited | Function

TEMPERATURE = Reading("temperature")


def lagged(of: Signal, tau: float) -> Signal:
    """Return a signal through a first-order lag."""
    return Weighted(((1.0, of), (-1.0, Behind(of, tau))))


def parts_of(signal: Signal) -> tuple[Signal, ...]:
    """Return the signals that a signal is made of."""
    match signal:
        case Behind() | Play() | Limited() | Function():
            return (signal.of,)
        case Weighted():
            return tuple(part for _, part in signal.terms)
        case Product():
            return (signal.a, signal.b)
        case _:
            return ()


def limited(signal: Signal, ends: Mapping[str, Sequence[tuple[float, float]]]) -> Signal:
    """Return a signal whose channels are held at their ends, a pair of limits a column.

    A function of a channel stays one: its table is as long as what the channel is held to.
    """
    match signal:
        case Reading() if signal.channel in ends:
            return Limited(signal, *ends[signal.channel][signal.column])
        case Function(of=Reading() as of) if of.channel in ends:
            low, high = ends[of.channel][of.column]
            if low < high:
                return Function(of, signal.at, low, high)
            return replace(signal, values=lambda u: signal.at(np.full_like(u, low)), beyond="constant")
        case Behind() | Play() | Limited() | Function():
            return replace(signal, of=limited(signal.of, ends))
        case Weighted():
            return replace(signal, terms=tuple((weight, limited(part, ends)) for weight, part in signal.terms))
        case Product():
            return replace(signal, a=limited(signal.a, ends), b=limited(signal.b, ends))
        case _:
            return signal


def walk(signal: Signal) -> Iterator[Signal]:
    """Yield all that a signal is made of, parts before what they are parts of, and itself last."""
    for part in parts_of(signal):
        yield from walk(part)
    yield signal
