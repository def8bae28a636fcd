"""The page of a fitted map and its charts: the curve among the samples of the soak, what it leaves, how sure it is."""

from __future__ import annotations

import numpy as np

from driftlab.maps.assessment import MapVerdict, text
from driftlab.maps.kind_selection import KindComparison
from driftlab.reports.charts import Chart, Line, LineStyle, Panel, Rule, Shade, band_alone, series
from driftlab.reports.map_selection import section
from driftlab.reports.pages import page
from driftlab.reports.provenance import Sheet
from driftlab.soak.blocks import WAYS
from driftlab.units import BiasUnit
from fusion_core.chunk import Array

LABEL = "temperature [°C]"
NEITHER = "before warming or cooling"
NAMES = WAYS | {NEITHER: 0}
STYLES: tuple[LineStyle, ...] = ("line", "dashed", "dotted")  # so that none hides one that is alike
ROLES = {"warming": "warming", "cooling": "cooling", NEITHER: "data"}


def chart(verdict: MapVerdict, unit: BiasUnit) -> Chart:
    """Return all panels over one temperature: of each axis the curve and what it leaves, then sigma and samples."""
    panels = [panel for axis in range(len(verdict.axes)) for panel in _of_axis(verdict, unit, axis)]
    return Chart((*panels, *_sure(verdict, unit)), LABEL, "Thermal map")


def axis_chart(verdict: MapVerdict, unit: BiasUnit, axis: int) -> Chart:
    """Return the curve of one axis among its samples, and below what it leaves of them."""
    name = verdict.axes[axis]
    caption = (
        "Points: means of the samples of one way in narrow ranges of temperature. Band of the curve: two standard "
        "deviations. Below: the same less the curve; the band there is one standard deviation of what white noise "
        "alone leaves of such a mean."
    )
    if verdict.seen:
        caption += " Dashed: half of the difference between up and down that is seen, to either side of the curve."
    return Chart(_of_axis(verdict, unit, axis), LABEL, f"Axis {name}", caption)


def sure_chart(verdict: MapVerdict, unit: BiasUnit) -> Chart:
    """Return the deviation of the curve, and the number of samples that it stands on."""
    sigma = "Sigma: one standard deviation of the curve; its mean over the fit is not in it. "
    caption = "Samples: in a kelvin, warming and cooling apart."
    caption = caption if verdict.sigma is None else sigma + caption
    return Chart(_sure(verdict, unit), LABEL, "Sigma of the curve, and its samples", caption)


def _holes(verdict: MapVerdict) -> tuple[Shade, ...]:
    return tuple(Shade(start, stop, "no sample", "hole") for start, stop in verdict.coverage.holes)


def _of_axis(verdict: MapVerdict, unit: BiasUnit, axis: int) -> tuple[Panel, ...]:
    name, fitted, T = verdict.axes[axis], verdict.fitted, verdict.T
    curve = fitted.bias(T)[:, axis] * unit.factor
    reach = None if verdict.sigma is None else 2 * verdict.sigma[:, axis] * unit.factor
    low, high = (None, None) if reach is None else (curve - reach, curve + reach)
    data, left = [], []
    for way_name, way in NAMES.items():
        count, at, mean = verdict.soak.cells(way)
        if np.any(count > 0):
            x, y, role = at[count > 0], mean[count > 0, axis], ROLES[way_name]
            less = (y - fitted.bias(np.clip(x, *fitted.domain))[:, axis]) * unit.factor
            data.append(Line(x, y * unit.factor, way_name, role, style="points"))
            left.append(Line(x, less, way_name, role, style="points"))
    shades, estimate = _holes(verdict), Line(T, curve, "curve", "estimate", low, high)
    lines = [_white(verdict, unit, axis), *left]
    if verdict.seen:
        half = verdict.memory.difference[:, axis] / 2 * unit.factor
        for way_name, way in WAYS.items():
            seen = f"{way_name}, by the difference seen"
            lines.append(Line(verdict.memory.T, half * way, seen, way_name, style="dashed"))
    return (
        Panel((*data, estimate), f"bias {name} [{unit.shown}]", shades, height=1.3),
        Panel(tuple(lines), f"{name} less the curve [{unit.shown}]", shades, (Rule(0.0, "", "sigma"),)),
    )


def _white(verdict: MapVerdict, unit: BiasUnit, axis: int) -> Line:
    """Return the band of what white noise leaves of a mean, for as many samples as each way has on the average."""
    count = verdict.soak.count
    ways = np.sum(count > 0, axis=0)
    n = np.where(ways > 0, count.sum(axis=0) / np.maximum(ways, 1), np.nan)
    sigma = verdict.soak.white[axis] * unit.factor / np.sqrt(n)
    return band_alone(verdict.coverage.T, sigma, "white noise alone", "sigma")


def _sure(verdict: MapVerdict, unit: BiasUnit) -> tuple[Panel, ...]:
    shades, coverage, panels = _holes(verdict), verdict.coverage, []
    if verdict.sigma is not None and verdict.good is not None:
        lines = tuple(
            Line(verdict.T, verdict.sigma[:, k] * unit.factor, f"sigma {name}", series(k + 2), style=STYLES[k % 3])
            for k, name in enumerate(verdict.axes)
        )
        worst = float(np.max(verdict.good)) * unit.factor
        rule = Rule(worst, f"good to {text(worst)}", "limit")
        panels.append(Panel(lines, f"sigma of the curve [{unit.shown}]", shades, (rule,)))
    width = float(np.diff(verdict.soak.edges[:2])[0]) or 1.0
    counts = {name: verdict.soak.cells(way)[0] / width for name, way in NAMES.items()}
    samples = tuple(
        Line(coverage.T, np.where(count > 0, count, np.nan), name, ROLES[name])
        for name, count in counts.items()
        if np.any(count > 0)
    )
    rules = tuple(Rule(part.needed, "as many as sigma asks for", "limit") for part in coverage.thin[:1])
    return (*panels, Panel(samples, "samples [1/K]", shades, rules, log=True))


def rows(verdict: MapVerdict, unit: BiasUnit) -> list[tuple[str, list[str]]]:
    """Return the table of the page: what, and a text for each axis; the decisive row first."""

    def row(label: str, values: Array) -> tuple[str, list[str]]:
        return f"{label} [{unit.shown}]", [text(float(v) * unit.factor) for v in values]

    differences = [_difference(verdict, unit, axis) for axis in range(len(verdict.axes))]
    table = [(f"up less down, largest [{unit.shown}]", differences)]
    if verdict.good is not None and verdict.sigma is not None:
        at = verdict.T[np.argmax(verdict.sigma, axis=0)]
        table[:0] = [
            row("good to: sigma of the curve, rms over the range", verdict.good),
            row("sigma where it is largest", verdict.sigma.max(axis=0)),
            ("… at [°C]", [text(float(T)) for T in at]),
        ]
    if verdict.fitted.record.residual is not None:
        table.append(row("residual: rms of the samples", np.asarray(verdict.fitted.record.residual)))
    return [*table, row("white noise alone: of a sample", verdict.soak.white)]


def _difference(verdict: MapVerdict, unit: BiasUnit, axis: int) -> str:
    memory = verdict.memory
    if memory.answer == "undecided":
        return "undecided" if np.isfinite(memory.evidence) else "not measured"
    if memory.answer == "none":
        return f"none larger than {text(float(memory.none_larger_than[axis]) * unit.factor, 2)}"
    size, sigma = memory.size[axis] * unit.factor, memory.sigma[axis] * unit.factor
    return f"{text(float(size))} ± {text(float(sigma), 2)} at {text(float(memory.where[axis]))} °C"


def _use(verdict: MapVerdict, unit: BiasUnit) -> str:
    """Return the meaning of the verdict for use."""
    if verdict.seen:
        return "do not calibrate by this map alone: up and down differ; run `driftlab explain` first."
    if verdict.sigma is None:
        return "check the map on another recording by `driftlab run`: its kind has no sigma."
    low, high = verdict.fitted.domain
    off = text(2 * float(np.max(verdict.sigma)) * unit.factor)
    turned = f", {off} deg of heading an hour" if unit.shown == "deg/h" else ""
    open_ = "" if verdict.memory.answer == "none" else ", and with a hysteresis or lag that this soak does not exclude"
    span = f"from {low:.3g} to {high:.3g} °C"
    return f"{span} count with up to {off} {unit.shown} (2 sigma) beside the level{turned}{open_}."


def page_of(
    verdict: MapVerdict, unit: BiasUnit, notes: list[str], sheet: Sheet, comparison: KindComparison | None = None
) -> str:
    """Return the page of a map; where its kind was chosen, with what was tried."""
    record = verdict.fitted.record
    low, high = record.domain
    density = verdict.coverage.density[verdict.coverage.density > 0]
    return page(
        "map",
        title=f"Thermal map of the {record.channel}: {verdict.settings.description}",
        lead=f"{record.samples:,} samples of {record.provenance.get('recordings', '') or 'samples in memory'}, "
        f"{low:.2f} to {high:.2f} °C",
        sheet=sheet,
        sentences=verdict.sentences(unit),
        use=_use(verdict, unit),
        notes=notes,
        axes=verdict.axes,
        rows=rows(verdict, unit),
        charts=[axis_chart(verdict, unit, axis) for axis in range(len(verdict.axes))],
        sure=sure_chart(verdict, unit),
        coverage=verdict.coverage,
        density=(np.median(density), np.min(density)),
        kinds=None if comparison is None else section(comparison, unit, verdict.axes),
    )
