"""What a line watches of a unit, each with its deviation: `driftlab.family.record.FIGURES`.

The residual is what 30 s averages of the soak leave of the own map, rms. Its deviation is that from soak to soak: with
n averages whose noise has the covariance C after a curve was fitted to them, the mean square has the variance
2 tr(C^2) / n^2 about tr(C) / n, and most of it is the walk's. The curve is the family's basis. The swing is as sure as
the curve's change between its ends. A coast over T is as sure as its reference (`driftlab.judging.measured`), and the
walk w of the density k that it happened to take has a mean square of which::

    E = k^2 T / 2,    Var = k^4 T^2 / 3

Squares of a walk are skew, of a few draws: their rms is taken for lognormal, sigma^2 = log(1 + Var / E^2) / 4 of its
logarithm, which for small Var / E^2 is what the derivative says. d axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from driftlab.family.record import Figure
from driftlab.family.repeatability import hysteresis_of, soaks_of
from driftlab.judging.limits import SIDE
from driftlab.judging.measured import coast_over, of_map
from driftlab.judging.yardsticks import HORIZONS
from driftlab.maps.residual import AVERAGED

if TYPE_CHECKING:
    from driftlab.family.densities import Densities
    from driftlab.family.soaked import Soaked
    from driftlab.judging.limits import Measured
    from driftlab.judging.yardsticks import Yardsticks
    from fusion_core.chunk import Array
    from fusion_core.contracts import FittedMap

NAMES = {"1 min": "coast_1min", "5 min": "coast_5min", "10 min": "coast", "to the end": "coast_end"}
MOST = 300  # averages whose covariance is written down


def figures_of(fitted: FittedMap, soaked: Soaked, densities: Densities) -> dict[str, Figure]:
    """Return the figures of map and soak."""
    measured = of_map(fitted)
    return {
        "residual": figure(measured["residual"].values, residual_sigma(measured["residual"].values, soaked)),
        "noise": figure(densities.white, densities.white_sigma),
        "walk": figure(densities.walk, densities.walk_sigma),
        "swing": figure(measured["swing"].values, _sigma(measured["swing"])),
        "hysteresis": hysteresis_of(soaked.recordings, densities.white, densities.likely, soaked.knots.step),
        "soaks": soaks_of(soaked.recordings, soaked.knots.step),
    }


def coasts_of(yardsticks: Yardsticks, length: float, noise: Array, walk: Array) -> dict[str, Figure]:
    """Return the coasts of a run.

    `length` is of what there is after the alignment, s, `noise` and `walk` (d,) the densities of white noise and walk.
    """
    found = {}
    for horizon in HORIZONS:
        measured = coast_over(horizon, yardsticks, length, noise)
        known = not measured.missing
        values = measured.values if known else np.full(len(measured.axes), np.nan)
        walked = np.minimum(walk**2 * min(HORIZONS[horizon], length) / 2, values**2)  # a map fitted on it took the rest
        positive = np.where(values > 0, values, np.nan)
        spread = 4 * (_sigma(measured) / positive) ** 2 + 4 / 3 * (walked / positive**2) ** 2 if known else values
        found[NAMES[horizon]] = figure(values, _rms_sigma(values, spread))
    return found


def figure(values: Array, sigma: Array) -> Figure:
    """Return a figure of values and their deviations (d,), None where they are not known."""
    both = ([float(v) if np.isfinite(v) else None for v in part] for part in (values, sigma))
    return Figure(value=tuple(next(both)), sigma=tuple(next(both)))


def unknown(d: int) -> Mapping[str, Figure]:
    """Return the coasts of a unit that was not coasted."""
    return dict.fromkeys(NAMES.values(), Figure(value=(None,) * d, sigma=(None,) * d))


def _sigma(measured: Measured) -> Array:
    if measured.low is None or measured.high is None:
        return np.full(len(measured.axes), np.nan)
    return np.asarray((measured.high - measured.low) / (2 * SIDE))


def _rms_sigma(rms: Array, spread: Array) -> Array:
    """Return the deviation (d,) of a rms (d,) of which the mean square has so large a variance over its square (d,)."""
    return np.asarray(rms * np.sqrt(np.log1p(spread)) / 2)


def residual_sigma(residual: Array, soaked: Soaked) -> Array:
    """Return the deviation (d,) from soak to soak of the residual (d,) of a unit."""
    rows = soaked.recordings
    n = sum(float(np.sum(part.span)) for part in rows) / AVERAGED
    count = sum(len(part.T) for part in rows)
    size = max(round(AVERAGED * count / (n * AVERAGED)), -(-count // MOST), 1)
    parts = [np.arange(0, max(len(part.T) - size, 0) + 1, size) for part in rows]
    T = np.concatenate(
        [np.add.reduceat(p.T, c) / np.diff(c, append=len(p.T)) for p, c in zip(rows, parts, strict=True)]
    )
    Q = np.linalg.svd(soaked.knots.values(T), full_matrices=False)
    U = Q[0][:, Q[1] > 1e-6 * Q[1][0]]
    walks, at = np.zeros((len(T), len(T))), 0
    for part, cuts in zip(rows, parts, strict=True):
        t = part.t[cuts] - part.t[0]
        own = np.minimum(t[:, None], t[None, :])
        walks[at : at + len(t), at : at + len(t)] = own
        at += len(t)
    walks = walks - U @ (U.T @ walks)
    walks = walks - (walks @ U) @ U.T
    white, walk = soaked.white**2 / AVERAGED, soaked.walk**2
    share, K = max(1 - U.shape[1] / len(T), 0.0), len(T)
    squares = white**2 * share / n + 2 * white * walk * np.trace(walks) / (n * K) + walk**2 * np.sum(walks**2) / K**2
    mean = white * share + walk * np.trace(walks) / K
    # a share of the residual: how large the walk is, a soak knows no better than it knows the residual
    return _rms_sigma(residual, 2 * squares / np.maximum(mean, np.finfo(float).tiny) ** 2)
