"""The choice of a map's kind and of a network's size: tables, sentences and charts for people, JSON for programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab import __version__
from driftlab.maps.kind_selection import ERROR_RANGES, KindComparison, Tried
from driftlab.maps.network_size import BINS, PARTS, Convergence, Selection
from driftlab.reports.charts import Chart, Line, Panel, Rule, axis_panels, series
from driftlab.reports.tables import TextTable
from driftlab.units import BiasUnit, with_uncertainty
from fusion_core.chunk import Array

CURVES = 4  # kinds whose curves are drawn
WIDE = 5.0  # between errors that are drawn by their logarithm


def comparison_table(comparison: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> TextTable:
    """Return the chosen kind, then the others from the smallest error on, and no map; without those that failed."""
    chosen, without = comparison.chosen, comparison.without
    cells = []
    for row in [chosen, *(row for row in _by_error(comparison) if row is not chosen), without]:
        name = f"{row.name} *" if row is chosen else row.name
        more = "" if row is without else "smallest" if row is comparison.best else _pm(row.more, row.more_sigma, unit)
        of_axes = [f"{value * unit.factor:.3g}" for value in row.rms] if len(row.rms) > 1 else []
        cells.append([name, _pm(row.error, row.sigma, unit), more, *of_axes])
    of_axes = [f"{axis} [{unit.shown}]" for axis in axes] if len(axes) > 1 else []
    heads = ["kind", f"left-out error [{unit.shown}]", f"above the smallest [{unit.shown}]", *of_axes]
    return TextTable(heads, cells, "left-out error of each kind; * is taken", whole=False, framed=False, width=12)


def failures(comparison: KindComparison) -> list[str]:
    """Return the reasons why kinds could not be fitted, a line each."""
    return [f"{row.name} failed: {row.failed}" for row in comparison.tried if row.failed]


def verdict(comparison: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
    """Return the parts that were left out, the kind to take, and the reasons, a sentence each."""
    chosen, division, without = comparison.chosen, comparison.division, comparison.without
    levels = "a constant of each taken off" if division.levels else (
        "nothing taken off: each temperature was passed once, so what the bias wandered counts as shape"
    )  # fmt: skip
    best = {row.settings.kind: row for row in reversed(_by_error(comparison)) if row.settings is not None}
    errors = [f"{chosen.name}: left-out error {_pm(chosen.error, chosen.sigma, unit)} {unit.shown}"]
    for kind in sorted(best.keys() - {chosen.settings.kind if chosen.settings else ""}):
        errors.append(_beside(comparison, best[kind], unit, axes))
    lines = [
        f"left out in turn: {division.what}; {levels}; scored: {100 * division.share:.0f} % of the samples",
        f"{'; '.join(errors)}; take {chosen.name}",
    ]
    if chosen.error >= without.error:
        lines.append(f"no map does as well ({_pm(without.error, without.sigma, unit)} {unit.shown}): "
                     "temperature explains nothing that lasts")  # fmt: skip
    return lines


def _by_error(comparison: KindComparison) -> list[Tried]:
    """Return the rows that could be fitted, the smallest error first."""
    return sorted((row for row in comparison.tried if not row.failed), key=lambda row: row.error)


def _beside(comparison: KindComparison, row: Tried, unit: BiasUnit, axes: Sequence[str]) -> str:
    """Return the error of the best of another kind."""
    text = f"{row.name}: {_pm(row.error, row.sigma, unit)}"
    if row.error - comparison.chosen.error <= row.more_sigma:
        return f"{text} is not better"
    axis, T = _where(row, comparison)
    return f"{text}, most of it {f'in {axes[axis]} ' if len(axes) > 1 else ''}at {T:.0f} °C"


def _where(row: Tried, comparison: KindComparison) -> tuple[int, float]:
    """Return the axis and the temperature at which a kind is most above the chosen one."""
    assert row.left is not None
    assert comparison.chosen.left is not None
    T, more = comparison.T, row.left**2 - comparison.chosen.left**2
    means, _ = _cell_means(T, more, ERROR_RANGES, np.isfinite(row.left[:, 0]))
    k, axis = np.unravel_index(int(np.argmax(means)), means.shape)
    return int(axis), float(T.min() + (k + 0.5) * np.ptp(T) / ERROR_RANGES)


def _cell_means(T: Array, values: Array, cells: int, rows: Array | None = None) -> tuple[Array, NDArray[np.intp]]:
    """Return the means (cells, n) of values (N, n), or some rows of them, in equal ranges of temperature (N,).

    And how many there are in each; a mean of none is zero.
    """
    cell = np.minimum(((T - T.min()) * (cells / np.ptp(T))).astype(int), cells - 1)
    cell, values = (cell, values) if rows is None else (cell[rows], values[rows])
    count = np.bincount(cell, minlength=cells)
    sums = np.stack([np.bincount(cell, column, cells) for column in values.T], axis=1)
    return sums / np.maximum(count, 1)[:, None], count


def config_line(comparison: KindComparison, path: Path | None = None) -> str:
    """Return the line of a config for the chosen kind, with the path of its map."""
    settings = comparison.chosen.settings
    assert settings is not None
    content = settings.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    content.pop("path", None)
    content |= {} if path is None else {"path": str(path)}
    return f"{{{', '.join(f'{key}: {value}' for key, value in {'kind': settings.kind, **content}.items())}}}"


def comparison_document(comparison: KindComparison, unit: BiasUnit) -> dict[str, Any]:
    """Return the comparison for programs, in SI."""
    return {
        "unit": unit.si,
        "left_out": comparison.division.what,
        "levels_taken_off": comparison.division.levels,
        "scored_share": comparison.division.share,
        "chosen": comparison.chosen.name,
        "config": config_line(comparison),
        "tried": [_as_json(row) for row in comparison.tried],
        "no_map": _as_json(comparison.without),
    }


def _as_json(row: Tried) -> dict[str, Any]:
    settings = None if row.settings is None else row.settings.model_dump(mode="json", exclude_none=True)
    return {
        "name": row.name, "settings": settings, "error": row.error, "error_sigma": row.sigma, "rms": row.rms,
        "above_smallest": row.more, "above_smallest_sigma": row.more_sigma, "freedom": row.freedom,
        "failed": row.failed,
    }  # fmt: skip


def error_bars(comparison: KindComparison, unit: BiasUnit) -> list[dict[str, Any]]:
    """Return a bar a kind, the smallest left-out error first: name, text, and lengths in per cent of the widest.

    `low` and `high` are the ends of its standard error; a bar is cut (`beyond`) at WIDE times the smallest error.
    """
    good = _by_error(comparison)
    widest = min(max(row.error + row.sigma for row in good), WIDE * good[0].error) or 1.0
    return [
        {
            "name": row.name, "added": row is comparison.chosen, "text": _pm(row.error, row.sigma, unit),
            "beyond": row.error > widest,
            **{name: min(100 * max(value, 0.0) / widest, 100.0) for name, value in (
                ("width", row.error), ("low", row.error - row.sigma), ("high", row.error + row.sigma),
            )},
        }
        for row in good
    ]  # fmt: skip


def curve_chart(comparison: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> Chart:
    """Return the means of the samples and the best curve of each other kind, all less the curve of the chosen one."""
    drawn: list[Tried] = [comparison.chosen]
    for row in _by_error(comparison):
        if all(row.settings is None or one.settings is None or row.settings.kind != one.settings.kind for one in drawn):
            drawn.append(row)
    T = np.linspace(comparison.T.min(), comparison.T.max(), 300)
    samples = np.column_stack([comparison.T, comparison.bias])
    means, count = _cell_means(comparison.T, samples, 4 * ERROR_RANGES)
    means = means[count > 0]

    chosen = drawn[0].fitted
    assert chosen is not None

    def lines(axis: int) -> Iterator[Line]:
        inside = np.clip(means[:, 0], *chosen.domain)
        left = means[:, 1 + axis] - chosen.bias(inside)[:, axis]
        yield Line(means[:, 0], left * unit.factor, "samples, means", "data", style="points")
        for k, row in enumerate(drawn[:CURVES]):
            assert row.fitted is not None
            less = row.fitted.bias(T)[:, axis] - chosen.bias(T)[:, axis]
            yield Line(T, less * unit.factor, row.name, series(k))

    panels = axis_panels(axes, lines, "less the chosen", unit.shown, legibly=True)
    return Chart(panels, "temperature [°C]", f"Kinds less {drawn[0].name}")


def section(comparison: KindComparison, unit: BiasUnit, axes: Sequence[str]) -> dict[str, Any]:
    """Return the section of a page: its sentences, its table and its charts."""
    return {
        "sentences": [*verdict(comparison, unit, axes), *failures(comparison)],
        "table": comparison_table(comparison, unit, axes),
        "bars": error_bars(comparison, unit),
        "charts": [curve_chart(comparison, unit, axes)],
    }


def _pm(value: float, sigma: float, unit: BiasUnit) -> str:
    return with_uncertainty(value * unit.factor, sigma * unit.factor)


TITLES = {"bias": "bias (standard filter)", "slope": "derivative of the bias (TCZUPT)"}


def selection_document(selection: Selection, unit: BiasUnit) -> dict[str, Any]:
    """Return the content of `select.json`, in SI."""
    rms, slope = "test_derivative_rms", f"{unit.si}/K"

    def by_part(values: Array) -> dict[str, Any]:
        return dict(zip(PARTS, values, strict=True))

    return {
        "schema": 1,
        "driftlab": __version__,
        "seed": selection.seed,
        "bins": BINS,
        "samples": dict(zip(PARTS, selection.samples, strict=True)),
        "neurons": selection.bias.neurons,
        **{
            target.target: {
                "unit": si,
                "chosen": target.chosen,
                "validation_limit": target.limit,
                "Sr": by_part(target.Sr.T),
                "noise": dict(zip(PARTS, target.noise, strict=True)),
            }
            for target, si in ((selection.bias, unit.si), (selection.slope, slope))
        },
        "slope_of_the_bias_networks": {"unit": slope, "Sr": by_part(selection.analytic.T)},
        f"{rms}_rad_s_K" if unit.si == "rad/s" else rms: {
            "slope_network": selection.slope_network,
            "analytic_slope": selection.analytic_slope,
            "between_the_two": selection.between,
        },
    }


def _unit_text(target: str, unit: BiasUnit) -> str:
    return unit.shown if target == "bias" else f"{unit.shown}/K"


def _number_of(unit: BiasUnit) -> Callable[[float, str], str]:
    """Return the text of a value in SI, of a width."""
    digits = ".3f" if unit.digits == ".2f" else unit.digits
    return lambda value, width: f"{value * unit.factor:{width}{digits}}"


def selection_table(selection: Selection, unit: BiasUnit) -> TextTable:
    """Return Sr of every size; * marks the chosen one of each target."""
    number = _number_of(unit)
    heads = [f"{target} {part}\n{_unit_text(target, unit)}" for target in TITLES for part in PARTS]
    cells = []
    for k, n in enumerate(selection.bias.neurons):
        row = [str(n)]
        for target in (selection.bias, selection.slope):
            train, validation, test = (number(value, "") for value in target.Sr[k])
            row += [train, f"{validation}{'*' if n == target.chosen else ' '}", test]
        cells.append(row)
    title = "Sr, eq. (12); * is chosen"
    return TextTable(["n", *heads], cells, title, texts=0, whole=False, framed=False)


def comparison(selection: Selection, unit: BiasUnit) -> list[str]:
    """Return the derivative network beside the analytic slope of the bias network, in lines."""
    number = _number_of(unit)
    errors = {
        f"derivative network, n = {selection.slope.chosen}": selection.slope_network,
        f"slope of the bias network, n = {selection.bias.chosen}": selection.analytic_slope,
        "one less the other": selection.between,
    }
    return [
        f"derivative against the test part's difference quotients, rms of each axis in {unit.shown}/K:",
        *(f"  {name:<34}" + "".join(number(value, "9") for value in values) for name, values in errors.items()),
    ]


def chart(selection: Selection, unit: BiasUnit) -> Chart:
    """Return Sr against the number of neurons, as figures 7 and 8 of the paper."""
    panels = (_panel(selection.bias, None, unit), _panel(selection.slope, selection.analytic, unit))
    return Chart(panels, "neurons in each hidden layer, n [1]", "Sr of every size of the network")


def _panel(target: Convergence, analytic: Array | None, unit: BiasUnit) -> Panel:
    n, Sr = np.array(target.neurons, dtype=np.float64), target.Sr * unit.factor
    lines = [Line(n, Sr[:, k], part, series(k)) for k, part in enumerate(PARTS)]
    if analytic is not None:
        slope = analytic[:, 1] * unit.factor
        lines.append(Line(n, slope, "bias network's slope, validation", series(1), style="dashed"))
    at = target.neurons.index(target.chosen)
    lines.append(Line(n[[at]], Sr[[at], 1], "chosen", "reached", style="points"))
    noise = float(target.noise[1]) * unit.factor
    rule = Rule(noise, f"noise of the validation part; chosen: {target.chosen}", "sigma")
    label = f"Sr of the {TITLES[target.target]} [{_unit_text(target.target, unit)}]"
    return Panel(tuple(lines), label, rules=(rule,), log=True, height=1.6)
