"""Control charts of single units: Shewhart's (individuals, moving ranges) and the EWMA.

Values are in a scale in which they are about normal, in the order in which the units were made. Of value i with the
deviation sigma_i = sqrt(s^2 + own_i^2), s between the units and own_i of its measurement::

    z_i = (x_i - centre) / sigma_i,         alarm beyond 3
    w_i = (1 - lambda) w_{i-1} + lambda z_i,  alarm beyond 2.962 sqrt(lambda / (2 - lambda) (1 - (1 - lambda)^{2 i}))

s is of the moving range of the units on which the limits stand, so that neither a shift nor a drift of the line widens
them. Sources: Montgomery, Introduction to Statistical Quality Control, 7th ed., 6.4 and 9.2 (table 9.11: lambda 0.2,
L 2.962 alarm once in 500 units of a line in control; three sigma, once in 370); NIST/SEMATECH e-Handbook 6.3.2.
n values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array

SIGMAS = 3.0
LAMBDA, L = 0.2, 2.962
D2 = float(2 / np.sqrt(np.pi))  # mean moving range of normal values over their deviation: 1.128
MEDIAN_RANGE = 0.9539  # and their median: sqrt(2) times the third quartile of a normal value
D4 = 3.686  # deviations that a moving range may have: D4 d2 = 3.267 * 1.128
WITHIN = 0.9754  # mean of the moving ranges that are below D4 deviations, over that of all


@dataclass(frozen=True)
class InControl:
    """What the line does where nothing has happened.

    Attributes
    ----------
    centre : float
    spread : float
        s, the deviation between units without that of their measurement.
    share : float
        What the own deviations are multiplied by: below 1 where they claim more than the values scatter.
    """

    centre: float
    spread: float
    share: float = 1.0

    def sigma(self, own: Array) -> Array:
        """Return the deviation (n,) of values measured with own deviations (n,)."""
        return np.asarray(np.hypot(self.spread, self.share * own))


def in_control(x: Array, own: Array) -> InControl:
    """Return centre and spread of values x (n,), at least two, with own deviations (n,), 0 where not known.

    Neither single odd values nor a shift among them count: the centre is an M-estimate, the spread of moving ranges of
    which those that no chart would let pass are left out.
    """
    low, high = 0.0, _short_term(x)
    if high == 0.0:
        return InControl(float(np.median(x)), 0.0)
    if not np.any(own):
        return InControl(_middle(x, np.full(len(x), high)), high)
    about = x - np.median(x)
    tight = _short_term(about / np.where(own > 0, own, np.median(own[own > 0])))
    if tight <= 1:  # the own deviations alone claim more than is there
        least = 1e-3 * high
        return InControl(_middle(x, np.hypot(least, tight * own)), least, tight)
    for _ in range(40):  # the more spread, the less do standardised values range: one root
        s = (low + high) / 2
        low, high = (s, high) if _short_term(about / np.hypot(s, own)) > 1 else (low, s)
    return InControl(_middle(x, np.hypot(s, own)), s)


def _short_term(x: Array) -> float:
    """Return the deviation from one unit to the next, by the mean of the moving ranges that are in control."""
    ranges = np.abs(np.diff(x))
    rough = float(np.median(ranges)) / MEDIAN_RANGE
    kept = ranges[ranges <= D4 * rough] if rough > 0 else ranges
    return float(np.mean(kept)) / (D2 * (WITHIN if rough > 0 else 1.0))


def _middle(x: Array, sigma: Array) -> float:
    """Return Huber's M-estimate of the mean of x (n,) with deviations (n,)."""
    centre = float(np.median(x))
    for _ in range(20):
        weight = np.minimum(1.345 / np.maximum(np.abs(x - centre) / sigma, 1e-12), 1.0) / sigma**2
        centre = float(np.sum(weight * x) / np.sum(weight))
    return centre


def ewma(z: Array, weight: float = LAMBDA, most: float = SIGMAS) -> Array:
    """Return the EWMA (..., n) of z (..., n), which counts to `most`.

    What is further out is for Shewhart's chart to say; else one odd unit would hold the EWMA out of its limits for ten.
    Clipped at three, it alarms once in 530 units.
    """
    from scipy.signal import lfilter

    return np.asarray(lfilter([weight], [1, weight - 1], np.clip(z, -most, most)))


def ewma_limit(n: int, weight: float = LAMBDA, width: float = L) -> Array:
    """Return how far the EWMA (n,) may be from 0, which is less for the first units."""
    return np.asarray(width * np.sqrt(weight / (2 - weight) * (1 - (1 - weight) ** (2.0 * np.arange(1, n + 1)))))
