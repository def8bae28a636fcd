"""The report of an Allan analysis: a table, lines for a config, JSON, charts and a page, in units of data sheets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.noise.allan_fit import LEVEL, Coefficients
from driftlab.noise.allan_model import KEYS, WALK, WHITE, AllanCurve, design
from driftlab.noise.recording import Analysis
from driftlab.reports.charts import Chart, Line, Panel, positive, series
from driftlab.reports.pages import page
from driftlab.reports.provenance import Sheet
from driftlab.reports.tables import TextTable
from driftlab.units import axis_name, number
from fusion_core.contracts import axis_of
from fusion_core.units import convert

ALIKE = 1.2  # axes that differ by less than this factor share one value in a config


def document(analysis: Analysis, *, curves: bool = True) -> dict[str, Any]:
    """Return the analysis as JSON holds it: coefficients in SI with their limits, and the curves."""
    first, channels = analysis.first, analysis.curves
    return {
        "schema": 1,
        "driftlab": __version__,
        "recording": analysis.name,
        "plugins": analysis.plugins,
        "recording_s": analysis.total_s,
        "used_s": analysis.used_s,
        "stretches": analysis.stretches,
        "longest_stretch_s": float(np.max(first.stretches)) * analysis.dt,
        "gaps_bridged": len(first.bridged),
        "bridged_from_s": float(np.max(first.bridged)) if len(first.bridged) else None,
        "start_s": analysis.start_s,
        "sample_interval_s": analysis.dt,
        "confidence": LEVEL,
        **{channel: _coefficients(analysis, channel) for channel in analysis.coefficients},
        "notes": analysis.notes,
        "config": config_lines(analysis),
        **({"curves": {channel: _curves(analysis, channel) for channel in channels}} if curves else {}),
    }


def _each_axis(analysis: Analysis, channel: str) -> Iterator[tuple[str, AllanCurve, Coefficients]]:
    """Return name, curve and fit of each axis of a channel."""
    return zip(analysis.axes[channel], analysis.curves[channel], analysis.coefficients[channel], strict=True)


def _coefficients(analysis: Analysis, channel: str) -> dict[str, Any]:
    si = units_of(analysis, channel).si
    return {
        axis: {
            key: {"value": fit.value[k], "low": fit.low[k], "high": fit.high[k], "unit": si[key]}
            for k, key in enumerate(KEYS)
        }
        for axis, _, fit in _each_axis(analysis, channel)
    }


def _curves(analysis: Analysis, channel: str) -> dict[str, Any]:
    return {"unit": units_of(analysis, channel).deviation_si} | {
        axis: {
            "fitted_from_s": c.tau[fit.first],
            "tau_s": c.tau,
            "allan": c.allan,
            "allan_sigma": c.allan * fit.spread,
            "hadamard": c.hadamard,
            "every": c.stride,
            "stretches": c.counts,
            "used_s": c.used,
        }
        for axis, c, fit in _each_axis(analysis, channel)
    }


def table(analysis: Analysis, channel: str) -> TextTable:
    """Return the coefficients of a triad, axes as columns, in the units of data sheets."""
    cells = []
    for name, unit, texts in rows(analysis, channel):
        full, _, within = name.rstrip(")").partition(" (")
        short, _, letter = within.rpartition(", ")  # 80 columns have no room for a long name
        head = f"{short or full}\n{letter} [{unit}]"
        cells.append([head, *(text.replace(" (", "\n(").replace(" to ", "–") for text in texts)])
    title = f"{channel}: value and {100 * LEVEL:.0f} % limits"
    return TextTable(["", *analysis.axes[channel]], cells, title, rigid=True)


def rows(analysis: Analysis, channel: str) -> list[tuple[str, str, list[str]]]:
    """Return the rows of the table: name, unit, a cell an axis."""
    units = units_of(analysis, channel)
    result = []
    for key, unit in units.human:
        scale = float(convert(1.0, unit, units.si[key]))
        cells = [_cell(fit, KEYS.index(key), scale) for fit in analysis.coefficients[channel]]
        result.append((names_of(units)[key], unit, cells))
    return result


def _cell(fit: Coefficients, k: int, scale: float) -> str:
    if np.isinf(fit.high[k]):
        return "not measured"
    value, low, high = (number(v[k] / scale) for v in (fit.value, fit.low, fit.high))
    return f"{value} ({low} to {high})" if fit.value[k] > 0 else f"< {high}"


def config_lines(analysis: Analysis) -> str:
    """Return the lines to paste into a config: `noise` and `bias` of each triad, one value or one an axis.

    Where the walk cannot be seen it is the fit's upper limit, or where there is none what makes the floor of the curve,
    sqrt(3)/2 floor^2 / noise.
    """
    lines = ["filter:"]
    for channel, fits in analysis.coefficients.items():
        if any(np.isinf(fit.high[WHITE]) for fit in fits):
            lines.append(f"  # {channel}: white noise is not measured")
            continue
        axes, units, warmed = analysis.axes[channel], units_of(analysis, channel), analysis.warmed.get(channel)
        noise = [float(fit.value[WHITE] or fit.high[WHITE]) for fit in fits]
        walk = [
            float(fit.value[WALK] or (fit.high[WALK] if np.isfinite(fit.high[WALK]) else _of_floor(c, n)))
            for fit, c, n in zip(fits, analysis.curves[channel], noise, strict=True)
        ]
        unseen = _unseen(axes, fits, WHITE, "white noise not seen: its upper limit")
        most = _unseen(axes, fits, WALK, f"walk not seen: at most this, with {100 * LEVEL:.0f} %")
        where = "" if axes in (["x", "y", "z"], [axis_of(channel)]) else f", axes: [{', '.join(axes)}]"
        # a sensor whose section is the filter itself has no section of its own
        bare = channel in analysis.sensors and analysis.sensors[channel].section == "filter"
        indent = "  " if bare else "    "
        lines += [
            f"  channel: {channel}" if bare else f"  {channel}:",
            *([f"{indent}# in doubt: the bias follows the temperature in {', '.join(warmed)}"] if warmed else []),
            f"{indent}noise: {_value_text(noise, units, 'white')}{unseen}",
            f"{indent}bias: {{kind: random_walk, walk: {_value_text(walk, units, 'rate_random_walk')}{where}}}{most}",
        ]
    return "\n".join(lines) + "\n" if any("noise: " in line for line in lines[1:]) else ""


def _of_floor(curve: AllanCurve, noise: float) -> float:
    """Return the walk with which white noise `noise` has the lowest Allan deviation of a curve."""
    return float(np.sqrt(3) / 2 * np.min(curve.allan) ** 2 / noise)


def _unseen(axes: list[str], items: list[Coefficients], k: int, text: str) -> str:
    about = [axis for axis, item in zip(axes, items, strict=True) if item.value[k] == 0]
    which = "" if len(about) == len(axes) else f"{', '.join(about)}: "
    return f"  # {which}{text}" if about else ""


def _value_text(values: list[float], units: DeviationUnits, key: str) -> str:
    unit = units.config(key)
    numbers = np.asarray(values) / float(convert(1.0, unit, units.si[key]))
    if max(numbers) <= ALIKE * min(numbers):
        return f"{np.sqrt(np.mean(numbers**2)):.4g} {unit}"
    return "[" + ", ".join(f"{number:.4g} {unit}" for number in numbers) + "]"


def page_of(analysis: Analysis, sheet: Sheet) -> str:
    """Return the page of an analysis."""
    return page(
        "allan",
        title=f"Allan deviation of {analysis.name}",
        lead=used(analysis),
        result=result_lines(analysis),
        level=f"{100 * LEVEL:.0f}",
        notes=analysis.notes,
        charts=charts(analysis),
        tables=[(channel, analysis.axes[channel], rows(analysis, channel)) for channel in analysis.curves],
        config=config_lines(analysis),
        sheet=sheet,
    )


def used(analysis: Analysis) -> str:
    """Return the part of the recording that was used, in one line."""
    spans, bridged = len(analysis.first.lengths), analysis.first.bridged
    many = f" in {spans} stretches" if spans > 1 else ""
    gaps = f"{len(bridged)} gaps" if len(bridged) > 1 else "1 gap"
    over = f"; {gaps}, bridged for averaging times over {np.max(bridged):.3g} s" if len(bridged) else ""
    share = f"{100 * analysis.used_s / analysis.total_s:.3g} %"
    return f"used {analysis.used_s:,.6g} s of {analysis.total_s:,.6g} s ({share}){many}, {1 / analysis.dt:.6g} Hz{over}"


CAPTION = (
    "Points: overlapping Allan deviation with one standard deviation. Grey points: Hadamard deviation, which no ramp "
    "reaches. Broad: the fit. Dashed: those of its terms that the data show for certain (the walk as the Hadamard "
    "curve has it, where a note says so)."
)


def charts(analysis: Analysis) -> list[Chart]:
    """Return a chart a sensor, a panel an axis: the curves, the fit and its terms."""
    return [_chart(_panels(analysis, channel), f"Deviations of the {channel}") for channel in analysis.curves]


def whole_chart(analysis: Analysis) -> Chart:
    """Return the panels of all sensors in one chart."""
    panels = (panel for channel in analysis.curves for panel in _panels(analysis, channel))
    return _chart(panels, f"Allan deviation of {analysis.name}")


def _chart(panels: Iterable[Panel], title: str) -> Chart:
    return Chart(tuple(panels), "averaging time [s]", title, CAPTION, log=True)


def _panels(analysis: Analysis, channel: str) -> Iterator[Panel]:
    units = units_of(analysis, channel)
    scale = float(convert(1.0, units.deviation, units.deviation_si))
    for axis, c, fit in _each_axis(analysis, channel):
        label = f"deviation of {axis_name(channel, axis)} [{units.deviation}]"
        yield Panel(tuple(_lines(c, fit, scale, names_of(units))), label, log=True, height=1.3)


def _lines(c: AllanCurve, fit: Coefficients, scale: float, names: dict[str, str]) -> Iterator[Line]:
    allan, hadamard = positive(c.allan / scale), positive(c.hadamard / scale)
    floor = np.nanmin([*allan, *hadamard, np.inf]) / 3  # terms go on far below what is measured
    A = design(c, hadamard=False).A
    if np.any(fit.best > 0):
        fitted = np.full(len(c.tau), np.nan)
        fitted[fit.first :] = np.sqrt(A[fit.first :] @ (fit.best * np.abs(fit.best))) / scale
        yield Line(c.tau, fitted, "fit", "reference")
    for k, key in enumerate(KEYS):
        if fit.value[k] > 0:
            term = np.sqrt(A[:, k]) * fit.value[k] / scale
            yield Line(c.tau, np.where(term > floor, term, np.nan), names[key], series(k + 1), style="dashed")
    yield Line(c.tau, hadamard, "Hadamard", "data", style="points")
    spread = np.minimum(fit.spread, 0.9)
    yield Line(c.tau, allan, "Allan, 1 sigma", "estimate", allan * (1 - spread), allan * (1 + fit.spread), "points")


def names_of(units: DeviationUnits) -> dict[str, str]:
    """Return the names of the coefficients of a sensor, each with its letter in IEEE Std 952 and 1293."""
    noise, walk = {
        "rad/s": ("angle random walk (ARW, N)", "rate random walk (RRW, K)"),
        "m/s^2": ("velocity random walk (VRW, N)", "random walk (K)"),
    }.get(units.deviation_si, ("white noise (N)", "random walk (K)"))
    return dict(zip(KEYS, ("quantisation (Q)", noise, "bias instability (B)", walk, "ramp (R)"), strict=True))


def result_lines(analysis: Analysis) -> list[str]:
    """Return the result in a sentence a sensor: N, B and K of its worst axis."""
    lines = []
    for channel in analysis.curves:
        units = units_of(analysis, channel)
        human = dict(units.human)  # of two units for one coefficient the last
        parts = []
        for key in ("white", "bias_instability", "rate_random_walk"):
            k, scale = KEYS.index(key), float(convert(1.0, human[key], units.si[key]))
            worst = max(analysis.coefficients[channel], key=lambda fit: float(fit.value[k] or fit.high[k]))
            cell = _cell(worst, k, scale).partition(" (")[0]
            parts.append(f"{names_of(units)[key]} {cell}{f' {human[key]}' * bool(np.isfinite(worst.high[k]))}")
        lines.append(f"{channel}, worst axis: {', '.join(parts)}.")
    return lines


@dataclass(frozen=True)
class DeviationUnits:
    """The units of a sensor: of its deviation, and of each coefficient in SI and for people (by key)."""

    deviation: str
    deviation_si: str
    si: dict[str, str]
    human: list[tuple[str, str]]

    def config(self, key: str) -> str:
        """Return the unit in which a coefficient is written in a config."""
        return dict(reversed(self.human))[key]


PER = ("/sqrt(Hz)", "", "/sqrt(s)", "/s")  # of a coefficient but the quantisation, after the unit of the sensor


def _units(shown: str, si: str, quantisation: tuple[str, str], white: tuple[str, ...] = ()) -> DeviationUnits:
    """Return the units of a sensor: `quantisation` for people and in SI, `white` for people beside the usual."""
    first, *others = KEYS
    known = [(key, shown + per) for key, per in zip(others, PER, strict=True)]
    human = [(first, quantisation[0]), known[0], *((others[0], unit) for unit in white), *known[1:]]
    in_si = {first: quantisation[1]} | {key: si + per for key, per in zip(others, PER, strict=True)}
    return DeviationUnits(shown, si, in_si, human)


UNITS = {
    "gyro": _units("deg/h", "rad/s", ("arcsec", "rad"), ("deg/sqrt(h)",)),
    "accel": _units("ug", "m/s^2", ("mm/s", "m/s"), ("m/s/sqrt(h)",)),
}


def units_of(analysis: Analysis, channel: str) -> DeviationUnits:
    """Return the units of a channel: those of data sheets for gyros and accelerometers, else its own."""
    sensor, known = analysis.sensors.get(channel), UNITS.get(channel)
    if known is not None and (sensor is None or sensor.unit == known.deviation_si):
        return known
    assert sensor is not None, "what is no triad is a sensor of the config"
    integral = "s" if sensor.unit == "1" else f"{sensor.unit}*s"
    return _units(sensor.shown, sensor.unit, (f"{sensor.shown}*s", integral))
