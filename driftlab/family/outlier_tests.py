"""Tests of each unit of a family against the others, and the probability of a value so far out.

Figures are those of a record, in a scale in which they are about normal, each with its own sigma. Curves are compared
by the distance from their family's, in the law of the other units, and along shapes. With r the unit's own coefficients
less its lot's mean, and Q the inverse of their covariance, family's and own::

    T^2 = z'z / tr K,   z = L' Q r,  K = 1 - M^-1 = L' Q L       over all shapes, by the soak's information on each
    t_g = g'Q r / sqrt(g'Q g)                                     along a shape g of which there may be more or less

with Sigma = L L' and M of `driftlab.family.reml`. Shapes are a level, a scale (g the mean curve), bumps of four
widths at all temperatures on which the soak has information (the logarithm of the largest |t| counts). Of a unit that
the family was fitted on, its own part in Sigma is taken out (Sherman and Morrison), of weight w among N::

    t_-g = t_g / sqrt((1 - h) (1 - h + w t_g^2 / N)),    h = w z'z / N

The usual values of each test follow a law that a file holds (`TailLaws`), so that a single new unit can be judged by a
known family. n units, d axes, q coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from sys import intern

import numpy as np
import numpy.typing as npt

from driftlab.family.mixed_model import Family
from driftlab.family.partitions import FamilyUnits, UnitOfLot, in_partitions
from driftlab.family.record import TERM_FIGURES, UnitRecord
from driftlab.family.reml import WEIGHT, inverse
from driftlab.family.tail_law import FigureLaw, TailLaw, TailLaws, standardised
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_records import at_places, figure_of, figures_in, of_units
from fusion_core.chunk import Array, Integers

KNOWN = 1e-2  # of the family's variance: a soak with less information on an axis has none
WIDTHS = (1.5, 2.2, 3.2, 5.0)  # of bumps, in steps of the knots
SEEN = 1e-6  # of the largest information of a soak on a bump: on one with less it has none
MAX_OWN = 0.9  # of Sigma, that a unit may have been
CURVES = ("level", "scale", "bump", "curve")  # statistics of the curve of an axis
FIGURES = ("residual", "noise", "walk", "coast", "hysteresis", "soaks", *TERM_FIGURES)  # not the swing: the curve's
TWO_SIDED = ("level", "scale", "noise", *TERM_FIGURES)  # a sensor may be too quiet; of other figures less is better
OF_NOISE = ("hysteresis", "soaks")  # compared with noise alone, where other units do not show the usual
SHAPES, MARGIN = 3, 2.0  # degrees of freedom of these, and by how much noise may be larger than its estimate
MIN_UNITS_OF_LOT, LOT_OFF = 5, 4.0  # units of a lot that may be off as a whole, and by how many deviations
LOGARITHMIC, FLOOR = ("noise",), 0.1  # of the median: a figure may be estimated as 0
Texts = npt.NDArray[np.object_]
REACH = 2.0  # times the usual: range of the noise of a unit


@dataclass(frozen=True, eq=False)
class CurveDeviation:
    """Coefficients of an axis less its lot's mean: z (q,), and K (q, q).

    `w` is the unit's weight in Sigma over the sum of all, 0 of a new unit.
    """

    z: Array
    K: Array
    w: float

    @cached_property
    def h(self) -> float:
        """Share of Sigma that is the unit's own."""
        return min(self.w * float(self.z @ self.z), MAX_OWN)

    def squared(self) -> float:
        """Return the squared distance as a Gaussian deviation (Wilson and Hilferty), NaN where nothing is known."""
        known = float(np.trace(self.K))
        if known < KNOWN:
            return np.nan
        dof = known**2 / float(np.sum(self.K * self.K))
        share = float(self.z @ self.z) / known * (1 - self.w) / (1 - self.h)
        return float((np.cbrt(share) - 1 + 2 / (9 * dof)) / np.sqrt(2 / (9 * dof)))

    def apart(self, t: Array) -> Array:
        """Return t with the unit's own part taken out of Sigma."""
        return np.asarray(t / np.sqrt((1 - self.h) * (1 - self.h + self.w * t**2)))


@dataclass(frozen=True, eq=False)
class DeviationShapes:
    """Of one lot and axis: mean c (q,), L (q, q), and the shapes g in L's coordinates, (q, shapes)."""

    c: Array
    L: Array
    level: Array
    scale: Array
    bumps: Array


class CurveStatistics:
    """Statistics of units under a family.

    Parameters
    ----------
    family : Family
    fitted : bool
        Whether the units are those that it was fitted on: each is then taken out of it again.
    """

    def __init__(self, family: Family, *, fitted: bool) -> None:
        self.family, self._fitted = family, fitted
        self._shapes: dict[str, list[DeviationShapes]] = {}
        self.at, self._bumps = _bumps(family)

    def of(self, soaked: UnitInformation, lot: str) -> Array:
        """Return the statistics of a unit (CURVES, d)."""
        J, h = self.family.information_of(soaked)
        total, weights = self.family.sampled + WEIGHT, self.family.weights.get(soaked.unit, (1.0,) * len(h))
        table = np.empty((len(CURVES), len(h)))
        for axis, shape in enumerate(self.shapes(lot)):
            V = inverse(np.eye(len(shape.c)) + shape.L.T @ J[axis] @ shape.L)
            z = V @ (shape.L.T @ (h[axis] - J[axis] @ shape.c))
            own = CurveDeviation(z, np.eye(len(z)) - V, float(weights[axis]) / total if self._fitted else 0.0)
            curve = own.squared()
            silent, bumps = np.nan if np.isnan(curve) else 1.0, shape.bumps[:, self.seen(J[axis])]
            t = silent * own.apart(_along(own, np.column_stack([shape.level, shape.scale, bumps])))
            bump = float(np.log(np.max(np.abs(t[2:]), initial=0.0))) if len(t) > 2 else np.nan
            table[:, axis] = t[0], t[1], bump, curve
        return table

    def seen(self, J: Array) -> npt.NDArray[np.bool_]:
        """Return the bumps (B,) on which a soak with J (q, q) has information: not those where it has no samples."""
        information = np.sum((J @ self._bumps) * self._bumps, axis=0)
        return np.asarray((information > SEEN * np.max(information)) & (information > 0))

    def shapes(self, lot: str) -> list[DeviationShapes]:
        """Return the shapes of a lot, of each axis."""
        if lot not in self._shapes:
            before = self.family.marginal(lot)
            self._shapes[lot] = [
                DeviationShapes(c, L, inverse.sum(axis=1), inverse @ c, inverse @ self._bumps)
                for c, L, inverse in zip(before.c, *before.root, strict=True)
            ]
        return self._shapes[lot]


def _bumps(family: Family) -> tuple[Array, Array]:
    """Return the temperatures of the bumps (B,), degC, and their coefficients (q, B)."""
    peaks, step = family.knots.peaks, family.knots.step
    at = np.tile(peaks[1:-1], len(WIDTHS))
    width = np.repeat(WIDTHS, len(peaks) - 2) * step
    return at, np.exp(-(((peaks[:, None] - at) / width) ** 2))


def _along(own: CurveDeviation, g: Array) -> Array:
    """Return t of shapes g (q, G) in the coordinates of L."""
    return np.asarray(g.T @ own.z / np.sqrt(np.maximum(np.sum((own.K @ g) * g, axis=0), 1e-300)))


@dataclass(frozen=True, eq=False)
class Tests:
    """Tests of n units; p-values and values are computed of those that are asked for.

    Attributes
    ----------
    what : list of (str, int)
        One of CURVES or FIGURES, and the axis, of each of the m tests: of the curves, and of figures that occur.
    curves : (n, CURVES, d) array
        Statistics of the curves, in deviations.
    records : sequence of UnitRecord
        Of the units.
    of_lots : (n,) array of str
        The units' lots.
    laws : TailLaws
    off : dict of str to list of dict
        Of each figure and axis the lots that are off as a whole, and by how much, as `scaled` has it.
    """

    what: list[tuple[str, int]]
    curves: Array
    records: Sequence[UnitRecord]
    of_lots: Texts
    laws: TailLaws
    off: dict[str, list[dict[str, float]]]

    def p(self, units: Integers) -> Array:
        """Return the p-values (k, m) of some units, NaN where there is no test."""
        curves, records, lots = self.curves[units], at_places(self.records, units), self.of_lots[units]
        columns = [_chance(self.laws.curves.get(name), curves[:, k], name) for k, name in enumerate(CURVES)]
        for name, off in self.off.items():
            figures = figure_of(records, name, curves.shape[2]).swapaxes(0, 1)
            columns.append(_of_figure(self.laws.figures.get(name), name, figures, lots, off))
        return np.concatenate(columns, axis=1)

    def figure(self, unit: int, name: str, axis: int) -> float:
        """Return a figure of an axis of a unit, SI."""
        return float(np.float32(figure_of([self.records[unit]], name, self.curves.shape[2])[0, 0, axis]))

    def odd_lots(self) -> list[tuple[str, int, str, float]]:
        """Return figures of lots that are off as a whole: figure, axis, lot, and how many times that of the others.

        Of a term of M by how much it is off, SI.
        """
        return [
            (name, axis, *lot) for name, off in self.off.items() if name in self.laws.figures
            for axis, own in enumerate(off) for lot in _times(name, self.laws.figures[name], axis, own)
        ]  # fmt: skip


def tests_of(
    family: Family, statistics: CurveStatistics, units: FamilyUnits, records: Sequence[UnitRecord],
    laws: TailLaws | None,
) -> Tests:  # fmt: skip
    """Return the tests of all units; of one without a record its curves alone. `laws` are a known family's."""
    d, n = len(family.axes), len(units)
    curves, lots = np.empty((n, len(CURVES), d)), np.empty(n, dtype=np.object_)

    def read() -> Iterator[str]:
        at = 0
        for names, of_lots, table in in_partitions(units).map(partial(_curves, statistics)):
            part = slice(at, at := at + len(names))
            curves[part], lots[part] = table, [*map(intern, of_lots)]
            yield from names

    known = of_units(records, read())
    figures = sorted(figures_in(known) & {*FIGURES}, key=FIGURES.index)
    off: dict[str, list[dict[str, float]]] = {name: [{}] * d for name in figures}
    if laws is None:
        found = {name: figure_law(name, figure_of(known, name, d).swapaxes(0, 1), lots) for name in figures}
        off = {name: own for name, (_, own) in found.items()}
        laws = TailLaws(
            curves={name: law for k, name in enumerate(CURVES) if (law := TailLaw.of(curves[:, k])) is not None},
            figures={name: law for name, (law, _) in found.items() if law is not None},
        )
    tests = [(name, axis) for name in (*CURVES, *figures) for axis in range(d)]
    return Tests(tests, curves, known, lots, laws, off)


def _curves(statistics: CurveStatistics, units: Sequence[UnitOfLot]) -> tuple[list[str], list[str], Array]:
    """Return the names of units, their lots, and the statistics of their curves (n, CURVES, d)."""
    names, lots = [soaked.unit for soaked, _ in units], [lot for _, lot in units]
    return names, lots, np.array([statistics.of(soaked, lot) for soaked, lot in units])


def _times(name: str, law: FigureLaw, axis: int, off: dict[str, float]) -> list[tuple[str, float]]:
    """Return lots that are `off` in a figure of an axis, and how many times that of the other lots it is.

    Of a term of M, which has a sign, by how much it is off.
    """
    usual, *shifted = (unscaled(name, law.centre[axis] + by, law.usual[axis]) for by in (0.0, *off.values()))
    return [
        (lot, size - usual if name in TERM_FIGURES else size / usual) for lot, size in zip(off, shifted, strict=True)
    ]


def figure_law(name: str, columns: Array, lots: Texts) -> tuple[FigureLaw | None, list[dict[str, float]]]:
    """Return the law of a figure, and of each axis the lots that are off as a whole.

    Parameters
    ----------
    name : str
    columns : (n, 2, d) array
        Value and sigma.
    lots : (n,) array of str

    Returns
    -------
    law : FigureLaw or None
        None where too few units have the figure.
    off : list of dict of str to float
        Of each axis, by how much the figure is off in such lots, as `scaled` has it.
    """
    d = columns.shape[2]
    u, off, rows = np.full((len(columns), d), np.nan), [], []
    for axis in range(d):
        value, sigma = columns[:, 0, axis], columns[:, 1, axis]
        usual = _usual(name, value, sigma)
        x, own = scaled(name, value, sigma, usual)
        sure = float(np.median(own[np.isfinite(own)])) if np.any(np.isfinite(own)) else 0.0
        own = np.fmax(own, sure)  # none is surer of itself than most because it came out large
        z, centre, width = standardised(x, own)
        total = float(np.hypot(width, sure))
        shifts = {lot: by * total for lot, by in _off(z, lots).items()}
        if shifts:
            z, centre, width = standardised(x - np.array([shifts.get(lot, 0.0) for lot in lots]), own)
        u[:, axis] = z
        off.append(shifts)
        rows.append((usual, sure, centre, width))
    law = TailLaw.of(u, same=1.0)
    if law is None:
        return None, off
    usual_of, sure_of, centre_of, width_of = (tuple(map(float, column)) for column in zip(*rows, strict=True))
    return FigureLaw(usual=usual_of, sure=sure_of, centre=centre_of, width=width_of, law=law), off


def _of_figure(law: FigureLaw | None, name: str, columns: Array, lots: Texts, off: Sequence[dict[str, float]]) -> Array:
    """Return p-values (n, d) of a figure with value and sigma (n, 2, d), of lots that are `off` as a whole."""
    if law is None:
        return _of_noise(columns, MARGIN) if name in OF_NOISE else np.full(columns[:, 0].shape, np.nan)
    u = np.full(columns[:, 0].shape, np.nan)
    for axis, shifts in enumerate(off):
        x, own = scaled(name, columns[:, 0, axis], columns[:, 1, axis], law.usual[axis])
        shift = np.array([shifts.get(lot, 0.0) for lot in lots])
        u[:, axis] = (x - shift - law.centre[axis]) / np.hypot(law.width[axis], np.fmax(own, law.sure[axis]))
    p = _chance(law.law, u, name)
    return np.fmax(p, _of_noise(columns, 1.0)) if name in OF_NOISE else p  # a walk makes a loop, too


def scaled(name: str, values: Array, sigma: Array, usual: float) -> tuple[Array, Array]:
    """Return a figure (n,) in the scale in which it is compared, and its deviations there.

    A density of white noise is known to a few percent and compared by its logarithm. All others are roots of sums of
    few squares, whose power 2/3 is about normal (Wilson and Hilferty 1931) also where little or nothing shows; what
    noise makes is compared with what noise lets expect. A term of M is compared as it is.
    """
    if name in TERM_FIGURES:
        return values / usual, sigma / usual
    known = np.isfinite(values)
    x = np.where(known, values, np.nan)
    if name in OF_NOISE:
        size = np.clip(sigma, usual / REACH, usual * REACH)  # a loop makes its own sigma wide
        return np.cbrt(x / size) ** 2, np.zeros(len(x))
    relative = sigma / np.where(known, np.maximum(x, usual / 2), np.nan)
    if name in LOGARITHMIC:
        return np.log(np.maximum(x / usual, FLOOR)), relative
    return np.cbrt(np.maximum(x, 0.0) / usual) ** 2, 2 / 3 * relative


def unscaled(name: str, x: float, usual: float) -> float:
    """Return the figure of an ordinary unit, of one in the scale of `scaled`."""
    if name in TERM_FIGURES:
        return usual * x
    return usual * (float(np.exp(x)) if name in LOGARITHMIC else max(x, 0.0) ** 1.5)


def _chance(law: TailLaw | None, u: Array, name: str) -> Array:
    return np.full(u.shape, np.nan) if law is None else law.p(u, upper=name not in TWO_SIDED)


def _of_noise(columns: Array, times: float) -> Array:
    """Return p-values (n, d) of what a unit's own noise makes, were it so many times as large."""
    from scipy.special import chdtrc

    with np.errstate(invalid="ignore", divide="ignore"):
        share = columns[:, 0] / (times * columns[:, 1])
    return np.asarray(np.where(np.isfinite(share), chdtrc(SHAPES, SHAPES * np.nan_to_num(share) ** 2), np.nan))


def _usual(name: str, values: Array, sigma: Array) -> float:
    """Return the usual size of a figure (n,); of one that shows in less than half of the units what would just show."""
    of = sigma if name in OF_NOISE else np.abs(values)
    known = np.isfinite(of)
    usual = float(np.median(of[known])) if np.any(known) else 1.0
    if usual > 0:
        return usual
    positive = sigma[np.isfinite(sigma) & (sigma > 0)]
    return float(np.median(positive)) if len(positive) else 1.0


def _off(u: Array, lots: Texts) -> dict[str, float]:
    """Return the shift, in widths, of each lot that is off as a whole."""
    known = np.isfinite(u)
    if not np.any(known):
        return {}
    names, number, count = np.unique(lots[known], return_inverse=True, return_counts=True)
    ordered, first = u[known][np.lexsort((u[known], number))], np.cumsum(count) - count
    middle = (ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2
    off = np.abs(middle) > np.maximum(1.0, LOT_OFF * 1.2533 / np.sqrt(count))
    off &= (count >= MIN_UNITS_OF_LOT) & (count <= len(u) / 2)
    return dict(zip(names[off].tolist(), middle[off].tolist(), strict=True))
