"""Groups of units by a column of their table (stratification), and figures that differ between them.

Units of one lot are alike, and so are units made one after the other where a line drifts. Hence units are compared
within blocks: lots that have units of several groups, or, where most lots are of one group, all of these, a value a
lot. A change of the line ends a block, a trend is taken off, and a run of units of one group counts as one value, their
mean. Of values less the median of their block, ranked over all, the sums S of the groups have, were groups dealt out
anew within each block::

    E S_g = sum_b n_bg m_b,    cov(S_g, S_h) = sum_b s_b^2 (n_bg [g = h] - n_bg n_bh / n_b)

with n_b values of block b, their mean m_b and variance s_b^2; (S - E S)' cov^-1 (S - E S) is chi-square.

Source: J. Hodges and E. Lehmann, Ann. Math. Stat. 33 (1962) 482, ranks of aligned values; N. Mantel, J. Amer. Statist.
Assoc. 58 (1963) 690, the covariance.
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
LEAST = 4  # values of a group that is compared
ALPHA = 0.05  # chance, over all columns, and over their figures, that one is said to differ where none does


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
    """Return the group of each unit by each column of two to CLASSES groups: of `by`, and the manifest's own.

    Lots have charts of their own.
    """
    columns = dict.fromkeys([*by, *(name for record in records for name in record.more)])
    found = {column: groups_of(records, column) for column in columns if column != "lot"}
    return {column: names for column, names in found.items() if 2 <= len({*names} - {NO_VALUE}) <= CLASSES}


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
    known, value = np.flatnonzero(names != NO_VALUE), chart.value
    if len(known) < 2 * LEAST:
        return None
    at, x = chart.at[known], chart.scale.to(value[known])
    if chart.trend is not None:
        x = x - np.polyval(np.polyfit(at, x, 1), at)
    stretch = np.searchsorted([change.at for change in chart.changes], at, side="right")
    groups, codes = np.unique(names[known], return_inverse=True)
    values, of_value, blocks, counted = _values(x, codes, np.unique(lots[known], return_inverse=True)[1], stretch)
    enough = np.bincount(of_value, minlength=len(groups)) >= LEAST
    some = enough[of_value]
    if np.sum(enough) < 2:
        return None
    values, of_value, blocks = aligned(values[some], blocks[some]), of_value[some], blocks[some]
    middle = {int(g): float(np.median(values[of_value == g])) for g in np.flatnonzero(enough)}
    far = max(middle, key=lambda g: abs(middle[g]))
    beside = float(np.median(value[known][counted & enough[codes] & (codes != far)]))
    more = middle[far] - float(np.median(values[of_value != far]))
    its = float(chart.scale.back(chart.scale.to(np.array([beside])) + more)[0])
    p, count = stratified_p(values, of_value, blocks), int(np.sum(counted & (codes == far)))
    return GroupDifference(chart.quantity, chart.axis, column, p, str(groups[far]), count, its, beside)


def _values(x: Array, codes: Integers, lots: Integers, stretch: Integers) -> tuple[Array, Integers, Integers, Flags]:
    """Return the values that are compared, the group and block of each, and which units (m,) they are of."""
    pairs = np.unique(np.stack([lots, codes]), axis=1)[0]
    mixed = np.bincount(pairs, minlength=int(lots.max()) + 1)[lots] > 1
    within = 2 * np.sum(mixed) >= len(x)
    counted = mixed if within else ~mixed
    places, block = np.flatnonzero(counted), (stretch * (int(lots.max()) + 1) + lots if within else stretch)[counted]
    ends = np.stack([codes[places], lots[places], stretch[places]])
    starts = np.flatnonzero(np.concatenate([[True], np.any(np.diff(ends, axis=1) != 0, axis=0)]))
    values = np.add.reduceat(x[places], starts) / np.diff(starts, append=len(places))
    return values, codes[places][starts], np.unique(block[starts], return_inverse=True)[1], counted


def aligned(values: Array, blocks: Integers) -> Array:
    """Return values (n,) less the median of their block."""
    left, order = values.copy(), np.argsort(blocks, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(blocks[order])) + 1):
        left[own] -= np.median(values[own])
    return left


def stratified_p(values: Array, groups: Integers, blocks: Integers) -> float:
    """Return the probability of aligned values (n,) that differ as much, were groups (n,) dealt out within blocks."""
    from scipy.special import chdtrc

    _, place, ties = np.unique(values, return_inverse=True, return_counts=True)
    rank = (np.cumsum(ties) - (ties - 1) / 2)[place]
    codes, block = (np.unique(x, return_inverse=True)[1] for x in (groups, blocks))
    count = np.zeros((int(block.max()) + 1, int(codes.max()) + 1))
    np.add.at(count, (block, codes), 1.0)
    n = count.sum(axis=1)
    mean = np.bincount(block, weights=rank) / n
    variance = np.bincount(block, weights=(rank - mean[block]) ** 2) / np.maximum(n - 1, 1)
    off = np.bincount(codes, weights=rank - mean[block])
    covariance = np.diag(variance @ count) - (count * (variance / n)[:, None]).T @ count
    free = int(np.linalg.matrix_rank(covariance, hermitian=True))
    return float(chdtrc(free, off @ np.linalg.pinv(covariance, hermitian=True) @ off)) if free else 1.0
