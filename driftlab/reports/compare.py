"""The report of a comparison: who coasts best, a figure and a table to decide from, and the paper's tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.compare import Comparison, paper
from driftlab.judging.ranking import TO_THE_END, duration, ranking
from driftlab.judging.sentences import notes, verdict
from driftlab.judging.summary import Rows, error_rows
from driftlab.judging.yardsticks import LONGEST_FIRST, over_axes
from driftlab.reports.charts import LOOKS, Look, series
from driftlab.reports.compare_charts import bias_chart, early_chart, error_chart, input_chart
from driftlab.reports.pages import write_page

if TYPE_CHECKING:
    from collections.abc import Sequence

    from driftlab.reports.sheet import Sheet
    from driftlab.units import BiasUnit
    from fusion_core.contracts import Sensor

Cells = list[tuple[str, str, list[str], bool]]  # of a table: label, axis, a text a config, whether it belongs above


@dataclass(frozen=True)
class Bar:
    """What a config is off by over a horizon, and its sigma: as texts, and in per cent of the widest of the horizon."""

    name: str
    error: str
    sigma: str
    long: float
    tick: float
    look: Look


def write_comparison(path: Path, found: dict[str, Comparison], recording: str, sheets: dict[str, Sheet]) -> None:
    """Write `report.html` of a comparison; `sheets` are those of its configs."""
    first = next(iter(found.values()))
    sensor, (size, near) = first.sensor, first.initial.texts
    si, factor, spec = first.initial.unit.columns[-1]
    runs = {name: c.yardsticks for name, c in found.items()}
    best = ranking(runs)
    write_page(
        path,
        "compare",
        recording=recording,
        sheets=sheets,
        names=list(found),
        verdict=verdict(found),
        best=best.best if best is not None and len(found) > 1 else (),
        remarks=notes(found),
        unit=sensor.shown,
        errors=_errors(found, sensor),
        headings=_headings(found) if sensor.integral else [],
        spans={TO_THE_END: duration(min(c.span for c in found.values()))},
        bars=_bars(found, first.initial.unit),
        charts=[bias_chart(found), error_chart(found)],
        axes=sensor.axes,
        size=size,
        near=near,
        si=si,
        tables=[(title, _cells(rows, sensor.axes, factor, spec)) for title, rows in paper(found)],
        convergence=[(n, [_text(v, ".1f") for v in c.offset.convergence]) for n, c in found.items()],
        figures=[input_chart(found), early_chart(found)],
    )


def _bars(found: dict[str, Comparison], unit: BiasUnit) -> list[tuple[str, list[Bar]]]:
    """Return the horizons that are known of any config, each with a bar for every config of which it is."""
    groups = []
    for horizon in LONGEST_FIRST:
        known = []
        for k, (name, c) in enumerate(found.items()):
            error, sigma = over_axes(c.yardsticks.coast[horizon]), over_axes(c.yardsticks.coast_sigma[horizon])
            if np.isfinite(error):
                known.append((name, error, sigma, LOOKS[series(k)]))
        widest = max((max(error, sigma) for _, error, sigma, _ in known), default=0.0) or 1.0
        bars = [
            Bar(
                name,
                _text(error * unit.factor, unit.digits),
                _text(sigma * unit.factor, unit.digits),
                100 * error / widest,
                100 * sigma / widest,
                look,
            )
            for name, error, sigma, look in known
        ]
        groups += [(horizon, bars)] if bars else []
    return groups


def _errors(found: dict[str, Comparison], sensor: Sensor) -> Cells:
    """Return the table to decide from, as sensors are shown; of several axes the coasts' rms over them comes first."""
    unit = next(iter(found.values())).initial.unit
    rows = error_rows([c.yardsticks for c in found.values()])
    cells = _cells(rows, sensor.axes, unit.factor, unit.digits)
    if len(sensor.axes) == 1:
        return cells
    coasts = [(label, [np.array([over_axes(v)]) for v in columns]) for label, columns in rows[: 2 * len(LONGEST_FIRST)]]
    return [*_cells(coasts, ("rms",), unit.factor, unit.digits), *cells]


def _headings(found: dict[str, Comparison]) -> list[tuple[str, list[str]]]:
    return [
        (name, [_text(float(np.rad2deg(c.yardsticks.heading[name])), ".2f") for c in found.values()])
        for name in LONGEST_FIRST
    ]


def _cells(rows: Rows, axes: Sequence[str], factor: float, spec: str) -> Cells:
    return [
        (label.strip() if k == 0 else "", axis, [_text(v[k] * factor, spec) for v in columns], label.startswith(" "))
        for label, columns in rows
        for k, axis in enumerate(axes)
    ]


def _text(value: float, spec: str) -> str:
    return f"{value:{spec}}" if np.isfinite(value) else "–"
