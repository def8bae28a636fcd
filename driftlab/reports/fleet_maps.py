"""Maps of a family as a fan: between which curves how many of the units lie, and those that are odd.

U units, d axes, G temperatures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from driftlab.reports.charts import SERIES, Chart, Line, Panel, series
from driftlab.units import BiasUnit
from fusion_core.chunk import Array

LABEL = "temperature [°C]"
SHARES = (5, 25, 50, 75, 95)
NAMED = SERIES - 1  # odd units with a colour of their own; the first colour is the fan's
EACH = 20  # units of which each is drawn: percentiles of so few say little
DRAWN = 40  # odd units on an axis at most


class Family(Protocol):
    """What a fan needs beside the curves."""

    @property
    def unit(self) -> BiasUnit:
        """In which biases are shown."""

    @property
    def mean(self) -> Array | None:
        """The family's curve (d, G), SI."""

    @property
    def odd(self) -> Mapping[str, Sequence[Any]]:
        """By unit, why it is odd."""


def fan(T: Array, curves: Any, drawn: Sequence[str], axes: Sequence[str], family: Family, ranges: Array) -> Chart:
    """Return the fan of curves (U, d, G), and how many units were measured at each temperature.

    `ranges` (n, 2) are the temperatures that each unit was soaked at, from and to, degC.
    """
    bands = percentiles(curves)
    mean = family.mean
    panels = [
        _panel(T, bands[:, k], curves[:, k], drawn, axis, family, None if mean is None else mean[k], "bias")
        for k, axis in enumerate(axes)
    ]
    near = 0.5 * float(np.diff(T).max())  # a soak reaches the temperature of the grid that it comes nearest to
    count = np.array([np.sum((ranges[:, 0] <= at + near) & (at - near <= ranges[:, 1])) for at in T], dtype=np.float64)
    panels.append(
        Panel(
            (Line(T, count, "units measured", "data"),),
            "units measured",
            height=0.6,
            span=(0.0, 1.1 * max(count.max(), 1.0)),
        )
    )
    return Chart(
        tuple(panels),
        LABEL,
        "Maps of the units",
        _caption(len(drawn), "Below: at how many units' soaks this temperature was."),
    )


def spread(T: Array, curves: Any, drawn: Sequence[str], axes: Sequence[str], family: Family) -> Chart:
    """Return the fan of curves (U, d, G) less their median."""
    bands = percentiles(curves)
    middle = bands[SHARES.index(50)].astype(curves.dtype)
    panels = [
        _panel(T, bands[:, k] - middle[k], curves[:, k] - middle[k], drawn, axis, family, None, "less the median:")
        for k, axis in enumerate(axes)
    ]
    return Chart(tuple(panels), LABEL, "By how much the units differ", _caption(len(drawn), ""))


def percentiles(curves: Any) -> Array:
    """Return percentiles SHARES (5, d, G) of curves (U, d, G), an axis at a time."""
    found = [np.nanpercentile(curves[:, k], SHARES, axis=0) for k in range(curves.shape[1])]
    return np.stack(found, axis=1).astype(np.float64)


def _panel(
    T: Array, bands: Array, own: Any, drawn: Sequence[str], axis: str, family: Family, mean: Array | None, what: str
) -> Panel:
    unit = family.unit
    five, quarter, half, most, all_but_five = (band * unit.factor for band in bands)
    lines = [
        Line(T, None, "90 % of the units", "estimate", five, all_but_five),
        Line(T, None, "half of the units (darker)", "estimate", quarter, most),
        Line(T, half, "median", "estimate"),
    ]
    if mean is not None:
        lines.append(Line(T, mean * unit.factor, "mean of the family", "sigma", style="dashed"))
    if len(drawn) <= EACH:
        lines += [Line(T, np.asarray(one, dtype=np.float64) * unit.factor, "a unit", "data") for one in own]
    bent = {name: [axis for one in found for axis in one.axis.split()] for name, found in _bent(family).items()}
    colours = {name: series(k + 1) for k, name in enumerate([name for name in drawn if name in bent][:NAMED])}
    odd = [k for k, name in enumerate(drawn) if axis in bent.get(name, ())]
    for k in odd[:DRAWN]:
        name = drawn[k]
        look = (name, colours[name]) if name in colours else ("more odd units", "limit")
        lines.append(Line(T, np.asarray(own[k], dtype=np.float64) * unit.factor, *look))
    return Panel(tuple(lines), f"{what} {axis} [{unit.shown}]", height=1.2)


def _bent(family: Family) -> dict[str, list[Any]]:
    """Return, by unit, what is odd about its shape: what else is odd is not to be seen in a map."""
    found = {name: [one for one in odd if one.T is not None] for name, odd in family.odd.items()}
    return {name: odd for name, odd in found.items() if odd}


def _caption(U: int, more: str) -> str:
    return (
        f"Of {U:,} unit{'s' * (U != 1)}: broad band 5 to 95 %, narrow band 25 to 75 %, at each temperature on its own. "
        f"Lines with a unit's name: of an odd shape on this axis. {more}"
    ).strip()
