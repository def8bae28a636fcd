"""The report of a comparison: who coasts best, a figure and a table to decide from, and the paper's tables.

The figures of a comparison, each said once: the page draws it, and `result.plot()`.

A config has one colour in all of them and one entry in the legend, so that one click hides it. d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftlab.evaluation.comparison import Comparison, notes, paper, verdict
from driftlab.evaluation.overview import thin
from driftlab.evaluation.ranking import TO_THE_END, duration, ranking
from driftlab.evaluation.scores import LONGEST_FIRST, over_axes
from driftlab.evaluation.summary import Rows, error_rows
from driftlab.reports.charts import LOOKS, Chart, Line, Look, Panel, Shade, clock, series
from driftlab.reports.pages import write_page
from driftlab.units import axis_name

if TYPE_CHECKING:
    from collections.abc import Sequence

    from driftlab.evaluation.comparison import Columns
    from driftlab.reports.provenance import Sheet
    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array
    from fusion_core.contracts import Sensor


Cells = list[tuple[str, str, list[str], bool]]  # of a table: label, axis, a text a config, whether it belongs above


@dataclass(frozen=True)
class WindowBar:
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


def _bars(found: dict[str, Comparison], unit: BiasUnit) -> list[tuple[str, list[WindowBar]]]:
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
            WindowBar(
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


EARLY = 600.0  # s after the first update, in which an initial error is shown


def bias_chart(found: dict[str, Comparison]) -> Chart:
    """Return reference, and every config's estimate and coast, of each axis over time, and temperature."""
    sensor, at, label = _first(found).sensor, *_clock(found)
    reference = _first(found).overview.curves
    shades = _shades(found, at)
    panels = []
    for k, axis in enumerate(sensor.axes):
        lines = [
            Line(
                at(reference["t"]), reference["reference"][:, k] * sensor.factor, "30 s average, reference", "reference"
            )
        ]
        for name, comparison, role in _each(found):
            curves = comparison.overview.curves
            t, begun = at(curves["t"]), np.isfinite(curves["coast"][:, 0])
            bias, coast = (curves[column][:, k] * sensor.factor for column in ("bias", "coast"))
            lines += [
                Line(t, np.where(begun, bias, np.nan), name, role),
                Line(t, coast, name, role, style="dashed"),
            ]
        panels.append(Panel(tuple(lines), f"bias {axis} [{sensor.shown}]", shades))
    return Chart(
        (*panels, *_temperature(found, at, shades)),
        label,
        f"Bias of the {sensor.channel}",
        "Broad and grey: the reference, the centred 30 s average of what was measured. Solid: estimates, which follow "
        "it while they are updated. Dashed: coasts, predicted from the end of the alignment with no measurement since.",
    )


def error_chart(found: dict[str, Comparison]) -> Chart:
    """Return every config's coast less the reference, with two deviations of what it says, of each axis over time."""
    sensor, at, label = _first(found).sensor, *_clock(found)
    shades = _shades(found, at)
    panels = []
    for k, axis in enumerate(sensor.axes):
        lines = []
        for name, comparison, role in _each(found):
            curves = comparison.overview.curves
            t, spread = at(curves["t"]), 2 * curves["coast_sigma"][:, k] * sensor.factor
            error = (curves["coast"] - curves["reference"])[:, k] * sensor.factor
            lines.append(Line(t, error, name, role, -spread, spread, "dashed"))
        panels.append(Panel(tuple(lines), f"coast error {axis} [{sensor.shown}]", shades))
    return Chart(
        (*panels, *_temperature(found, at, shades)),
        label,
        "Error of the coasts",
        "Prediction less reference. The band is two of its standard deviations about zero: 95 % of the time an honest "
        "prediction is inside.",
    )


def early_chart(found: dict[str, Comparison]) -> Chart:
    """Return what the estimates make of an initial error, in the first minutes (the paper's figures 14 to 16)."""
    sensor, at, label = _first(found).sensor, *_clock(found)
    size, _ = _first(found).initial.texts
    panels = []
    for k, axis in enumerate(sensor.axes):
        lines = []
        for name, comparison, role in _each(found):
            estimates = comparison.offset.estimates
            rows = np.flatnonzero(estimates["t"] <= estimates["t"][0] + EARLY)
            rows = rows[thin(len(rows))]
            begun = np.isfinite(estimates["coast"][rows, 0])
            bias = np.where(begun, estimates["bias"][rows, k], np.nan) * sensor.factor
            lines.append(Line(at(estimates["t"][rows]), bias, name, role))
        panels.append(Panel(tuple(lines), f"bias {axis} [{sensor.shown}]"))
    return Chart(tuple(panels), label, f"Estimates, {size} added at the start (figures 14 to 16)")


def input_chart(found: dict[str, Comparison]) -> Chart:
    """Return what each filter is given, without what is faster than 1 Hz (the paper's figures 9 and 10)."""
    sensor, at, label = _first(found).sensor, *_clock(found)
    given = [(name, role, *_slow(c.nominal.estimates)) for name, c, role in _each(found)]
    panels = tuple(
        Panel(
            tuple(Line(at(t), rate[:, k] * sensor.factor, name, role) for name, role, t, rate in given),
            f"{_input_name(sensor, axis)} [{sensor.shown}]",
        )
        for k, axis in enumerate(sensor.axes)
    )
    return Chart(panels, label, "What the filters are given (figures 9 and 10)")


def _input_name(sensor: Sensor, axis: str) -> str:
    return f"rate {axis}" if sensor.integral else axis_name(sensor.channel, axis)


def _slow(estimates: Columns) -> tuple[Array, Array]:
    """Return times and what the filter is given at them, through a second-order low-pass: for the eye only."""
    from scipy.signal import butter, sosfiltfilt

    rate = estimates["rate"] - estimates["calibration"]
    sampling = 1 / float(np.median(estimates["tau"]))
    if sampling > 2.5 and len(rate) >= 20:
        rate = sosfiltfilt(butter(2, 1.0, fs=sampling, output="sos"), rate, axis=0)
    keep = thin(len(rate))
    return estimates["t"][keep], np.asarray(rate[keep])


def _first(found: dict[str, Comparison]) -> Comparison:
    return next(iter(found.values()))


def _each(found: dict[str, Comparison]) -> Iterator[tuple[str, Comparison, str]]:
    """Yield name, comparison and role of every config."""
    for k, (name, comparison) in enumerate(found.items()):
        yield name, comparison, series(k)


def _clock(found: dict[str, Comparison]) -> tuple[Callable[[Array], Array], str]:
    """Return what turns times in s into those of the figures, from the first row, and the label of x."""
    zero = _first(found).first_row
    at, unit = clock(zero, max(c.overview.end for c in found.values()))
    return at, f"time from the first row [{unit}]"


def _shades(found: dict[str, Comparison], at: Callable[[Array], Array]) -> tuple[Shade, ...]:
    """Return where the unit moved, and where the filter of a config refused one that stood still.

    Motion is told from the sensors alone: it is shown once where all configs have the same.
    """
    shades: list[Shade] = []
    alike = len({c.moving for c in found.values()}) == 1
    for k, (name, comparison, role) in enumerate(_each(found)):
        refused = f"{name}: refused"
        shades += [Shade(*_edges(span, at), refused, role) for span in comparison.refused]
        moved = "moved" if alike else f"{name}: moved"
        if k == 0 or not alike:
            shades += [Shade(*_edges(span, at), moved, "moving") for span in comparison.moving]
    return tuple(shades)


def _edges(span: tuple[float, float], at: Callable[[Array], Array]) -> tuple[float, float]:
    start, stop = at(np.array(span)).tolist()
    return start, stop


def _temperature(
    found: dict[str, Comparison], at: Callable[[Array], Array], shades: tuple[Shade, ...]
) -> Iterator[Panel]:
    """Yield the temperature that any of the configs was given."""
    for comparison in found.values():
        curves = comparison.overview.curves
        if "temperature" in curves:
            line = Line(at(curves["t"]), curves["temperature"], "temperature", "temperature")
            yield Panel((line,), "temperature [°C]", shades, height=0.7)
            return
