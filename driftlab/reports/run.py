"""The report of a run: one HTML file that opens without a network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from driftlab.judging.overview import Overview
from driftlab.judging.summary import error_rows, remarks
from driftlab.judging.yardsticks import Yardsticks
from driftlab.reports.pages import drawing, write_page
from driftlab.reports.plots import bias_figure, innovation_figure, svg
from driftlab.reports.sections import sections
from driftlab.units import BiasUnit, unit_of
from fusion_core.contracts import MeasurementModel, Sensor
from fusion_core.moments import moment


def write_report(
    path: Path,
    overview: Overview,
    summary: dict[str, Any],
    *,
    title: str,
    config: str,
    model: MeasurementModel,
) -> None:
    """Write `report.html` of one run."""
    nis, t, yardsticks = summary["nis"], summary["t"], overview.yardsticks
    sensor, unit = model.tracked, unit_of(model.tracked)
    bounds = f"{'within' if nis['consistent'] else 'outside'} its bounds {nis['low']:.3f} to {nis['high']:.3f}"
    judged = np.isfinite(nis["mean_per_component"])
    write_page(
        path,
        "report",
        title=title,
        lead=f"{summary['updates']['count']:,} updates over {_duration(t['end_s'] - t['start_s'])}, "
        f"aligned at {moment(t['aligned_s'], t['first_row_s'])}",
        remarks=remarks(summary, model),
        bias_svg=drawing(svg(bias_figure({"": overview.curves}, sensor, overview.first_row))),
        nis_svg=drawing(svg(innovation_figure(overview, model.m))),
        channel=sensor.channel,
        earth=sensor.integral is not None,
        columns=[(axis, text) for text, _, _ in unit.columns for axis in sensor.axes],
        rows=_rows(yardsticks, unit),
        nis=f"{nis['mean_per_component']:.3f}, {bounds}" if judged else "not known, no update was used",
        whiteness=", ".join(
            f"{name} {_number(p, '.2g')}" for name, p in zip(summary["states"], summary["whiteness_p"], strict=False)
        ),
        headings=_headings(yardsticks, sensor),
        config=config,
        sections=sections(summary, overview.curves),
    )


def _rows(yardsticks: Yardsticks, unit: BiasUnit) -> list[tuple[str, list[str]]]:
    return [
        (label, [_number(v * factor, spec) for _, factor, spec in unit.columns for v in values])
        for label, (values,) in error_rows([yardsticks])
    ]


def _headings(yardsticks: Yardsticks, sensor: Sensor) -> list[str]:
    """Return the heading error of each horizon, of a gyro."""
    if sensor.integral is None:
        return []
    return [f"{name} {_number(np.rad2deg(v), '.2f')}" for name, v in yardsticks.heading.items()]


def _number(value: float, spec: str) -> str:
    return f"{value:{spec}}" if np.isfinite(value) else "–"


def _duration(seconds: float) -> str:
    if seconds < 600:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
