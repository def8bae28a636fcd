"""The comparison of kinds of maps: for people as a table, a sentence and a chart, for programs as JSON.

The selection of a network's size: for people as a table and a figure, for programs as JSON.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.maps.kind_selection import ERROR_RANGES, KindComparison, Tried
from driftlab.maps.network_size import BINS, PARTS, Convergence, Selection
from driftlab.reports.charts import Chart, Line, Panel, Rule, series
from driftlab.reports.figures import figure_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.figure import Figure
    from rich.table import Table

    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array


CURVES = 4  # kinds whose curves are drawn
WIDE = 5.0  # between errors that are drawn by their logarithm


def columns(axes: Sequence[str], unit: BiasUnit) -> list[str]:
    """Return the heads of the columns of `rows`."""
    of_axes = [f"{axis} [{unit.shown}]" for axis in axes] if len(axes) > 1 else []
    return ["kind", f"left-out error [{unit.shown}]", f"above the smallest [{unit.shown}]", *of_axes]


def rows(found: KindComparison, unit: BiasUnit) -> list[list[str]]:
    """Return the cells of the table: the chosen kind, then the others from the smallest error on, no map, failures."""
    others = sorted((row for row in found.tried if row is not found.chosen), key=lambda row: row.error)
    table = []
    for row in [found.chosen, *others, found.without]:
        if row.failed:
            continue
        name = f"{row.name} *" if row is found.chosen else row.name
        more = "" if row is found.without else "smallest" if row is found.best else _pm(row.more, row.more_sigma, unit)
        of_axes = [_said(value, unit) for value in row.rms] if len(row.rms) > 1 else []
        table.append([name, _pm(row.error, row.sigma, unit), more, *of_axes])
    return table


def comparison_table(found: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> Table:
    """Return the table for a terminal."""
    from rich import box
    from rich.table import Table

    result = Table(box=box.SIMPLE_HEAD, title="left-out error of each kind; * is taken", title_justify="left")
    for k, name in enumerate(columns(axes, unit)):
        result.add_column(name, justify="right" if k else "left", min_width=0 if k else 12)
    for row in rows(found, unit):
        result.add_row(*row)
    return result


def failures(found: KindComparison) -> list[str]:
    """Return why kinds could not be fitted, a line each."""
    return [f"{row.name} failed: {row.failed}" for row in found.tried if row.failed]


def verdict(found: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
    """Return what was left out, which kind to take and why, a sentence each."""
    chosen, division = found.chosen, found.division
    levels = "a constant of each taken off" if division.levels else (
        "nothing taken off: each temperature was passed once, so what the bias wandered counts as shape"
    )  # fmt: skip
    lines = [f"left out in turn: {division.what}; {levels}; scored: {100 * division.share:.0f} % of the samples"]
    said = [f"{chosen.name}: left-out error {_pm(chosen.error, chosen.sigma, unit)} {unit.shown}"]
    kinds = {row.settings.kind for row in found.tried if row.settings is not None and not row.failed}
    for kind in sorted(kinds - {chosen.settings.kind if chosen.settings else ""}):
        said.append(_beside(found, kind, unit, axes))
    lines.append(f"{'; '.join(said)}; take {chosen.name}")
    if chosen.error >= found.without.error:
        lines.append(f"no map does as well ({_pm(found.without.error, found.without.sigma, unit)} {unit.shown}): "
                     "temperature explains nothing that lasts")  # fmt: skip
    return lines


def _beside(found: KindComparison, kind: str, unit: BiasUnit, axes: Sequence[str]) -> str:
    """Return how the best of another kind does."""
    own = [row for row in found.tried if row.settings is not None and row.settings.kind == kind and not row.failed]
    row = min(own, key=lambda row: row.error)
    text = f"{row.name}: {_pm(row.error, row.sigma, unit)}"
    if row.error - found.chosen.error <= row.more_sigma:
        return f"{text} is not better"
    axis, T = _where(row, found)
    return f"{text}, most of it {f'in {axes[axis]} ' if len(axes) > 1 else ''}at {T:.0f} °C"


def _where(row: Tried, found: KindComparison) -> tuple[int, float]:
    """Return the axis and the temperature at which a kind is most above the chosen one."""
    assert row.left is not None
    assert found.chosen.left is not None
    cell = np.minimum(((found.T - found.T.min()) * (ERROR_RANGES / np.ptp(found.T))).astype(int), ERROR_RANGES - 1)
    scored = np.isfinite(row.left[:, 0])
    count = np.maximum(np.bincount(cell[scored], minlength=ERROR_RANGES), 1)
    more = row.left**2 - found.chosen.left**2
    means = np.stack([np.bincount(cell[scored], column[scored], ERROR_RANGES) / count for column in more.T], axis=1)
    k, axis = np.unravel_index(int(np.argmax(means)), means.shape)
    return int(axis), float(found.T.min() + (k + 0.5) * np.ptp(found.T) / ERROR_RANGES)


def config_line(found: KindComparison, path: Path | None = None) -> str:
    """Return what to write in a config for the chosen kind, and where its map is."""
    assert found.chosen.settings is not None
    content = found.chosen.settings.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    content.pop("path", None)
    content |= {} if path is None else {"path": str(path)}
    pairs = ", ".join(f"{key}: {value}" for key, value in {"kind": found.chosen.settings.kind, **content}.items())
    return f"{{{pairs}}}"


def comparison_document(found: KindComparison, unit: BiasUnit) -> dict[str, Any]:
    """Return the comparison for programs, in SI."""
    return {
        "unit": unit.si,
        "left_out": found.division.what,
        "levels_taken_off": found.division.levels,
        "scored_share": found.division.share,
        "chosen": found.chosen.name,
        "config": config_line(found),
        "tried": [_as_json(row) for row in found.tried],
        "no_map": _as_json(found.without),
    }


def _as_json(row: Tried) -> dict[str, Any]:
    settings = None if row.settings is None else row.settings.model_dump(mode="json", exclude_none=True)
    return {
        "name": row.name, "settings": settings, "error": row.error, "error_sigma": row.sigma, "rms": row.rms,
        "above_smallest": row.more, "above_smallest_sigma": row.more_sigma, "freedom": row.freedom,
        "failed": row.failed,
    }  # fmt: skip


def error_chart(found: KindComparison, unit: BiasUnit) -> Chart:
    """Return the left-out error of each kind with its standard error, from the smallest on."""
    good = sorted((row for row in found.tried if not row.failed), key=lambda row: row.error)
    at = np.arange(1, len(good) + 1, dtype=np.float64)
    error = np.array([row.error for row in good]) * unit.factor
    sigma = np.array([row.sigma for row in good]) * unit.factor
    taken = np.array([row is found.chosen for row in good])
    lines = (
        Line(at, error, "left-out error", "estimate", low=np.maximum(error - sigma, error / 10), high=error + sigma,
             style="points"),
        Line(at[taken], error[taken], f"taken: {found.chosen.name}", "reached", style="points"),
    )  # fmt: skip
    names = "; ".join(f"{k} {row.name}" for k, row in enumerate(good, start=1))
    return Chart(
        (Panel(lines, f"left-out error [{unit.shown}]", log=bool(error.max() > WIDE * error.min())),),
        "kind",
        "Left-out error of each kind",
        caption=f"With one standard error. {names}.",
    )  # fmt: skip


def curve_chart(found: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> Chart:
    """Return the curves of the chosen kind and of the best of each other kind, over means of the samples."""
    drawn: list[Tried] = [found.chosen]
    for row in sorted((row for row in found.tried if not row.failed), key=lambda row: row.error):
        if all(row.settings is None or one.settings is None or row.settings.kind != one.settings.kind for one in drawn):
            drawn.append(row)
    T = np.linspace(found.T.min(), found.T.max(), 300)
    means_T, means = _means(found)
    panels = []
    for axis, name in enumerate(axes):
        lines = [Line(means_T, means[:, axis] * unit.factor, "samples, means", "data", style="points")]
        for k, row in enumerate(drawn[:CURVES]):
            assert row.fitted is not None
            lines.append(Line(T, row.fitted.bias(T)[:, axis] * unit.factor, row.name, series(k)))
        panels.append(Panel(tuple(lines), f"bias {name} [{unit.shown}]"))
    return Chart(tuple(panels), "temperature [°C]", "Curves of the kinds")


def section(found: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> dict[str, Any]:
    """Return the section of a page: its sentences, its table and its charts."""
    return {
        "sentences": [*verdict(found, unit, axes), *failures(found)],
        "columns": columns(axes, unit),
        "rows": rows(found, unit),
        "charts": [error_chart(found, unit), curve_chart(found, unit, axes)],
    }


def _means(found: KindComparison) -> tuple[Array, Array]:
    cells = 4 * ERROR_RANGES
    cell = np.minimum(((found.T - found.T.min()) * (cells / np.ptp(found.T))).astype(int), cells - 1)
    count = np.bincount(cell, minlength=cells)
    full = count > 0
    means = [np.bincount(cell, column, cells)[full] / count[full] for column in (found.T, *found.bias.T)]
    return means[0], np.stack(means[1:], axis=1)


def _said(value: float, unit: BiasUnit) -> str:
    return f"{value * unit.factor:.3g}"


def _pm(value: float, sigma: float, unit: BiasUnit) -> str:
    """Return a value and its standard error, to two digits of the latter."""
    own, other = value * unit.factor, sigma * unit.factor
    if not other > 0:
        return f"{own:.3g}"
    digits = int(np.clip(1 - np.floor(np.log10(other)), 0, 12))
    if abs(own) < 1e-4 or abs(own) >= 1e6:
        return f"{own:.3g} ± {other:.1g}"
    return f"{own:.{digits}f} ± {other:.{digits}f}"


TITLES = {"bias": "bias (standard filter)", "slope": "derivative of the bias (TCZUPT)"}


def selection_document(selection: Selection, unit: BiasUnit) -> dict[str, Any]:
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


def selection_table(selection: Selection, unit: BiasUnit) -> Table:
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
