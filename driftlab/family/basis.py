"""Basis in which the maps of a family are compared: cubic B-splines whose knots every unit shares.

The knots lie at whole multiples of a step, so the information of one unit, whatever range it saw, is about the same
coefficients as that of any other. Coefficient k, of the spline that peaks at the knot k step, is about the value
of the curve there. q splines, N temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fusion_core.chunk import Array, read_only

STEP = 2.5  # K: what one map of a family may have and the others not is about as wide
DEGREE = 3


@dataclass(frozen=True)
class SplineBasis:
    """Equal intervals between `first` and `first + intervals` times `step`.

    Attributes
    ----------
    first : int
        Lower end of the domain, in steps from 0 degC.
    intervals : int
    step : float
        K.
    """

    first: int
    intervals: int
    step: float = STEP

    @classmethod
    def covering(cls, low: float, high: float, step: float = STEP) -> SplineBasis:
        """Return the fewest intervals that hold the temperatures from low to high, degC."""
        first = int(np.floor(low / step + 1e-9))
        return cls(first, max(int(np.ceil(high / step - 1e-9)) - first, 1), step)

    @classmethod
    def over(cls, T: Array, step: float = STEP) -> SplineBasis:
        """Return the fewest intervals that hold the temperatures T (N,), degC."""
        return cls.covering(float(T.min()), float(T.max()), step)

    @property
    def domain(self) -> tuple[float, float]:
        """Lowest and highest temperature, degC."""
        return self.first * self.step, (self.first + self.intervals) * self.step

    @property
    def q(self) -> int:
        """Number of splines."""
        return self.intervals + DEGREE

    @property
    def peaks(self) -> Array:
        """Temperature (q,) at which each spline peaks, degC; the outermost lie one step beyond the domain."""
        return np.asarray((self.first - 1 + np.arange(self.q)) * self.step, dtype=np.float64)

    def values(self, T: Array) -> Array:
        """Return the splines (N, q) at T (N,) degC; beyond the domain those at its ends."""
        x = np.clip(T / self.step - self.first, 0, self.intervals)
        k = np.minimum(x.astype(np.intp), self.intervals - 1)
        u, places = x - k, np.arange(len(x)) * self.q + k
        B = np.zeros(len(x) * self.q)
        for j, spline in enumerate(((1 - u) ** 3, (3 * u - 6) * u**2 + 4, ((3 - 3 * u) * u + 3) * u + 1, u**3)):
            B[places + j] = spline / 6
        return B.reshape(len(x), self.q)

    @lru_cache(maxsize=16)  # noqa: B019  # of a family's knots, which all its units have
    def grid(self, of_interval: int) -> tuple[Array, Array]:
        """Return temperatures (N,) over the domain, so many of each interval, degC, and the splines there (N, q)."""
        T = np.linspace(*self.domain, of_interval * self.intervals + 1)
        return read_only(T), read_only(self.values(T))

    def within(self, wider: SplineBasis) -> slice:
        """Return the coefficients of a wider domain that are those of this one.

        Raises
        ------
        ValueError
            If the steps differ, or the domain is not wider.
        """
        start = self.first - wider.first
        if self.step != wider.step or start < 0 or start + self.intervals > wider.intervals:
            raise ValueError(f"knots of {self.domain} °C, {self.step} K apart, are no part of those of {wider}")
        return slice(start, start + self.q)

    def joined(self, other: SplineBasis) -> SplineBasis:
        """Return the knots of both domains and of what is between them."""
        first = min(self.first, other.first)
        return SplineBasis(first, max(self.first + self.intervals, other.first + other.intervals) - first, self.step)
