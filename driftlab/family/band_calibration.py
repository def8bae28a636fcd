"""Calibration of the bands of posterior maps on units that their family was not fitted on.

A posterior's deviation is right in the mean of the squares whatever the family's law; that 95 of 100 lie within 1.96
of it is so for a Gaussian law alone. So units are left out of the family in folds, each is taken as if a part of its
range had been soaked, and the map that follows is compared with the one of its whole soak::

    z(T) = B(T) (c_part - c_whole) / s(T),    s^2 = B (C_part - C_whole) B'

the whole soak's data including the part's (C are the posterior covariances). The share p of |z| at temperatures that
the part did not see is below its p-quantile; as a multiple f of a Gaussian's it is the width of the bands there (split
conformal prediction: Lei et al., Distribution-free predictive inference for regression, J. Am. Stat. Assoc. 113, 2018).
The rest after the whole soak is noise that both maps share, and cannot be measured: of the part's variance V only the
share g that the whole takes away is scaled, f^2 g + 1 - g. Where the part saw, all is taken as it is. d axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from driftlab.family.bands import LEVELS, Bands, Typical, deviation
from driftlab.family.mixed_model import Family, Posterior, fit_family
from driftlab.family.parallel import ParallelMap, serial
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import common_walk
from fusion_core.chunk import Array

PARTS = tuple((at * (1 - share), at * (1 - share) + share) for share in (0.2, 0.4, 0.7) for at in (0.0, 0.5, 1.0))
"""Lower and upper end of what a left-out unit is taken to have seen, as shares of the family's range."""
FOLDS = 5
FAR = 0.01  # of the units left out have a larger distance than `far`
MIN_UNITS = 10  # below which nothing is measured
MAX_LEFT_OUT = 200  # units, so that the time does not grow with the family
ONE_AXIS = 50  # units from which on an axis has factors of its own
SEEN = 0.9  # of the family's range, that a unit must have seen to be a measure
GRID = 2  # temperatures an interval
ALIKE, PASSES = 16, 1.3  # units that tell a common walk; times the likely walk, that passes ask for
GAINED = 0.05  # of a variance, that the whole soak must have taken away
SAMPLE = 400  # units of a larger family that the bands are to be measured on

Pairs = Sequence[tuple[UnitInformation, str]]


def sample_of(count: int) -> set[int]:
    """Return the places of the sampled units, of so many."""
    return set(np.linspace(0, count - 1, min(count, SAMPLE)).astype(int).tolist())


def measure_bands(family: Family, units: Pairs, each: ParallelMap = serial) -> Bands | None:
    """Return the factors of a family, or None where too few units saw its whole range.

    A part in which no unit has samples is left out: the nearest other part is taken for it.

    Parameters
    ----------
    family : Family
    units : sequence of (UnitInformation, str)
        Its units and their lots, or a sample of them.
    each : ParallelMap, optional
        Goes through the folds.
    """
    first, last = np.array([soaked.knots.domain for soaked, _ in units]).T
    whole = float(np.quantile(first, 0.25)), float(np.quantile(last, 0.75))  # of most: one may have seen more
    long = np.flatnonzero((last - first) / (whole[1] - whole[0]) >= SEEN)
    if len(long) < MIN_UNITS:
        return None
    long = long[np.unique(np.linspace(0, len(long) - 1, min(len(long), MAX_LEFT_OUT)).astype(int))]
    folds = list(each(partial(_measured, family, whole), _folds(units, long), at_once=1))
    parts, factors, far = [], [], []
    for k, part in enumerate(PARTS):
        if measured := [pair for fold in folds for pair in fold[k]]:
            parts.append(part)
            factors.append(_factors([scores for scores, _ in measured], len(long)))
            far.append(tuple(np.quantile([distances for _, distances in measured], 1 - FAR, axis=0).tolist()))
    noise = _typical([soaked for soaked, _ in units])
    return Bands(units=len(long), parts=parts, factors=factors, far=far, noise=noise) if parts else None


def _folds(units: Pairs, long: NDArray[np.intp]) -> Iterator[tuple[Pairs, Pairs]]:
    """Yield the units that are left in each fold, without their rows, and those of `long` that are left out."""
    bare = [(replace(soaked, recordings=()), lot) for soaked, lot in units]
    for fold in range(FOLDS):
        out = set(long[fold::FOLDS].tolist())
        yield [pair for k, pair in enumerate(bare) if k not in out], [units[k] for k in sorted(out)]


def _measured(of_all: Family, whole: tuple[float, float], fold: tuple[Pairs, Pairs]) -> list[list[tuple[Array, Array]]]:
    """Return, of each part, z and g of the units that were left out of their family in a fold, and their distances."""
    family, measured = fit_family(fold[0], start=of_all), [list[tuple[Array, Array]]() for _ in PARTS]
    marginal = {lot: family.marginal(lot) for _, lot in fold[1]}
    for soaked, lot in fold[1]:
        before = marginal[lot]
        more = before.informed(*family.information_of(soaked))
        (low, high), (first, last) = soaked.knots.domain, family.knots.domain
        T = np.linspace(max(low, first), min(high, last), GRID * soaked.knots.intervals + 1)
        B = family.knots.values(T)
        for part, pairs in zip(PARTS, measured, strict=True):
            low, high = (whole[0] + share * (whole[1] - whole[0]) for share in part)
            short = soaked.between(low, high)
            if short is not None:
                J, h = family.information_of(short)
                beyond = B[(low > T) | (high < T)]
                pairs.append((_scores(beyond, before.informed(J, h), more), before.distance(J, h)))
    return measured


def _typical(units: Sequence[UnitInformation]) -> Typical:
    """Return the noise of units; their walk, which a soak may hardly show, as some of them have it alike.

    Where their sweeps need a larger walk than is likely by neighbouring rows, that is in it too.
    """
    tiny = np.finfo(float).tiny
    logs = {name: np.log(np.maximum([getattr(soaked, name) for soaked in units], tiny)) for name in ("white", "walk")}
    middle = {name: np.median(of, axis=0) for name, of in logs.items()}
    spread = {name: 1.4826 * np.median(np.abs(of - middle[name]), axis=0) for name, of in logs.items()}
    with_rows = [soaked for soaked in units if soaked.recordings]
    if with_rows:
        some = [with_rows[k] for k in np.unique(np.linspace(0, len(with_rows) - 1, ALIKE).astype(int))]
        alike, likely = common_walk([soaked.recordings for soaked in some], some[0].knots.step)
        more = np.exp(middle["walk"]) / np.maximum(np.median(likely, axis=0), tiny)
        walk = np.exp(middle["white"]) * alike * np.where(more > PASSES, more, 1.0)
        middle["walk"] = np.log(np.maximum(walk, tiny))
    return Typical(
        white=tuple(np.exp(middle["white"]).tolist()), walk=tuple(np.exp(middle["walk"]).tolist()),
        white_spread=tuple(spread["white"].tolist()), walk_spread=tuple(spread["walk"].tolist()),
    )  # fmt: skip


def _scores(B: Array, less: Posterior, more: Posterior) -> Array:
    """Return z and g (N, d, 2) of a part of a soak, at temperatures with the splines B (N, q).

    z is not a number where the part knew nearly as much as the whole.
    """
    own, after = deviation(B, less.covariance) ** 2, deviation(B, more.covariance) ** 2
    gained = np.maximum(own - after, 0.0)
    known = np.where(gained > GAINED * own, gained, np.nan)
    return np.stack([B @ (less.c - more.c).T / np.sqrt(known), gained / own], axis=2)


def _factors(scores: list[Array], units: int) -> tuple[tuple[float, ...], ...]:
    """Return the factors (3, d) of z and g (n, d, 2), of all axes alike where units are few; 1 where there are none."""
    both = np.concatenate(scores)
    if not len(both):
        return ((1.0,) * both.shape[1],) * len(LEVELS)
    if units < ONE_AXIS:
        both = np.broadcast_to(both.reshape(-1, 1, 2), (both[..., 0].size, both.shape[1], 2))
    share = np.mean(both[..., 1], axis=0)
    rows = []
    for level in LEVELS:
        order = min(level * (units + 1) / units, 1.0)  # of the units left out and the new one
        wide = np.array([_quantile(np.abs(own[np.isfinite(own)]), order, level, units) for own in both[..., 0].T])
        rows.append(tuple(np.sqrt(wide**2 * share + 1 - share).tolist()))
    return tuple(rows)


def _quantile(z: Array, order: float, level: float, units: int) -> float:
    """Return the quantile of z (n,) as a multiple of a Gaussian's; 1 where there is less than one z a unit."""
    gauss = NormalDist().inv_cdf((1 + level) / 2)
    return float(np.quantile(z, order)) / gauss if len(z) >= units else 1.0
