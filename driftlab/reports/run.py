"""The report of a run: one HTML file that opens without a network.

The figures of a run, each said once: the page draws it, and `result.plot()`.

Drawn from at most a few thousand points, however long the recording. d axes.

Sections that plugins add to the report of a run.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from driftlab.evaluation.overview import SMOOTHED, Overview
from driftlab.evaluation.ranking import duration
from driftlab.evaluation.scores import Scores, moving_average
from driftlab.evaluation.summary import error_rows, remarks, too_much
from driftlab.reports.charts import Chart, Line, Panel, Rule, Shade, clock, legible, marked
from driftlab.reports.pages import drawing, write_page
from driftlab.reports.provenance import Sheet
from driftlab.units import BiasUnit, unit_of
from fusion_core.chunk import Array, read_only
from fusion_core.contracts import FittedMap, MeasurementModel, ReportSection, Section, Sensor
from fusion_core.errors import FusionError, moment
from fusion_core.host.guard import guarded
from fusion_core.host.registry import registry


def write_report(
    path: Path,
    overview: Overview,
    summary: dict[str, Any],
    *,
    title: str,
    config: str,
    model: MeasurementModel,
    sheet: Sheet,
    fitted: FittedMap | None = None,
) -> None:
    """Write `report.html` of one run; `fitted` is the map that it used, where it used one."""
    t, yardsticks = summary["t"], overview.yardsticks
    sensor, unit = model.tracked, unit_of(model.tracked)
    domain = None if fitted is None else fitted.domain
    write_page(
        path,
        "report",
        title=title,
        lead=f"{summary['updates']['count']:,} updates over {duration(t['end_s'] - t['start_s'])}, "
        f"aligned at {moment(t['aligned_s'], t['first_row_s'])}",
        sheet=sheet,
        remarks=remarks(summary, model),
        channel=sensor.channel,
        known="Earth rate" if sensor.integral is not None else "its known input",
        bias=bias_chart(overview, model, summary, domain=domain),
        error=error_chart(overview, model, summary),
        domain=domain,
        axes=sensor.axes,
        unit=unit.shown,
        rows=_rows(yardsticks, unit),
        headings=_headings(yardsticks, sensor),
        nis=nis_words(summary),
        nis_chart=nis_chart(overview, model.m),
        whiteness=", ".join(
            f"{name} {_number(p, '.2g')}" for name, p in zip(summary["states"], summary["whiteness_p"], strict=False)
        ),
        map_chart=fitted and map_chart(fitted, overview, unit, sensor.axes),
        config=config,
        sections=sections(summary, overview.curves),
    )


def nis_words(summary: dict[str, Any]) -> str:
    """Return in a sentence or two what the NIS says of the deviations of a run."""
    nis = summary["nis"]
    mean = nis["mean_per_component"]
    if not np.isfinite(mean):
        return "The NIS is not known, no update was used."
    bounds = f"{nis['low']:.3f} to {nis['high']:.3f}"
    if nis["consistent"]:
        return f"The mean NIS a component is {mean:.3f}, within {bounds}: innovations are as large as the model says."
    return f"The mean NIS a component is {mean:.3f}, outside {bounds}: {too_much(mean)}."


def _rows(yardsticks: Scores, unit: BiasUnit) -> list[tuple[str, list[str]]]:
    return [
        (label, [_number(v * unit.factor, unit.digits) for v in values])
        for label, (values,) in error_rows([yardsticks])
    ]


def _headings(yardsticks: Scores, sensor: Sensor) -> list[str]:
    """Return the heading error of each horizon, of a gyro."""
    if sensor.integral is None:
        return []
    return [f"{name} {_number(np.rad2deg(v), '.2f')}" for name, v in yardsticks.heading.items()]


def _number(value: float, spec: str) -> str:
    return f"{value:{spec}}" if np.isfinite(value) else "–"


NEAR = 1.0  # swings of the temperature from it, within which an end of the map's domain is drawn
Z95 = 1.96


def bias_chart(
    overview: Overview,
    model: MeasurementModel,
    summary: dict[str, Any],
    *,
    errors: bool = False,
    domain: tuple[float, float] | None = None,
) -> Chart:
    """Return reference, estimate and coast of each axis over time, and temperature.

    With `errors` the panels of `error_chart` stand below those of the bias; `domain` is of the map, degC.
    """
    curves, sensor = overview.curves, model.tracked
    at, unit = clock(overview.first_row, overview.end)
    t, shades = at(curves["t"]), marked(summary, at)
    reference = curves.get("reference")
    if reference is None:
        reference = moving_average(curves["t"], curves["rate"], curves["tau"], curves["still"].astype(bool))
    panels = []
    for k, axis in enumerate(sensor.axes):
        given = Line(t, reference[:, k] * sensor.factor, f"{sensor.channel}, 30 s average", "reference")
        lines = (_coast_band(t, curves, sensor, k), given, *_estimates(t, curves, sensor, k))
        panels.append(Panel(lines, f"bias {axis} [{sensor.shown}]", shades, span=legible(lines)))
    if errors:
        panels += error_chart(overview, model, summary).panels
    if "temperature" in curves:
        panels.append(_temperature(t, curves["temperature"], shades, domain))
    return Chart(tuple(panels), f"time from the first row [{unit}]", f"Bias of the {sensor.channel}")


def _coast_band(t: Array, curves: dict[str, Array], sensor: Sensor, k: int) -> Line:
    """Return two deviations about the coast of axis k: below all lines, it is wide."""
    coast, spread = (curves[name][:, k] * sensor.factor for name in ("coast", "coast_sigma"))
    return Line(t, None, "± 2σ of the coast", "coast", coast - 2 * spread, coast + 2 * spread)


def _estimates(t: Array, curves: dict[str, Array], sensor: Sensor, k: int) -> tuple[Line, ...]:
    """Return estimate, with two deviations, and coast of axis k, and what is known given all of it."""
    bias, sigma, coast = (curves[name][:, k] * sensor.factor for name in ("bias", "bias_sigma", "coast"))
    coasting = np.isfinite(curves["coast"][:, 0])
    bias, sigma = (np.where(coasting, values, np.nan) for values in (bias, sigma))
    lines = (
        Line(t, bias, "estimate, ± 2σ", "estimate", bias - 2 * sigma, bias + 2 * sigma),
        Line(t, coast, "coast", "coast", style="dashed"),
    )
    if SMOOTHED not in curves:
        return lines
    return (*lines, Line(t, curves[SMOOTHED][:, k] * sensor.factor, "given all of it", "other", style="dotted"))


def error_chart(overview: Overview, model: MeasurementModel, summary: dict[str, Any]) -> Chart:
    """Return the errors of estimate and coast against the reference, with two deviations of what the filter says."""
    curves, errors, sensor = overview.curves, overview.errors, model.tracked
    at, unit = clock(overview.first_row, overview.end)
    t, when, shades = at(curves["t"]), at(errors["t"]), marked(summary, at)
    panels = []
    for k, axis in enumerate(sensor.axes):
        own, spread = (2 * curves[name][:, k] * sensor.factor for name in ("bias_sigma", "coast_sigma"))
        own = np.where(np.isfinite(spread), own, np.nan)
        own_error = np.where(np.isfinite(errors["coast"]), errors["bias"], np.nan)[:, k] * sensor.factor
        lines = (
            Line(t, None, "± 2σ of the coast", "coast", -spread, spread),
            Line(t, None, "± 2σ of the estimate", "estimate", -own, own),
            Line(when, own_error, "estimate less reference", "error"),
            Line(when, errors["coast"][:, k] * sensor.factor, "coast less reference", "coast", style="dashed"),
        )
        panels.append(Panel(lines, f"error {axis} [{sensor.shown}]", shades, span=legible(lines)))
    return Chart(tuple(panels), f"time from the first row [{unit}]", "Error")


def nis_chart(overview: Overview, m: int) -> Chart:
    """Return the mean NIS a component of stretches, and where 95 % of them are if the model is right."""
    t, nis, count = overview.nis_curve.T
    at, unit = clock(overview.first_row, overview.end)
    when = at(t)
    reach = Z95 * np.sqrt(2 / (m * np.maximum(count, 1)))  # of the mean of chi squares
    lines = (
        Line(when, None, "95 % where the model is right", "sigma", np.maximum(1 - reach, 0.0), 1 + reach),
        Line(when, nis / m, "mean NIS of a stretch", "nis", style="points"),
    )
    wide = overview.nis_highest > 20 * m
    level = Rule(1.0, "1: as good as it says")
    panel = Panel(_positive(lines) if wide else lines, "NIS a component [1]", rules=(level,), log=wide)
    return Chart((panel,), f"time from the first row [{unit}]", "Is the filter as good as it says?")


def _positive(lines: tuple[Line, ...]) -> tuple[Line, ...]:
    """Return the lines for a logarithmic scale."""

    def above(values: Array | None) -> Array | None:
        return None if values is None else np.where(values > 0, values, np.nan)

    return tuple(replace(line, y=above(line.y), low=above(line.low), high=above(line.high)) for line in lines)


def map_chart(fitted: FittedMap, overview: Overview, unit: BiasUnit, axes: tuple[str, ...]) -> Chart:
    """Return the map that was used over temperature, with two deviations of its curve, below what was measured."""
    T = np.linspace(*fitted.domain, 300)
    bias, sigma = fitted.bias(T) * unit.factor, 2 * fitted.sigma(T) * unit.factor
    found = overview.curves
    holes = fitted.record.error.holes if fitted.record.error else ()
    shades = tuple(Shade(start, stop, "nothing recorded", "hole") for start, stop in holes)
    measured, reference = found["temperature_raw"], found["reference"] * unit.factor
    order = np.argsort(measured, kind="stable")
    panels = []
    for k, axis in enumerate(axes):
        curve, spread = bias[:, k], sigma[:, k]
        lines = (
            Line(measured[order], reference[order, k], "this run, 30 s average", "data", style="points"),
            Line(T, curve, "map, ± 2σ of its curve", "estimate", curve - spread, curve + spread),
        )
        panels.append(Panel(lines, f"bias {axis} [{unit.shown}]", shades))
    return Chart(tuple(panels), "temperature [°C]", "The map that was used")


def _temperature(t: Array, T: Array, shades: tuple[Shade, ...], domain: tuple[float, float] | None) -> Panel:
    """Return temperature, with the ends of the map's domain where they are near."""
    low, high = float(np.min(T)), float(np.max(T))
    reach = NEAR * max(high - low, 1.0)
    names = ("map begins", "map ends")
    ends = [(y, text) for y, text in zip(domain or (), names, strict=bool(domain)) if low - reach <= y <= high + reach]
    rules = tuple(Rule(y, f"{text}, {y:.4g} °C") for y, text in ends)
    return Panel((Line(t, T, "temperature", "temperature"),), "temperature [°C]", shades, rules)


def sections(summary: Mapping[str, Any], curves: Mapping[str, Array]) -> list[dict[str, Any]]:
    """Return title, paragraphs, HTML and drawing of each section; one that fails says so in its own place."""
    shared = MappingProxyType({name: read_only(values) for name, values in curves.items()})
    found = []
    for kind, cls in registry().classes(ReportSection).items():
        try:
            with guarded(cls, "its settings"):
                plugin: Any = cls.model_validate({"kind": kind})
            section = plugin.section(copy.deepcopy(dict(summary)), shared)
        except FusionError as error:
            section = Section(kind, f"This section could not be made: {error}")
        if section is not None:
            found.append(_values(section))
    return found


def _values(section: Section) -> dict[str, Any]:
    paragraphs = [part for part in section.text.split("\n\n") if part.strip()]
    inside = {"html": drawing(section.html), "svg": drawing(section.svg)}
    return {"title": section.title, "paragraphs": paragraphs, **inside}
