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

from collections.abc import Sequence
from functools import partial
from itertools import chain
from operator import call
from statistics import NormalDist

import numpy as np

from driftlab.family.bands import LEVELS, Bands, Typical, deviation
from driftlab.family.mixed_model import Family, Posterior, fit_some, stacked
from driftlab.family.partitions import A_FEW, FamilyUnits, Partition, Partitions, UnitOfLot, in_partitions
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


def sample_of(count: int, most: int = SAMPLE) -> list[int]:
    """Return the places of the sampled units, of so many: at most `most`, evenly spread."""
    return [int(k) for k in np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))]


def measure_bands(family: Family, units: FamilyUnits) -> Bands | None:
    """Return the factors of a family, or None where too few units saw its whole range.

    A part in which no unit has samples is left out: the nearest other part is taken for it.

    Parameters
    ----------
    family : Family
    units : FamilyUnits
        Its units and their lots, or a sample of them; with their rows.
    """
    units = in_partitions(units, A_FEW)
    domains, noise, known, lots = zip(*(row for own in units.map(_ranges) for row in own), strict=True)
    first, last = np.array(domains).T
    whole = float(np.quantile(first, 0.25)), float(np.quantile(last, 0.75))  # of most: one may have seen more
    long = np.flatnonzero((last - first) / (whole[1] - whole[0]) >= SEEN)
    if len(long) < MIN_UNITS:
        return None
    long = long[sample_of(len(long), MAX_LEFT_OUT)]
    folds, have = [long[k::FOLDS] for k in range(FOLDS)], np.flatnonzero(known)
    others = (np.setdiff1d(np.arange(len(units)), fold) for fold in folds)
    alike = units.chosen((have[k] for k in sample_of(len(have), ALIKE)), ALIKE).parts
    fit = partial(fit_some, family, Partitions(stacked(units, family.knots).parts), lots)
    jobs = [*(partial(fit, some) for some in others), *(partial(_common_walk, p) for p in alike)]
    found = [*units.engine(call, jobs)]
    todo = [(own, part) for own, fold in zip(found, folds, strict=False) for part in units.chosen(fold, A_FEW).parts]
    of_units = [*chain.from_iterable(units.engine(partial(_measured, whole), todo))]
    measured = [of_units[k] for k in np.argsort(np.concatenate(folds))]
    parts, factors, far = [], [], []
    for part, column in zip(PARTS, zip(*measured, strict=True), strict=True):
        if pairs := [pair for pair in column if pair is not None]:
            parts.append(part)
            factors.append(_factors([scores for scores, _ in pairs], len(long)))
            far.append(tuple(np.quantile([distances for _, distances in pairs], 1 - FAR, axis=0).tolist()))
    typical = _typical(np.array(noise), *found[FOLDS:])
    return Bands(units=len(long), parts=parts, factors=factors, far=far, noise=typical) if parts else None


def _ranges(units: Sequence[UnitOfLot]) -> list[tuple[tuple[float, float], tuple[Array, Array], bool, str]]:
    """Return the range of each unit, degC, the densities of its noise, white and walk, if it has rows, and its lot."""
    return [(soaked.knots.domain, (soaked.white, soaked.walk), bool(soaked.recordings), lot) for soaked, lot in units]


def _measured(
    whole: tuple[float, float], job: tuple[Family, Partition[Sequence[UnitOfLot]]]
) -> list[list[tuple[Array, Array] | None]]:
    """Return z and g of each part of each unit by a family that it was left out of, and its distances; None of none."""
    (family, units), measured = job, []
    first, last = family.knots.domain
    parts = whole[0] + (whole[1] - whole[0]) * np.array(PARTS)
    for soaked, lot in units.read():
        before, (low, high) = family.marginal(lot), soaked.knots.domain
        T = np.linspace(max(low, first), min(high, last), GRID * soaked.knots.intervals + 1)
        shorts = [soaked.between(*part) for part in parts]
        known = [family.information_of(one) for one in (soaked, *shorts) if one is not None]
        informed = before.informed(*(np.stack(values) for values in zip(*known, strict=True)))
        found = zip(_scores(family.knots.values(T), informed), known[1:], strict=True)
        of_parts = list[tuple[Array, Array] | None]()
        for (low, high), short in zip(parts, shorts, strict=True):
            if short is None:
                of_parts.append(None)
                continue
            scores, (J, h) = next(found)
            of_parts.append((scores[(low > T) | (high < T)], before.distance(J, h)))
        measured.append(of_parts)
    return measured


def _common_walk(units: Partition[Sequence[UnitOfLot]]) -> tuple[Array, Array]:
    """Return the walk over white noise that units have alike, 1/sqrt(s), and the likely walk of each."""
    some = [soaked for soaked, _ in units.read()]
    return common_walk([soaked.recordings for soaked in some], some[0].knots.step)


def _typical(noise: Array, common: tuple[Array, Array] | None = None) -> Typical:
    """Return the noise of units with white noise and walk (n, 2, d); the walk, which a soak may hardly show, of some.

    Of these the `common` one is known, and the likely ones. Where their sweeps need a larger walk than is likely by
    neighbouring rows, that is in it too.
    """
    tiny = np.finfo(float).tiny
    logs = np.log(np.maximum(noise, tiny))
    white, walk = middle = np.median(logs, axis=0)
    spread = 1.4826 * np.median(np.abs(logs - middle), axis=0)
    if common is not None:
        alike, likely = common
        more = np.exp(walk) / np.maximum(np.median(likely, axis=0), tiny)
        walk = np.log(np.maximum(np.exp(white) * alike * np.where(more > PASSES, more, 1.0), tiny))
    return Typical(
        white=tuple(np.exp(white).tolist()), walk=tuple(np.exp(walk).tolist()),
        white_spread=tuple(spread[0].tolist()), walk_spread=tuple(spread[1].tolist()),
    )  # fmt: skip


def _scores(B: Array, informed: Posterior) -> Array:
    """Return z and g (P, N, d, 2) of P parts of a soak, at temperatures with the splines B (N, q).

    `informed` is the unit's law by the whole soak, and by each part. z is not a number where a part knew nearly as much
    as the whole.
    """
    (P, d, q), N = informed.c.shape, len(B)
    variances = deviation(B, informed.covariance.reshape(P * d, q, q)).T.reshape(P, d, N).transpose(0, 2, 1) ** 2
    curves = B @ informed.c.transpose(0, 2, 1)
    own = variances[1:]
    gained = np.maximum(own - variances[0], 0.0)
    known = np.where(gained > GAINED * own, gained, np.nan)
    return np.stack([(curves[1:] - curves[0]) / np.sqrt(known), gained / own], axis=3)


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
