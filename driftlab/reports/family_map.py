"""What is said of a map by a unit's own soak and its family: sentences, a table, a chart, JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from driftlab.maps.assessment import text
from driftlab.reports.charts import Chart, Line, Panel, Shade

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.family.posterior_map import UnitPosterior
    from driftlab.units import BiasUnit
    from fusion_core.chunk import Array
    from fusion_core.contracts import FittedMap

PLACES = 9  # temperatures of the table
WIDER = 1.1  # a factor of a band, from which on it is told
SHARP = 0.9  # of the family's deviation: with less than that the soak has told something


class FamilyMapFacts(Protocol):
    """What the words are about: what is known of a unit, its own map if it has one, and arrays over the temperature."""

    known: UnitPosterior
    own: FittedMap | None
    unit: BiasUnit

    def __getitem__(self, name: str) -> Array:
        """Return an array by name."""


def sentences(found: FamilyMapFacts) -> list[str]:
    """Return how good the map is, what the unit's own soak told, and what the family adds."""
    return [_good(found), *_own(found), _family(found), *_odd(found), *_measured(found.known)]


def _good(found: FamilyMapFacts) -> str:
    known, factor, unit = found.known, found.unit.factor, found.unit.shown
    low, high = known.family.knots.domain
    each = ", ".join(f"{a} {text(v * factor)}" for a, v in zip(known.family.axes, rms(known.sigma), strict=True))
    k, axis = np.unravel_index(int(np.argmax(known.sigma)), known.sigma.shape)
    return (
        f"good to {text(float(np.max(rms(known.sigma))) * factor)} {unit} between {low:.3g} and {high:.3g} °C, its "
        f"level included (1 sigma, rms over the range: {each}; worst {known.family.axes[int(axis)]} "
        f"{text(known.sigma[k, axis] * factor)} at {known.T[k]:.3g} °C)"
    )


def _own(found: FamilyMapFacts) -> list[str]:
    known, factor, unit = found.known, found.unit.factor, found.unit.shown
    low, high = known.band.low, known.band.high
    domain = known.family.knots.domain
    share = (min(high, domain[1]) - max(low, domain[0])) / (domain[1] - domain[0])
    of_range = f"{100 * max(share, 0.0):.0f} % of the range"
    saw = f"its own soak saw {low:.3g} to {high:.3g} °C ({of_range}) in {known.hours:.3g} h"
    if found.own is None:
        return [f"{saw}, too little for a map of its own"]
    inside = known.inside
    if not np.any(inside):
        return [f"{saw}, none of it in the family's range: only noise and lot are the unit's own"]
    T = np.clip(known.T[inside], *found.own.domain)
    own, both = (float(np.max(rms(values))) * factor for values in (found.own.sigma(T), known.sigma[inside]))
    return [
        f"{saw}: there its own map knows the curve to {text(own)} {unit}, its level apart, and with the family curve "
        f"and level are known to {text(both)} {unit}"
    ]


def _family(found: FamilyMapFacts) -> str:
    known, factor, unit = found.known, found.unit.factor, found.unit.shown
    outside = ~known.inside
    if not np.any(outside):
        return "the whole range of the family was soaked: the family only smooths the map"
    before, after = (rms(values[outside]) * factor for values in (known.before, known.sigma))
    axis = int(np.argmax(after))
    name = known.family.axes[axis]
    return (
        f"beyond that it is the family of {known.family.units} units that tells: {name} differs there by "
        f"{text(before[axis])} {unit} (1 sigma), of which the soak leaves {text(after[axis])}"
    )


def _odd(found: FamilyMapFacts) -> list[str]:
    known = found.known
    if known.far is None:
        return []
    odd = [axis for axis, far in zip(known.family.axes, known.far, strict=True) if far > 1]
    if not odd:
        return ["what was soaked looks like the family"]
    return [
        f"what was soaked of {', '.join(odd)} is further from the family than that of 99 in 100 of its units: the map "
        "may be off by more than its sigma where nothing was soaked; soak the whole range"
    ]


def _measured(known: UnitPosterior) -> list[str]:
    bands = known.family.bands
    if bands is None:
        return ["sigma stands on a Gaussian law: too few units saw the whole range to measure it on them"]
    low, high = float(np.min(known.band.factors[1])), float(np.max(known.band.factors[1]))
    return [
        f"sigma is as measured on {bands.units} units left out of the family: 95 of 100 lay within 1.96 sigma ("
        f"{low:.2f} to {high:.2f} times that of a Gaussian law where nothing was soaked)"
    ]


def rms(values: Array) -> Array:
    """Return the root mean square (d,) of values (N, d)."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def rows(found: FamilyMapFacts) -> list[list[str]]:
    """Return the table's rows: temperature, and of the worst axis sigma of the family, the own map, and both."""
    known, factor = found.known, found.unit.factor
    places = np.linspace(0, len(known.T) - 1, PLACES).astype(int)
    shown = []
    for k in places:
        own = float(np.max(found["own_sigma"][k]))
        cells = [float(np.max(known.before[k])), own, float(np.max(known.sigma[k]))]
        shown.append([f"{known.T[k]:.1f}", *("" if np.isnan(v) else text(v * factor) for v in cells)])
    return shown


def table(found: FamilyMapFacts) -> Table:
    """Return it for a terminal."""
    from rich.table import Table

    result = Table(title=f"sigma over the range, worst axis [{found.unit.shown}]", title_justify="left")
    for head in ("°C", "family alone", "own map", "both"):
        result.add_column(head, justify="right")
    for row in rows(found):
        result.add_row(*row)
    return result


def chart(found: FamilyMapFacts) -> Chart:
    """Return, of each axis, the map with its band beside the unit's own and the family's mean; and what is known."""
    known, factor, shown = found.known, found.unit.factor, found.unit.shown
    mean = known.family.knots.values(known.T) @ known.family.marginal(known.lot).c.T * factor
    curve, own, reach = found["bias"] * factor, found["own_bias"] * factor, 2 * known.sigma * factor
    soaked = (Shade(known.band.low, known.band.high, "soaked", "hole"),)
    panels = []
    for k, axis in enumerate(known.family.axes):
        spread = 2 * known.before[:, k] * factor
        lines = (
            Line(known.T, mean[:, k], "family", "sigma", mean[:, k] - spread, mean[:, k] + spread),
            Line(known.T, curve[:, k], "both", "estimate", curve[:, k] - reach[:, k], curve[:, k] + reach[:, k]),
            Line(known.T, own[:, k], "own map", "data", style="dashed"),
        )
        panels.append(Panel(lines, f"bias {axis} [{shown}]", soaked, height=1.3))
    return Chart(tuple(panels), "temperature [°C]", "Map by its own soak and its family", "bands: two sigma")


def as_json(found: FamilyMapFacts) -> dict[str, Any]:
    """Return the numbers, in SI."""
    known = found.known
    own = None if found.own is None else rms(found.own.sigma(np.linspace(*found.own.domain, 200)))
    return {
        "soaked_degC": [known.band.low, known.band.high],
        "hours": known.hours,
        "units": known.family.units,
        "lot": known.lot,
        "sigma": {"rms": rms(known.sigma), "worst": known.sigma.max(axis=0)},
        "family_sigma": {"rms": rms(known.before)},
        "own_sigma": {"rms": own},
        "noise": {"white": known.soaked.white, "walk": known.soaked.walk},
        "factors": None if known.family.bands is None else known.band.factors,
        "far": known.far,
    }
