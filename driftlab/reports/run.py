"""The report of a run: one HTML file that opens without a network, and its charts for notebooks.

Drawn from at most a few thousand points, however long the recording. d axes. Plugins may add sections.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from driftlab.evaluation.comparison import REFUTED
from driftlab.evaluation.overview import SMOOTHED, Overview, ScoredRun
from driftlab.evaluation.scores import HORIZONS
from driftlab.evaluation.summary import error_pairs, inconsistency, remarks
from driftlab.filtering.segment import RunLog
from driftlab.reports import charts
from driftlab.reports.charts import Chart, Clock, Line, Panel, Rule, Shade
from driftlab.reports.pages import drawing, page
from driftlab.reports.provenance import Sheet
from driftlab.units import BiasUnit, duration, formatted
from fusion_core.chunk import Array, read_only
from fusion_core.consistency import NisTest
from fusion_core.contracts import FittedMap, ReportSection, Section
from fusion_core.errors import FusionError, moment
from fusion_core.host.guard import guarded
from fusion_core.host.registry import registry


def page_of(
    run: ScoredRun, summary: dict[str, Any], *, title: str, sheet: Sheet, fitted: FittedMap | None = None,
    notes: Sequence[str] = (),
) -> str:  # fmt: skip
    """Return the page of one run; `fitted` is the map that it used, where it used one, `summary` is for plugins.

    `notes` are remarks beside those on the filter.
    """
    overview, model, scores, sensor, unit = run.overview, run.model, run.yardsticks, run.sensor, run.unit
    domain = None if fitted is None else fitted.domain
    aligned = moment(run.alignment.t, run.journal.faults.first_row)
    headings = scores.heading.items() if sensor.integral is not None else ()
    whiteness = zip(model.space.labels, overview.whiteness_p, strict=False)
    return page(
        "report",
        title=title,
        lead=f"{overview.count:,} updates over {duration(overview.end - overview.start)}, aligned at {aligned}",
        sheet=sheet,
        results=result_sentences(run),
        remarks=[*remarks(run), *notes],
        channel=sensor.channel,
        known="Earth rate" if sensor.integral is not None else "its known input",
        bias=bias_chart(run, domain=domain),
        error=error_chart(run),
        domain=domain,
        axes=sensor.axes,
        unit=unit.shown,
        rows=_errors(run),
        headings=[f"{name} {formatted(np.rad2deg(angle), '.2f')}" for name, angle in headings],
        nis=nis_sentence(overview.nis),
        nis_chart=nis_chart(overview, model.m),
        whiteness=", ".join(f"{name} {formatted(p, '.2g')}" for name, p in whiteness),
        map_chart=fitted and map_chart(fitted, overview, unit, sensor.axes),
        config=run.config.as_yaml(),
        sections=sections(summary, overview.curves),
    )


def _errors(run: ScoredRun) -> list[tuple[str, list[str]]]:
    """Return the errors of each axis, the sigma of a prediction in brackets: a label, and a text an axis."""
    unit = run.unit

    def text(error: float, sigma: float | None = None) -> str:
        return unit.number(error, "–") + ("" if sigma is None else f" ({unit.number(sigma, '–')})")

    rows: list[tuple[str, list[str]]] = []
    of_all = ((f"prediction, {name}", ((error, sigma),)) for name, (error, sigma, _) in run.predictions.items())
    for label, ((errors, sigmas),) in (*of_all, *error_pairs([run.yardsticks])[len(HORIZONS) :]):
        rows.append((label, [text(*pair) for pair in zip(errors, *([] if sigmas is None else [sigmas]), strict=True)]))
    return rows


def result_sentences(run: ScoredRun) -> tuple[str, str]:
    """Return the result of a run in a sentence, and its meaning for use; the second is empty where none is known.

    It is of all predictions of 10 minutes where there are several, and of the run's own first where there is one.
    """
    scores, unit, of_all = run.yardsticks, run.unit, run.predictions
    name = next((name for name in list(of_all)[1:] if np.all(np.isfinite(of_all[name][0]))), None)
    if name is None:
        return "No prediction of a minute or more is scored: too little of the recording is at rest.", ""
    errors, sigmas, ratios = of_all[name]
    worst, unsure = int(np.argmax(errors)), int(np.nanargmax(ratios))
    axis = f" of {scores.axes[worst]}" if len(scores.axes) > 1 else ""
    several, length = name not in HORIZONS, "10 min" if name not in HORIZONS else name
    which = f" of {len(scores.coasts)} predictions" if several else ""
    size = f"{unit.number(errors[worst])} {unit.shown}"
    result = f"Without updates the bias{axis} is predicted over {length} to {size} rms{which}"
    if several and np.all(np.isfinite(own := scores.coast[length])):
        result += f"; the first is off by {unit.number(own[worst])} {unit.shown}"
    of = axis and f" of {scores.axes[unsure]}"
    verdict = "no sign that it is too small" if ratios[unsure] <= REFUTED else "it is too small; widen walk or map"
    size = f"{unit.number(sigmas[unsure])} {unit.shown}"
    times = f"the error {ratios[unsure]:.1f} times that and the reference's noise together"
    whose = f"sigma{of}" + (f" over all {len(scores.coasts)}" if several else " there")
    trust = f"{whose} is {size}, and {times}: {verdict}"
    known = run.sensor.integral is not None  # without gravity no axis is known as up
    angle = float(np.rad2deg(scores.heading[length])) if known else np.nan
    turned = (
        f"{'the first ' * several}{length} without updates turn the heading by {angle:.2g} deg; "
        if np.isfinite(angle)
        else ""
    )
    return f"{result}.", f"{turned}{trust}."


def nis_sentence(nis: NisTest) -> str:
    """Return in a sentence or two what the NIS says of the deviations of a run."""
    if not np.isfinite(nis.mean):
        return "The NIS is not known, no update was used."
    mean, bounds = f"The mean NIS per component is {nis.mean:.3f}", f"{nis.low:.3f} to {nis.high:.3f}"
    if nis.consistent:
        return f"{mean}, within {bounds}: innovations are as large as the model says, over one update."
    return f"{mean}, outside {bounds}: {inconsistency(nis.mean)}."


NEAR = 1.0  # swings of the temperature from it, within which an end of the map's domain is drawn
Z95 = 1.96


def bias_chart(run: ScoredRun, *, errors: bool = False, domain: tuple[float, float] | None = None) -> Chart:
    """Return reference, estimate and prediction of each axis over time, and temperature.

    With `errors` the panels of `error_chart` stand below those of the bias; `domain` is of the map, degC.
    """
    curves, sensor = run.overview.curves, run.sensor
    clock = Clock(run.overview.first_row, run.overview.end)
    t, shades = clock(curves["t"]), event_shades(run.journal, clock)
    coasting = np.isfinite(curves["coast"][:, 0])

    def lines(k: int) -> Iterator[Line]:
        bias, sigma, coast, spread = (
            curves[name][:, k] * sensor.factor for name in ("bias", "bias_sigma", "coast", "coast_sigma")
        )
        # wide: below all
        yield Line(t, None, "± 2σ of the prediction", "coast", coast - 2 * spread, coast + 2 * spread)
        yield Line(t, curves["reference"][:, k] * sensor.factor, f"{sensor.channel}, 30 s average", "reference")
        yield charts.band(t, np.where(coasting, bias, np.nan), 2 * sigma, "estimate, ± 2σ")
        yield Line(t, coast, "prediction", "coast", style="dashed")
        if SMOOTHED in curves:
            yield Line(t, curves[SMOOTHED][:, k] * sensor.factor, "given all of it", "other", style="dotted")

    panels = charts.axis_panels(sensor.axes, lines, "bias", sensor.shown, legibly=True, shades=shades)
    if errors:
        panels += error_chart(run).panels
    if "temperature" in curves:
        T = curves["temperature"]
        panels += (charts.temperature_panel(t, T, shades, rules=_domain_rules(T, domain)),)
    return Chart(panels, clock.label, f"Bias of the {sensor.channel}")


def event_shades(journal: RunLog, clock: Clock, refused: str = "refused") -> tuple[Shade, ...]:
    """Return the spans in which the filter refused measurements, or the unit moved."""
    dt = journal.alignments[0].dt
    return (
        *charts.span_shades(journal.refused.spans, clock, refused, "refused", dt),
        *charts.span_shades(journal.moving.spans, clock, "moved", "moving", dt),
    )


def error_chart(run: ScoredRun) -> Chart:
    """Return the errors of estimate and prediction against the reference, with two of the filter's deviations."""
    curves, errors, sensor = run.overview.curves, run.overview.errors, run.sensor
    clock = Clock(run.overview.first_row, run.overview.end)
    t, when = clock(curves["t"]), clock(errors["t"])

    def lines(k: int) -> Iterator[Line]:
        sigma, spread = (2 * curves[name][:, k] * sensor.factor for name in ("bias_sigma", "coast_sigma"))
        error = np.where(np.isfinite(errors["coast"]), errors["bias"], np.nan)[:, k] * sensor.factor
        yield charts.band_alone(t, spread, "± 2σ of the prediction", "coast")
        yield charts.band_alone(t, np.where(np.isfinite(spread), sigma, np.nan), "± 2σ of the estimate", "estimate")
        yield Line(when, error, "estimate less reference", "error")
        yield Line(when, errors["coast"][:, k] * sensor.factor, "prediction less reference", "coast", style="dashed")

    shades = event_shades(run.journal, clock)
    panels = charts.axis_panels(sensor.axes, lines, "error", sensor.shown, legibly=True, shades=shades)
    return Chart(panels, clock.label, "Error")


def nis_chart(overview: Overview, m: int) -> Chart:
    """Return the mean NIS a component of stretches, and where 95 % of them are if the model is right."""
    t, nis, count = overview.nis_curve.T
    clock = Clock(overview.first_row, overview.end)
    when = clock(t)
    reach = Z95 * np.sqrt(2 / (m * np.maximum(count, 1)))  # of the mean of chi squares
    lines = (
        Line(when, None, "95 % where the model is right", "sigma", np.maximum(1 - reach, 0.0), 1 + reach),
        Line(when, nis / m, "mean NIS of a stretch", "nis", style="points"),
    )
    wide = overview.nis_highest > 20 * m
    level = Rule(1.0, "1: as good as it says")
    drawn = tuple(map(_positive, lines)) if wide else lines
    panel = Panel(drawn, "NIS per component [1]", rules=(level,), log=wide)
    return Chart((panel,), clock.label, "Is the filter as good as it says?")


def _positive(line: Line) -> Line:
    """Return a line for a logarithmic scale."""
    y, low, high = (None if v is None else charts.positive(v) for v in (line.y, line.low, line.high))
    return replace(line, y=y, low=low, high=high)


def map_chart(fitted: FittedMap, overview: Overview, unit: BiasUnit, axes: tuple[str, ...]) -> Chart:
    """Return the map that was used over temperature, with two deviations of its curve, below what was measured."""
    T = np.linspace(*fitted.domain, 300)
    bias, sigma = fitted.bias(T) * unit.factor, 2 * fitted.sigma(T) * unit.factor
    holes = fitted.record.error.holes if fitted.record.error else ()
    shades = tuple(Shade(start, stop, "nothing recorded", "hole") for start, stop in holes)
    measured, reference = overview.curves["temperature_raw"], overview.curves["reference"] * unit.factor
    order = np.argsort(measured, kind="stable")

    def lines(k: int) -> Iterator[Line]:
        yield Line(measured[order], reference[order, k], "this run, 30 s average", "data", style="points")
        yield charts.band(T, bias[:, k], sigma[:, k], "map, ± 2σ of its curve")

    panels = charts.axis_panels(axes, lines, "bias", unit.shown, shades=shades)
    return Chart(panels, "temperature [°C]", "The map that was used")


def _domain_rules(T: Array, domain: tuple[float, float] | None) -> tuple[Rule, ...]:
    """Return the ends of the map's domain where they are near the temperatures."""
    low, high = float(np.min(T)), float(np.max(T))
    reach = NEAR * max(high - low, 1.0)
    ends = zip(domain or (), ("map begins", "map ends"), strict=False)
    return tuple(Rule(y, f"{text}, {y:.4g} °C") for y, text in ends if low - reach <= y <= high + reach)


def sections(summary: Mapping[str, Any], curves: Mapping[str, Array]) -> list[dict[str, Any]]:
    """Return title, paragraphs, HTML and drawing of each section; one that fails says so in its own place."""
    shared = MappingProxyType({name: read_only(values) for name, values in curves.items()})
    result = []
    for kind, cls in registry().classes(ReportSection).items():
        try:
            with guarded(cls, "its settings"):
                plugin: Any = cls.model_validate({"kind": kind})
            section = plugin.section(copy.deepcopy(dict(summary)), shared)
        except FusionError as error:
            section = Section(kind, f"This section could not be made: {error}")
        if section is not None:
            paragraphs = [part for part in section.text.split("\n\n") if part.strip()]
            inside = {"html": drawing(section.html), "svg": drawing(section.svg)}
            result.append({"title": section.title, "paragraphs": paragraphs, **inside})
    return result
