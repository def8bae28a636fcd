"""The law of a family of units: c_i ~ N(mu + lot, Sigma) for each axis, and what follows for a unit.

It is fitted by `driftlab.family.model.fit_family`. A unit that saw part of the range has no information on the
rest, which is then what the family says of a unit like it. d axes, q coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from driftlab.family.bands import Bands
from driftlab.family.knots import Knots
from driftlab.family.restricted import Law
from driftlab.family.soaked import Soaked
from driftlab.family.tail_law import Laws
from fusion_core.chunk import Array


class Units(Protocol):
    """The units of a family with their lots; may be gone through several times, each time in the same order."""

    def __iter__(self) -> Iterator[tuple[Soaked, str]]: ...

    def __len__(self) -> int: ...


@dataclass(frozen=True, eq=False)
class Posterior:
    """Coefficients `c` (d, q) of a unit and their `covariance` (d, q, q), on the family's knots."""

    c: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Lot:
    """By how much the mean of a lot is off the family's: `shift` (d, q), its `sigma`, and how many units it has.

    `mean_covariance` (d, q, q) is that of the family's mean and the shift together.
    """

    shift: Array
    sigma: Array
    mean_covariance: Array
    units: int


@dataclass(frozen=True, eq=False)
class Family:
    """What the units of one type have in common.

    Attributes
    ----------
    knots : Knots
        Over the temperatures that enough of the units saw.
    axes : tuple of str
    channel, bias_unit : str
        Whose bias, and its SI unit.
    mu, mu_covariance : (d, q) and (d, q, q) arrays
    Sigma, Lambda : (d, q, q) arrays
        Covariance of units about their lot's mean, and of the lots' means about the family's.
    lots : dict of str to Lot
    units, sampled : int
        How many there were, and how many of them Sigma is of.
    weights : dict of str to (d,) array
        Of the units that were weighted down in Sigma and mu.
    steps, moved : (d,) arrays
        Of EM, and by what share of its deviations Sigma changed in the last.
    bands : Bands or None
        How wide bands must be, as measured on units left out (`driftlab.family.bands`).
    laws : Laws or None
        What is usual of its units, by which a new one is judged (`driftlab.family.outliers`).
    """

    knots: Knots
    axes: tuple[str, ...]
    channel: str
    bias_unit: str
    mu: Array
    mu_covariance: Array
    Sigma: Array
    Lambda: Array
    lots: dict[str, Lot]
    units: int
    sampled: int
    weights: dict[str, Array] = field(default_factory=dict)
    steps: Array = field(default_factory=lambda: np.zeros(0))
    moved: Array = field(default_factory=lambda: np.zeros(0))
    bands: Bands | None = None
    laws: Laws | None = None

    def marginal(self, lot: str = "") -> Posterior:
        """Return what is known of a new unit before it is soaked: of a lot of the family, or of one unheard of."""
        if lot in self.lots:
            own = self.lots[lot]
            return Posterior(self.mu + own.shift, self.Sigma + own.mean_covariance)
        return Posterior(self.mu, self.Sigma + self.Lambda + self.mu_covariance)

    def posterior(self, soaked: Soaked | None, lot: str = "") -> Posterior:
        """Return what is known of a unit of a lot, by the family and by its own soak.

        The unit is taken as a new one: of a unit that the family was fitted on, its own data count in mu once more,
        with a weight of one unit of all.

        Raises
        ------
        ValueError
            If the soak's axes or knots are not the family's.
        """
        before = self.marginal(lot)
        if soaked is None:
            return before
        J, h = self.said(soaked)
        c, covariance = np.empty_like(before.c), np.empty_like(before.covariance)
        for k in range(len(self.axes)):
            L, _, _ = Law(before.covariance[k], before.covariance[k]).root()
            V = np.linalg.inv(np.eye(L.shape[1]) + L.T @ J[k] @ L)
            c[k] = before.c[k] + L @ (V @ (L.T @ (h[k] - J[k] @ before.c[k])))
            covariance[k] = L @ V @ L.T
        return Posterior(c, covariance)

    def said(self, soaked: Soaked) -> tuple[Array, Array]:
        """Return J (d, q, q) and h (d, q) of a soak on the family's knots.

        Raises
        ------
        ValueError
            If its axes or the step of its knots are not the family's.
        """
        if soaked.axes != self.axes or soaked.knots.step != self.knots.step:
            raise ValueError(
                f"unit {soaked.unit} has axes {', '.join(soaked.axes)} and knots {soaked.knots.step} K apart, the "
                f"family {', '.join(self.axes)} and {self.knots.step} K; soak units of one family alike"
            )
        return brought(soaked, self.knots)


def brought(soaked: Soaked, knots: Knots) -> tuple[Array, Array]:
    """Return J (d, q, q) and h (d, q) of a soak on other knots; what it says of temperatures beyond them is let go."""
    wide = soaked.knots.joined(knots)
    J, h = soaked.on(wide)
    if wide == knots:
        return J, h
    part = knots.within(wide)
    rest = np.ones(wide.q, dtype=bool)
    rest[part] = False
    keep = np.flatnonzero(~rest)
    beyond = np.flatnonzero(rest & np.any(np.diagonal(J, axis1=1, axis2=2) > 0, axis=0))
    Jk, hk = J[:, keep][:, :, keep], h[:, keep]
    if len(beyond) == 0:
        return Jk, hk
    across, inner = J[:, keep][:, :, beyond], J[:, beyond][:, :, beyond]
    inner = inner + 1e-9 * np.max(np.diagonal(inner, axis1=1, axis2=2), axis=1)[:, None, None] * np.eye(len(beyond))
    taken = across @ np.linalg.inv(inner)
    found = Jk - taken @ across.transpose(0, 2, 1)
    return (found + found.transpose(0, 2, 1)) / 2, hk - np.einsum("dij,dj->di", taken, h[:, beyond])
