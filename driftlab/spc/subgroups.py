"""Mean and deviation of each lot (X-bar-S chart), against what lots of so many units have in a line in control.

Of lot i its n_i values in the chart's scale, their mean, and their deviation s_i. With the mean deviation s-bar::

    mean:       centre +- A3 s-bar            A3 = 3 / (c4 sqrt(n))
    deviation:  B3 s-bar to B4 s-bar          B3, B4 = 1 -+ 3 sqrt(1 - c4^2) / c4, at least 0
    c4 = sqrt(2 / (n - 1)) Gamma(n / 2) / Gamma((n - 1) / 2)

Lots of different sizes: s-bar is c4(n_i) sigma, and sigma the mean of s_i / c4(n_i) with the weights c4^2 / (1 - c4^2)
that vary least (Burr, Industrial Quality Control 1969). Lots whose deviation is beyond its limits are left out of
s-bar, until none is (phase I). Against frozen limits sigma is theirs, and centre +- A sigma the limits of the mean. A
unit counts to three sigma in the mean: one that is further out shows in the deviation. Source: Montgomery,
Introduction to Statistical Quality Control, 7th ed., 6.3; the constants are those of its appendix VI (and of ASTM,
AIAG).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.family.partitions import by_lot
from fusion_core.chunk import Array

REACH = 3.0  # sigmas


@dataclass(frozen=True)
class LotPoint:
    """The units of one lot on a chart.

    Attributes
    ----------
    name : str
    n : int
        Units.
    mean, low, high : float
        Mean, and the limits of means of so many units, SI.
    out : bool
        Whether it is beyond them.
    deviation, deviation_low, deviation_high : float
        In the chart's scale: of a logarithm 1, as it is SI; NaN of one unit.
    """

    name: str
    n: int
    mean: float
    low: float
    high: float
    out: bool
    deviation: float
    deviation_low: float
    deviation_high: float

    @property
    def uneven(self) -> bool:
        """True if the deviation is beyond its limits."""
        return self.deviation > self.deviation_high or self.deviation < self.deviation_low

    def as_json(self) -> dict[str, Any]:
        """Return it as `fleet.json` has it."""
        values = (self.deviation, self.deviation_low, self.deviation_high)
        spread = dict(zip(("s", "s_low", "s_high"), values, strict=True)) if self.n > 1 else {}
        limits = {"mean": self.mean, "low": self.low, "high": self.high, "out": self.out}
        return {"lot": self.name, "units": self.n, **limits, **spread, "s_out": self.uneven}


def c4(n: Any) -> Any:
    """Return the mean of the deviation of n normal values over that of their law; n from 2 on."""
    from scipy.special import gammaln

    n = np.asarray(n, dtype=np.float64)
    return np.sqrt(2 / (n - 1)) * np.exp(gammaln(n / 2) - gammaln((n - 1) / 2))


def factors(n: Any) -> tuple[Any, Any, Any]:
    """Return the constants A3, B3 and B4 of lots of n units."""
    c = c4(n)
    reach = REACH * np.sqrt(1 - c**2) / c
    return REACH / (c * np.sqrt(n)), np.maximum(1 - reach, 0.0), 1 + reach


def within(n: NDArray[np.intp], s: Array) -> float:
    """Return sigma of lots of n (k,) units by their deviations (k,); NaN where no lot has two units."""
    kept = n > 1
    while np.any(kept):
        c = c4(n[kept])
        weight = c**2 / (1 - c**2)
        sigma = float(np.sum(weight * s[kept] / c) / np.sum(weight))
        _, low, high = factors(n[kept])
        usual = (s[kept] >= low * c * sigma) & (s[kept] <= high * c * sigma)
        if np.all(usual):
            return sigma
        kept[np.flatnonzero(kept)[~usual]] = False
    return float("nan")


def lots_of(names: NDArray[Any], x: Array, own: Array, known: float | None = None) -> list[tuple[str, Array]]:
    """Return of each lot, in the order of the first units, its name and the seven numbers of its point in the scale.

    Parameters
    ----------
    names : (m,) array of str
        Lots of the values.
    x : (m,) array
        Values less the centre, in the chart's scale.
    own : (m,) array
        Their deviations in control.
    known : float, optional
        Sigma that is frozen.

    Returns
    -------
    list of (name, (7,) array)
        Units, mean, its limits, deviation, its limits.
    """
    of_lot = [*by_lot(names.tolist()).items()]
    n = np.array([len(part) for _, part in of_lot], dtype=np.intp)
    s = np.array([np.std(x[part], ddof=1) if len(part) > 1 else np.nan for _, part in of_lot])
    sigma = within(n.copy(), s) if known is None else known
    ratio = sigma / float(np.median(own)) if sigma > 0 else 1.0  # of what lots vary to what neighbours do
    points = []
    for (name, part), count, deviation in zip(of_lot, n.tolist(), s.tolist(), strict=True):
        weight = 1 / own[part] ** 2
        about = x[part] - np.median(x[part])
        z = np.clip(about / own[part], -REACH, REACH)
        mean = float(np.median(x[part]) + np.sum(weight * z * own[part]) / np.sum(weight))
        reach = ratio * REACH / float(np.sqrt(np.sum(weight)))
        _, low, high = factors(count) if count > 1 else (0.0, np.nan, np.nan)
        usual = c4(count) * ratio * float(np.median(own)) if count > 1 else np.nan
        points.append((name, np.array([count, mean, -reach, reach, deviation, low * usual, high * usual])))
    return points
