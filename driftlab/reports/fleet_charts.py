"""The charts of a fleet: the fan of its maps, and the content of its page.

A fan shows between which curves how many of the units lie, and those that are odd. U units, d axes, G temperatures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from driftlab.family.outliers import Outlier
from driftlab.family.record import UnitRecord
from driftlab.reports.charts import SERIES, Chart, Line, Panel, axis_panels, series
from driftlab.reports.line_charts import SHARES
from driftlab.spc.acknowledgements import Acknowledgement
from driftlab.spc.charts import LineReport
from driftlab.spc.gauge_study import GaugeStudy
from driftlab.spc.yields import Yield
from driftlab.units import BiasUnit
from fusion_core.chunk import Array

LABEL = "temperature [°C]"
NAMED = SERIES - 1  # odd units with a colour of their own; the first colour is the fan's
EACH = 20  # units of which each is drawn: percentiles of so few say little
DRAWN = 40  # odd units on an axis at most


@dataclass(frozen=True)
class SharedEffectRow:
    """An effect that the units share.

    Attributes
    ----------
    name : str
    sentence : str
        What it is, how large, and how sure.
    unit : str
        Of the sizes by lot, as they are shown.
    lots : tuple of (lot, units, axis, size, sigma)
        Its mean size in each lot, in `unit`.
    """

    name: str
    sentence: str
    unit: str = ""
    lots: tuple[tuple[str, int, str, float, float], ...] = ()

    @property
    def axes(self) -> list[str]:
        """The axes of `lots`, in their order."""
        return list(dict.fromkeys(axis for _, _, axis, _, _ in self.lots))

    @property
    def rows(self) -> list[tuple[str, int, list[str]]]:
        """Of each lot its name, its units, and a text an axis: the size, and by how much it may be off (1 sigma)."""
        rows: dict[str, tuple[int, dict[str, str]]] = {}
        for lot, n, axis, size, sigma in self.lots:
            rows.setdefault(lot, (n, {}))[1][axis] = f"{size:.3g} ± {sigma:.2g}"
        return [(lot, n, [texts.get(axis, "–") for axis in self.axes]) for lot, (n, texts) in rows.items()]


@dataclass(frozen=True, eq=False)
class FleetOverview:
    """The content of the page.

    Attributes
    ----------
    title : str
        Of the fleet.
    records : sequence of UnitRecord
        In the order of the manifest.
    unit : BiasUnit
        In which biases are shown.
    line : LineReport
    T : (G,) array
        degC.
    curves : (U, d, G) array
        Maps of the units over T, single precision will do.
    drawn : sequence of str
        Whose they are.
    mean : (d, G) array or None
        The family's curve.
    odd : mapping of str to sequence of Outlier
        By unit.
    effects : sequence of SharedEffectRow
    links : mapping of str to str
        Units' pages, relative to this one.
    remarks : sequence of str
        What else should be known.
    yields : Yield or None
    gauge : GaugeStudy or None
    acknowledged : mapping of str to Acknowledgement
        By unit, of those whose alarms are all known.
    notes : sequence of Acknowledgement
        All notes, the latest last.
    judged : bool
        Whether odd units were looked for.
    """

    title: str
    records: Sequence[UnitRecord]
    unit: BiasUnit
    line: LineReport
    T: Array
    curves: Any
    drawn: Sequence[str]
    mean: Array | None = None
    odd: Mapping[str, Sequence[Outlier]] = field(default_factory=dict)
    effects: Sequence[SharedEffectRow] = ()
    links: Mapping[str, str] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    yields: Yield | None = None
    gauge: GaugeStudy | None = None
    acknowledged: Mapping[str, Acknowledgement] = field(default_factory=dict)
    notes: Sequence[Acknowledgement] = ()
    judged: bool = True


def map_charts(overview: FleetOverview, ranges: Array) -> list[Chart]:
    """Return the fan of the units' curves, and that of what they are less their median.

    Below the first, how many units were measured at each temperature: `ranges` (n, 2) are those that each unit was
    soaked at, from and to, degC.
    """
    curves, T, U = overview.curves, overview.T, len(overview.drawn)
    if not U:
        return []
    all_of = len(overview.line.units)
    sample = f" (an even sample of {all_of:,}, and those of an odd shape)" * (all_of > U)
    caption = (
        f"Of {U:,} unit{'s' * (U != 1)}{sample}: broad band 5 to 95 %, narrow band 25 to 75 %, at each temperature on "
        "its own. Lines with a unit's name: of an odd shape on this axis."
    )
    low, high = ranges.T
    near = 0.5 * float(np.diff(T).max())  # a soak reaches the temperature of the grid that it comes nearest to
    count = np.array([np.sum((low <= at + near) & (at - near <= high)) for at in T], dtype=np.float64)
    line, span = Line(T, count, "units measured", "data"), (0.0, 1.1 * max(count.max(), 1.0))
    bands, below = percentiles(curves), Panel((line,), "units measured", height=0.6, span=span)
    panels = (*_fan(overview, bands, curves, overview.mean, "bias"), below)
    more = f"{caption} Below: at how many units' soaks this temperature was."
    charts = [Chart(panels, LABEL, "Maps of the units", more)]
    if U > 1:
        middle = bands[SHARES.index(50)].astype(curves.dtype)
        panels = _fan(overview, bands - middle, curves - middle, None, "less the median:")
        charts.append(Chart(panels, LABEL, "Deviation from the median of the units", caption))
    return charts


def _fan(overview: FleetOverview, bands: Array, curves: Any, mean: Array | None, quantity: str) -> tuple[Panel, ...]:
    drawn, axes = overview.drawn, overview.line.axes
    # what else is odd than a shape is not to be seen in a map
    bent = {name: {axis for one in odd if one.T is not None for axis in one.axis.split()}
            for name, odd in overview.odd.items()}  # fmt: skip
    bent = {name: axes for name, axes in bent.items() if axes}
    named = [name for name in drawn if name in bent][:NAMED]
    looks = {name: (name, series(k + 1)) for k, name in enumerate(named)}
    T, factor = overview.T, overview.unit.factor

    def lines(axis: int) -> Iterator[Line]:
        five, quarter, half, most, all_but_five = bands[:, axis] * factor
        yield Line(T, None, "90 % of the units", "estimate", five, all_but_five)
        yield Line(T, None, "half of the units (darker)", "estimate", quarter, most)
        yield Line(T, half, "median", "estimate")
        if mean is not None:
            yield Line(T, mean[axis] * factor, "mean of the family", "sigma", style="dashed")
        if len(drawn) <= EACH:
            for curve in curves[:, axis]:
                yield Line(T, np.asarray(curve, dtype=np.float64) * factor, "a unit", "data")
        odd = [k for k, name in enumerate(drawn) if axes[axis] in bent.get(name, ())]
        for k in odd[:DRAWN]:
            name, role = looks.get(drawn[k], ("more odd units", "alarm"))
            yield Line(T, np.asarray(curves[k, axis], dtype=np.float64) * factor, name, role)

    return axis_panels(axes, lines, quantity, overview.unit.shown, height=1.2)


def percentiles(curves: Any) -> Array:
    """Return percentiles SHARES (5, d, G) of curves (U, d, G), an axis at a time."""
    of_all = np.percentile if np.all(np.isfinite(curves)) else np.nanpercentile  # which goes temperature by temperature
    return np.stack([of_all(own, SHARES, axis=0) for own in curves.swapaxes(0, 1)], axis=1).astype(np.float64)
