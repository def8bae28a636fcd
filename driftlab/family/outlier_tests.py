"""What of each unit of a family is compared with the others, and how seldom a value so far out is.

Of the curves: `driftlab.family.curve_statistics`. The figures of a record in a scale in which they are about
normal, each with its own sigma.
The usual values of each follow a law that a file holds (`TailLaws`), so that a single new unit can be judged by a
known family. n units, d axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.family.curve_statistics import CurveStatistics
from driftlab.family.mixed_model import Family, FamilyUnits
from driftlab.family.record import UnitRecord
from driftlab.family.tail_law import FigureLaw, TailLaw, TailLaws, standardised
from fusion_core.chunk import Array

CURVES = ("level", "scale", "bump", "curve")  # statistics of the curve of an axis
FIGURES = ("residual", "noise", "walk", "coast", "hysteresis", "soaks")  # not the swing: it is the curve's
TWO_SIDED = ("level", "scale", "noise")  # a sensor may be too quiet; of other figures less is only better
OF_NOISE = ("hysteresis", "soaks")  # what noise alone lets expect is known, where other units do not say what is usual
SHAPES, MARGIN = 3, 2.0  # degrees of freedom of these, and by how much noise may be larger than it is said to be
LOT_FEWEST, LOT_OFF = 5, 4.0  # units of a lot that may be off as a whole, and by how many deviations
LOGARITHMIC, FLOOR = ("noise",), 0.1  # of the median: a figure may be estimated as 0
REACH = 2.0  # times the usual: what the noise of a unit may be


@dataclass(frozen=True, eq=False)
class Tests:
    """What was tested of units `names`.

    Attributes
    ----------
    what : list of (str, int)
        One of CURVES or FIGURES, and the axis, of each of the m tests.
    p, values : (n, m) arrays
        NaN where there is no test; values in SI, of the statistics of curves in deviations.
    laws : Laws
        What is usual.
    """

    names: list[str]
    what: list[tuple[str, int]]
    p: Array
    values: Array
    laws: TailLaws


def tests_of(
    family: Family,
    statistics: CurveStatistics,
    units: FamilyUnits,
    records: Iterable[UnitRecord],
    laws: TailLaws | None,
) -> Tests:
    """Return the tests of all units; of one without a record its curves alone. `laws` are a known family's."""
    of = {record.unit: record for record in records if record.state == "done"}
    d = len(family.axes)
    names, lots, rows, curves = [], [], [], []
    for soaked, lot in units:
        names.append(soaked.unit)
        lots.append(lot)
        curves.append(statistics.of(soaked, lot))
        rows.append(row_of(of.get(soaked.unit), d))
    table = np.array(rows).reshape(len(rows), len(FIGURES), 2, d)
    what, p, values = [], [], []
    known, figures = {}, {}
    for name in CURVES:
        own = np.array([curve[name] for curve in curves]).reshape(-1, d)
        law = TailLaw.of(own) if laws is None else laws.curves.get(name)
        if law is not None:
            known[name] = law
        p.append(_chance(law, own, name))
        values.append(own)
    for k, name in enumerate(FIGURES):
        usual = figure_law(name, table[:, k], lots)[0] if laws is None else laws.figures.get(name)
        if usual is not None:
            figures[name] = usual
        p.append(_of_figure(usual, name, table[:, k], lots, shifted=laws is None))
        values.append(table[:, k, 0])
    what = [(name, axis) for name in (*CURVES, *FIGURES) for axis in range(d)]
    return Tests(
        names, what, np.concatenate(p, axis=1), np.concatenate(values, axis=1), TailLaws(curves=known, figures=figures)
    )


def row_of(record: UnitRecord | None, d: int) -> Array:
    """Return value and sigma (figures, 2, d) of a unit."""
    found = np.full((len(FIGURES), 2, d), np.nan)
    for k, name in enumerate(FIGURES):
        if record is not None and name in record.figures and len(record.figures[name].value) == d:
            found[k] = np.array([record.figures[name].value, record.figures[name].sigma], dtype=float)
    return found


def figure_law(name: str, columns: Array, lots: Sequence[str]) -> tuple[FigureLaw | None, list[dict[str, float]]]:
    """Return what is usual of a figure, and of each axis the lots that are off as a whole.

    Parameters
    ----------
    name : str
    columns : (n, 2, d) array
        Value and sigma.
    lots : sequence of str
        Of the n units.

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
    law = TailLaw.of(u)
    if law is None:
        return None, off
    columns_of = (tuple(map(float, column)) for column in zip(*rows, strict=True))
    return FigureLaw(**dict(zip(("usual", "sure", "centre", "width"), columns_of, strict=True)), law=law), off


def _of_figure(law: FigureLaw | None, name: str, columns: Array, lots: Sequence[str], *, shifted: bool) -> Array:
    """Return p-values (n, d) of a figure with value and sigma (n, 2, d)."""
    if law is None:
        return _of_noise(columns, MARGIN) if name in OF_NOISE else np.full(columns[:, 0].shape, np.nan)
    u = np.full(columns[:, 0].shape, np.nan)
    off = figure_law(name, columns, lots)[1] if shifted else [{}] * columns.shape[2]
    for axis, shifts in enumerate(off):
        x, own = scaled(name, columns[:, 0, axis], columns[:, 1, axis], law.usual[axis])
        shift = np.array([shifts.get(lot, 0.0) for lot in lots])
        u[:, axis] = (x - shift - law.centre[axis]) / np.hypot(law.width[axis], np.fmax(own, law.sure[axis]))
    found = _chance(law.law, u, name)
    return np.fmax(found, _of_noise(columns, 1.0)) if name in OF_NOISE else found  # a walk makes a loop, too


def scaled(name: str, values: Array, sigma: Array, usual: float) -> tuple[Array, Array]:
    """Return a figure (n,) in the scale in which it is compared, and its deviations there.

    A density of white noise is known to a few percent and compared by its logarithm. All others are roots of sums of
    few squares, whose power 2/3 is about normal (Wilson and Hilferty 1931) also where little or nothing shows; what
    noise makes is compared with what noise lets expect.
    """
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
    """Return what `scaled` was given, of an ordinary unit."""
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
    of = sigma if name in OF_NOISE else values
    known = np.isfinite(of)
    usual = float(np.median(of[known])) if np.any(known) else 1.0
    if usual > 0:
        return usual
    positive = sigma[np.isfinite(sigma) & (sigma > 0)]
    return float(np.median(positive)) if len(positive) else 1.0


def _off(u: Array, lots: Sequence[str]) -> dict[str, float]:
    """Return by how many widths the lots are off that are off as a whole."""
    found = {}
    for lot in sorted(set(lots)):
        own = u[np.array([other == lot for other in lots]) & np.isfinite(u)]
        if LOT_FEWEST <= len(own) <= len(u) / 2:
            middle = float(np.median(own))
            if abs(middle) > max(1.0, LOT_OFF * 1.2533 / np.sqrt(len(own))):
                found[lot] = middle
    return found
