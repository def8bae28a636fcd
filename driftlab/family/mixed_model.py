"""A family fitted to its units.

Sigma and the spread of the lots are those of `driftlab.family.reml`, of all units or of a seeded sample of SAMPLE of
them; mu and the lots' shifts are of all units under that law, one unit at a time. d axes, q coefficients, G lots.

The law of a family of units: c_i ~ N(mu + lot, Sigma) for each axis, and what follows for a unit.

It is fitted by `driftlab.family.mixed_model.fit_family`. A unit that saw part of the range has no information on the
rest, which is then what the family says of a unit like it. d axes, q coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from driftlab.family.bands import Bands
from driftlab.family.basis import SplineBasis
from driftlab.family.parallel import ParallelMap, serial
from driftlab.family.reml import Fitted, Index, Means, VarianceComponents, fit_axis, means_of, outlier_weights
from driftlab.family.tail_law import TailLaws
from driftlab.family.unit_information import UnitInformation
from fusion_core.chunk import Array

__all__ = ["Family", "FamilyUnits", "LotEffect", "Posterior", "fit_family"]


SAMPLE = 1500  # units that Sigma is of, where there are more
FEWEST = 3  # units that saw a temperature, for it to be in the family's domain
SHARE = 0.02  # of all units, likewise


@dataclass(frozen=True)
class Survey:
    """What the units have in common: knots and axes; and the lot of each."""

    knots: SplineBasis
    axes: tuple[str, ...]
    lots: list[str]


def fit_family(
    units: FamilyUnits, *, channel: str = "gyro", bias_unit: str = "rad/s", seed: int = 0, each: ParallelMap = serial
) -> Family:
    """Return the family of units.

    Parameters
    ----------
    units : Units
    channel, bias_unit : str
        Whose bias, and its SI unit.
    seed : int
        Of the sample of SAMPLE units that Sigma is of, where there are more.
    each : Each, optional
        Who fits the axes.

    Raises
    ------
    ValueError
        If there are fewer than FEWEST units, they differ in axes or in the step of their knots, or no temperature was
        seen by FEWEST of them.
    """
    found = surveyed(units)
    n, d = len(found.lots), len(found.axes)
    chosen = np.arange(n)
    if n > SAMPLE:
        chosen = np.sort(np.random.default_rng(seed).choice(n, SAMPLE, replace=False))
    numbers = numbered(found.lots)
    lot = np.array([numbers[found.lots[k]] for k in chosen])
    present, lot = np.unique(lot, return_inverse=True)
    J, h, names = _sample(units, found.knots, set(chosen.tolist()))
    of_axes = ((J[:, axis], h[:, axis], lot, found.knots.peaks) for axis in range(d))
    fits = list(each(_fit, of_axes, at_once=1))
    w = np.stack([fit.w for fit in fits], axis=1)
    if n > SAMPLE:
        del J, h
        means = _means_of_all(units, found, fits, present, numbers)
    else:
        means = [fit.found.means for fit in fits]
    low = {name: w[k] for k, name in enumerate(names) if np.any(w[k] < 0.5)}
    return Family(
        found.knots, found.axes, channel, bias_unit, np.stack([m.mu for m in means]),
        _symmetric([m.covariance for m in means]), np.stack([fit.law.Sigma for fit in fits]),
        _symmetric([fit.law.Lambda for fit in fits]), _lots(found.lots, numbers, means), n, len(chosen), low,
         np.array([fit.steps for fit in fits]),
        np.array([fit.moved for fit in fits]),
    )  # fmt: skip


def _fit(of_axis: tuple[Array, Array, Index, Array]) -> Fitted:
    return fit_axis(*of_axis)


def surveyed(units: FamilyUnits) -> Survey:
    """Return knots over the temperatures that enough units saw, the axes, and each unit's lot.

    Raises
    ------
    ValueError
        As `fit_family`.
    """
    lots, spans, axes, step = [], [], None, 0.0
    for soaked, lot in units:
        lots.append(lot)
        spans.append((soaked.knots.first, soaked.knots.intervals))
        axes, step = axes or soaked.axes, step or soaked.knots.step
        if soaked.axes != axes or soaked.knots.step != step:
            raise ValueError(
                f"unit {soaked.unit} has axes {', '.join(soaked.axes)} and knots {soaked.knots.step} K apart, others "
                f"{', '.join(axes)} and {step} K; a family is of one type of unit, soaked alike"
            )
    if axes is None or len(lots) < FEWEST:
        raise ValueError(f"a family of {len(lots)} units; at least {FEWEST} are needed to know how units differ")
    first = min(span[0] for span in spans)
    seen = np.zeros(max(sum(span) for span in spans) - first, dtype=int)
    for start, count in spans:
        seen[start - first : start - first + count] += 1
    enough = np.flatnonzero(seen >= max(FEWEST, SHARE * len(lots)))
    if len(enough) == 0:
        raise ValueError(
            f"no temperature was seen by {max(FEWEST, int(np.ceil(SHARE * len(lots))))} of {len(lots)} units; soak the "
            "units of a family over one range"
        )
    knots = SplineBasis(first + int(enough[0]), int(enough[-1] - enough[0]) + 1, step)
    return Survey(knots, axes, lots)


def numbered(lots: list[str]) -> dict[str, int]:
    """Return a number for each lot; 0 for all where every unit has one of its own, which tells nothing of lots."""
    names = sorted(set(lots))
    return dict.fromkeys(names, 0) if len(names) == len(lots) else {name: k for k, name in enumerate(names)}


def _sample(units: FamilyUnits, knots: SplineBasis, chosen: set[int]) -> tuple[Array, Array, list[str]]:
    """Return J (n, d, q, q), h (n, d, q) and the names of the chosen units."""
    J, h, names = [], [], []
    for k, (soaked, _) in enumerate(units):
        if k in chosen:
            said = brought(soaked, knots)
            J.append(said[0])
            h.append(said[1])
            names.append(soaked.unit)
    return np.stack(J), np.stack(h), names


def _means_of_all(
    units: FamilyUnits, found: Survey, fits: list[Fitted], present: Array, numbers: dict[str, int]
) -> list[Means]:
    """Return the means of all units, of which the fits are a sample with the lots numbered `present`."""
    d, q, G = len(found.axes), found.knots.q, max(numbers.values()) + 1
    roots = [fit.law.root() for fit in fits]
    centres = np.zeros((d, G, q))
    for axis, fit in enumerate(fits):
        centres[axis] = fit.found.means.mu
        centres[axis, present] += fit.found.means.shifts
    information, weighted = np.zeros((d, G, q, q)), np.zeros((d, G, q))
    for soaked, lot in units:
        J, h = brought(soaked, found.knots)
        g = numbers[lot]
        for axis, (L, inverse, _) in enumerate(roots):
            A, a = L.T @ J[axis] @ L, L.T @ h[axis]
            K = np.eye(q) - np.linalg.inv(A + np.eye(q))
            own = a - K @ a
            z = own - K @ (inverse @ centres[axis, g])
            w = float(outlier_weights(z @ z / np.trace(K), fits[axis].limit))
            V = np.linalg.inv(A + w * np.eye(q)) if w < 1 else np.eye(q) - K
            information[axis, g] += w * (np.eye(q) - w * V)
            weighted[axis, g] += w * V @ a
    return [means_of(information[k], weighted[k], lots).turned(L) for k, (L, _, lots) in enumerate(roots)]


def _lots(lots: list[str], numbers: dict[str, int], means: list[Means]) -> dict[str, LotEffect]:
    """Return what is known of each lot that has a name, or is the only one."""
    if len(set(numbers.values())) < len(numbers):
        return {}
    found = {}
    for name, g in numbers.items():
        shift = np.stack([m.shifts[g] for m in means])
        sigma = np.sqrt(np.stack([np.diag(m.shifts_covariance[g]) for m in means]))
        if name or len(numbers) == 1:
            found[name] = LotEffect(shift, sigma, _symmetric([m.of_lot[g] for m in means]), lots.count(name))
    return found


def _symmetric(matrices: list[Array]) -> Array:
    """Return matrices (d, q, q) without what rounding made of their symmetry."""
    found = np.stack(matrices)
    return (found + found.transpose(0, 2, 1)) / 2


class FamilyUnits(Protocol):
    """The units of a family with their lots; may be gone through several times, each time in the same order."""

    def __iter__(self) -> Iterator[tuple[UnitInformation, str]]: ...

    def __len__(self) -> int: ...


@dataclass(frozen=True, eq=False)
class Posterior:
    """Coefficients `c` (d, q) of a unit and their `covariance` (d, q, q), on the family's knots."""

    c: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class LotEffect:
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

    knots: SplineBasis
    axes: tuple[str, ...]
    channel: str
    bias_unit: str
    mu: Array
    mu_covariance: Array
    Sigma: Array
    Lambda: Array
    lots: dict[str, LotEffect]
    units: int
    sampled: int
    weights: dict[str, Array] = field(default_factory=dict)
    steps: Array = field(default_factory=lambda: np.zeros(0))
    moved: Array = field(default_factory=lambda: np.zeros(0))
    bands: Bands | None = None
    laws: TailLaws | None = None

    def marginal(self, lot: str = "") -> Posterior:
        """Return what is known of a new unit before it is soaked: of a lot of the family, or of one unheard of."""
        if lot in self.lots:
            own = self.lots[lot]
            return Posterior(self.mu + own.shift, self.Sigma + own.mean_covariance)
        return Posterior(self.mu, self.Sigma + self.Lambda + self.mu_covariance)

    def posterior(self, soaked: UnitInformation | None, lot: str = "") -> Posterior:
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
            L, _, _ = VarianceComponents(before.covariance[k], before.covariance[k]).root()
            V = np.linalg.inv(np.eye(L.shape[1]) + L.T @ J[k] @ L)
            c[k] = before.c[k] + L @ (V @ (L.T @ (h[k] - J[k] @ before.c[k])))
            covariance[k] = L @ V @ L.T
        return Posterior(c, covariance)

    def said(self, soaked: UnitInformation) -> tuple[Array, Array]:
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


def brought(soaked: UnitInformation, knots: SplineBasis) -> tuple[Array, Array]:
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
