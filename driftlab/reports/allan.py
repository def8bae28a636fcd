"""What an Allan analysis shows: a table, lines for a config, JSON, a figure and a page.

The curves of an Allan analysis as charts: for its page, for notebooks, and for `allan.svg`.

In which units an Allan analysis is shown, and what its terms are called.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.noise.allan_fit import LEVEL
from driftlab.noise.allan_model import KEYS, WALK, design
from driftlab.reports.charts import Chart, Line, Panel, series
from driftlab.reports.figures import figure_of, svg
from driftlab.reports.pages import write_page
from driftlab.units import axis_name
from fusion_core.contracts import axis_of
from fusion_core.units import convert

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.figure import Figure
    from rich.table import Table

    from driftlab.noise.allan_fit import Coefficients
    from driftlab.noise.allan_model import AllanCurve
    from driftlab.noise.recording import Analysis
    from driftlab.reports.provenance import Sheet
    from fusion_core.chunk import Array


ALIKE = 1.2  # axes that differ by less than this factor share one value in a config
WHITE = KEYS.index("white")


def document(found: Analysis, *, curves: bool = True) -> dict[str, Any]:
    """Return the analysis as JSON holds it: coefficients in SI with their limits, and the curves."""
    content: dict[str, Any] = {
        "schema": 1,
        "driftlab": __version__,
        "recording": found.name,
        "plugins": found.plugins,
        "recording_s": found.total_s,
        "used_s": found.used_s,
        "stretches": found.stretches,
        "longest_stretch_s": float(np.max(found.first.stretches)) * found.dt,
        "gaps_bridged": len(found.first.bridged),
        "bridged_from_s": float(np.max(found.first.bridged)) if len(found.first.bridged) else None,
        "start_s": found.start_s,
        "sample_interval_s": found.dt,
        "confidence": LEVEL,
    }
    for channel, items in found.coefficients.items():
        si = units_of(found, channel).si
        content[channel] = {
            axis: {
                key: {"value": item.value[k], "low": item.low[k], "high": item.high[k], "unit": si[key]}
                for k, key in enumerate(KEYS)
            }
            for axis, item in zip(found.axes[channel], items, strict=True)
        }
    content |= {"notes": found.notes, "config": config_lines(found)}
    if curves:
        content["curves"] = {channel: _curves(found, channel) for channel in found.curves}
    return content


def _curves(found: Analysis, channel: str) -> dict[str, Any]:
    axes = zip(found.axes[channel], found.curves[channel], found.coefficients[channel], strict=True)
    return {"unit": units_of(found, channel).deviation_si} | {
        axis: {
            "fitted_from_s": c.tau[item.first],
            "tau_s": c.tau,
            "allan": c.allan,
            "allan_sigma": c.allan * item.spread,
            "hadamard": c.hadamard,
            "every": c.stride,
            "stretches": c.counts,
            "used_s": c.used,
        }
        for axis, c, item in axes
    }


def table(found: Analysis, channel: str) -> Table:
    """Return the coefficients of a triad, axes as columns, in the units of data sheets."""
    from rich.table import Table
    from rich.text import Text

    title = f"{channel}: value and {100 * LEVEL:.0f} % limits"
    result = Table(title=title, title_justify="left")
    result.add_column("", no_wrap=True)
    for axis in found.axes[channel]:
        result.add_column(axis, justify="right", no_wrap=True)
    for name, unit, cells in rows(found, channel):
        result.add_row(Text(f"{name}\n[{unit}]"), *(cell.replace(" (", "\n(").replace(" to ", "–") for cell in cells))
    return result


def rows(found: Analysis, channel: str) -> list[tuple[str, str, list[str]]]:
    """Return the rows of the table: name, unit, a cell an axis."""
    units = units_of(found, channel)
    result = []
    for key, unit in units.human:
        k = KEYS.index(key)
        scale = float(convert(1.0, unit, units.si[key]))
        cells = [_cell(item, k, scale) for item in found.coefficients[channel]]
        result.append((NAMES[key], unit, cells))
    return result


def _cell(item: Coefficients, k: int, scale: float) -> str:
    value, low, high = (v[k] / scale for v in (item.value, item.low, item.high))
    if high == 0:
        return "-"
    return f"{_digits(value)} ({_digits(low)} to {_digits(high)})" if value > 0 else f"< {_digits(high)}"


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"


def config_lines(found: Analysis) -> str:
    """Return the lines to paste into a config: `noise` and `bias` of each triad, one value or one an axis.

    Where the walk cannot be seen it is the largest that the floor allows, sqrt(3)/2 floor^2 / noise, or the fit's upper
    limit where that is lower.
    """
    lines = ["filter:"]
    for channel, items in found.coefficients.items():
        if any(item.high[WHITE] == 0 for item in items):
            lines.append(f"  # {channel}: no coefficient could be fitted")
            continue
        axes, units = found.axes[channel], units_of(found, channel)
        noise = [float(item.value[WHITE] or item.high[WHITE]) for item in items]
        walk = [
            float(item.value[WALK] or min(np.sqrt(3) / 2 * np.min(c.allan) ** 2 / n, item.high[WALK]))
            for item, c, n in zip(items, found.curves[channel], noise, strict=True)
        ]
        unseen = _unseen(axes, items, WHITE, "white noise not seen: its upper limit")
        floor = _unseen(axes, items, WALK, "walk not seen: at most this, by the floor of the curve")
        where = "" if axes in (["x", "y", "z"], [axis_of(channel)]) else f", axes: [{', '.join(axes)}]"
        own = [
            f"noise: {_written(noise, units, 'white')}{unseen}",
            f"bias: {{kind: random_walk, walk: {_written(walk, units, 'rate_random_walk')}{where}}}{floor}",
        ]
        if channel in found.sensors and found.sensors[channel].section == "filter":  # it has no section of its own
            lines += [f"  channel: {channel}", *(f"  {line}" for line in own)]
        else:
            lines += [f"  {channel}:", *(f"    {line}" for line in own)]
    return "\n".join(lines) + "\n" if any("noise: " in line for line in lines[1:]) else ""


def _unseen(axes: list[str], items: list[Coefficients], k: int, text: str) -> str:
    about = [axis for axis, item in zip(axes, items, strict=True) if item.value[k] == 0]
    which = "" if len(about) == len(axes) else f"{', '.join(about)}: "
    return f"  # {which}{text}" if about else ""


def _written(values: list[float], units: DeviationUnits, key: str) -> str:
    unit = units.config(key)
    numbers = np.asarray(values) / float(convert(1.0, unit, units.si[key]))
    if max(numbers) <= ALIKE * min(numbers):
        return f"{np.sqrt(np.mean(numbers**2)):.4g} {unit}"
    return "[" + ", ".join(f"{number:.4g} {unit}" for number in numbers) + "]"


def figure(found: Analysis) -> Figure:
    """Draw the curves with one standard deviation, the Hadamard deviation, the fit and each of its terms."""
    return figure_of(whole_chart(found))


def write_results(
    folder: Path, found: Analysis, sheet: Sheet, limits: list[dict[str, Any]], write_json: Callable[[Path, Any], None]
) -> None:
    """Write allan.json, summary.json, allan.svg and report.html; `limits` are as JSON holds them."""
    more = {"serial": sheet.serial or None, "limits": limits}
    write_json(folder / "allan.json", document(found) | more)
    write_json(folder / "summary.json", document(found, curves=False) | more)
    (folder / "allan.svg").write_text(svg(figure(found)) + "\n", encoding="utf-8")
    write_page(
        folder / "report.html",
        "allan",
        title=f"Allan deviation of {found.name}",
        lead=used(found),
        level=f"{100 * LEVEL:.0f}",
        notes=found.notes,
        charts=charts(found),
        tables=[(channel, found.axes[channel], rows(found, channel)) for channel in found.curves],
        config=config_lines(found),
        sheet=sheet,
    )


def used(found: Analysis) -> str:
    """Return which part of the recording was used, in one line."""
    spans, bridged = len(found.first.lengths), found.first.bridged
    many = f" in {spans} stretches" if spans > 1 else ""
    gaps = f"{len(bridged)} gaps" if len(bridged) > 1 else "1 gap"
    over = f"; {gaps}, bridged for averaging times over {np.max(bridged):.3g} s" if len(bridged) else ""
    return (
        f"used {found.used_s:,.6g} s of {found.total_s:,.6g} s ({100 * found.used_s / found.total_s:.3g} %){many}, "
        f"{1 / found.dt:.6g} Hz{over}"
    )


CAPTION = (
    "Points: overlapping Allan deviation with one standard deviation. Grey points: Hadamard deviation, which no ramp "
    "reaches. Broad: the fit. Dashed: those of its terms that the data show for certain (the walk as the Hadamard "
    "curve has it, where a note says so)."
)


def charts(found: Analysis) -> list[Chart]:
    """Return a chart a sensor, a panel an axis: the curves, the fit and its terms."""
    return [
        Chart(tuple(_panels(found, channel)), "averaging time [s]", f"Deviations of the {channel}", CAPTION, log=True)
        for channel in found.curves
    ]


def whole_chart(found: Analysis) -> Chart:
    """Return the panels of all sensors in one chart."""
    panels = tuple(panel for channel in found.curves for panel in _panels(found, channel))
    return Chart(panels, "averaging time [s]", f"Allan deviation of {found.name}", CAPTION, log=True)


def _panels(found: Analysis, channel: str) -> Iterator[Panel]:
    units = units_of(found, channel)
    scale = float(convert(1.0, units.deviation, units.deviation_si))
    axes = zip(found.axes[channel], found.curves[channel], found.coefficients[channel], strict=True)
    for axis, c, item in axes:
        label = f"deviation of {axis_name(channel, axis)} [{units.deviation}]"
        yield Panel(tuple(_lines(c, item, scale)), label, log=True, height=1.3)


def _lines(c: AllanCurve, item: Coefficients, scale: float) -> Iterator[Line]:
    allan, hadamard = _positive(c.allan / scale), _positive(c.hadamard / scale)
    floor = np.nanmin([*allan, *hadamard, np.inf]) / 3  # terms go on far below what is measured
    A = design(c, hadamard=False).A
    if np.any(item.best > 0):
        fitted = np.sqrt(A @ item.best**2) / scale
        fitted[: item.first] = np.nan
        yield Line(c.tau, fitted, "fit", "reference")
    for k, key in enumerate(KEYS):
        if item.value[k] > 0:
            term = np.sqrt(A[:, k]) * item.value[k] / scale
            yield Line(c.tau, np.where(term > floor, term, np.nan), NAMES[key], series(k + 1), style="dashed")
    yield Line(c.tau, hadamard, "Hadamard", "data", style="points")
    spread = np.minimum(item.spread, 0.9)
    yield Line(c.tau, allan, "Allan, 1 sigma", "estimate", allan * (1 - spread), allan * (1 + item.spread), "points")


def _positive(values: Array) -> Array:
    """Return values that a logarithm can show."""
    return np.where(values > 0, values, np.nan)


NAMES = dict(zip(KEYS, ("quantisation", "white noise", "bias instability", "random walk", "ramp"), strict=True))


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


UNITS = {
    "gyro": DeviationUnits(
        "deg/h",
        "rad/s",
        dict(zip(KEYS, ("rad", "rad/s/sqrt(Hz)", "rad/s", "rad/s/sqrt(s)", "rad/s/s"), strict=True)),
        [
            ("quantization", "arcsec"), ("white", "deg/h/sqrt(Hz)"), ("white", "deg/sqrt(h)"),
            ("bias_instability", "deg/h"), ("rate_random_walk", "deg/h/sqrt(s)"), ("rate_ramp", "deg/h/s"),
        ],
    ),
    "accel": DeviationUnits(
        "ug",
        "m/s^2",
        dict(zip(KEYS, ("m/s", "m/s^2/sqrt(Hz)", "m/s^2", "m/s^2/sqrt(s)", "m/s^2/s"), strict=True)),
        [
            ("quantization", "mm/s"), ("white", "ug/sqrt(Hz)"), ("white", "m/s/sqrt(h)"),
            ("bias_instability", "ug"), ("rate_random_walk", "ug/sqrt(s)"), ("rate_ramp", "ug/s"),
        ],
    ),
}  # fmt: skip
PER = ("*s", "/sqrt(Hz)", "", "/sqrt(s)", "/s")  # of a coefficient, after the unit of the sensor


def units_of(found: Analysis, channel: str) -> DeviationUnits:
    """Return the units of a channel: those of data sheets for gyros and accelerometers, else its own."""
    sensor, known = found.sensors.get(channel), UNITS.get(channel)
    if known is not None and (sensor is None or sensor.unit == known.deviation_si):
        return known
    assert sensor is not None, "what is no triad is a sensor of the config"
    si = {
        key: "s" if sensor.unit == "1" and per == "*s" else sensor.unit + per
        for key, per in zip(KEYS, PER, strict=True)
    }
    return DeviationUnits(
        sensor.shown, sensor.unit, si, [(key, sensor.shown + per) for key, per in zip(KEYS, PER, strict=True)]
    )
