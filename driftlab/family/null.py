"""How far out a value is among those of a family, whose law is not Gaussian and is contaminated by what is sought.

An empirical null (Efron 2004) from all values u, mostly of ordinary units::

    u ~ (1 - e) t_nu(centre, lower and upper width) + e uniform over all that occurs

by maximum likelihood for each nu of DOF. The data seldom tell which nu is right, so a p-value is the mean over nu by
their likelihoods: few values, or heavy tails, make it larger. Widths on both sides of the centre take up skew, and the
second part the odd ones, which thus do not widen the law in which they are to stand out. n values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array

DOF = (2.5, 4.0, 8.0, 16.0, 1e6)  # the last is Gaussian
CHANCE = (0.02, 0.08, 0.2, 0.3, 0.4)  # of each, before the data are seen
HEAVY = (0.1, 0.15, 0.2, 0.25, 0.3)  # of distances, which add up what many shapes have
MOST = 2000  # values that it is of, where there are more: every so many-th of the sorted ones
FEWEST = 8
ODD = 0.02  # of values
SURE = 0.7  # of a unit: what a width found robustly is worth


@dataclass(frozen=True, eq=False)
class Null:
    """Centre, lower and upper width (m, 3) for the m degrees of freedom DOF, and the `share` (m,) of each.

    `most` are the degrees of freedom that a width found from few units leaves at most.
    """

    numbers: Array
    share: Array
    most: float

    @classmethod
    def of(cls, values: Array, units: int, chance: tuple[float, ...] = CHANCE) -> Null:
        """Return the null of values (n,), of which the bulk is as wide as 1 about 0 by so many `units`."""
        u = np.sort(values[np.isfinite(values)])
        u = u[np.unique(np.linspace(0, len(u) - 1, min(len(u), MOST)).astype(int))]
        fits = [_fit(u, dof) for dof in DOF]
        likelihood = np.array([fit[1] for fit in fits])
        share = np.array(chance) * np.exp(likelihood - likelihood.max())
        return cls(np.stack([fit[0] for fit in fits]), share / share.sum(), SURE * units)

    def p(self, values: Array, *, upper: bool = False) -> Array:
        """Return the chance (n,) of a value as far out as each, on either side, or only on the `upper`."""
        from scipy.stats import t

        found = np.zeros(len(values))
        for (centre, below, above), dof, share in zip(self.numbers, DOF, self.share, strict=True):
            x = values - centre
            of_side = 2 * (above if upper else 1.0) / (below + above if upper else 1.0)
            tail = t.sf(np.where(x > 0, x / above, -x / below), 1 / (1 / dof + 1 / self.most))
            one = np.where(x > 0, of_side * tail, 1 - 2 * below / (below + above) * tail)
            found += share * (one if upper else 2 * tail)
        return found


def standardised(values: Array, sigma: Array) -> tuple[Array, float, float]:
    """Return values (n,) about their median by their width and their own sigma (n,) together; median and width.

    The width is what units have in common beside what each is uncertain by. NaN stays NaN.
    """
    known = np.isfinite(values)
    x, s = values[known], np.nan_to_num(sigma[known])
    centre = float(np.median(x)) if len(x) else 0.0
    off = np.abs(x - centre)
    width = 1.4826 * float(np.median(off)) if len(x) else 0.0
    low, high = 0.0, max(width, float(np.finfo(float).tiny))
    for _ in range(40):  # the width with which the median of the standardised deviations is that of a Gaussian
        width = (low + high) / 2
        if len(x) and np.median(off / np.sqrt(width**2 + s**2)) > 1 / 1.4826:
            low = width
        else:
            high = width
    return (values - centre) / np.sqrt(width**2 + np.nan_to_num(sigma) ** 2), centre, width


def scores(z: Array) -> Array:
    """Return the columns of z (n, m), of width about 1 about 0, as Gaussian deviations under laws with tails as theirs.

    Each column's law is a t of the width of its bulk, its degrees of freedom weighed as above, the share of odd values
    fixed at ODD. NaN stays NaN.
    """
    from scipy.special import log_ndtr, logsumexp, ndtri_exp
    from scipy.stats import t

    known = np.isfinite(z)
    middle = np.nanmedian(z, axis=0)
    width = 1.4826 * np.nanmedian(np.abs(z - middle), axis=0)
    x = np.abs(z - middle) / np.maximum(width, 1e-300)
    reach = np.nanmax(x, axis=0) + 1.0
    likely, tails = [], []
    for dof in DOF:
        unit = t.ppf(0.75, dof) * 1.4826  # of a t, its median deviation is as that of a Gaussian
        density = (1 - ODD) * 2 * unit * t.pdf(x * unit, dof) + ODD / reach
        likely.append(np.sum(np.log(density), axis=0, where=known))
        tails.append(t.logsf(x * unit, dof) if dof < 1e5 else log_ndtr(-x))
    likelihoods = np.array(likely) + np.log(HEAVY)[:, None]
    share = likelihoods - logsumexp(likelihoods, axis=0)
    found = -ndtri_exp(np.minimum(logsumexp(np.array(tails) + share[:, None], axis=0), np.log(0.5)))
    return np.asarray(np.where(known, np.sign(z - middle) * found, np.nan))


def _fit(u: Array, dof: float) -> tuple[Array, float]:
    """Return centre and widths (3,), and the log likelihood."""
    from scipy.optimize import minimize
    from scipy.special import gammaln

    reach = float(np.ptp(u)) + 1.0
    constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi)
    if dof > 1e5:
        constant = -0.5 * np.log(2 * np.pi)

    def cost(numbers: Array) -> float:
        centre, below, above = numbers[0], np.exp(numbers[1]), np.exp(numbers[2])
        x = (u - centre) / np.where(u > centre, above, below)
        own = constant - (dof + 1) / 2 * np.log1p(x**2 / dof) + np.log(2 / (below + above))
        odd = 0.25 / (1 + np.exp(-np.clip(numbers[3], -50, 50)))
        # priors as weak as a value or two keep the widths of few values near what is expected
        weak = 0.5 * (numbers[1] ** 2 + numbers[2] ** 2 + 4 * (numbers[1] - numbers[2]) ** 2) - np.log1p(
            -4 * odd * 0.99
        )
        return float(weak - np.sum(np.log((1 - odd) * np.exp(own) + odd / reach)))

    best = minimize(cost, np.array([0.0, 0.0, 0.0, -2.0]), method="Nelder-Mead", options={"maxiter": 400})
    return np.array([best.x[0], np.exp(best.x[1]), np.exp(best.x[2])]), -float(best.fun)
