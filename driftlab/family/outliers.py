"""Units of a family that are not as the others, with the reason in words, at a false discovery rate.

Of each unit and axis the curve and the figures of its record are compared with those of the other units
(`driftlab.family.outlier_tests`). A unit's tests are taken together as Simes (1986) has it, Benjamini & Hochberg
(1995) choose the units at FALSE, and of a chosen unit those tests are reported that pass at FALSE times the share of
units that were chosen (Benjamini & Bogomolov 2014). A new unit of a family that is known is one more of that family's
units, which are taken as ordinary. A lot that is off as a whole is reported as a lot (`Outliers.lots`): its units are
compared with one another.

The reason of an odd curve is the hypothesis under which it is likeliest. Each is a law of the coefficients, and with
the soak's information J, h::

    - 2 log p = c'Jc - 2 h'c - a'M^-1 a + log det M + price,   a = L'(h - J c),  M = 1 + L'J L

Of a reversed sign c is the mean with the other sign, of swapped axes c and L are each other's; a scale of the mean
(with a level), a level and a local deviation have the size that is likeliest. A price is twice the logarithm of the
number of trials. A hypothesis holds if with it the curve is an ordinary one of the family. d axes, q coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, combinations

import numpy as np
import numpy.typing as npt

from driftlab.evaluation.limits import OF_M
from driftlab.family.bands import deviation
from driftlab.family.mixed_model import Family
from driftlab.family.outlier_tests import (
    CURVES,
    FIGURES,
    LOT_OFF,
    MIN_UNITS_OF_LOT,
    CurveDeviation,
    CurveStatistics,
    DeviationShapes,
    Tests,
    tests_of,
    unscaled,
)
from driftlab.family.partitions import FamilyUnits, UnitOfLot, in_partitions
from driftlab.family.record import PER, TERM_FIGURES, UnitRecord, figure_name
from driftlab.family.reml import inverse
from driftlab.family.tail_law import MIN_UNITS, FigureLaw, TailLaws
from driftlab.family.unit_information import UnitInformation
from driftlab.units import BiasUnit, axis_name, default_unit, number
from fusion_core.chunk import Array, Integers
from fusion_core.faults import DOUBT, in_doubt

FALSE = 0.05  # expected share of false ones among the units that are reported
AT_ONCE = 1000  # units whose p-values are in memory
FOLLOWS = {
    "soaks": (*CURVES, *(name for name in FIGURES if name not in ("soaks", *TERM_FIGURES))),
    "hysteresis": ("walk", "residual", "coast"),
}
"""Tests that an odd figure makes odd too, and that are not reported: a joint fit takes it for a walk."""


@dataclass(frozen=True)
class Outlier:
    """A test of a unit that is not as in its family.

    Attributes
    ----------
    unit : str
    what : str
        DOUBT; `thermometer`; of a curve `sign`, `swap`, `scale`, `level` or `shape`; or one of `outlier_tests.FIGURES`.
    axis : str
    p : float
        Chance of a value as far out among units of the family.
    value : float
        The figure; of a curve how far it is off; SI.
    T : float or None
        Of a curve: where it is off most, degC.
    sentence : str
    as_family : tuple of str
        The other tests of the unit, which are as in the family.
    """

    unit: str
    what: str
    axis: str
    p: float
    value: float
    T: float | None
    sentence: str
    as_family: tuple[str, ...]


@dataclass(frozen=True)
class LotOutlier:
    """A lot that is off: `what` (`shape` or a figure) on which axis, and in words."""

    lot: str
    what: str
    axis: str
    sentence: str


@dataclass(frozen=True, eq=False)
class Outliers:
    """The odd units, by their names, the least likely reason first; the laws that they were judged by, and odd lots.

    `remarks` say what was not judged, a sentence each.
    """

    odd: dict[str, tuple[Outlier, ...]]
    laws: TailLaws | None = None
    remarks: list[str] = field(default_factory=list)
    lots: tuple[LotOutlier, ...] = ()


def find_outliers(
    family: Family, units: FamilyUnits, records: Sequence[UnitRecord], *, shown: BiasUnit | None = None,
    fitted: bool = True,
) -> Outliers:  # fmt: skip
    """Return the odd units with their reasons.

    Parameters
    ----------
    family : Family
    units : FamilyUnits
        Those to be judged.
    records : sequence of UnitRecord
        Of the same units; one without a record is judged by its curves alone.
    shown : BiasUnit, optional
        Of sentences; of a rate deg/h, else SI.
    fitted : bool
        Whether the units are those that the family was fitted on; others are judged by the laws that it has.
    """
    units, statistics = in_partitions(units), CurveStatistics(family, fitted=fitted)
    tests = tests_of(family, statistics, units, records, None if fitted else family.laws)
    if not len(tests.curves):
        return Outliers({})
    places, p, reported = chosen(tests.p, len(tests.curves), 0 if fitted or family.laws is None else family.units)
    unit = shown or default_unit(family.bias_unit)
    words = _Words(family, tests, CurveReasons(statistics, tests.laws), unit)
    read = zip(places.tolist(), p, reported, units.chosen(places).read(), strict=True)
    odd = {soaked.unit: words.of(k, own, passed, soaked, lot) for k, own, passed, (soaked, lot) in read}
    lots = _odd_lots(family, tests, unit) if fitted else ()
    elsewhere = chain.from_iterable(units.map(partial(_elsewhere, family.knots.domain)))
    return Outliers(odd, tests.laws, [*_not_judged(family, tests, known=not fitted), *elsewhere], lots)


def _elsewhere(domain: tuple[float, float], units: Sequence[UnitOfLot]) -> list[str]:
    """Return a sentence on each unit that saw none of the family's temperatures, degC."""
    low, high = domain
    return [
        f"Unit {soaked.unit} was soaked from {soaked.seen[0]:.3g} to {soaked.seen[1]:.3g} °C, where the family has "
        "nothing: its curve is not judged, and not in the family."
        for soaked, _ in units
        if soaked.seen[1] < low or soaked.seen[0] > high
    ]


def _not_judged(family: Family, tests: Tests, *, known: bool) -> list[str]:
    """Return the units or figures that were not judged, and why."""
    n = len(tests.curves)
    if not tests.laws.curves:
        few = f"{n:,} unit{'s are' if n != 1 else ' is'} too few to judge one by the others, {MIN_UNITS} will do"
        new = f"; the family's file, of {family.units:,}, does not say what is usual of its units" if known else ""
        return [f"Units are held against their own noise alone: {few}{new}."]
    if known and family.laws is None:
        return ["The family's file does not say what is usual of its units: these are held against one another."]
    return []


def of_doubts(record: UnitRecord) -> tuple[Outlier, ...]:
    """Return the doubts about a unit as reasons for which it stands out: nothing of it is said to be as the family."""
    return tuple(Outlier(record.unit, DOUBT, "", 0.0, float("nan"), None, text, ()) for text in in_doubt(record.doubts))


def describe(unit: str, odd: tuple[Outlier, ...]) -> str:
    """Return the reasons of an odd unit, in a sentence."""
    fine = [*map(figure_name, odd[0].as_family)]
    rest = f"; {', '.join(fine[:-1])}{' and ' if len(fine) > 1 else ''}{fine[-1]} as the family" if fine else ""
    return f"unit {unit}: {'; '.join(one.sentence for one in odd)}{rest}"


def chosen(
    p: Callable[[Integers], Array], count: int, ordinary: int = 0
) -> tuple[Integers, Array, npt.NDArray[np.bool_]]:
    """Return the units (k,) that stand out, the p-values (k, m) of their tests, and which of these are reported.

    `p` returns those of some of `count` units, NaN where there is no test; `ordinary` further units are known to be as
    they should.
    """
    of_unit = np.concatenate([simes(p(part)) for part in np.split(np.arange(count), range(AT_ONCE, count, AT_ONCE))])
    share = _level(of_unit[np.isfinite(of_unit)], FALSE, int(np.sum(np.isfinite(of_unit))) + ordinary)
    places = np.flatnonzero(of_unit <= share)
    tested = p(places)
    known = [row[np.isfinite(row)] for row in tested]
    reported = tested <= np.array([_level(row, share, len(row)) for row in known]).reshape(-1, 1)
    passed = np.any(reported, axis=1)
    return places[passed], tested[passed], reported[passed]


def _level(p: Array, false: float, n: int) -> float:
    """Return the level of Benjamini and Hochberg for p-values (m,) of n tests; 0 where none passes."""
    passed = np.flatnonzero(np.sort(p) <= false * np.arange(1, len(p) + 1) / max(n, 1))
    return false * (int(passed[-1]) + 1 if len(passed) else 0) / max(n, 1)


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

    def of(
        self, k: int, of_tests: Array, reported: npt.NDArray[np.bool_], soaked: UnitInformation, lot: str
    ) -> tuple[Outlier, ...]:
        """Return the outliers of unit k with p-values `of_tests` (m,), of which those `reported` passed."""
        tests, (J, h) = self.tests, self.family.information_of(soaked)
        p = {what: float(one) for what, one, passed in zip(tests.what, of_tests, reported, strict=True) if passed}
        named = {what for what, _ in p}
        silent = {after for what in named for after in FOLLOWS.get(what, ())}
        tested = dict.fromkeys(
            "shape" if what in CURVES else what
            for (what, _), one in zip(tests.what, of_tests, strict=True) if np.isfinite(one)
        )  # fmt: skip
        odd_curve = named & set(CURVES)
        fine = tuple(w for w in tested if w not in named | silent and not (w == "shape" and odd_curve))
        of_curve = {
            axis: min(value for (what, own), value in p.items() if own == axis and what in CURVES)
            for axis in sorted({axis for what, axis in p if what in CURVES and what not in silent})
        }
        outliers = [
            self._of_curve(soaked.unit, reason, min(of_curve.get(axis, 1.0) for axis in reason.axes), fine)
            for reason in self.reasons.of(J, h, lot, tuple(of_curve))
            if not self._of_loop(k, p, reason)
        ]
        for (what, axis), value in p.items():
            if what in FIGURES and what not in silent:
                outliers.append(self._of_figure(soaked.unit, tests.figure(k, what, axis), what, axis, value, fine))
        return tuple(sorted(outliers, key=lambda odd: odd.p))

    def _of_loop(self, k: int, p: Mapping[tuple[str, int], float], reason: Reason) -> bool:
        """Return True if a curve is off by no more than its hysteresis, which ends where the temperature turns."""
        loops = [own for what, own in p if what == "hysteresis" and own in reason.axes]
        value = [self.tests.figure(k, "hysteresis", own) for own in loops]
        return bool(value) and abs(reason.off) < max(value)

    def _of_curve(self, name: str, reason: Reason, p: float, fine: tuple[str, ...]) -> Outlier:
        called, factor = " and ".join(self._axis(axis) for axis in reason.axes), self.unit.factor
        size, spread = (number(value * factor) for value in (abs(reason.off), reason.spread))
        off = f"{size} {self.unit.shown}, the family's spread there is {spread}"
        sentence = {
            "sign": f"{called} is negated: with its sign reversed it is as the family",
            "swap": f"{called} are swapped: exchanged they are as the family",
            "scale": f"{called} is {reason.times:.3g} times what is usual: scale",
            "level": f"{called} is off by {number(reason.off * factor)} {self.unit.shown}: level (the family's "
            f"spread is {spread})",
            "bump": f"{called} has a local deviation at {reason.T:.0f} °C as none of the others ({off})",
        }.get(reason.what, f"{called} is shaped as none of the others, most at {reason.T:.0f} °C ({off})")
        axis = " ".join(self.family.axes[own] for own in reason.axes)
        what = reason.what if reason.what in ("sign", "swap", "scale", "level") else "shape"
        return Outlier(name, what, axis, p, reason.off, reason.T, sentence, fine)

    def _of_figure(self, name: str, value: float, what: str, axis: int, p: float, fine: tuple[str, ...]) -> Outlier:
        shown = _shown(what, self.unit)
        size, called = f"{_number(value, shown)} {shown.shown}{PER.get(what, '')}", self._axis(axis)
        law = self.tests.laws.figures.get(what)
        sentence = {
            "hysteresis": f"{called} differs by {size} between warming and cooling",
            "soaks": f"two soaks differ more than one unit can: by {size} on {called}",
        }.get(what, f"{figure_name(what)} of {called} is {size}")
        usual = () if law is None else [_number(end, shown) for end in _usual(what, law, axis)]
        sentence += f", of most units {' to '.join(usual)}" if usual else ", more than noise explains"
        return Outlier(name, what, self.family.axes[axis], p, value, None, sentence, fine)

    def _axis(self, axis: int) -> str:
        """Return the name of an axis: its letter, or its channel where it is the only one."""
        family = self.family
        return family.axes[axis] if len(family.axes) > 1 else axis_name(family.channel, family.axes[axis])


def _shown(what: str, unit: BiasUnit) -> BiasUnit:
    """Return the unit in which a figure is shown, but for PER: that of the bias, or of a term of M."""
    return OF_M["misalignment" if what != TERM_FIGURES[0] else "scale"] if what in TERM_FIGURES else unit


def _number(value: float, shown: BiasUnit) -> str:
    """Return a figure in the unit in which it is shown; ppm without an exponent."""
    size = value * shown.factor
    return f"{size:.0f}" if shown is OF_M["scale"] and abs(size) >= 1000 else f"{size:.3g}"


def _usual(what: str, law: FigureLaw, axis: int) -> list[float]:
    """Return the range of a figure of an axis in most units, SI."""
    width = float(np.hypot(law.width[axis], law.sure[axis]))
    return [unscaled(what, law.centre[axis] + by * width, law.usual[axis]) for by in (-2, 2)]


SHAPE = "shape"
MATTERS = 0.5  # of the units' spread
MAD_WORTH = 0.37  # of the degrees of freedom of a variance: what one from the median of deviations is worth
MIN_LOTS = 3  # lots; of two none tells which is off


def _odd_lots(family: Family, tests: Tests, unit: BiasUnit) -> tuple[LotOutlier, ...]:
    """Return the lots whose mean curve, or whose figures, are off those of the others.

    By more than is as seldom as LOT_OFF deviations of the lots' spread and of the uncertainty of their means, and by
    more than MATTERS of the units' spread; of lots of at least MIN_UNITS_OF_LOT units, and not more than half of all.
    """
    odd, lots, peaks = [], family.lots, family.knots.peaks[1:-1]
    B = family.knots.values(peaks)
    spread = deviation(B, family.Sigma)
    for name, lot in lots.items() if len(lots) >= MIN_LOTS else ():
        if not MIN_UNITS_OF_LOT <= lot.units <= family.units / 2:
            continue
        off, sure = _off(family, name, B)
        for axis, k in enumerate(np.argmax(np.abs(off) / spread, axis=0)):
            if abs(off[k, axis]) > max(sure[k, axis], MATTERS * spread[k, axis]):
                called, T = family.axes[axis], float(peaks[k])
                sentence = (
                    f"lot {name}: {called} is off the other lots by {number(off[k, axis] * unit.factor)} {unit.shown} "
                    f"at {T:.0f} °C (its units spread by {number(spread[k, axis] * unit.factor)}); its {lot.units} "
                    "units are held against one another"
                )
                odd.append(LotOutlier(name, SHAPE, called, sentence))
    for name, axis, lot_name, times in tests.odd_lots():
        differs = f"{times:.2g} times that of"
        if name in TERM_FIGURES:
            shown = _shown(name, unit)
            differs = f"{_number(times, shown)} {shown.shown} off"
        sentence = (
            f"lot {lot_name}: {figure_name(name)} of {family.axes[axis]} is {differs} the other lots; its "
            f"{np.sum(tests.of_lots == lot_name)} units are held against one another"
        )
        odd.append(LotOutlier(lot_name, name, family.axes[axis], sentence))
    return tuple(odd)


def _off(family: Family, name: str, B: Array) -> tuple[Array, Array]:
    """Return the deviation of the curves of a lot from the other lots' (G, d), and the limit of chance (G, d).

    The spread of the lots is that of the others, robustly: one that is off must not widen what it is judged by. Its
    degrees of freedom are few where there are few lots (Satterthwaite).
    """
    from scipy.special import ndtr, stdtrit

    curves = {lot: B @ one.shift.T for lot, one in family.lots.items()}
    variances = {lot: deviation(B, one.mean_covariance) ** 2 for lot, one in family.lots.items()}
    mine, own = curves.pop(name), variances.pop(name)
    others, n = np.array(list(curves.values())), len(curves)
    theirs, middle = np.median(list(variances.values()), axis=0), np.median(others, axis=0)
    wide = (1.4826 * np.median(np.abs(others - middle), axis=0)) ** 2
    between = np.maximum(np.median(wide / theirs, axis=0) - 1, 0.0) * theirs  # in all, not where it is least
    variance = between + own + (between + theirs) * np.pi / (2 * n)
    units = max(family.units - len(family.lots), 1)
    dof = variance**2 / (between**2 / (MAD_WORTH * max(n - 1, 1)) + own**2 / units)
    return mine - middle, -stdtrit(np.maximum(dof, 0.5), ndtr(-LOT_OFF)) * np.sqrt(variance)


PRICES = {"sign": 4.0, "swap": 4.0, "level": 8.0, "scale": 18.0, "bump": 16.0}
SCALES = 0.25, 4.0  # of either sign: -0.4 times the usual curve is not the usual one negated
SMALL = np.geomspace(1e-6, SCALES[0], 109)  # of an axis in another unit; 12 % apart, as a curve tells it
ORDINARY = 1e-3  # probability of a curve as far from its family, that is still one of it
LITTLE = 0.15  # of the squared distance


@dataclass(frozen=True)
class Reason:
    """Reason of an odd curve: `sign`, `swap`, `scale`, `level`, `bump`, or `curve` where none of these is all.

    The curve of `axes` is `off` most at `T` degC, where units spread by `spread` (SI), or is so many `times` the usual.
    Of `bump` and `curve` both are of the likeliest local deviation, the rest of the curve given.
    """

    what: str
    axes: tuple[int, ...]
    off: float
    spread: float
    T: float
    times: float = 1.0


class CurveReasons:
    """Reasons for odd curves, by the statistics of a family and the laws of these."""

    def __init__(self, statistics: CurveStatistics, laws: TailLaws) -> None:
        self.statistics, self.laws = statistics, laws

    def of(self, J: Array, h: Array, lot: str, axes: Sequence[int]) -> list[Reason]:
        """Return the reasons of the axes whose curves are odd, of a soak with J (d, q, q) and h (d, q)."""
        reasons, rest, shapes = [], list(axes), self.statistics.shapes(lot)
        every = [self._hypotheses(J[axis], h[axis], shapes[axis], axis) for axis in range(len(J))]
        least = [own[0 if axis in axes else -1][0] for axis, own in enumerate(every)]
        for a, b in combinations(range(len(J)), 2):
            if not {a, b} & set(rest):
                continue
            crossed = [
                self._hypothesis(J[i], h[i], shapes[i], shapes[k].c, shapes[k].L, i) for i, k in ((a, b), (b, a))
            ]
            cost = sum(own[0] for own in crossed) + PRICES["swap"]
            if cost < least[a] + least[b] and all(own[2] for own in crossed):
                rest = [axis for axis in rest if axis not in (a, b)]
                reasons.append(self._where("swap", (a, b), J[a], h[a], shapes[a]))
        for axis in rest:
            (*tried, (usual, none, _)) = every[axis]
            ordinary = [(cost, reason) for cost, reason, good in tried if good]
            likelier = [reason for cost, reason in ordinary if cost < usual]  # a reason that gains less is none
            off = self._where("curve", (axis,), J[axis], h[axis], shapes[axis]) if ordinary else none
            reasons.append(likelier[0] if likelier else off)
        return reasons

    def _hypotheses(self, J: Array, h: Array, shapes: DeviationShapes, axis: int) -> list[tuple[float, Reason, bool]]:
        """Return cost, reason, and whether it makes the curve ordinary, the likeliest first; at the end `curve`."""
        cost, _, own = _fit(J, h, shapes.c, shapes.L)
        where, reasons = self._where("curve", (axis,), J, h, shapes), []

        def add(what: str, times: float, g: Array | None, T: float = where.T) -> None:
            priced, size, good = self._hypothesis(J, h, shapes, times * shapes.c, abs(times) * shapes.L, axis, g)
            reason = replace(where, what=what, times=times)
            if g is not None and what != "scale":
                reason = Reason(what, (axis,), size, float(1 / np.sqrt(g @ own.K @ g)), T)
            reasons.append((priced + PRICES[what], reason, good))

        add("sign", -1.0, None)
        add("level", 1.0, shapes.level)
        times = 1 + float(_fit(J, h, shapes.c, shapes.L, np.column_stack([shapes.scale, shapes.level]))[1][0])
        if SCALES[0] < abs(times) < SCALES[1]:
            add("scale", times, shapes.level / times)
        times = _smaller(J, h, shapes)
        add("scale", times, shapes.level / times)
        seen = np.flatnonzero(self.statistics.seen(J))
        bumps = shapes.bumps[:, seen]
        t = (bumps.T @ own.z) ** 2 / np.sum((own.K @ bumps) * bumps, axis=0)
        k = int(seen[np.argmax(t)]) if len(seen) else 0
        add("bump", 1.0, shapes.bumps[:, k], float(self.statistics.at[k]))
        none = replace(reasons[-1][1], what="curve")  # where a local deviation would be likeliest
        return [*sorted(reasons, key=lambda one: one[0]), (cost, none, True)]

    def _hypothesis(
        self, J: Array, h: Array, mine: DeviationShapes, c: Array, L: Array, axis: int, g: Array | None = None
    ) -> tuple[float, float, bool]:
        """Return the cost of a curve about c with L, the size of a shape g of it, and whether it is ordinary then.

        Ordinary is what is left as far from its family as its units are, or next to nothing of what it was.
        """
        cost, size, left = _fit(J, h, c, L, None if g is None else g[:, None])
        law, square, before = self.laws.curves.get("curve"), left.squared(), _fit(J, h, mine.c, mine.L)[2]
        if law is None or np.isnan(square):
            return cost, float(size[0]), False
        p = law.p(np.full((1, len(law.centre)), square), upper=True)[0, axis]
        return cost, float(size[0]), bool(p > ORDINARY or left.z @ left.z < LITTLE * (before.z @ before.z))

    def _where(self, what: str, axes: tuple[int, ...], J: Array, h: Array, shapes: DeviationShapes) -> Reason:
        """Return a reason with where the curve of the first of the axes is off its lot's mean most."""
        family, axis = self.statistics.family, axes[0]
        peaks = family.knots.peaks[1:-1]
        B = family.knots.values(peaks)
        spread = deviation(B, family.Sigma[axis : axis + 1])[:, 0]
        off = B @ (shapes.L @ _fit(J, h, shapes.c, shapes.L)[2].z)
        k = int(np.argmax(np.abs(off) / spread))
        return Reason(what, axes, float(off[k]), float(spread[k]), float(peaks[k]))


def _smaller(J: Array, h: Array, shapes: DeviationShapes) -> float:
    """Return the factor, of either sign and below SCALES, under which a curve, its level apart, is likeliest.

    Of an axis in another unit not only the mean is so many times as large, but also what units differ by.
    """
    c, L, times = shapes.c, shapes.L, np.concatenate([SMALL, -SMALL])
    gain, U = np.linalg.eigh(L.T @ J @ L)  # in whose coordinates M of every factor is diagonal
    t, (of_h, of_mean, g) = times[:, None], (U.T @ own for own in (L.T @ h, L.T @ (J @ c), shapes.level))
    M, a = 1 + t**2 * gain, np.abs(t) * (of_h - t * of_mean)
    of_level = np.sum(g * a / M, axis=1) ** 2 / np.sum(g**2 * (1 - 1 / M), axis=1)
    cost = times**2 * (c @ J @ c) - 2 * times * (h @ c) + np.sum(np.log(M) - a**2 / M, axis=1) - of_level
    return float(times[np.argmin(cost)])


def _fit(J: Array, h: Array, c: Array, L: Array, g: Array | None = None) -> tuple[float, Array, CurveDeviation]:
    """Return - 2 log p of the module's text, without the price, with shapes g (q, G) of the likeliest sizes.

    Beside it these sizes (G,), and the deviation of the coefficients that is left.
    """
    M = np.eye(L.shape[1]) + L.T @ J @ L
    V, a = inverse(M), L.T @ (h - J @ c)
    z, K = V @ a, np.eye(len(a)) - V
    cost = float(c @ J @ c - 2 * h @ c - a @ z + np.linalg.slogdet(M)[1])
    if g is None:
        return cost, np.zeros(1), CurveDeviation(z, K, 0.0)
    pull = g.T @ z
    size = np.linalg.solve(g.T @ K @ g, pull)
    return cost - float(pull @ size), np.asarray(size), CurveDeviation(z - K @ g @ size, K, 0.0)
