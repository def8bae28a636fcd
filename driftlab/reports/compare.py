"""The report of a comparison: the paper's tables and figures as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.compare import Columns, Comparison, tables
from driftlab.judging.overview import thin
from driftlab.judging.summary import Rows
from driftlab.reports.pages import drawing, write_page
from driftlab.reports.plots import COLOURS, bias_figure, clock, plain_label, svg
from driftlab.units import axis_name, unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fusion_core.chunk import Array
    from fusion_core.contracts import Sensor


def write_comparison(path: Path, found: dict[str, Comparison], recording: str) -> None:
    """Write `report.html` of a comparison."""
    first = next(iter(found.values()))
    sensor, (size, near) = first.sensor, first.initial.texts
    nominal, early = ({n: of(c) for n, c in found.items()} for of in (lambda c: c.nominal.estimates, _early))
    figures = [
        ("What the filters are given (the paper's figures 9 and 10)", input_figure(found)),
        ("Bias, nominal (figures 11 to 13)", bias_figure(nominal, sensor, first.first_row)),
        (f"Bias, {size} at the start (figures 14 to 16)", bias_figure(early, sensor, first.first_row)),
    ]
    write_page(
        path,
        "compare",
        recording=recording,
        names=list(found),
        axes=sensor.axes,
        units=[text for text, _, _ in first.initial.unit.columns],
        size=size,
        near=near,
        tables=[(title, _cells(rows, sensor)) for title, rows in tables(found)],
        remarks=[f"{name}: {line}" for name, c in found.items() for line in c.remarks],
        convergence=[(n, [_text(v, ".1f") for v in c.offset.convergence]) for n, c in found.items()],
        figures=[(title, drawing(svg(figure))) for title, figure in figures],
    )


def input_figure(found: dict[str, Comparison]) -> Figure:
    """Draw what each filter is given, without what is faster than 1 Hz (second-order low-pass, for the eye only)."""
    from matplotlib.figure import Figure

    sensor = next(iter(found.values())).sensor
    d = len(sensor.axes)
    names = [f"rate {axis}" if sensor.integral else axis_name(sensor.channel, axis) for axis in sensor.axes]
    figure = Figure(figsize=(10, 2.0 * d + 0.6), layout="constrained")
    panels: list[Axes] = list(np.ravel(np.asarray(figure.subplots(d, 1, sharex=True), dtype=object)))
    for k, (name, comparison) in enumerate(found.items()):
        estimates = comparison.nominal.estimates
        rate = _slow(estimates) * sensor.factor
        keep = thin(len(rate))
        t, unit = clock(estimates["t"], comparison.first_row)
        label = plain_label(name)
        for axis, panel in enumerate(panels):
            panel.plot(t[keep], rate[keep, axis], color=COLOURS[k % len(COLOURS)], lw=0.7, alpha=0.7, label=label)
            panel.set_ylabel(f"{names[axis]} [{sensor.shown}]")
            panel.grid(alpha=0.25)
        panels[-1].set_xlabel(f"time from the first row [{unit}]")
    panels[0].legend(ncols=3, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    return figure


def _slow(estimates: Columns) -> Array:
    from scipy.signal import butter, sosfiltfilt

    rate = estimates["rate"] - estimates["calibration"]
    sampling = 1 / float(np.median(estimates["tau"]))
    if sampling <= 2.5 or len(rate) < 20:
        return np.asarray(rate)
    return np.asarray(sosfiltfilt(butter(2, 1.0, fs=sampling, output="sos"), rate, axis=0))


def _early(comparison: Comparison) -> Columns:
    """Return the first ten minutes, where the initial error is."""
    estimates = comparison.offset.estimates
    rows = estimates["t"] <= estimates["t"][0] + 600.0
    return {name: values[rows] for name, values in estimates.items()}


def _cells(rows: Rows, sensor: Sensor) -> list[tuple[str, str, list[str]]]:
    cells, parts = [], unit_of(sensor).columns
    for label, columns in rows:
        for k, axis in enumerate(sensor.axes):
            texts = [_text(v[k] * factor, spec) for v in columns for _, factor, spec in parts]
            cells.append((label if k == 0 else "", axis, texts))
    return cells


def _text(value: float, spec: str) -> str:
    return f"{value:{spec}}" if np.isfinite(value) else "–"
