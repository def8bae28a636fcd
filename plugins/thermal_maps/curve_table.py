"""A smooth curve as a table of polynomials, for many temperatures: d axes, N temperatures.

Over each of INTERVALS equal parts of the domain stands the polynomial of fifth degree through the six nodes about it.
Its error is that of interpolation, (h / s)^6 for nodes h apart and a curve that bends over s; it is measured halfway
between the nodes, against the curve itself, and a curve that is not that smooth has no table. A pulse that lies whole
between two of these temperatures would not be seen: it is narrower than 1/4096 of the domain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion_core.chunk import Array, extremes, read_only
from fusion_core.fast import compiled

INTERVALS = 2048
NODES = np.arange(-2.0, 4.0) - 0.5  # of one polynomial, about the middle of its interval and in its width
EXACT = 1e-13  # of the largest value: as near as the curve's own arithmetic, whose sums are in another order


@dataclass(frozen=True)
class CurveTable:
    """The table: coefficients (INTERVALS, 6, d), the lowest power first, of the place within each interval."""

    low: float
    high: float
    coefficients: Array

    @classmethod
    def of(cls, curve: Callable[[Array], Array], domain: tuple[float, float]) -> Self | None:
        """Return the table of a curve, (N,) in degC to (N, d), over its domain; None where one would not be exact."""
        nodes = np.linspace(*domain, INTERVALS + 1)
        values = curve(nodes)
        # at either end the polynomial of the first, or last, whole set of nodes stands for its neighbours too
        first = np.clip(np.arange(INTERVALS) - 2, 0, INTERVALS - 5)
        through = values[first[:, None] + np.arange(6)]
        shifts = first - (np.arange(INTERVALS) - 2)
        coefficients = np.empty_like(through)
        for shift in np.unique(shifts):
            here = shifts == shift
            coefficients[here] = np.linalg.inv(np.vander(NODES + shift, increasing=True)) @ through[here]
        table = cls(*domain, coefficients)
        halfway = (nodes[1:] + nodes[:-1]) / 2
        exact = np.abs(table.at(halfway) - curve(halfway)) <= EXACT * np.max(np.abs(values))
        return table if np.all(exact) else None

    def covers(self, T: Array) -> bool:
        """Return True if all of one temperature or more (N,) are within the domain."""
        coldest, hottest = extremes(T)
        return self.low <= coldest and hottest <= self.high

    def at(self, T: Array) -> Array:
        """Return the curve (N, d) at temperatures (N,) within the domain."""
        # what a map is given cannot be written to: of that kind alone is a loop compiled
        return np.asarray(_at(read_only(T), self.low, INTERVALS / (self.high - self.low), self.coefficients))


@compiled
def _at(T: Array, low: float, scale: float, coefficients: Array) -> Array:
    count, powers, d = coefficients.shape
    values = np.empty((len(T), d))
    for k in range(len(T)):
        place = (T[k] - low) * scale
        i = min(int(place), count - 1)
        x = place - i - 0.5
        for j in range(d):
            value = coefficients[i, powers - 1, j]
            for p in range(powers - 2, -1, -1):
                value = value * x + coefficients[i, p, j]
            values[k, j] = value
    return values
