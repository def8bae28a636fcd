"""A family fitted to its units.

Sigma and the spread of the lots are those of `driftlab.family.robust`, of all units or of a seeded sample of SAMPLE of
them; mu and the lots' shifts are of all units under that law, one unit at a time. d axes, q coefficients, G lots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftlab.family.each import Each, alone
from driftlab.family.knots import Knots
from driftlab.family.law import Family, Lot, Posterior, Units, brought
from driftlab.family.restricted import Index, Means, means_of
from driftlab.family.robust import Fitted, falling, fit_axis
from fusion_core.chunk import Array

__all__ = ["Family", "Lot", "Posterior", "Units", "fit_family"]

SAMPLE = 1500  # units that Sigma is of, where there are more
FEWEST = 3  # units that saw a temperature, for it to be in the family's domain
SHARE = 0.02  # of all units, likewise


@dataclass(frozen=True)
class Survey:
    """What the units have in common: knots and axes; and the lot of each."""

    knots: Knots
    axes: tuple[str, ...]
    lots: list[str]


def fit_family(
    units: Units, *, channel: str = "gyro", bias_unit: str = "rad/s", seed: int = 0, each: Each = alone
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


def surveyed(units: Units) -> Survey:
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
    knots = Knots(first + int(enough[0]), int(enough[-1] - enough[0]) + 1, step)
    return Survey(knots, axes, lots)


def numbered(lots: list[str]) -> dict[str, int]:
    """Return a number for each lot; 0 for all where every unit has one of its own, which tells nothing of lots."""
    names = sorted(set(lots))
    return dict.fromkeys(names, 0) if len(names) == len(lots) else {name: k for k, name in enumerate(names)}


def _sample(units: Units, knots: Knots, chosen: set[int]) -> tuple[Array, Array, list[str]]:
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
    units: Units, found: Survey, fits: list[Fitted], present: Array, numbers: dict[str, int]
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
            w = float(falling(z @ z / np.trace(K), fits[axis].limit))
            V = np.linalg.inv(A + w * np.eye(q)) if w < 1 else np.eye(q) - K
            information[axis, g] += w * (np.eye(q) - w * V)
            weighted[axis, g] += w * V @ a
    return [means_of(information[k], weighted[k], lots).turned(L) for k, (L, _, lots) in enumerate(roots)]


def _lots(lots: list[str], numbers: dict[str, int], means: list[Means]) -> dict[str, Lot]:
    """Return what is known of each lot that has a name, or is the only one."""
    if len(set(numbers.values())) < len(numbers):
        return {}
    found = {}
    for name, g in numbers.items():
        shift = np.stack([m.shifts[g] for m in means])
        sigma = np.sqrt(np.stack([np.diag(m.shifts_covariance[g]) for m in means]))
        if name or len(numbers) == 1:
            found[name] = Lot(shift, sigma, _symmetric([m.of_lot[g] for m in means]), lots.count(name))
    return found


def _symmetric(matrices: list[Array]) -> Array:
    """Return matrices (d, q, q) without what rounding made of their symmetry."""
    found = np.stack(matrices)
    return (found + found.transpose(0, 2, 1)) / 2
