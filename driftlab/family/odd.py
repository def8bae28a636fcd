"""Units of a family that are not as the others, with the reason in words, at a false discovery rate.

Of each unit and axis the shape of its curve and the figures of its record are held against those of the other units:
`driftlab.family.null` says how seldom a value so far out is. A unit's tests are taken together as Simes (1986) has it,
Benjamini & Hochberg (1995) choose the units at RATE, and of a chosen unit those tests are told that pass at RATE times
the share of units that were chosen (Benjamini & Bogomolov 2014). A lot that is off as a whole is the lot's matter: its
units are held against one another. d axes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from driftlab.family.comparing import SHAPE, Tests, tests_of
from driftlab.family.law import Family, Units
from driftlab.family.record import UnitRecord
from driftlab.family.shapes import Bend, Shapes
from driftlab.units import RATE, BiasUnit, axis_name
from fusion_core.chunk import Array

FALSE = 0.05  # expected share of false ones among the units that are reported
PER = {"noise": "/sqrt(Hz)", "walk": "/sqrt(s)"}


@dataclass(frozen=True)
class Odd:
    """What of a unit is not as in its family.

    Attributes
    ----------
    unit : str
    what : str
        `shape`, or one of `driftlab.family.comparing.FIGURES`.
    axis : str
    p : float
        Chance of a value as far out among units of the family.
    value, expected, spread : float
        The figure, the units' median and width of it; of a shape the height of the bend, 0, and the units' spread; SI.
    T : float or None
        Of a shape: where it is off most, degC.
    sentence : str
    as_family : tuple of str
        What else of the unit was tested, and is as in the family.
    """

    unit: str
    what: str
    axis: str
    p: float
    value: float
    expected: float
    spread: float
    T: float | None
    sentence: str
    as_family: tuple[str, ...]


def find_odd(
    family: Family,
    units: Units,
    records: Iterable[UnitRecord],
    *,
    shown: BiasUnit | None = None,
    fitted: bool = True,
) -> dict[str, tuple[Odd, ...]]:
    """Return what is odd of each unit of which anything is, the least likely first.

    Parameters
    ----------
    family : Family
    units : Units
        Those to be judged.
    records : iterable of UnitRecord
        Of the same units; one without a record is judged by its shape alone.
    shown : BiasUnit, optional
        Of sentences; of a rate deg/h, else SI.
    fitted : bool
        Whether the units are those that the family was fitted on.
    """
    tests, shapes = tests_of(family, units, records, fitted=fitted), Shapes(family, fitted=fitted)
    if not tests.names:
        return {}
    unit = shown or (RATE if family.bias_unit == RATE.si else BiasUnit(family.bias_unit, family.bias_unit))
    told = chosen(tests.p)
    found: dict[str, tuple[Odd, ...]] = {}
    for k, (soaked, lot) in enumerate(units):
        own = sorted(np.flatnonzero(told[k]), key=lambda j, p=tests.p[k]: float(p[j]))  # type: ignore[misc]
        if not own:
            continue
        fine = _as_family(tests, k, told[k])
        odd = []
        for j in map(int, own):
            what, axis = tests.what[j]
            if what == SHAPE:
                bend = shapes.bend(soaked, lot, axis)
                odd.append(_of_shape(soaked.unit, bend, axis, family, unit, float(tests.p[k, j]), fine))
            else:
                odd.append(_of_figure(tests, k, j, family, unit, fine))
        found[soaked.unit] = tuple(odd)
    return found


def in_words(unit: str, odd: tuple[Odd, ...]) -> str:
    """Return why a unit is odd, in a sentence."""
    fine = odd[0].as_family
    rest = f"; {', '.join(fine[:-1])}{' and ' if len(fine) > 1 else ''}{fine[-1]} as the family" if fine else ""
    return f"unit {unit}: {'; '.join(one.sentence for one in odd)}{rest}"


def chosen(p: Array) -> npt.NDArray[np.bool_]:
    """Return which tests (n, m) are told, of p-values (n, m), NaN where there is no test."""
    of_unit = simes(p)
    n = int(np.sum(np.isfinite(of_unit)))
    ordered = np.sort(of_unit[np.isfinite(of_unit)])
    passed = np.flatnonzero(ordered <= FALSE * np.arange(1, n + 1) / max(n, 1))
    count = int(passed[-1]) + 1 if len(passed) else 0
    told = np.zeros(p.shape, dtype=bool)
    for k in np.flatnonzero(of_unit <= FALSE * count / max(n, 1)):
        own = np.nan_to_num(p[k], nan=2.0)
        order, m = np.sort(own[own <= 1]), int(np.sum(own <= 1))
        inside = np.flatnonzero(order <= FALSE * count / n * np.arange(1, m + 1) / m)
        told[k] = own <= order[inside[-1]]
    return told


def simes(p: Array) -> Array:
    """Return the p-value (n,) of all tests of a unit together, of p (n, m)."""
    ordered, m = np.sort(p, axis=1), np.sum(np.isfinite(p), axis=1)
    scaled = ordered * np.where(m > 0, m, np.nan)[:, None] / np.arange(1, p.shape[1] + 1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.fmin.reduce(scaled, axis=1))


def _as_family(tests: Tests, k: int, told: npt.NDArray[np.bool_]) -> tuple[str, ...]:
    """Return what of a unit was tested and is not odd on any axis."""
    tested = [what for (what, _), p in zip(tests.what, tests.p[k], strict=True) if np.isfinite(p)]
    odd = {what for (what, _), is_told in zip(tests.what, told, strict=True) if is_told}
    return tuple(what for what in dict.fromkeys(tested) if what not in odd)


def _of_shape(name: str, bend: Bend, axis: int, family: Family, unit: BiasUnit, p: float, fine: tuple[str, ...]) -> Odd:
    called, size = _axis(family, axis), f"{abs(bend.height) * unit.factor:.3g} {unit.shown}"
    spread = f"the family's spread there is {bend.spread * unit.factor:.2g}"
    if bend.local:
        sentence = f"{called} bends at {bend.T:.0f} degC as none of the others ({size}, {spread})"
    else:
        sentence = f"{called} is shaped as none of the others, most at {bend.T:.0f} degC ({size} off, {spread})"
    return Odd(name, SHAPE, family.axes[axis], float(p), bend.height, 0.0, bend.spread, bend.T, sentence, fine)


def _of_figure(tests: Tests, k: int, j: int, family: Family, unit: BiasUnit, fine: tuple[str, ...]) -> Odd:
    what, axis = tests.what[j]
    centre, width = tests.middle[j]
    value, per = float(tests.values[k, j]), PER.get(what, "")
    low, high = np.exp(centre - 2 * width) * unit.factor, np.exp(centre + 2 * width) * unit.factor
    sentence = (
        f"{what} of {_axis(family, axis)} is {value * unit.factor:.3g} {unit.shown}{per}, of most units "
        f"{low:.3g} to {high:.3g}"
    )
    middle = float(np.exp(centre))
    return Odd(
        tests.names[k], what, family.axes[axis], float(tests.p[k, j]), value, middle, middle * width, None, sentence,
        fine,
    )  # fmt: skip


def _axis(family: Family, axis: int) -> str:
    """Return what an axis is called: by its letter, or as its channel where it is the only one."""
    return family.axes[axis] if len(family.axes) > 1 else axis_name(family.channel, family.axes[axis])
