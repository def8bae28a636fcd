"""Densities of a unit's white noise and random walk, whatever its curve: restricted maximum likelihood.

The rows of a soak are a curve of the family's basis, a walk and white noise (`driftlab.family.unit_information`). With
the densities s of the white noise and k of the walk, r = k^2 / s^2 is found beside the curve
(`driftlab.noise.local_level`) on a grid in its logarithm, of which the likelihood is smooth. Deviations are those of
the logarithms, from the curvature of the likelihood at its maximum. d axes, q coefficients.

A real unit's slow noise is more than its fast walk lets expect: it lags, it wanders where the temperature does, and
after a warm night it is elsewhere. So `walk_from_repeated_sweeps` cuts the soak into sweeps and holds a curve for each
sweep against one for all. By white noise and walk alone, the gain is chi-square::

    G = Q(one curve) - Q(a curve each),    E G = n,    n the coefficients that this adds

Where G is more than chance, the walk is the least at which G is n; white noise is that of neighbouring rows.
Temperatures visited only once contribute nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.family.basis import STEP, SplineBasis
from driftlab.family.unit_information import UnitInformation
from driftlab.noise.local_level import LevelLikelihood
from driftlab.soak.blocks import SoakRows
from fusion_core.chunk import Array
from fusion_core.thermal.sweeps import directions, sweeps_of

GRID = np.linspace(-18.0, 14.0, 44)  # of log (walk over the whole soak / white noise of a row), its variance
FINE = np.linspace(GRID[0], GRID[-1], 12801)
GAIN = 2.71  # of - 2 log likelihood: a walk that gains less does not show, 95 % on one side
RANK = 1e-10  # of the largest eigenvalue of B'B: combinations that no row has seen
MIN_FREEDOM = 8  # rows more than coefficients, for a walk
TURN = 0.25  # of the range: a smaller way back is no turn
MAX_SWEEPS = 8  # where there are more, those that warm are one, and those that cool
CHANCE = 0.01  # probability with which white noise and walk alone are not believed
LARGEST = 1e3  # times the likely walk
CLOSE = 0.01  # tolerance of the logarithm of the walk


@dataclass(frozen=True, eq=False)
class Densities:
    """Densities of the noise of each axis.

    Attributes
    ----------
    white, white_sigma : (d,) arrays
        Density of the white noise, SI/sqrt(Hz), and its deviation.
    walk, walk_sigma : (d,) arrays
        Of the walk, SI/sqrt(s). Where none shows it is 0, and its deviation `likely`.
    likely : (d,) array
        Root of the mean of walk^2 under the likelihood: the walk to use where it hardly shows.
    """

    white: Array
    white_sigma: Array
    walk: Array
    walk_sigma: Array
    likely: Array


def soaked_of(
    unit: str, axes: tuple[str, ...], rows: tuple[SoakRows, ...], step: float = STEP
) -> tuple[UnitInformation, Densities]:
    """Return the information of rows on a unit under its own noise, and the densities of that.

    The walk is the likely one, or the larger one that repeated sweeps need.
    """
    noise = densities_of(rows, step)
    walk = walk_from_repeated_sweeps(rows, noise.white, noise.likely, step)
    return UnitInformation.of(unit, axes, rows, noise.white, walk, step), noise


def densities_of(recordings: Sequence[SoakRows], step: float) -> Densities:
    """Return the densities of the noise in rows about a curve with knots `step` K apart."""
    likelihood, unit = _likelihood(recordings, step)
    costs, scales = likelihood.over(np.exp(GRID) * unit)
    none, s2_none, nu = likelihood.at(0.0)
    curves = _Curves(costs, scales)
    each = [curves.densities(axis, *of_none, nu) for axis, of_none in enumerate(zip(none, s2_none, strict=True))]
    white, white_sigma, walk, walk_sigma, likely = np.array(each).T
    root = np.sqrt(unit)  # from the ratio of the grid to that of the densities
    return Densities(white, white_sigma, walk * root, walk_sigma * root, likely * root)


def common_walk(units: Sequence[Sequence[SoakRows]], step: float) -> tuple[Array, Array]:
    """Return the walk (d,) over white noise that units have alike, 1/sqrt(s), and the likely walk (n, d) of each.

    By the product of their likelihoods: a soak that hardly shows a walk does not exclude one that is many times larger;
    many such soaks together do.
    """
    from scipy.interpolate import CubicSpline

    likelihoods, own = zip(*(_likelihood(recordings, step) for recordings in units), strict=True)
    logs = np.log(own)
    middle = float(np.median(logs))
    curves = [one.over(np.exp(GRID) * unit) for one, unit in zip(likelihoods, own, strict=True)]
    places = np.clip(GRID + middle - logs[:, None], GRID[0], GRID[-1])
    total = np.sum([CubicSpline(GRID, costs)(at) for at, (costs, _) in zip(places, curves, strict=True)], axis=0)
    common = _Curves(total, np.ones_like(total)).likely * np.exp(middle / 2)
    return common, np.array([_Curves(*both).likely for both in curves]) * np.exp(logs / 2)[:, None]


def _likelihood(recordings: Sequence[SoakRows], step: float) -> tuple[LevelLikelihood, float]:
    """Return the likelihood of the walk beside the curve, all axes at once, and the ratio that is 1 on the grids."""
    knots = SplineBasis.over(np.concatenate([rows.T for rows in recordings]), step)
    first, *others = [knots.values(rows.T) for rows in recordings]
    # a curve that the levels of further recordings can make is theirs
    B = np.concatenate([first, *(values - values.mean(axis=0) for values in others)])
    own, V = np.linalg.eigh(B.T @ B)
    seen = own > RANK * own[-1]
    U = B @ (V[:, seen] / np.sqrt(own[seen]))
    y = np.concatenate([rows.bias for rows in recordings])
    y = y - U @ (U.T @ y)  # the curve is free: to take it off first only saves digits
    edges = np.cumsum([len(rows.T) for rows in recordings])[:-1]
    columns = np.split(np.hstack([U, y]), edges)
    noises = [(1.0 / rows.span, rows.steps(free=k > 0)) for k, rows in enumerate(recordings)]
    whole = sum(float(rows.t[-1] - rows.t[0]) for rows in recordings) or 1.0
    unit = 1.0 / (whole * float(np.median(np.concatenate([rows.span for rows in recordings]))))
    return LevelLikelihood([(X, *noise) for X, noise in zip(columns, noises, strict=True)], U.shape[1]), unit


class _Curves:
    """Curves over the log ratio of all axes, - 2 log likelihood and log s^2, from values (G, d) on the grid.

    `likely` (d,) is the likely walk, root of the mean of its variance under the likelihood, even in the walk, in the
    unit of the grid.
    """

    def __init__(self, costs: Array, s2: Array) -> None:
        from scipy.interpolate import CubicSpline

        self.spline = CubicSpline(GRID, np.hstack([costs, np.log(s2)]))
        self.costs, scales = np.split(self.spline(FINE), 2, axis=1)
        weight = np.exp(-(self.costs - self.costs.min(axis=0)) / 2 + FINE[:, None] / 2)
        self.likely = np.sqrt(np.sum(weight * np.exp(scales + FINE[:, None]), axis=0) / np.sum(weight, axis=0))

    def densities(self, axis: int, none: float, s2_none: float, nu: int) -> tuple[float, ...]:
        """Return white, its sigma, walk, its sigma and the likely walk of an axis, the walk in the unit of the grid."""
        likely, k = self.likely[axis], int(np.argmin(self.costs[:, axis]))
        if nu < MIN_FREEDOM:
            return np.sqrt(s2_none), np.sqrt(s2_none), 0.0, likely, likely
        if none - self.costs[k, axis] < GAIN:
            return np.sqrt(s2_none), np.sqrt(s2_none / (2 * nu)), 0.0, likely, likely
        bend = max(float(self.spline(FINE[k], 2)[axis]), 1e-3)
        scale, slope = (float(self.spline(FINE[k], order)[axis - len(self.likely)]) for order in (0, 1))
        of_white = np.sqrt(2 / nu + slope**2 * 2 / bend) / 2
        of_walk = np.sqrt(2 / nu + (1 + slope) ** 2 * 2 / bend) / 2
        white, walk = np.exp(scale / 2), np.exp((scale + FINE[k]) / 2)
        return float(white), float(white * of_white), float(walk), float(walk * of_walk), likely


def walk_from_repeated_sweeps(recordings: Sequence[SoakRows], white: Array, walk: Array, step: float) -> Array:
    """Return the walk (d,) with which the sweeps of recordings agree: at least `walk` (d,), SI/sqrt(s)."""
    from scipy.special import chdtri

    curves, larger = _curves_of_sweeps(recordings, step), walk.copy()
    for axis in np.flatnonzero((white > 0) & (walk > 0)) if curves[0].shape[1] > 1 else ():
        gain, n = _gain(recordings, curves, axis, white[axis], walk[axis])
        if n == 0 or gain <= float(chdtri(n, CHANCE)):
            continue
        low, high = 0.0, np.log(LARGEST)
        while high - low > CLOSE:
            middle = (low + high) / 2
            gain, n = _gain(recordings, curves, axis, white[axis], walk[axis] * float(np.exp(middle)))
            low, high = (middle, high) if gain > n else (low, middle)
        larger[axis] *= float(np.exp(high))
    return larger


def _curves_of_sweeps(recordings: Sequence[SoakRows], step: float) -> list[Array]:
    """Return the splines of each recording's rows, in the place of their sweep: (R, sweeps, q)."""
    T = np.concatenate([rows.T for rows in recordings])
    knots, turn = SplineBasis.over(T, step), TURN * float(np.ptp(T))
    number = [sweeps_of(rows.T, turn) for rows in recordings]
    first = np.cumsum([0, *(int(own[-1]) + 1 for own in number)])
    which = [own + start for own, start in zip(number, first[:-1], strict=True)]
    if first[-1] > MAX_SWEEPS:
        which = [(directions(rows.T, turn) < 0).astype(np.int64) for rows in recordings]
    places = np.eye(int(max(own.max() for own in which)) + 1)
    return [
        places[own][:, :, None] * knots.values(rows.T)[:, None] for rows, own in zip(recordings, which, strict=True)
    ]


def _gain(
    recordings: Sequence[SoakRows], curves: Sequence[Array], axis: np.intp, white: float, walk: float
) -> tuple[float, int]:
    """Return G of an axis, and the number of coefficients that a curve for each sweep adds."""
    _, count, q = curves[0].shape
    N = np.zeros((count * q + 1, count * q + 1))
    for k, (rows, own) in enumerate(zip(recordings, curves, strict=True)):
        columns = np.column_stack([own.reshape(len(own), -1), rows.bias[:, axis]])
        X = rows.whitened(columns, white, walk, free=k > 0)
        N += X.T @ X
    A, b = N[:-1, :-1], N[:-1, -1]
    each, rank = _explained(A, b)
    common, rank_of_one = _explained(A.reshape(count, q, count, q).sum(axis=(0, 2)), b.reshape(count, q).sum(axis=0))
    return each - common, rank - rank_of_one


def _explained(A: Array, b: Array) -> tuple[float, int]:
    """Return b' A^-1 b and the rank of A."""
    scale = np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
    used = np.diag(A) > RANK * np.max(np.diag(A))
    own, V = np.linalg.eigh((A / np.outer(scale, scale))[np.ix_(used, used)])
    seen = own > RANK * own[-1]
    return float(np.sum((V[:, seen].T @ (b / scale)[used]) ** 2 / own[seen])), int(np.sum(seen))
