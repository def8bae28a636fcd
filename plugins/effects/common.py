"""The common part of effects: lags of a channel, and the hyper-parameters that recordings of a search are worth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

import numpy as np

import fusion_core.contracts.table as core
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory

E = TypeVar("E", bound=Effect)
_NOISE = 6.0  # deviations of the thermometer: noise of thousands of samples spans about that much


class OfChannel(Effect):
    """An effect that reads one channel."""

    channel: str

    @property
    def requires(self) -> tuple[str, ...]:
        """The channel."""
        return (self.channel,)


class FadingLag(Effect):
    """An effect whose state is that of one first-order lag of `tau`, a hyper-parameter."""

    def fading(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return exp(-dt / tau), 1 at the first sample of all; the memory is whether there were samples before."""
        from fusion_core.recursions import lag_fading

        return lag_fading(chunk.dt, len(chunk), self.hyper_parameters["tau"], memory is not None), True

    @property
    def memory_span(self) -> float:
        """Of the lag."""
        return self.hyper_parameters["tau"]


def lag_of(chunk: Chunk, u: Array, tau: float, memory: Memory) -> tuple[Array, Memory]:
    """Return a signal u (N,) through a first-order lag, from equilibrium; the memory is the last input and output."""
    from fusion_core.recursions import lag

    before, y = (u[0], u[0]) if memory is None else memory
    output = lag(np.ascontiguousarray(np.broadcast_to(chunk.dt, u.shape)), u, tau, before, y)
    return output, (float(u[-1]), float(output[-1]))


def varied(effect: E, name: str, values: Iterable[float]) -> Iterator[E]:
    """Yield copies of an effect, each with another value of a hyper-parameter."""
    return (effect.model_copy(update={name: value}) for value in values)


def auxiliary(recordings: Sequence[Chunk]) -> list[str]:
    """Return the auxiliary channels that all recordings have, thermometers left out: other effects are about those."""
    return sorted(name for name in core.auxiliary(recordings) if not name.startswith("temperature"))


def scalars(recordings: Sequence[Chunk]) -> list[str]:
    """Return temperature, where it is recorded, and the auxiliary channels, of those that have one column."""
    first = recordings[0].channels
    return [name for name in ("temperature", *auxiliary(recordings)) if name in first and first[name].ndim == 1]


def longest_span(recordings: Sequence[Chunk]) -> float:
    """Return the length of the longest recording, in s."""
    return max(float(chunk.t[-1] - chunk.t[0]) for chunk in recordings)


def up_to(grid: Array, most: float) -> list[float]:
    """Return the values of a grid that are at most `most`."""
    return [float(value) for value in grid if value <= most]


def largest_reversal(x: Array) -> float:
    """Return the largest way back of x (N,) after a turn, either way; 0 where there is none beyond its ripple.

    A way back counts up to twice the way there: a play that starts in its middle is dragged after half its width, and
    what it is not dragged through, it does not answer to differently.
    """
    largest = max(_largest_drop(x), _largest_drop(-x))
    steps = np.abs(np.diff(x))
    steps = steps[steps > 0]
    if len(steps) < 2:
        return 0.0
    noise = float(np.median(np.abs(np.diff(x, n=2)))) / 0.6745 / np.sqrt(6)
    return largest if largest > max(_NOISE * noise, 1.5 * float(np.min(steps))) else 0.0


def _largest_drop(x: Array) -> float:
    before = x - np.minimum.accumulate(x)
    after = x - np.minimum.accumulate(x[::-1])[::-1]
    return float(np.max(np.minimum(2 * before, after), initial=0.0))
