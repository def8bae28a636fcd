"""Lots of a family that are off as a whole: a matter of the lot, not of each of its units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from driftlab.family.law import Family
from driftlab.family.outlier_tests import FIGURES, LOT_FEWEST, LOT_OFF, figure_law, row_of, unscaled
from driftlab.family.record import UnitRecord
from driftlab.units import RATE, BiasUnit
from fusion_core.chunk import Array

SHAPE = "shape"
MATTERS = 0.5  # of the units' spread
MAD_WORTH = 0.37  # of the degrees of freedom of a variance: what one from the median of deviations is worth
FEWEST = 3  # lots; of two none tells which is off


@dataclass(frozen=True)
class OddLot:
    """A lot that is off: `what` (`shape` or a figure) on which axis, at `T` degC if it is the curve, and in words."""

    lot: str
    what: str
    axis: str
    T: float | None
    sentence: str


def find_odd_lots(
    family: Family, records: Iterable[UnitRecord], *, shown: BiasUnit | None = None
) -> tuple[OddLot, ...]:
    """Return the lots whose mean curve, or whose figures, are off those of the others.

    By more than is as seldom as LOT_OFF deviations of what lots differ by and their means are uncertain by, and by more
    than MATTERS of the units' spread; of lots of at least LOT_FEWEST units, and not more than half of all. `shown` is
    the unit of sentences, of a rate deg/h where it is None.
    """
    unit = shown or (RATE if family.bias_unit == RATE.si else BiasUnit(family.bias_unit, family.bias_unit))
    done = [record for record in records if record.state == "done"]
    return (*_curves(family, unit), *_figures(family, done))


def _curves(family: Family, unit: BiasUnit) -> list[OddLot]:
    found = []
    B = family.knots.values(family.knots.peaks[1:-1])
    if len(family.lots) < FEWEST:
        return []
    for name, lot in family.lots.items():
        if not LOT_FEWEST <= lot.units <= family.units / 2:
            continue
        for axis, called in enumerate(family.axes):
            off, sure = _off(family, name, axis, B)
            spread = np.sqrt(_variance(B, family.Sigma[axis]))
            k = int(np.argmax(np.abs(off) / spread))
            if abs(off[k]) > max(sure[k], MATTERS * spread[k]):
                T = float(family.knots.peaks[1 + k])
                sentence = (
                    f"lot {name}: {called} is off the other lots by {off[k] * unit.factor:.3g} {unit.shown} at {T:.0f} "
                    f"°C (its units spread by {spread[k] * unit.factor:.2g}); its {lot.units} units are held against "
                    "one another"
                )
                found.append(OddLot(name, SHAPE, called, T, sentence))
    return found


def _off(family: Family, name: str, axis: int, B: Array) -> tuple[Array, Array]:
    """Return by how much the curve of a lot is off the other lots' (G,), and how much of that may be chance (G,).

    The spread of the lots is that of the others, robustly: one that is off must not widen what it is judged by. Its
    degrees of freedom are few where there are few lots (Satterthwaite).
    """
    from scipy.stats import norm, t

    lots = family.lots
    others = np.array([B @ lot.shift[axis] for other, lot in lots.items() if other != name])
    own = _variance(B, lots[name].mean_covariance[axis])
    theirs = np.median([_variance(B, lot.mean_covariance[axis]) for o, lot in lots.items() if o != name], axis=0)
    middle = np.median(others, axis=0)
    wide = (1.4826 * np.median(np.abs(others - middle), axis=0)) ** 2
    between, n = max(float(np.median(wide / theirs)) - 1, 0.0) * theirs, len(others)  # in all, not where it is least
    variance = between + own + (between + theirs) * np.pi / (2 * n)
    dof = variance**2 / (between**2 / (MAD_WORTH * max(n - 1, 1)) + own**2 / max(family.units - len(lots), 1))
    return B @ lots[name].shift[axis] - middle, t.isf(norm.sf(LOT_OFF), np.maximum(dof, 0.5)) * np.sqrt(variance)


def _variance(B: Array, covariance: Array) -> Array:
    return np.asarray(np.einsum("ti,ij,tj->t", B, covariance, B))


def _figures(family: Family, records: list[UnitRecord]) -> list[OddLot]:
    if not records:
        return []
    found = []
    table, lots = np.array([row_of(record, len(family.axes)) for record in records]), [r.lot for r in records]
    for k, name in enumerate(FIGURES):
        law, off = figure_law(name, table[:, k], lots)
        for axis, (called, shifts) in enumerate(zip(family.axes, off, strict=True)):
            for lot, by in shifts.items():
                if law is None:
                    continue
                usual, shifted = [unscaled(name, law.centre[axis] + own, law.usual[axis]) for own in (0.0, by)]
                sentence = (
                    f"lot {lot}: {name} of {called} is {shifted / usual:.2g} times that of the other lots; its "
                    f"{lots.count(lot)} units are held against one another"
                )
                found.append(OddLot(lot, name, called, None, sentence))
    return found
