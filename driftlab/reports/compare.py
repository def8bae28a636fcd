"""The report of a comparison: who predicts best, charts and tables to decide from, and the paper's tables.

A config has one colour in all of them and one entry in the legend, so that one click hides it. d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.evaluation.comparison import TO_THE_END, Columns, Comparison, notes, paper, ranking, verdict
from driftlab.evaluation.overview import map_of, thin
from driftlab.evaluation.scores import LONGEST_FIRST, Scores, over_axes
from driftlab.evaluation.summary import Rows, error_pairs, in_sample
from driftlab.reports import charts
from driftlab.reports.charts import LOOKS, Chart, Clock, Line, Panel, Shade, series
from driftlab.reports.pages import write_page
from driftlab.reports.provenance import Sheet
from driftlab.units import BiasUnit, axis_name, duration, formatted
from fusion_core.chunk import Array
from fusion_core.contracts import Sensor

Runs = dict[str, Comparison]
Cells = list[tuple[str, str, list[str]]]  # of a table: label, axis, a text a config


def write_comparison(path: Path, runs: Runs, recording: str, sheets: dict[str, Sheet]) -> None:
    """Write `report.html` of a comparison; `sheets` are those of its configs."""
    first = next(iter(runs.values()))
    sensor, unit, (size, near) = first.sensor, first.initial.unit, first.initial.texts
    si, factor, spec = unit.columns[-1]
    scores = {name: run.yardsticks for name, run in runs.items()}
    ranked = ranking(scores)
    heading = {name: [np.rad2deg(y.heading[name]) for y in scores.values()] for name in LONGEST_FIRST}
    write_page(
        path,
        "compare",
        recording=recording,
        sheets=sheets,
        names=list(runs),
        verdict=verdict(runs),
        best=ranked.best if ranked is not None and len(runs) > 1 else (),
        in_sample=[name for name, run in runs.items() if in_sample(map_of(run.config), [run.config.recording])],
        remarks=notes(runs),
        unit=sensor.shown,
        errors=_folded(scores, sensor.axes, unit),
        headings=[(name, _texts(row, ".2f")) for name, row in heading.items()] if sensor.integral else [],
        spans={TO_THE_END: duration(min(run.span for run in runs.values()))},
        bars=[(name, bars) for name in LONGEST_FIRST if (bars := _bars(runs, name, unit))],
        charts=[bias_chart(runs), error_chart(runs)],
        axes=sensor.axes,
        size=size,
        near=near,
        si=si,
        tables=[(title, _cells(rows, sensor.axes, factor, spec)) for title, rows in paper(runs)],
        convergence=[(name, _texts(run.offset.convergence, ".1f")) for name, run in runs.items()],
        figures=[input_chart(runs), early_chart(runs)],
    )


def _bars(runs: Runs, horizon: str, unit: BiasUnit) -> list[dict[str, Any]]:
    """Return, of every config of which a horizon is known, its error and its sigma.

    As texts, and as the lengths of a bar and of its tick in per cent of the widest of the horizon.
    """
    sizes = {
        name: (over_axes(run.yardsticks.coast[horizon]), over_axes(run.yardsticks.coast_sigma[horizon]))
        for name, run in runs.items()
    }
    known = {name: pair for name, pair in sizes.items() if np.isfinite(pair[0])}
    widest = max((max(pair) for pair in known.values()), default=0.0) or 1.0
    looks = {name: LOOKS[series(k)] for k, name in enumerate(runs)}
    return [
        {
            "name": name, "error": unit.number(error, "–"), "sigma": unit.number(sigma, "–"),
            "long": 100 * error / widest, "tick": 100 * sigma / widest, "look": looks[name],
        }
        for name, (error, sigma) in known.items()
    ]  # fmt: skip


def _cells(rows: Rows, axes: Sequence[str], factor: float, spec: str) -> Cells:
    return [
        (label if k == 0 else "", axis, _texts([v[k] * factor for v in columns], spec))
        for label, columns in rows
        for k, axis in enumerate(axes)
    ]


def _folded(scores: dict[str, Scores], axes: Sequence[str], unit: BiasUnit) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return a row an error: its label, and of each config the error of every axis and its sigma, as texts."""

    def text(values: Array | None) -> str:
        if values is None:
            return ""
        texts = [unit.number(value, "–") for value in values]
        if len(set(texts)) == 1:
            return texts[0] if len(axes) == 1 else f"{texts[0]} each"
        return ", ".join(f"{axis}\u00a0{value}" for axis, value in zip(axes, texts, strict=True))

    rows = error_pairs(list(scores.values()))
    return [(label, [(text(error), text(sigma)) for error, sigma in columns]) for label, columns in rows]


def _texts(values: Sequence[float] | Array, spec: str) -> list[str]:
    return [formatted(value, spec) for value in values]


EARLY = 600.0  # s after the first update, in which an initial error is shown


def bias_chart(runs: Runs) -> Chart:
    """Return reference, and every config's estimate and prediction, of each axis over time, and temperature."""
    sensor, clock = _sensor(runs), _clock(runs)
    reference = next(iter(runs.values())).overview.curves

    def lines(k: int) -> Iterator[Line]:
        measured = reference["reference"][:, k] * sensor.factor
        yield Line(clock(reference["t"]), measured, "30 s average, reference", "reference")
        for name, run, role in _with_roles(runs):
            curves = run.overview.curves
            t, begun = clock(curves["t"]), np.isfinite(curves["coast"][:, 0])
            bias, coast = (curves[column][:, k] * sensor.factor for column in ("bias", "coast"))
            yield Line(t, np.where(begun, bias, np.nan), name, role)
            yield Line(t, coast, name, role, style="dashed")

    caption = (
        "Broad and grey: the reference, the centred 30 s average of what was measured. Solid: estimates, which follow "
        "it while they are updated. Dashed: predictions without updates, from the end of the alignment on."
    )
    return _over_time(runs, lines, "bias", f"Bias of the {sensor.channel}", caption)


def error_chart(runs: Runs) -> Chart:
    """Return every config's prediction less the reference, with two deviations, of each axis over time."""
    sensor, clock = _sensor(runs), _clock(runs)

    def lines(k: int) -> Iterator[Line]:
        for name, run, role in _with_roles(runs):
            curves = run.overview.curves
            spread = 2 * curves["coast_sigma"][:, k] * sensor.factor
            error = (curves["coast"] - curves["reference"])[:, k] * sensor.factor
            yield Line(clock(curves["t"]), error, name, role, -spread, spread, "dashed")

    caption = (
        "Prediction less reference. The band is two of its standard deviations about zero: 95 % of the time an honest "
        "prediction is inside."
    )
    return _over_time(runs, lines, "prediction error", "Error of the predictions", caption)


def _over_time(runs: Runs, lines: Callable[[int], Iterator[Line]], quantity: str, title: str, caption: str) -> Chart:
    """Return lines of each axis over time, with what moved or was refused, and the temperature below."""
    sensor, clock = _sensor(runs), _clock(runs)
    shades = _shades(runs, clock)
    panels = charts.axis_panels(sensor.axes, lines, quantity, sensor.shown, legibly=True, shades=shades)
    return Chart((*panels, *_temperature(runs, clock, shades)), clock.label, title, caption)


def early_chart(runs: Runs) -> Chart:
    """Return the estimates after an initial error, in the first minutes (the paper's figures 14 to 16)."""
    sensor, clock = _sensor(runs), _clock(runs)
    size, _ = next(iter(runs.values())).initial.texts

    def lines(k: int) -> Iterator[Line]:
        for name, run, role in _with_roles(runs):
            estimates = run.offset.estimates
            rows = np.flatnonzero(estimates["t"] <= estimates["t"][0] + EARLY)
            rows = rows[thin(len(rows))]
            begun = np.isfinite(estimates["coast"][rows, 0])
            bias = np.where(begun, estimates["bias"][rows, k], np.nan) * sensor.factor
            yield Line(clock(estimates["t"][rows]), bias, name, role)

    panels = charts.axis_panels(sensor.axes, lines, "bias", sensor.shown)
    return Chart(panels, clock.label, f"Estimates, {size} added at the start (figures 14 to 16)")


def input_chart(runs: Runs) -> Chart:
    """Return the input of each filter, without what is faster than 1 Hz (the paper's figures 9 and 10)."""
    sensor, clock = _sensor(runs), _clock(runs)
    slow = [(name, role, *_slow(run.nominal.estimates)) for name, run, role in _with_roles(runs)]
    panels = []
    for k, axis in enumerate(sensor.axes):
        lines = tuple(Line(clock(t), rate[:, k] * sensor.factor, name, role) for name, role, t, rate in slow)
        label = f"rate {axis}" if sensor.integral else axis_name(sensor.channel, axis)
        panels.append(Panel(lines, f"{label} [{sensor.shown}]"))
    return Chart(tuple(panels), clock.label, "Input of the filters (figures 9 and 10)")


def _slow(estimates: Columns) -> tuple[Array, Array]:
    """Return times and what the filter is given at them, through a second-order low-pass: for the eye only."""
    from scipy.signal import butter, sosfiltfilt

    rate = estimates["rate"] - estimates["calibration"]
    sampling = 1 / float(np.median(estimates["tau"]))
    if sampling > 2.5 and len(rate) >= 20:
        rate = sosfiltfilt(butter(2, 1.0, fs=sampling, output="sos"), rate, axis=0)
    rows = thin(len(rate))
    return estimates["t"][rows], np.asarray(rate[rows])


def _sensor(runs: Runs) -> Sensor:
    return next(iter(runs.values())).sensor


def _with_roles(runs: Runs) -> Iterator[tuple[str, Comparison, str]]:
    """Yield name, comparison and role of every config."""
    for k, (name, comparison) in enumerate(runs.items()):
        yield name, comparison, series(k)


def _clock(runs: Runs) -> Clock:
    overviews = [run.overview for run in runs.values()]
    return Clock(overviews[0].first_row, max(overview.end for overview in overviews))


def _shades(runs: Runs, clock: Clock) -> tuple[Shade, ...]:
    """Return the spans in which the unit moved, or a config's filter refused one that stood still.

    Motion is detected by the sensors alone: it is shown once where all configs have the same.
    """
    shades: list[Shade] = []
    alike = len({tuple(run.journal.moving.spans) for run in runs.values()}) == 1
    for k, (name, run, role) in enumerate(_with_roles(runs)):
        shades += charts.span_shades(run.journal.refused.spans, clock, f"{name}: refused", role)
        if k == 0 or not alike:
            text = "moved" if alike else f"{name}: moved"
            shades += charts.span_shades(run.journal.moving.spans, clock, text, "moving")
    return tuple(shades)


def _temperature(runs: Runs, clock: Clock, shades: tuple[Shade, ...]) -> Iterator[Panel]:
    """Yield the temperature that any of the configs was given."""
    for curves in (run.overview.curves for run in runs.values()):
        if "temperature" in curves:
            yield charts.temperature_panel(clock(curves["t"]), curves["temperature"], shades, height=0.7)
            return
