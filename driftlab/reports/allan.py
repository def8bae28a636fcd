"""What an Allan analysis shows: a table, lines for a config, JSON, a figure and a page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.noise.fit import LEVEL
from driftlab.noise.model import KEYS, WALK
from driftlab.reports.allan_charts import charts, whole_chart
from driftlab.reports.allan_units import NAMES, Units, units_of
from driftlab.reports.drawing import figure_of, svg
from driftlab.reports.pages import write_page
from fusion_core.contracts import axis_of
from fusion_core.units import convert

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from driftlab.noise.deviation import Analysis
    from driftlab.noise.fit import Coefficients
    from driftlab.reports.sheet import Sheet

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


def _written(values: list[float], units: Units, key: str) -> str:
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
