"""The curves of an Allan analysis as charts: for its page, for notebooks, and for `allan.svg`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftlab.noise.model import KEYS, design
from driftlab.reports.allan_units import NAMES, units_of
from driftlab.reports.charts import Chart, Line, Panel, series
from driftlab.units import axis_name
from fusion_core.units import convert

if TYPE_CHECKING:
    from collections.abc import Iterator

    from driftlab.noise.deviation import Analysis
    from driftlab.noise.fit import Coefficients
    from driftlab.noise.model import Curve
    from fusion_core.chunk import Array

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


def _lines(c: Curve, item: Coefficients, scale: float) -> Iterator[Line]:
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
