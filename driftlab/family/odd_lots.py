"""Lots of a family that are off as a whole: a matter of the lot, not of each of its units."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from driftlab.family.comparing import FIGURES, LOT_FEWEST, LOT_OFF, SHAPE, row_of, standardised_figure
from driftlab.family.law import Family
from driftlab.family.record import UnitRecord
from driftlab.units import RATE, BiasUnit

MATTERS = 0.5  # of the units' spread


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

    By more than LOT_OFF of what the mean of a lot is uncertain by, and by more than MATTERS of the units' spread; of
    lots of at least LOT_FEWEST units, and not more than half of all. `shown` is the unit of sentences, of a rate deg/h
    where it is None.
    """
    unit = shown or (RATE if family.bias_unit == RATE.si else BiasUnit(family.bias_unit, family.bias_unit))
    done = [record for record in records if record.state == "done"]
    return (*_curves(family, unit), *_figures(family, done))


def _curves(family: Family, unit: BiasUnit) -> list[OddLot]:
    found = []
    B = family.knots.values(family.knots.peaks[1:-1])
    for name, lot in family.lots.items():
        if not LOT_FEWEST <= lot.units <= family.units / 2:
            continue
        for axis, called in enumerate(family.axes):
            off, sure = B @ lot.shift[axis], B @ lot.sigma[axis]
            spread = np.sqrt(np.einsum("ti,ij,tj->t", B, family.Sigma[axis], B))
            k = int(np.argmax(np.abs(off) / spread))
            if abs(off[k]) > max(LOT_OFF * sure[k], MATTERS * spread[k]):
                T = float(family.knots.peaks[1 + k])
                sentence = (
                    f"lot {name}: {called} is off the other lots by {off[k] * unit.factor:.3g} {unit.shown} at {T:.0f} "
                    f"degC (its units spread by {spread[k] * unit.factor:.2g}); its {lot.units} units are held against "
                    "one another"
                )
                found.append(OddLot(name, SHAPE, called, T, sentence))
    return found


def _figures(family: Family, records: list[UnitRecord]) -> list[OddLot]:
    if not records:
        return []
    found = []
    table, lots = np.array([row_of(record, len(family.axes)) for record in records]), [r.lot for r in records]
    for k, name in enumerate(FIGURES, 1):
        _, _, off = standardised_figure(name, table[:, k], lots)
        for called, shifts in zip(family.axes, off, strict=True):
            for lot, by in shifts.items():
                sentence = (
                    f"lot {lot}: {name} of {called} is {np.exp(by):.2g} times that of the other lots; its "
                    f"{lots.count(lot)} units are held against one another"
                )
                found.append(OddLot(lot, name, called, None, sentence))
    return found
