"""A live run on a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fusion_core.contracts import axis_of

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.live.status import Status
    from driftlab.units import BiasUnit

COLOURS = {"good": "green", "waiting": "", "warning": "yellow", "bad": "red"}


def screen(status: Status) -> Table:
    """Return a status as a table for the terminal."""
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False, min_width=60)
    table.add_column(style="dim", no_wrap=True)
    table.add_column()
    if status.samples:
        table.add_row("time", f"{status.t:,.1f} s, {status.samples:,} samples, {status.rate():.1f} a second")
    table.add_row("state", Text(status.state, COLOURS[status.level]))
    if status.waiting is None:
        channel = status.sensor.channel if status.sensor else "gyro"
        for axis, bias, sigma in zip(status.axes, status.bias, status.sigma, strict=True):
            table.add_row(
                f"{channel} bias {axis}".removesuffix(f" {axis_of(channel)}"), _bias(bias, sigma, status.unit)
            )
        table.add_row("nis", f"{status.nis:.2f} per component, 1 where the model is right")
    if np.isfinite(status.temperature):
        rate = status.temperature_rate * 60
        table.add_row("temperature", f"{status.temperature:.2f} °C, {rate:+.3f} K/min")
    table.add_row("lost", f"{status.lost:,} samples")
    if status.recorded:
        table.add_row("recorded", f"{status.recorded:,} rows")
    for line in () if status.map is None else status.map.lines():
        table.add_row(f"map {status.map.kind}" if status.map else "", line)
    for line in status.lines():
        table.add_row("note", line)
    return table


def _bias(bias: float, sigma: float, unit: BiasUnit) -> str:
    """Return a bias and its deviation, as they are shown and in SI where that is another unit."""
    digits, of_sigma = (".3f", ".3f") if unit.digits == ".2f" else (".6g", ".2g")
    text = f"{bias * unit.factor:12{digits}} ± {sigma * unit.factor:{of_sigma}} {unit.shown}"
    return text if len(unit.columns) == 1 else f"{text}   {bias:+.4e} ± {sigma:.1e} {unit.si}"
