"""The figures of a comparison, each said once: the page draws it, and `result.plot()`.

A config has one colour in all of them and one entry in the legend, so that one click hides it. d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.overview import thin
from driftlab.reports.charts import Chart, Line, Panel, Shade, series
from driftlab.reports.over_time import clock
from driftlab.units import axis_name

if TYPE_CHECKING:
    from driftlab.judging.compare import Columns, Comparison
    from fusion_core.chunk import Array
    from fusion_core.contracts import Sensor

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
