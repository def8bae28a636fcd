"""Units of a family that are not as the others, with the reason in words, at a false discovery rate.

Of each unit and axis the curve and the figures of its record are held against those of the other units
(`driftlab.family.outlier_tests`). A unit's tests are taken together as Simes (1986) has it, Benjamini & Hochberg
(1995) choose the units at FALSE, and of a chosen unit those tests are reported that pass at FALSE times the share of
units that were chosen (Benjamini & Bogomolov 2014). A new unit of a family that is known is one more of that family's
units, which are held to be ordinary. A lot that is off as a whole is the lot's matter: its units are held against one
another. Which of a reversed sign, swapped axes, a scale, a level or a local deviation a curve has is what makes it
likeliest (`driftlab.family.curve_reasons`). d axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from driftlab.family.curve_reasons import CurveReasons, Reason
from driftlab.family.curve_statistics import CurveStatistics
from driftlab.family.law import Family, Units
from driftlab.family.outlier_tests import CURVES, FIGURES, Tests, tests_of, unscaled
from driftlab.family.record import UnitRecord
from driftlab.family.tail_law import FEWEST, FigureLaw, Laws
from driftlab.units import RATE, BiasUnit, axis_name
from fusion_core.chunk import Array

FALSE = 0.05  # expected share of false ones among the units that are reported
PER = {"noise": "/sqrt(Hz)", "walk": "/sqrt(s)"}
FOLLOWS = {
    "soaks": (*CURVES, *(name for name in FIGURES if name != "soaks")),
    "hysteresis": ("walk", "residual", "coast"),
}
"""What a figure that is odd makes odd too, and is not said again: a joint fit takes it for a walk."""


@dataclass(frozen=True)
class Odd:
    """What of a unit is not as in its family.

    Attributes
    ----------
    unit : str
    what : str
        Of a curve `sign`, `swap`, `scale`, `level` or `shape`; or one of `driftlab.family.outlier_tests.FIGURES`.
    axis : str
    p : float
        Chance of a value as far out among units of the family.
    value, expected, spread : float
        The figure, the units' median and width of it; of a curve how far it is off, 0, and the units' spread; SI.
    T : float or None
        Of a curve: where it is off most, degC.
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


@dataclass(frozen=True, eq=False)
class Outliers:
    """The odd units, by their names, the least likely reason first; the laws that they were judged by, and remarks.

    `remarks` say what was not judged, a sentence each.
    """

    odd: dict[str, tuple[Odd, ...]]
    laws: Laws | None = None
    remarks: list[str] = field(default_factory=list)


def find_outliers(
    family: Family, units: Units, records: Iterable[UnitRecord], *, shown: BiasUnit | None = None, fitted: bool = True
) -> Outliers:
    """Return what is odd of each unit of which anything is.

    Parameters
    ----------
    family : Family
    units : Units
        Those to be judged.
    records : iterable of UnitRecord
        Of the same units; one without a record is judged by its curves alone.
    shown : BiasUnit, optional
        Of sentences; of a rate deg/h, else SI.
    fitted : bool
        Whether the units are those that the family was fitted on; others are judged by the laws that it has.
    """
    statistics = CurveStatistics(family, fitted=fitted)
    tests = tests_of(family, statistics, units, records, None if fitted else family.laws)
    if not tests.names:
        return Outliers({})
    unit = shown or (RATE if family.bias_unit == RATE.si else BiasUnit(family.bias_unit, family.bias_unit))
    chosen_tests = chosen(tests.p, 0 if fitted or family.laws is None else family.units)
    found: dict[str, tuple[Odd, ...]] = {}
    words = _Words(family, tests, CurveReasons(statistics, tests.laws), unit)
    for k, (soaked, lot) in enumerate(units):
        if np.any(chosen_tests[k]):
            found[soaked.unit] = words.of(k, chosen_tests[k], *family.said(soaked), lot)
    return Outliers(found, tests.laws, _not_judged(family, tests, known=not fitted))


def _not_judged(family: Family, tests: Tests, *, known: bool) -> list[str]:
    """Return which units or figures were not judged, and why."""
    n = len(tests.names)
    if not tests.laws.curves:
        few = f"{n:,} unit{'s are' if n != 1 else ' is'} too few to judge one by the others, {FEWEST} will do"
        new = f"; the family's file, of {family.units:,}, does not say what is usual of its units" if known else ""
        return [f"Units are held against their own noise alone: {few}{new}."]
    if known and family.laws is None:
        return ["The family's file does not say what is usual of its units: these are held against one another."]
    return []


def in_words(unit: str, odd: tuple[Odd, ...]) -> str:
    """Return why a unit is odd, in a sentence."""
    fine = odd[0].as_family
    rest = f"; {', '.join(fine[:-1])}{' and ' if len(fine) > 1 else ''}{fine[-1]} as the family" if fine else ""
    return f"unit {unit}: {'; '.join(one.sentence for one in odd)}{rest}"


def chosen(p: Array, ordinary: int = 0) -> npt.NDArray[np.bool_]:
    """Return which tests (n, m) are reported, of p-values (n, m), NaN where there is no test.

    `ordinary` further units are known to be as they should.
    """
    of_unit = simes(p)
    n = int(np.sum(np.isfinite(of_unit))) + ordinary
    ordered = np.sort(of_unit[np.isfinite(of_unit)])
    passed = np.flatnonzero(ordered <= FALSE * np.arange(1, len(ordered) + 1) / max(n, 1))
    share = FALSE * (int(passed[-1]) + 1 if len(passed) else 0) / max(n, 1)
    found = np.zeros(p.shape, dtype=bool)
    for k in np.flatnonzero(of_unit <= share):
        own = np.nan_to_num(p[k], nan=2.0)
        order = np.sort(own[own <= 1])
        inside = np.flatnonzero(order <= share * np.arange(1, len(order) + 1) / len(order))
        found[k] = own <= order[inside[-1]]
    return found


def simes(p: Array) -> Array:
    """Return the p-value (n,) of all tests of a unit together, of p (n, m)."""
    ordered, m = np.sort(p, axis=1), np.sum(np.isfinite(p), axis=1)
    scaled = ordered * np.where(m > 0, m, np.nan)[:, None] / np.arange(1, p.shape[1] + 1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.fmin.reduce(scaled, axis=1))


class _Words:
    """Sentences about units."""

    def __init__(self, family: Family, tests: Tests, reasons: CurveReasons, unit: BiasUnit) -> None:
        self.family, self.tests, self.reasons, self.unit = family, tests, reasons, unit

    def of(self, k: int, reported: npt.NDArray[np.bool_], J: Array, h: Array, lot: str) -> tuple[Odd, ...]:
        """Return what is odd of unit k, of which the tests `reported` (m,) passed."""
        tests = self.tests
        p = {one: float(tests.p[k, j]) for j, one in enumerate(tests.what) if reported[j]}
        named = {what for what, _ in p}
        silent = {after for what in named for after in FOLLOWS.get(what, ())}
        tested = dict.fromkeys(
            "shape" if what in CURVES else what
            for (what, _), one in zip(tests.what, tests.p[k], strict=True) if np.isfinite(one)
        )  # fmt: skip
        odd_curve = named & set(CURVES)
        fine = tuple(w for w in tested if w not in named | silent and not (w == "shape" and odd_curve))
        of_curve = {
            axis: min(value for (what, own), value in p.items() if own == axis and what in CURVES)
            for axis in sorted({axis for what, axis in p if what in CURVES and what not in silent})
        }
        found = [
            self._of_curve(tests.names[k], reason, min(of_curve.get(axis, 1.0) for axis in reason.axes), fine)
            for reason in self.reasons.of(J, h, lot, tuple(of_curve))
            if not self._of_loop(k, p, reason)
        ]
        for (what, axis), value in p.items():
            if what in FIGURES and what not in silent:
                found.append(self._of_figure(k, what, axis, value, fine))
        return tuple(sorted(found, key=lambda odd: odd.p))

    def _of_loop(self, k: int, p: Mapping[tuple[str, int], float], reason: Reason) -> bool:
        """Whether a curve is off by no more than what its hysteresis is, which ends where the temperature turns."""
        loops = [own for what, own in p if what == "hysteresis" and own in reason.axes]
        value = [float(self.tests.values[k, self.tests.what.index(("hysteresis", own))]) for own in loops]
        return bool(value) and abs(reason.off) < max(value)

    def _of_curve(self, name: str, reason: Reason, p: float, fine: tuple[str, ...]) -> Odd:
        called = " and ".join(self._axis(axis) for axis in reason.axes)
        size, spread = (f"{value * self.unit.factor:.{n}g}" for value, n in ((abs(reason.off), 3), (reason.spread, 2)))
        off = f"{size} {self.unit.shown}, the family's spread there is {spread}"
        sentence = {
            "sign": f"{called} is negated: with its sign reversed it is as the family",
            "swap": f"{called} are swapped: exchanged they are as the family",
            "scale": f"{called} is {reason.times:.3g} times what is usual: scale",
            "level": f"{called} is off by {reason.off * self.unit.factor:.3g} {self.unit.shown}: level (the family's "
            f"spread is {spread})",
            "bump": f"{called} has a local deviation at {reason.T:.0f} °C as none of the others ({off})",
        }.get(reason.what, f"{called} is shaped as none of the others, most at {reason.T:.0f} °C ({off})")
        axis = " ".join(self.family.axes[own] for own in reason.axes)
        what = reason.what if reason.what in ("sign", "swap", "scale", "level") else "shape"
        return Odd(name, what, axis, p, reason.off, 0.0, reason.spread, reason.T, sentence, fine)

    def _of_figure(self, k: int, what: str, axis: int, p: float, fine: tuple[str, ...]) -> Odd:
        tests, factor = self.tests, self.unit.factor
        value = float(tests.values[k, tests.what.index((what, axis))])
        size, called = f"{value * factor:.3g} {self.unit.shown}{PER.get(what, '')}", self._axis(axis)
        law = tests.laws.figures.get(what)
        low, middle, high = (np.nan,) * 3 if law is None else _usual(what, law, axis)
        sentence = {
            "hysteresis": f"{called} differs by {size} between warming and cooling",
            "soaks": f"two soaks differ more than one unit can: by {size} on {called}",
        }.get(what, f"{what} of {called} is {size}")
        of_most = f"of most units {low * factor:.3g} to {high * factor:.3g}"
        sentence += ", more than noise explains" if law is None else f", {of_most}"
        return Odd(
            tests.names[k], what, self.family.axes[axis], p, value, middle, (high - low) / 4, None, sentence, fine
        )

    def _axis(self, axis: int) -> str:
        """Return what an axis is called: by its letter, or as its channel where it is the only one."""
        family = self.family
        return family.axes[axis] if len(family.axes) > 1 else axis_name(family.channel, family.axes[axis])


def _usual(what: str, law: FigureLaw, axis: int) -> tuple[float, float, float]:
    """Return what a figure of an axis is in most units, from, in the middle, and to; SI."""
    width = float(np.hypot(law.width[axis], law.sure[axis]))
    low, middle, high = (unscaled(what, law.centre[axis] + by * width, law.usual[axis]) for by in (-2, 0, 2))
    return low, middle, high
