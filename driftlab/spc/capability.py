"""How well a line keeps a limit from above: Cpk, Ppk, and what they are worth where values are not normal.

Of a limit U, in a scale in which the values are about normal, mean m of n values::

    Ppk = (U - m) / (3 s)  with s the deviation of all of them,  Cpk the same with that from one unit to the next

Interval of Ppk by the noncentral t distribution, of which 3 sqrt(n) Ppk is a draw, as a normal one (Abramowitz and
Stegun 26.7.10); of the share beyond the limit by Clopper and Pearson, which needs no law of the values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array

FEWEST = 10  # units of which an index is said at all


@dataclass(frozen=True)
class Capability:
    """What a line makes of one limit on one axis.

    Attributes
    ----------
    quantity, axis : str
    limit : float
        At most, SI.
    n : int
        Units.
    since : int
        Place of the first of them in the line: 0, or that of the last change of the line.
    cpk, ppk : float
    ppk_low, ppk_high : float
        95 % interval.
    beyond : int
        Units above the limit.
    share_low, share_high : float
        95 % interval of the share of units above the limit.
    scale : str
        In which the indices are: `log`, `sqrt`, `as it is`.
    normal : float
        Probability of values as little normal in that scale, if they were (Shapiro and Wilk).
    """

    quantity: str
    axis: str
    limit: float
    n: int
    since: int
    cpk: float
    ppk: float
    ppk_low: float
    ppk_high: float
    beyond: int
    share_low: float
    share_high: float
    scale: str
    normal: float

    @property
    def trusted(self) -> bool:
        """Whether the indices mean what they say; where not, the share of units above the limit does."""
        return self.normal >= 0.01


def indices(x: Array, limit: float, short_term: float) -> tuple[float, float, float, float]:
    """Return Cpk, Ppk, and the 95 % interval of Ppk, of values x (n,) and the deviation from one to the next."""
    n, room, sd = len(x), limit - float(np.mean(x)), float(np.std(x, ddof=1))
    if not sd > 0 or not short_term > 0:
        return (np.inf if room >= 0 else -np.inf,) * 4
    ppk = room / (3 * sd)
    middle = ppk * (1 - 1 / (4 * (n - 1)))
    half = 1.96 * float(np.sqrt(1 / (9 * n) + ppk**2 / (2 * (n - 1))))
    return room / (3 * short_term), ppk, middle - half, middle + half


def share_beyond(beyond: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share of which `beyond` of n were seen."""
    from scipy.stats import beta

    low = 0.0 if beyond == 0 else float(beta.ppf(0.025, beyond, n - beyond + 1))
    high = 1.0 if beyond == n else float(beta.ppf(0.975, beyond + 1, n - beyond))
    return low, high
