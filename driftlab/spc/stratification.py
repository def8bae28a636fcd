"""Groups of units by a column of their table (stratification), and figures that differ between them.

Units of one lot are alike, and so are units made one after the other where a line drifts. Hence a run of units of one
group and lot counts as one value, their mean; where a lot has units of several groups, less the lot's median. Whether
such values differ between the groups by more than chance is Kruskal and Wallis' test; of few values the probability is
no smaller than that of one arrangement of them.

Source: W. Kruskal and A. Wallis, J. Amer. Statist. Assoc. 47 (1952) 583. Blocks: Montgomery, Design and Analysis of
Experiments, 8th ed., chapter 4.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.family.record import UnitRecord
from driftlab.spc.charts import ControlChart, GroupDifference, LineReport
from fusion_core.chunk import Array, Flags, Integers

COLUMNS: dict[str, Callable[[UnitRecord], str]] = {
    "lot": lambda record: record.lot,
    "date": lambda record: record.date[:10],
    "channel": lambda record: record.channel,
    "driftlab": lambda record: record.driftlab,
    "T_low": lambda record: f"{record.domain[0]:g}" if record.domain else "",
    "T_high": lambda record: f"{record.domain[1]:g}" if record.domain else "",
    "hours": lambda record: f"{record.hours:g}" if record.hours else "",
}
"""Columns of the units' table beside those of the manifest itself."""
NO_VALUE = "not known"
CLASSES = 12  # numbers of a column that are groups by themselves; of more there are four classes
LEAST = 3  # values of a group that is compared
ALPHA = 0.05  # chance, over all columns and figures, that one is said to differ where none does


def groups_of(records: Iterable[UnitRecord], column: str) -> list[str]:
    """Return the group of each unit: its text in the column, or a quarter of many numbers."""
    own = COLUMNS.get(column)
    texts = [(record.more.get(column, "") if own is None else own(record)).strip() for record in records]
    numbers = np.array([_number(text) for text in texts])
    known = np.isfinite(numbers)
    if len(set(texts)) <= CLASSES or not np.all(known | np.array([not text for text in texts])):
        return [text or NO_VALUE for text in texts]
    return _quarters(numbers, known)


def _quarters(numbers: Array, known: Any) -> list[str]:
    edges = np.quantile(numbers[known], [0.25, 0.5, 0.75])
    quarter = np.searchsorted(edges, numbers, side="left")
    spans = {
        k: f"{np.min(numbers[known & (quarter == k)]):.4g} to {np.max(numbers[known & (quarter == k)]):.4g}"
        for k in set(quarter[known].tolist())
    }
    return [spans[k] if one else NO_VALUE for k, one in zip(quarter.tolist(), known.tolist(), strict=True)]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def strata_of(records: Sequence[UnitRecord], by: Iterable[str]) -> dict[str, list[str]]:
    """Return the group of each unit by each column that has some groups and not many: `by`, and the manifest's own."""
    columns = dict.fromkeys([*by, *(name for record in records for name in record.more)])
    found = {column: groups_of(records, column) for column in columns if column != "lot"}  # which has charts
    return {column: names for column, names in found.items() if 2 <= len(set(names)) <= CLASSES}


def differences(line: LineReport, strata: Mapping[str, Sequence[str]]) -> tuple[GroupDifference, ...]:
    """Return the figures of a line that differ between groups; of each column the group of each unit, in its order."""
    tried = [
        _compared(chart, column, np.array(names)[chart.at], np.array(line.lots)[chart.at])
        for column, names in strata.items() for chart in line.controls
    ]  # fmt: skip
    compared = [one for one in tried if one is not None]
    return tuple(one for one in compared if one.p < ALPHA / len(compared))


def _compared(
    chart: ControlChart, column: str, names: NDArray[np.str_], lots: NDArray[np.str_]
) -> GroupDifference | None:
    """Return the difference of a chart's quantity between groups (m,) of units; None where too few can be compared."""
    value = chart.value
    codes = np.unique(names, return_inverse=True)[1]
    values, groups = _values(chart.scale.to(value), codes, np.unique(lots, return_inverse=True)[1])
    count = np.bincount(groups)
    enough = count[groups] >= LEAST
    compared = np.unique(groups[enough])
    if len(compared) < 2:
        return None
    p = kruskal_wallis(values[enough], groups[enough])
    middle = {g: float(np.median(values[groups == g])) for g in compared}
    centre = float(np.median(values[enough]))
    far = max(compared, key=lambda g: abs(middle[g] - centre))
    own: Flags = codes == far
    its, others = (float(np.median(value[where])) for where in (own, ~own))
    name = str(names[np.argmax(own)])
    return GroupDifference(chart.quantity, chart.axis, column, p, name, int(np.sum(own)), its, others)


def _values(x: Array, codes: Integers, lots: Integers) -> tuple[Array, Integers]:
    """Return the values that are compared, and the group of each: means of runs, less what a mixed lot has as usual."""
    x = x.copy()
    order = np.argsort(lots, kind="stable")
    for lot in np.split(order, np.flatnonzero(np.diff(lots[order])) + 1):
        if len(set(codes[lot].tolist())) > 1:
            x[lot] -= np.median(x[lot])
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(codes) != 0) | (np.diff(lots) != 0)]))
    return np.add.reduceat(x, starts) / np.diff(starts, append=len(x)), codes[starts]


def kruskal_wallis(values: Array, groups: Integers) -> float:
    """Return the probability that groups (n,) of values (n,) from one distribution differ as much in their ranks."""
    from scipy.special import chdtrc, gammaln

    _, place, ties = np.unique(values, return_inverse=True, return_counts=True)
    rank = (np.cumsum(ties) - (ties - 1) / 2)[place] - (len(values) + 1) / 2  # less the mean of all
    codes = np.unique(groups, return_inverse=True)[1]
    count = np.bincount(codes)
    spread = float(rank @ rank)
    if spread == 0:
        return 1.0
    statistic = (len(values) - 1) * float(np.sum(np.bincount(codes, weights=rank) ** 2 / count)) / spread
    arrangements = float(gammaln(len(values) + 1) - np.sum(gammaln(count + 1)))
    return max(float(chdtrc(len(count) - 1, statistic)), float(np.exp(-arrangements)))
