"""Capability of a line: how far its units stay within a limit, and whether such an index means anything.

Of n values x with mean m, in a scale in which they are about normal, and an upper limit U::

    Ppk = (U - m) / (3 s),   s the deviation of all of them, nu = n - 1
    Cpk = (U - m) / (3 s'),  s' the deviation from one unit to the next, nu = 0.6 (n - 1)

3 sqrt(n) Ppk is a draw of the noncentral t distribution with nu degrees of freedom, of which 3 sqrt(n) times the true
index is the noncentrality: the 95 % interval is exact (Kushler and Hurley, Journal of Quality Technology 24 (1992),
188). Bissell's (Applied Statistics 39 (1990) 331) is its approximation::

    Ppk +- 1.96 sqrt(1 / (9 n) + Ppk^2 / (2 nu))

s' is the mean moving range over 1.128, which is worth 0.6 of the degrees of freedom of a variance.

An index counts units beyond the limit by the tail of a normal law. There is none where the Anderson-Darling test
rejects that law, mean and deviation being estimated (Stephens, Journal of the American Statistical Association 69
(1974) 730; p-values of D'Agostino and Stephens, Goodness-of-Fit Techniques (1986), table 4.9), nor of fewer units than
could show another law, nor where units resemble those before them: n of them tell less than n that are independent. The
share of units beyond the limit (Clopper and Pearson) needs no law.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array

ENOUGH = 25  # units of an index; of fewer the test of normality sees little (AIAG: 25 subgroups)
NORMAL = 0.01  # p-value below which values are not taken for normal, nor for independent
WORTH = 0.6  # of the degrees of freedom of a variance: what one from moving ranges is worth
D2 = float(2 / np.sqrt(np.pi))  # mean moving range of normal values over their deviation: 1.128


@dataclass(frozen=True)
class Capability:
    """Capability of a line for one limit on one axis.

    Attributes
    ----------
    quantity, axis : str
    limit : float
        At most, SI.
    n : int
        Units.
    since : int
        Place of the first of them in the line: 0, or that of the last change of the line.
    cpk, cpk_low, cpk_high, ppk, ppk_low, ppk_high : float
        Indices and their 95 % intervals, 1; NaN where `why_not` says why there is none.
    beyond : int
        Units above the limit.
    share_low, share_high : float
        95 % interval of the share of units above the limit, 1.
    scale : str
        In which the indices are: `log`, `sqrt`, `as it is`.
    normal : float
        p-value of the Anderson-Darling test in that scale.
    why_not : str
        Reason for which there is no index; empty where there is one.
    trend : bool
        Whether the line has a trend: the indices are of no steady line.
    """

    quantity: str
    axis: str
    limit: float
    n: int
    since: int
    cpk: float
    cpk_low: float
    cpk_high: float
    ppk: float
    ppk_low: float
    ppk_high: float
    beyond: int
    share_low: float
    share_high: float
    scale: str
    normal: float
    why_not: str = ""
    trend: bool = False

    @property
    def trusted(self) -> bool:
        """True if there are indices; where not, the share of units above the limit says how it is kept."""
        return not self.why_not

    def as_json(self, unit: str, first: str) -> dict[str, Any]:
        """Return it as `fleet.json` has it; `unit` is SI, `first` the name of the first of the units."""

        def index(name: str) -> dict[str, Any]:
            value, low, high = (getattr(self, f"{name}{end}") for end in ("", "_low", "_high"))
            return {name: None, f"{name}_95": None} if self.why_not else {name: value, f"{name}_95": [low, high]}

        return {
            "quantity": self.quantity, "axis": self.axis, "unit": unit, "limit": self.limit, "units": self.n,
            "since": first, **index("cpk"), **index("ppk"), "above": self.beyond,
            "share_above_95": [self.share_low, self.share_high], "scale": self.scale,
            "anderson_darling_p": self.normal, "why_not": self.why_not or None,
            "trend": self.trend,
        }  # fmt: skip


def indices(x: Array, limit: float) -> tuple[float, float, float, float, float, float]:
    """Return Cpk and Ppk of values x (n,) in their order, each with its 95 % interval."""
    n, room = len(x), limit - float(np.mean(x))
    short, whole = float(np.mean(np.abs(np.diff(x)))) / D2, float(np.std(x, ddof=1))
    return (*_with_interval(room / (3 * short), n, WORTH * (n - 1)), *_with_interval(room / (3 * whole), n, n - 1))


def _with_interval(index: float, n: int, nu: float) -> tuple[float, float, float]:
    from scipy.special import nctdtrinc

    scale = 3 * np.sqrt(n)
    low, high = nctdtrinc(nu, [0.975, 0.025], scale * index) / scale
    return index, float(low), float(high)


def why_no_index(x: Array, odd: NDArray[np.bool_], limit: float, *, trend: bool) -> tuple[float, str]:
    """Return the p-value of normality of values x (n,), and why there is no index of them; empty where there is.

    `odd` (n,) marks values so far out that they may be the reason by themselves: Ppk of the others is said then. Of a
    `trend` that is known there is an index: its remark says of what.
    """
    from scipy.special import ndtri

    n = len(x)
    if np.ptp(x) == 0:
        return 1.0, "the values do not vary"
    p = anderson_darling(x)[1]
    if n < ENOUGH:
        return p, f"{n} units; {ENOUGH} are needed to see whether they are normal"
    if p >= NORMAL:
        off = x - np.mean(x)
        phi = without_bias(float(off[1:] @ off[:-1]) / float(off @ off), n)
        if trend or phi < -ndtri(NORMAL) / np.sqrt(n):
            return p, ""
        return p, f"units resemble those before them (autocorrelation {phi:.2g}): so many tell less than they are"
    why = f"not normal (Anderson-Darling, p {'< 0.0001' if p < 1e-4 else f'= {p:.2g}'})"
    rest, count = x[~odd], int(np.sum(odd))
    if count and len(rest) >= ENOUGH and np.ptp(rest) > 0 and (without := anderson_darling(rest)[1]) >= NORMAL:
        far = "1 unit that is" if count == 1 else f"{count:,} units that are"
        ppk, low, high = indices(rest, limit)[3:]
        why += f", by {far} far out; of the others p = {without:.2g}, Ppk {ppk:.2f} ({low:.2f} to {high:.2f})"
    return p, why


def without_bias(phi: float, n: int) -> float:
    """Return an autocorrelation of n values, which few show as less (Kendall, Biometrika 41 (1954) 403)."""
    return phi + (1 + 3 * phi) / n


def anderson_darling(x: Array) -> tuple[float, float]:
    """Return A^2 of values x (n,) against a normal law of their mean and deviation, and its p-value; n from 8 on."""
    from scipy.special import log_ndtr

    n = len(x)
    z = np.sort((x - np.mean(x)) / np.std(x, ddof=1))
    weight = 2 * np.arange(1, n + 1) - 1
    squared = -n - float(np.sum(weight * (log_ndtr(z) + log_ndtr(-z[::-1])))) / n
    a = min(squared * (1 + 0.75 / n + 2.25 / n**2), 150.0)  # beyond, p would rise again
    if a >= 0.6:
        p = np.exp(1.2937 - 5.709 * a + 0.0186 * a**2)
    elif a > 0.34:
        p = np.exp(0.9177 - 4.279 * a - 1.38 * a**2)
    elif a > 0.2:
        p = 1 - np.exp(-8.318 + 42.796 * a - 59.938 * a**2)
    else:
        p = 1 - np.exp(-13.436 + 101.14 * a - 223.73 * a**2)
    return squared, min(float(p), 1.0)


def share_beyond(beyond: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share of which `beyond` of n were seen (Clopper and Pearson)."""
    from scipy.special import betaincinv

    low = betaincinv(beyond, n - beyond + 1, 0.025) if beyond else 0.0
    return float(low), float(betaincinv(beyond + 1, n - beyond, 0.975)) if beyond < n else 1.0
