"""The report of a run: one HTML file that opens without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from driftlab.judging.overview import Overview
from driftlab.judging.ranking import duration
from driftlab.judging.summary import error_rows, remarks, too_much
from driftlab.judging.yardsticks import Yardsticks
from driftlab.reports.pages import write_page
from driftlab.reports.run_charts import bias_chart, error_chart, map_chart, nis_chart
from driftlab.reports.sections import sections
from driftlab.reports.sheet import Sheet
from driftlab.units import BiasUnit, unit_of
from fusion_core.contracts import FittedMap, MeasurementModel, Sensor
from fusion_core.moments import moment


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


def _rows(yardsticks: Yardsticks, unit: BiasUnit) -> list[tuple[str, list[str]]]:
    return [
        (label, [_number(v * unit.factor, unit.digits) for v in values])
        for label, (values,) in error_rows([yardsticks])
    ]


def _headings(yardsticks: Yardsticks, sensor: Sensor) -> list[str]:
    """Return the heading error of each horizon, of a gyro."""
    if sensor.integral is None:
        return []
    return [f"{name} {_number(np.rad2deg(v), '.2f')}" for name, v in yardsticks.heading.items()]


def _number(value: float, spec: str) -> str:
    return f"{value:{spec}}" if np.isfinite(value) else "–"
