"""The page of a vehicle: what is known of each sensor and lost by the firmware, and the map of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from driftlab.maps.assessment import MapVerdict, text
from driftlab.reports.charts import Chart
from driftlab.reports.map import chart
from driftlab.reports.pages import page
from driftlab.reports.provenance import Sheet
from driftlab.reports.tables import TextTable
from driftlab.units import BiasUnit
from fusion_core.contracts import Loss, SensorLoss

STAIRS = "its renewal in stairs"  # of the causes of a loss


class SensorReport(NamedTuple):
    """A sensor on the page: its verdict and what the firmware loses, None where there is none."""

    title: str
    sentences: Sequence[str]
    verdict: MapVerdict | None
    unit: BiasUnit | None
    loss: SensorLoss | None


def table(sections: Sequence[SensorReport]) -> TextTable:
    """Return the table of all sensors, each by its worst axis."""
    heads = ("sensor", "unit", "range\n[°C]", "good to\n(1 sigma)", "lost over\nthe range", "lost in\na warm-up",
             "of that\nthe stairs")  # fmt: skip
    return TextTable(heads, [_row(section) for section in sections], framed=False)


def _row(section: SensorReport) -> list[str]:
    verdict, unit, loss = section.verdict, section.unit, section.loss
    if verdict is None or unit is None:
        return [section.title, "", "no map", *["-"] * 4]
    low, high = verdict.fitted.domain
    good = "-" if verdict.good is None else text(float(np.max(verdict.good)) * unit.factor)
    cells = [section.title, unit.shown, f"{low:.1f} to {high:.1f}", good]
    if loss is None:
        return [*cells, *["not exported", "-", "-"]]
    parts = (loss.domain, loss.warm_up, loss.causes.get(STAIRS))
    return [*cells, *("-" if part is None else text(float(np.max(part.rms)) * unit.factor) for part in parts)]


def _most_lost(sections: Sequence[SensorReport]) -> str:
    """Return the sensor of which the firmware loses most beside the sigma of its map; empty where it is none of it."""
    lost = list[tuple[float, str, str]]()
    for title, _, verdict, unit, loss in sections:
        if verdict is not None and unit is not None and loss is not None and verdict.good is not None:
            beside = float(np.max(loss.domain.rms)), float(np.max(verdict.good))
            off, good = (text(value * unit.factor) for value in beside)
            lost.append((beside[0] / beside[1], f"{off} {unit.shown} on {title}", good))
    times, off, good = max(lost, default=(0.0, "", ""))
    return f"; the firmware is off its map by {off}, which is good to {good}" if times > 1 else ""


def charts(sections: Sequence[SensorReport]) -> list[tuple[SensorReport, Chart | None]]:
    """Return each sensor with the chart of its map."""
    drawn = (None if one.verdict is None or one.unit is None else chart(one.verdict, one.unit) for one in sections)
    return [(one, found and replace(found, title=one.title)) for one, found in zip(sections, drawn, strict=True)]


def page_of(
    product: str,
    recordings: Sequence[str],
    sections: Sequence[SensorReport],
    sheet: Sheet | None,
    loss: Loss | None,
    problem: str,
) -> str:
    """Return the page of a vehicle; `problem`: why there is no loss."""
    mapped = sum(section.verdict is not None for section in sections)
    exported = sum(section.loss is not None for section in sections)
    return page(
        "vehicle",
        title="Thermal calibration of a vehicle",
        lead=f"{', '.join(Path(name).name for name in recordings)}, read by `{product}`",
        verdict=f"{mapped} of {len(sections)} sensors have a map, {exported} are in the parameter file"
        + (f": {problem}" if problem else _most_lost(sections)),
        table=table(sections),
        sections=charts(sections),
        losses=[] if loss is None else loss.lines(),
        sheet=sheet,
    )
