"""Baseline of a line: its laws in control, frozen, against which the units of later days are judged (phase II).

Of each figure of each axis the centre, the deviations and the tails (`driftlab.family.tail_law`) in control: z
is the normal score of a value by that law, so that three sigma alarm as rarely where values are skew or have heavy
tails. Of each axis the covariance S of the figures' z, over n units. Of a further unit Hotelling's ::

    T2 = z' S^-1 z,    T2 n (n - p) / (p (n + 1) (n - 1)) ~ F(p, n - p)
    d_i = T2 - T2 without figure i

and d_i is the contribution of a figure (Runger, Alt and Montgomery 1996). Source: Montgomery, Introduction to
Statistical Quality Control, 7th ed., 11.3, equations 11.21 and 11.22. S is of deviations that count to three sigma, so
that single odd units of phase I do not widen it. p figures, U units.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from driftlab.family.record import Covariances
from driftlab.family.tail_law import DOF, TailLaw
from fusion_core.chunk import Array
from fusion_core.thermal.record_texts import Name, Plain

ScaleName = Literal["log", "sqrt", "as it is"]
MOST = 3.0  # sigmas to which a deviation counts in S
PER_FIGURE = 3  # units that S needs, for each of its figures
WIDTH = 1e-3  # sigmas: least width of a side
SURE = 1e-15  # least p-value, a score of eight
GRID = np.sinh(np.linspace(-6.0, 6.0, 1201))  # deviations, up to 200 sigmas
WHOLE = 0.9  # of the range: a soak over less is over a part
ALARM = 0.0027  # chance of an alarm of a line in control, as beyond three sigma


class FrozenLimits(BaseModel):
    """Law in control of one figure on one axis.

    Attributes
    ----------
    quantity, axis : str
    scale : str
        `log`, `sqrt` or `as it is`: in which the others are.
    centre, spread : float
        Middle of a line in control, and the deviation between units without that of their measurement.
    share : float
        Factor of the units' own deviations.
    own : float or None
        Least own deviation of a unit, in the scale: the middle one of the units of the line. None, in files from
        before it was frozen: the middle one of those that are judged together.
    tails : TailLaw or None
        Law of one column, the deviations from the centre in sigmas; None where they are taken for normal.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    quantity: Name
    axis: Name
    scale: ScaleName
    centre: FiniteFloat
    spread: Annotated[FiniteFloat, Field(ge=0)]
    share: Annotated[FiniteFloat, Field(ge=0)] = 1.0
    own: Annotated[FiniteFloat, Field(ge=0)] | None = None
    tails: TailLaw | None = None

    @model_validator(mode="after")
    def _usable(self) -> FrozenLimits:
        if self.quantity == "level" and self.scale != "as it is":
            raise ValueError("a level has no scale of its own")
        if self.tails is not None and not usable(self.tails):
            raise ValueError("tails are no law of one column")
        return self

    def scores(self, deviations: Array) -> Array:
        """Return the normal scores (U,) of deviations (U,) from the centre in sigmas."""
        from scipy.special import ndtri

        if self.tails is None:
            return deviations
        p = np.maximum(self.tails.p(deviations[:, None], upper=False)[:, 0], SURE)
        return np.asarray(-np.sign(deviations - self.tails.centre[0]) * ndtri(p / 2))

    def deviations(self, scores: Array) -> Array:
        """Return the deviations (U,) from the centre in sigmas that have such normal scores (U,)."""
        return scores if self.tails is None else np.interp(scores, self.scores(GRID), GRID)


def covers(domain: tuple[float, float], whole: tuple[float, float]) -> bool:
    """Return True if a soak over a `domain` is one over the `whole` range, and no wider, degC."""
    (low, high), width = whole, whole[1] - whole[0]
    both = min(domain[1], high) - max(domain[0], low)
    return both >= WHOLE * width and domain[1] - domain[0] - both <= (1 - WHOLE) * width


def usable(tails: TailLaw) -> bool:
    """Return True if a law is of one column that has a width: not of values of which most are the same."""
    columns = (tails.centre, tails.below, tails.above)
    if any(len(column) != 1 for column in columns) or any(len(side) != len(DOF) for side in tails.share):
        return False
    numbers = np.concatenate([*columns, *tails.share, [tails.most]])
    positive = min(*tails.below, *tails.above) > WIDTH and tails.most > 0 and np.min(tails.share) >= 0
    return bool(np.all(np.isfinite(numbers)) and positive)


class Together(BaseModel):
    """Covariance (p, p) of the deviations of one axis' `quantities`, in sigmas, over a number of `units`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    axis: Name
    quantities: Annotated[tuple[Name, ...], Field(min_length=2)]
    covariance: Covariances
    units: Annotated[int, Field(ge=3)]

    @model_validator(mode="after")
    def _definite(self) -> Together:
        p = len(self.quantities)
        if self.covariance.shape != (p, p) or np.linalg.eigvalsh(self.covariance).min() <= 0:
            raise ValueError(f"covariance is none of {p} quantities")
        if self.units <= p:
            raise ValueError(f"{self.units} units are too few for {p} quantities")
        return self

    @classmethod
    def of(cls, axis: str, deviations: Mapping[str, Array]) -> Together | None:
        """Return that of deviations (U,) by quantity, NaN where not known; None of too few units or quantities."""
        some = {name: z for name, z in deviations.items() if np.nanstd(z) > 0}
        if len(some) < 2:
            return None
        Z = np.clip(np.stack([*some.values()], axis=1), -MOST, MOST)
        Z = Z[np.all(np.isfinite(Z), axis=1)]
        n, p = Z.shape
        if n < PER_FIGURE * p + 1:
            return None
        S = np.cov(Z.T)
        if np.linalg.eigvalsh(S).min() < 1e-9 * np.trace(S):
            return None
        return cls(axis=axis, quantities=tuple(some), covariance=S, units=n)

    def judged(self, deviations: Mapping[str, Array]) -> tuple[Array, Array, Array]:
        """Return T-squared (U,), its limit (U,) and the contributions (U, p) of further units.

        A unit without some of the quantities is judged by the others, one without any is NaN.
        """
        z = np.stack([deviations[name] for name in self.quantities], axis=1)
        values, limits, shares = (np.full(shape, np.nan) for shape in (len(z), len(z), z.shape))
        known = np.isfinite(z)
        for mask in np.unique(known, axis=0):
            units, some = np.flatnonzero(np.all(known == mask, axis=1)), np.flatnonzero(mask)
            if not len(some):
                continue
            values[units], limits[units] = self._squared(z[units], some), self._limit(len(some))
            for i in some:
                shares[units, i] = values[units] - self._squared(z[units], some[some != i])
        return values, limits, shares

    def _squared(self, z: Array, some: NDArray[np.intp]) -> Array:
        """Return T-squared (U,) of some columns of z (U, p)."""
        part = z[:, some]
        return np.asarray(np.sum(part * np.linalg.solve(self.covariance[np.ix_(some, some)], part.T).T, axis=1))

    def _limit(self, p: int) -> float:
        from scipy.special import fdtri

        n = self.units
        return p * (n + 1) * (n - 1) / (n * (n - p)) * float(fdtri(p, n - p, 1 - ALARM))


class Baseline(BaseModel):
    """Limits of a line as its `units`, made from the date `first` to `last`, have them.

    Attributes
    ----------
    domain : (low, high), optional
        Temperatures that most of them were soaked over, degC.
    limits : tuple of FrozenLimits
    together : tuple of Together
        Of the axes of which enough units have two quantities or more.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: Annotated[int, Field(ge=0)]
    first: Plain = ""
    last: Plain = ""
    domain: tuple[FiniteFloat, FiniteFloat] | None = None
    limits: tuple[FrozenLimits, ...]
    together: tuple[Together, ...] = ()

    def of(self, quantity: str, axis: str) -> FrozenLimits | None:
        """Return the law of a quantity of an axis; None where there is none."""
        return next((one for one in self.limits if (one.quantity, one.axis) == (quantity, axis)), None)

    def covered(self, domain: tuple[float, float] | None) -> bool:
        """Return True if a soak over a `domain` (degC) is one over the range of the baseline's units, and no wider."""
        if self.domain is None or domain is None:
            return self.domain is domain
        return covers(domain, self.domain)

    @model_validator(mode="after")
    def _together_have_limits(self) -> Baseline:
        known = {(one.quantity, one.axis) for one in self.limits}
        if any((name, one.axis) not in known for one in self.together for name in one.quantities):
            raise ValueError("a covariance is of quantities without limits")
        return self
