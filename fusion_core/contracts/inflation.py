"""What the noise of a sensor must be multiplied with, as innovations of a run say: what an exporter of noise is given.

d axes, K lags.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array


@dataclass(frozen=True)
class Factor:
    """A factor on a deviation and its 95 % interval, each (d,)."""

    value: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Lag:
    """What a bias does over a time, by the differences of adjacent means over it.

    Attributes
    ----------
    seconds : float
        The lag.
    ratio : (d,) array
        Rms of the differences over what noise and walk with their factors say.
    high : (d,) array
        What a right model exceeds with a probability of 0.1 %.
    walk : (d,) array
        Factor on the walk that would make the ratio one; 0 where white noise alone is more.
    count : int
        Differences.
    """

    seconds: float
    ratio: Array
    high: Array
    walk: Array
    count: int


@dataclass(frozen=True)
class Inflation:
    """Factors on white noise and walk with which innovations are as large as they are said to be.

    Attributes
    ----------
    noise, walk : (d,) arrays
        Densities that the factors are on, unit/sqrt(Hz) and unit/sqrt(s).
    of_noise, of_walk : Factor
        Those that make the innovations most likely.
    lags : tuple of Lag
        What they are worth over longer times than from one update to the next, as far as the run lasts.
    """

    noise: Array
    walk: Array
    of_noise: Factor
    of_walk: Factor
    lags: tuple[Lag, ...] = ()

    def of_walk_up_to(self, horizon: float) -> Array:
        """Return the factor (d,) on the walk with which no lag up to `horizon`, s, is more than it may be."""
        factor = self.of_walk.value
        for lag in self.lags:
            if lag.seconds <= horizon:
                factor = np.where(lag.ratio > lag.high, np.maximum(factor, lag.walk), factor)
        return np.asarray(factor)
