"""The selection of a network's size: for people as a table and a figure, for programs as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.maps.network_size import BINS, PARTS, Convergence, Selection
from driftlab.reports.charts import Chart, Line, Panel, Rule, series
from driftlab.reports.drawing import figure_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array

TITLES = {"bias": "bias (standard filter)", "slope": "derivative of the bias (TCZUPT)"}


def as_json(selection: Selection, unit: BiasUnit) -> dict[str, Any]:
    """Return the content of `select.json`, in SI."""
    rms = "test_derivative_rms"
    content: dict[str, Any] = {
        "schema": 1,
        "driftlab": __version__,
        "seed": selection.seed,
        "bins": BINS,
        "samples": dict(zip(PARTS, selection.samples, strict=True)),
        "neurons": selection.bias.neurons,
    }
    for found, si in ((selection.bias, unit.si), (selection.slope, f"{unit.si}/K")):
        content[found.target] = {
            "unit": si,
            "chosen": found.chosen,
            "validation_limit": found.limit,
            "Sr": _columns(found.Sr),
            "noise": dict(zip(PARTS, found.noise, strict=True)),
        }
    content["slope_of_the_bias_networks"] = {"unit": f"{unit.si}/K", "Sr": _columns(selection.analytic)}
    content[f"{rms}_rad_s_K" if unit.si == "rad/s" else rms] = {
        "slope_network": selection.slope_network,
        "analytic_slope": selection.analytic_slope,
        "between_the_two": selection.between,
    }
    return content


def _shown(target: str, unit: BiasUnit) -> str:
    return unit.shown if target == "bias" else f"{unit.shown}/K"


def _digits(unit: BiasUnit) -> str:
    return ".3f" if unit.digits == ".2f" else unit.digits


def _columns(Sr: Array) -> dict[str, Array]:
    return dict(zip(PARTS, Sr.T, strict=True))


def table(selection: Selection, unit: BiasUnit) -> Table:
    """Return Sr of every size; * marks the chosen one of each target."""
    from rich import box
    from rich.table import Table

    result = Table(box=box.SIMPLE_HEAD, title="Sr, eq. (12); * is chosen", title_justify="left")
    result.add_column("n", justify="right")
    for target, part in ((target, part) for target in TITLES for part in PARTS):
        result.add_column(f"{target} {part}\n{_shown(target, unit)}", justify="right")
    for k, n in enumerate(selection.bias.neurons):
        cells = []
        for found in (selection.bias, selection.slope):
            mark = "*" if n == found.chosen else " "
            values = [f"{value * unit.factor:{_digits(unit)}}" for value in found.Sr[k]]
            cells += [values[0], f"{values[1]}{mark}", values[2]]
        result.add_row(str(n), *cells)
    return result


def comparison(selection: Selection, unit: BiasUnit) -> list[str]:
    """Return the derivative network beside the analytic slope of the bias network, in lines."""
    rows = (
        (f"derivative network, n = {selection.slope.chosen}", selection.slope_network),
        (f"slope of the bias network, n = {selection.bias.chosen}", selection.analytic_slope),
        ("one less the other", selection.between),
    )
    lines = [f"derivative against the test part's difference quotients, rms of each axis in {unit.shown}/K:"]
    return lines + [
        f"  {name:<34}" + "".join(f"{value * unit.factor:9{_digits(unit)}}" for value in values)
        for name, values in rows
    ]


def figure(selection: Selection, unit: BiasUnit) -> Figure:
    """Draw `chart` by matplotlib."""
    return figure_of(chart(selection, unit))


def chart(selection: Selection, unit: BiasUnit) -> Chart:
    """Return Sr against the number of neurons, as figures 7 and 8 of the paper."""
    panels = (_panel(selection.bias, None, unit), _panel(selection.slope, selection.analytic, unit))
    return Chart(panels, "neurons in each hidden layer, n [1]", "Sr of every size of the network")


def _panel(found: Convergence, analytic: Array | None, unit: BiasUnit) -> Panel:
    n = np.array(found.neurons, dtype=np.float64)
    lines = [Line(n, found.Sr[:, k] * unit.factor, part, series(k)) for k, part in enumerate(PARTS)]
    if analytic is not None:
        lines.append(
            Line(n, analytic[:, 1] * unit.factor, "bias network's slope, validation", series(1), style="dashed")
        )
    at = found.neurons.index(found.chosen)
    lines.append(Line(n[[at]], found.Sr[[at], 1] * unit.factor, "chosen", "reached", style="points"))
    noise = Rule(float(found.noise[1]) * unit.factor, f"noise of the validation part; chosen: {found.chosen}", "sigma")
    label = f"Sr of the {TITLES[found.target]} [{_shown(found.target, unit)}]"
    return Panel(tuple(lines), label, rules=(noise,), log=True, height=1.6)
