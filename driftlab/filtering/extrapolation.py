"""Extrapolation of effects beyond the inputs that they were fitted on: part of the bias's deviation.

Beyond its domain an effect holds (`Effect.held`). The error of that is bounded by its value if it went on as fitted,
less its value with channels and regressors held at the ends of their ranges::

    x(t) = S(u) theta - [S(u held)] held theta

A prediction from t_0 on is off by up to x(t) - x(t_0), since the bias at t_0 was measured. The running estimate is off
by what its filter has not followed yet, x less its lag of 1 / g with the gain g = P / noise^2 a second. N epochs, d
axes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.contracts import BiasModel, Effect, Memory, ThermalBias
from fusion_core.contracts.effect import as_measured
from fusion_core.fast import compiled


class Extrapolation:
    """Error of a bias whose effects are beyond their domains.

    Parameters
    ----------
    bias : BiasModel
        Of the tracked sensor.

    Attributes
    ----------
    memories : tuple of pairs
        Of both evaluations of each effect, after the last epoch.
    last, lagged : (d,) arrays
        x and its lag there.
    """

    def __init__(self, bias: BiasModel) -> None:
        self.effects = [effect for effect in with_domain(bias) if effect.coefficients]
        d = len(bias.axes)
        self.memories: tuple[tuple[Memory, Memory], ...] = ((None, None),) * len(self.effects)
        self.last, self.lagged = np.zeros(d), np.zeros(d)

    def look(self, chunk: Chunk) -> Array | None:
        """Return x (N, d) over the next epochs; None where it is zero."""
        if not self.effects:
            return None
        chunk = as_measured(chunk)
        x, after = None, []
        for effect, (held, free) in zip(self.effects, self.memories, strict=True):
            inside = effect.within_domain(chunk)
            unlimited, own = effect.signature(inside, held)
            within = effect.within_regressors(unlimited)
            if inside is chunk and free is held:  # no channel has ever been beyond
                on, other = unlimited, own
            else:
                on, other = effect.signature(chunk, free)
            after.append((own, own if other is None else other))
            if on is not within:
                part = (on - within) @ np.asarray(effect.coefficients)
                x = part if x is None else x + part
        self.memories, self.last = tuple(after), np.zeros_like(self.last) if x is None else x[-1]
        return x

    def of_estimate(self, x: Array | None, P: Array, dt: Array, noise: Array) -> Array | None:
        """Return the part of x (N, d) a filter of variance P (N, d) has not followed yet; noise (d,) is the sensor's.

        None where that is zero.
        """
        if not self.effects or (x is None and not np.count_nonzero(self.lagged)):
            return None
        x = np.zeros_like(P) if x is None else x
        self.lagged, left = self.lagged.copy(), np.empty_like(P)
        _follow(x, P / noise**2 * np.broadcast_to(dt, len(x))[:, None], self.lagged, left)
        return left


def with_domain(bias: BiasModel) -> Iterator[Effect]:
    """Yield the effects of a bias that have a domain."""
    if isinstance(bias, ThermalBias):
        yield from (effect for effect in bias.effects if effect.domain)


def beyond(effect: Effect, chunk: Chunk) -> Iterator[tuple[str, Flags]]:
    """Yield the channels of an effect that leave its domain, and in which samples (N,) they do."""
    for name in effect.domain or {}:
        if name in chunk.channels:
            values = chunk[name].reshape(len(chunk), -1)
            low, high = effect.ends(name).T
            rounding = 1e-9 * np.maximum(np.maximum(np.abs(low), np.abs(high)), 1.0)  # of a mean
            outside = np.any((values < low - rounding) | (values > high + rounding), axis=1)
            if np.any(outside):
                yield name, outside


@compiled
def _follow(x: Array, gain: Array, lagged: Array, left: Array) -> None:
    for k in range(len(x)):
        for j in range(len(lagged)):
            lagged[j] += (x[k, j] - lagged[j]) * gain[k, j] / (1 + gain[k, j])
            left[k, j] = x[k, j] - lagged[j]
