"""Law of a test over the units of a family, which is not Gaussian and is contaminated by outliers.

Of each column of values, about its median, each side has a width of its own by the median deviation of that side, which
takes up skew and of which an odd unit has no part. Beyond it the law of a side is a t law. The weight of its tails is
estimated from the values of all columns on that side, and from the other side as far as both may be alike: a law that
ends on one side may have a heavy tail on the other. Each of the degrees of freedom DOF has a weight by the likelihood
of ::

    |u| ~ (1 - e) t_nu + e uniform over all that occurs,    e averaged over SHARES

so odd units do not make the tails in which they are to stand out. A p-value is the mean over nu by these weights, with
no more degrees of freedom than a width of so few units has. n values, m columns.
"""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict

from fusion_core.chunk import Array
from fusion_core.contracts import SLAB

DOF = (2.5, 4.0, 8.0, 16.0, 1e6)  # the last is Gaussian
CHANCE = (0.02, 0.08, 0.2, 0.3, 0.4)  # of each, before the data are seen
ALIKE = 0.9  # chance that both sides are
SHARES = (0.002, 0.01, 0.05)  # of odd values: of all axes together, each unit may have one or two, or many units are
SURE = 0.7  # of a unit: what a width found robustly is worth
MIN_UNITS = 8
WIDTH = 1e-9  # of the largest deviation: a side without has no width
OF_SIDES = 5.4  # times 1/n: variance of the logarithm of the ratio of both sides' widths


class TailLaw(BaseModel):
    """Medians and widths on either side (m,) of the columns, 0 of one with too few values.

    `share` has the weights of DOF below and above; `most` are the degrees of freedom that a width found from few units
    leaves at most.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    centre: tuple[float, ...]
    below: tuple[float, ...]
    above: tuple[float, ...]
    share: tuple[tuple[float, ...], tuple[float, ...]]
    most: float

    @classmethod
    def of(cls, values: Array, same: float = 0.0) -> TailLaw | None:
        """Return the law of values (n, m), NaN where there is none; None where every column has less than MIN_UNITS.

        A column of which most values are the same has the width `same`: 1 where they are in their own deviations.
        """
        known = np.sum(np.isfinite(values), axis=0)
        if not np.any(known >= MIN_UNITS):
            return None
        x = values[:, known >= MIN_UNITS]
        centre = np.nanmedian(x, axis=0)
        off = x - centre
        below, above = _widths(off, same)
        wide = np.minimum(below, above) > WIDTH * np.nanmax(np.abs(off), axis=0, initial=0.0)  # most are not the same
        off = off[:, wide]
        off /= np.where(off > 0, above[wide], below[wide])
        at = np.zeros((3, values.shape[1]))
        at[:, known >= MIN_UNITS] = centre, below, above
        return cls(
            centre=tuple(at[0].tolist()), below=tuple(at[1].tolist()), above=tuple(at[2].tolist()),
            share=_weights(-off[off < 0], off[off > 0]), most=SURE * float(np.max(known)),
        )  # fmt: skip

    def column(self, k: int) -> TailLaw | None:
        """Return the law of one column alone; None where it had too few values."""
        own = {name: (getattr(self, name)[k],) for name in ("centre", "below", "above")}
        return self.model_copy(update=own) if self.below[k] > 0 else None

    def p(self, values: Array, *, upper: bool) -> Array:
        """Return the chance (n, m) of values as far out on either side, or only on the `upper`."""
        from scipy.special import stdtr

        off = np.where(np.array(self.below) > 0, values - np.array(self.centre), np.nan)
        p = np.zeros(off.shape)
        for sign, width, shares in zip((-1, 1), (self.below, self.above), self.share, strict=True):
            with np.errstate(over="ignore"):  # beyond all others, where most are the same
                x, tail = sign * off / np.maximum(width, 1e-300), np.zeros(off.shape)
            for dof, share in zip(DOF, shares, strict=True):
                tail += share * stdtr(1 / (1 / dof + 1 / self.most), -x * _unit(dof))
            p += np.where((x >= 0) if sign > 0 else (x > 0), tail if sign > 0 else (1 - tail if upper else tail), 0)
        return np.asarray(np.where(np.isfinite(off), p if upper else 2 * p, np.nan))


class FigureLaw(BaseModel):
    """Law of a figure, of each axis (d,).

    `usual` is its size (SI), `sure` how well most units know theirs; `centre` and `width` are those of its values in
    the scale of `driftlab.family.outlier_tests`, and `law` that of the deviations.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    usual: tuple[float, ...]
    sure: tuple[float, ...]
    centre: tuple[float, ...]
    width: tuple[float, ...]
    law: TailLaw


class TailLaws(BaseModel):
    """Laws of the curves' statistics and of the figures of a family, by their names."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    curves: dict[str, TailLaw]
    figures: dict[str, FigureLaw]


def _widths(off: Array, same: float) -> tuple[Array, Array]:
    """Return the widths (m,) below and above of values (n, m) about their medians.

    As far apart as more than chance has them (James and Stein): a width of one side is of half the values. Where most
    are the same, as where a walk or a loop does not show, it is `same`.
    """
    # a column at a time: a million units need no table more
    sides = [np.array([1.4826 * np.median(np.abs(x[s * x >= 0])) for x in off.T]) for s in (-1, 1)]
    both = np.array([1.4826 * np.nanmedian(np.abs(x)) or same for x in off.T])
    tiny = 1e-6 * both + np.finfo(float).tiny
    apart = np.log(np.maximum(sides[1], tiny) / np.maximum(sides[0], tiny))
    chance = OF_SIDES / np.sum(np.isfinite(off), axis=0)
    half = 0.5 * apart * np.maximum(1 - 4 * chance / np.maximum(apart**2, 1e-12), 0.0)
    return np.maximum(both * np.exp(-half), tiny), np.maximum(both * np.exp(half), tiny)


def _unit(dof: float) -> float:
    """Return the width of a t law of which the median deviation is as that of a Gaussian of width 1."""
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.75)) * 1.4826


def _weights(below: Array, above: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the weights of DOF below and above, by values (n,) on either side in widths of their side."""
    from scipy.special import logsumexp

    one = np.array(CHANCE)
    prior = ALIKE * np.diag(one) + (1 - ALIKE) * np.outer(one, one)
    both = np.log(prior) + np.add.outer(_likely(below), _likely(above))
    weights = np.exp(both - logsumexp(both))
    return tuple(weights.sum(axis=1).tolist()), tuple(weights.sum(axis=0).tolist())


def _likely(x: Array) -> Array:
    """Return the log-likelihood of each of DOF by values x (n,) of one side, in its widths."""
    from scipy.special import betaln, logsumexp

    reach, likely = float(np.max(x, initial=0.0)) + 1.0, np.zeros((len(DOF), len(SHARES)))
    for start in range(0, len(x), SLAB):
        part = x[start : start + SLAB]
        for dof, sums in zip(DOF, likely, strict=True):
            own = (dof + 1) / 2 * np.log1p((part * _unit(dof)) ** 2 / dof) + betaln(0.5, dof / 2) + 0.5 * np.log(dof)
            density = 2 * _unit(dof) * np.exp(-own)
            sums += [np.sum(np.log((1 - e) * density + e / reach)) for e in SHARES]
    return np.asarray(logsumexp(likely, axis=1))


def standardised(values: Array, sigma: Array) -> tuple[Array, float, float]:
    """Return values (n,) about their median by their width and their own sigma (n,) together; median and width.

    The width is common to the units, beside the uncertainty of each. NaN stays NaN.
    """
    known = np.isfinite(values)
    x, s = values[known], np.nan_to_num(sigma[known])
    centre = float(np.median(x)) if len(x) else 0.0
    off = np.abs(x - centre)
    if not np.any(off):
        return values - centre, centre, 0.0
    low, high = 0.0, max(1.4826 * float(np.median(off)), float(np.max(off)) * np.finfo(float).eps)
    for _ in range(40):  # the width with which the median of the standardised deviations is that of a Gaussian
        width = (low + high) / 2
        if np.median(off / np.sqrt(width**2 + s**2)) > 1 / 1.4826:
            low = width
        else:
            high = width
    return (values - centre) / np.sqrt(width**2 + np.nan_to_num(sigma) ** 2), centre, width
