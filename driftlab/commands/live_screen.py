"""A live run on a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.summary import DEG_H

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.jobs.live import Status


def screen(status: Status) -> Table:
    """Return what is shown of a status."""
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False, min_width=60)
    table.add_column(style="dim", no_wrap=True)
    table.add_column()
    if status.samples:
        table.add_row("time", f"{status.t:,.1f} s, {status.samples:,} samples, {status.rate():.1f} a second")
    table.add_row("state", Text(status.state, "red" if status.moving or not status.samples else ""))
    if status.waiting is None:
        for axis, bias, sigma in zip(status.axes, status.bias, status.sigma, strict=True):
            text = f"{bias * DEG_H:12.3f} ± {sigma * DEG_H:.3f} deg/h   {bias:+.4e} ± {sigma:.1e} rad/s"
            table.add_row(f"gyro bias {axis}", text)
        table.add_row("nis", f"{status.nis:.2f} per component, 1 where the model is right")
    if np.isfinite(status.temperature):
        rate = status.temperature_rate * 60
        table.add_row("temperature", f"{status.temperature:.2f} degC, {rate:+.3f} K/min")
    table.add_row("lost", f"{status.lost:,} samples")
    if status.recorded:
        table.add_row("recorded", f"{status.recorded:,} rows")
    for line in status.lines():
        table.add_row("note", line)
    return table
