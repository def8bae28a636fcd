"""Widths of the bands of posterior maps, as measured (`driftlab.family.band_calibration`). d axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict

from fusion_core.chunk import Array

LEVELS = (0.68, 0.95, 0.997)


@dataclass(frozen=True, eq=False)
class Band:
    """Factors (3, d) of a posterior's deviation outside of low to high degC, one a level.

    Between them, and of what was never measured, 1. `far` (d,) is the distance that one unit in a hundred exceeds, None
    where it was not measured.
    """

    low: float
    high: float
    factors: Array
    far: Array | None = None

    def factor(self, T: Array, step: float) -> Array:
        """Return the factor (N, d) at T (N,) with which 95 of 100 are within 1.96 sigma; it goes over within a step."""
        beyond = np.maximum(np.maximum(self.low - T, T - self.high), 0.0)[:, None]
        share = np.minimum(beyond / step, 1.0)
        return np.asarray(1 - share + self.factors[1] * share)


class Typical(BaseModel):
    """Noise of the family's units: medians (d,) of white noise, SI/sqrt(Hz), and walk, SI/sqrt(s).

    The spreads are standard deviations of their logarithms over units.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    white: tuple[float, ...]
    walk: tuple[float, ...]
    white_spread: tuple[float, ...]
    walk_spread: tuple[float, ...]


class Bands(BaseModel):
    """Measurements on units left out of their family, as `family.json` has them.

    Attributes
    ----------
    units : int
        Number that were left out in turn.
    levels : tuple of float
        Shares that are to lie within.
    parts : (P, 2)
        Ranges that were taken to be seen, as shares of the family's.
    factors : (P, 3, d)
        At temperatures outside of it.
    far : (P, d)
        The `distance` that one in a hundred of them has from its family.
    noise : Typical
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: int
    levels: tuple[float, ...] = LEVELS
    parts: tuple[tuple[float, float], ...]
    factors: tuple[tuple[tuple[float, ...], ...], ...]
    far: tuple[tuple[float, ...], ...]
    noise: Typical

    def band(self, domain: tuple[float, float], seen: tuple[float, float]) -> Band:
        """Return the band of a unit by the part that is most like the range it saw of the family's domain, degC."""
        low, high = domain
        share = (np.array(seen) - low) / (high - low)
        k = int(np.argmin(np.sum(np.abs(share - np.array(self.parts)), axis=1)))
        return Band(*seen, np.array(self.factors[k]), np.array(self.far[k]))


def deviation(B: Array, covariance: Array) -> Array:
    """Return the deviation (N, d) of a curve B (N, q) c, c of the covariance (d, q, q)."""
    variance = np.sum((B @ covariance) * B, axis=2)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0))).T
