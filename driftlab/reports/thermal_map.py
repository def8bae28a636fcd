"""A thermal map as a figure: bias over temperature, and how sure the curve is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftlab.maps.fit import axes_of
from driftlab.reports.plots import COLOURS, LIMITS, margins

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from driftlab.units import BiasUnit
    from fusion_core.contracts import FittedMap


def figure(fitted: FittedMap, unit: BiasUnit) -> Figure:
    """Draw the bias of each axis over the map's domain, with two standard deviations of the curve."""
    from matplotlib.figure import Figure

    record = fitted.record
    T = np.linspace(*fitted.domain, 400)
    bias, sigma = fitted.bias(T) * unit.factor, fitted.sigma(T) * unit.factor
    d = bias.shape[1]
    result = Figure(figsize=(10, 2.1 * d + 0.6))
    grid = result.subplots(d, 1, sharex=True, squeeze=False, gridspec_kw=margins(result))
    panels: list[Axes] = list(grid[:, 0])
    for k, panel in enumerate(panels):
        low, high = bias[:, k] - 2 * sigma[:, k], bias[:, k] + 2 * sigma[:, k]
        panel.fill_between(T, low, high, color=COLOURS[0], alpha=0.2, lw=0)
        panel.plot(T, bias[:, k], color=COLOURS[0], lw=1)
        for start, stop in record.error.holes if record.error else ():
            panel.axvspan(start, stop, color="#c8553d", alpha=0.15, lw=0)
        panel.set_ylabel(f"bias {axes_of(fitted)[k]} [{unit.shown}]")
        panel.ticklabel_format(axis="y", scilimits=LIMITS)
        panel.grid(alpha=0.25)
    panels[-1].set_xlabel("temperature [°C]   (band: two standard deviations of the curve; red: nothing was recorded)")
    return result
