"""What is a lot's and what is the line's: nothing is told twice.

A lot that is off the others shows as two changes of the line, one where it begins and one back where it ends: these
are the lot's. A lot that is like the units before or after it, as far as the line has not changed, is not off by
itself: the change is the line's. The curve of a unit is watched by its level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from driftlab.family.outliers import SHAPE, LotOutlier
from driftlab.spc.charts import LEVEL, ControlChart, LineReport
from driftlab.spc.sentences import sentences


def reconcile(lots: Sequence[LotOutlier], line: LineReport) -> tuple[tuple[LotOutlier, ...], LineReport]:
    """Return the lots that are off by themselves, and the line with what it says beside them."""
    kept, controls = [], {(chart.quantity, chart.axis): chart for chart in line.controls}
    for lot in lots:
        key = (LEVEL if lot.what == SHAPE else lot.what, lot.axis)
        if key not in controls:
            kept.append(lot)
            continue
        controls[key], own = _apart(lot, controls[key], line)
        kept += [lot] if own else []
    line = replace(line, controls=tuple(controls.values()))
    return tuple(kept), replace(line, sentences=tuple(sentences(line)))


def _apart(lot: LotOutlier, chart: ControlChart, line: LineReport) -> tuple[ControlChart, bool]:
    """Return the chart with the changes that are the lot's, and whether the lot is off by itself."""
    lots = np.array(line.lots)
    places = np.flatnonzero(lots == lot.lot)
    start, stop = int(places[0]), int(places[-1]) + 1
    if stop - start > len(places):  # mixed with others: no stretch of the line
        return chart, True
    begins = [change for change in chart.changes if change.low <= start <= change.high]
    ends = [change for change in chart.changes if change.low <= stop <= change.high]
    if begins and ends and (begins[0].after > begins[0].before) != (ends[0].after > ends[0].before):
        own = (begins[0], ends[0])
        marked = (replace(change, of_lot=lot.lot) if change in own else change for change in chart.changes)
        return replace(chart, changes=tuple(marked)), True
    return chart, not _as_neighbours(chart, lots == lot.lot, start, stop)


def _as_neighbours(chart: ControlChart, own: NDArray[np.bool_], start: int, stop: int) -> bool:
    """Whether a change of the line says what a lot is off by: it came where the lot began, or before, and stayed."""
    if not chart.changes:
        return False
    edges = np.array([0, *(change.at for change in chart.changes), len(own)])
    middle = (start + stop) // 2
    k = int(np.searchsorted(edges, middle, "right")) - 1
    inside = (chart.at >= edges[k]) & (chart.at < edges[k + 1])
    x, of_lot = chart.scale.to(chart.value), own[chart.at]
    rest, outside = inside & ~of_lot, ~inside & ~of_lot
    if not np.any(of_lot) or not np.any(outside):
        return False
    if not np.any(rest):
        return True
    off = abs(np.median(x[of_lot]) - np.median(x[rest]))
    return bool(off < abs(np.median(x[of_lot]) - np.median(x[outside])) / 2)
