"""What of each unit of a family is compared with the others, and how seldom a value so far out is.

Figures are compared by their logarithms, each with its own sigma; the distance of a curve as a Gaussian deviation. n
units, d axes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from driftlab.family.law import Family, Units
from driftlab.family.null import CHANCE, FEWEST, HEAVY, Null, standardised
from driftlab.family.record import UnitRecord
from driftlab.family.shapes import Shapes, distances
from fusion_core.chunk import Array

SHAPE = "shape"
FIGURES = ("residual", "noise", "walk", "coast")  # not the swing: it is the curve's, of which the shape is all
BOTH_SIDES = ("noise",)  # a sensor may be too quiet; of all else less is only better
LOT_FEWEST, LOT_OFF = 5, 4.0  # units of a lot that may be off as a whole, and by how many deviations
FLOOR = 0.1  # of the median: a figure may be estimated as 0


@dataclass(frozen=True, eq=False)
class Tests:
    """What was tested.

    Attributes
    ----------
    names : list of str
        Units.
    what : list of (str, int)
        SHAPE or a figure, and the axis, of each test.
    p, values : (n, tests) arrays
        NaN where there is no test.
    middle : list of (float, float)
        Median and width of the logarithms of each test's figure.
    """

    names: list[str]
    what: list[tuple[str, int]]
    p: Array
    values: Array
    middle: list[tuple[float, float]]


def tests_of(family: Family, units: Units, records: Iterable[UnitRecord], *, fitted: bool) -> Tests:
    """Return the tests of all units; of one without a record the shape alone."""
    of = {record.unit: record for record in records if record.state == "done"}
    shapes, d = Shapes(family, fitted=fitted), len(family.axes)
    names, lots, rows, curves = [], [], [], []
    for soaked, lot in units:
        names.append(soaked.unit)
        lots.append(lot)
        curves.append(shapes.deviations(soaked, lot))
        rows.append(row_of(of.get(soaked.unit), d))
    table = np.array(rows).reshape(len(rows), 1 + len(FIGURES), 2, d)
    table[:, 0, 0], table[:, 0, 1] = distances(np.array(curves)), 0.0
    what, p, middle = [], [], []
    for k, name in enumerate((SHAPE, *FIGURES)):
        u, own, _ = standardised_figure(name, table[:, k], lots)
        what += [(name, axis) for axis in range(d)]
        p.append(_p(name, u))
        middle += own
    values = np.transpose(table[:, :, 0], (0, 1, 2)).reshape(len(rows), -1)
    return Tests(names, what, np.concatenate(p, axis=1), values, middle)


def row_of(record: UnitRecord | None, d: int) -> Array:
    """Return value and sigma (1 + figures, 2, d) of a unit; those of its shape are not known yet."""
    found = np.full((1 + len(FIGURES), 2, d), np.nan)
    for k, name in enumerate(FIGURES, 1):
        if record is not None and name in record.figures and len(record.figures[name].value) == d:
            found[k] = np.array([record.figures[name].value, record.figures[name].sigma], dtype=float)
    return found


def standardised_figure(
    name: str, columns: Array, lots: list[str]
) -> tuple[Array, list[tuple[float, float]], list[dict[str, float]]]:
    """Return deviations of a figure, how it is distributed, and the lots that are off as a whole.

    Parameters
    ----------
    name : str
    columns : (n, 2, d) array
        Value and sigma.
    lots : list of str
        Of the n units.

    Returns
    -------
    u : (n, d) array
        Deviations from the median of all, or of a lot that is off as a whole.
    middle : list of (float, float)
        Of each axis median and width, of figures those of their logarithms.
    off : list of dict of str to float
        Of each axis, by how much the (logarithm of the) figure is off in such lots.
    """
    u, middle, off = np.full((len(columns), columns.shape[2]), np.nan), [], []
    for axis in range(columns.shape[2]):
        x, sigma = columns[:, 0, axis], columns[:, 1, axis]
        if name != SHAPE:
            x, sigma = _logarithms(x, sigma)
        own, centre, width = standardised(x, sigma)
        total = float(np.hypot(width, np.median(sigma[np.isfinite(sigma)]))) if np.any(np.isfinite(sigma)) else width
        shifts = {} if name == SHAPE else {lot: by * total for lot, by in _off(own, lots).items()}
        if shifts:
            own, centre, width = standardised(x - np.array([shifts.get(lot, 0.0) for lot in lots]), sigma)
        u[:, axis] = own
        middle.append((centre, total))
        off.append(shifts)
    return u, middle, off


def _logarithms(x: Array, sigma: Array) -> tuple[Array, Array]:
    """Return logarithms (n,) of a figure and their deviations; what is estimated as 0 is taken as FLOOR of the usual.

    A walk that shows in less than half of the units is added to what would just show, else it has no usual size.
    """
    known = np.isfinite(x)
    if not np.any(known):
        return np.full(len(x), np.nan), sigma
    usual = float(np.median(x[known]))
    if usual <= 0:
        positive = sigma[known & (sigma > 0)]
        usual = float(np.median(positive)) if len(positive) else 1.0
        x = x + usual
    found = np.log(np.where(known, np.maximum(x, FLOOR * usual), np.nan))
    relative = sigma / np.where(known, np.maximum(x, usual / 2), np.nan)
    sure = np.isfinite(relative)  # none is surer of itself than most because it came out large
    return found, np.maximum(relative, np.median(relative[sure]) if np.any(sure) else 0.0)


def _off(u: Array, lots: list[str]) -> dict[str, float]:
    """Return by how many widths the lots are off that are off as a whole."""
    found = {}
    for lot in sorted(set(lots)):
        own = u[np.array([other == lot for other in lots]) & np.isfinite(u)]
        if LOT_FEWEST <= len(own) <= len(u) / 2:
            middle = float(np.median(own))
            if abs(middle) > max(1.0, LOT_OFF * 1.2533 / np.sqrt(len(own))):
                found[lot] = middle
    return found


def _p(name: str, u: Array) -> Array:
    """Return p-values (n, d) of deviations (n, d), the axes taken together."""
    known = np.isfinite(u)
    p = np.full(u.shape, np.nan)
    if np.sum(known) >= FEWEST:
        p[known] = Null.of(u[known], int(np.max(np.sum(known, axis=0))), HEAVY if name == SHAPE else CHANCE).p(
            u[known], upper=name not in BOTH_SIDES
        )
    return p
