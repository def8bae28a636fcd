"""The map of a unit by its own soak and its family: sentences, a table, a chart, JSON."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from driftlab.family.posterior_map import UnitPosterior
from driftlab.maps.assessment import text
from driftlab.reports.charts import Chart, Line, Shade, axis_panels, band
from driftlab.reports.tables import TextTable
from driftlab.units import BiasUnit
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap

PLACES = 9  # temperatures of the table


class FamilyMapFacts(Protocol):
    """The posterior of a unit, its own map if it has one, and arrays over the temperature."""

    known: UnitPosterior
    own: FittedMap | None
    unit: BiasUnit

    def __getitem__(self, name: str) -> Array:
        """Return an array by name."""


def sentences(facts: FamilyMapFacts) -> list[str]:
    """Return the verdict on the map, the contribution of the unit's own soak, and that of the family."""
    return [_good(facts), _own_map(facts), _family(facts), *_distance(facts.known), _measured(facts.known)]


def _good(facts: FamilyMapFacts) -> str:
    known, factor, unit = facts.known, facts.unit.factor, facts.unit.shown
    axes, (low, high), good = known.family.axes, known.family.knots.domain, rms(known.sigma)
    each = ", ".join(f"{axis} {text(v * factor)}" for axis, v in zip(axes, good, strict=True))
    k, worst = np.unravel_index(int(np.argmax(known.sigma)), known.sigma.shape)
    return (
        f"good to {text(float(np.max(good)) * factor)} {unit} between {low:.3g} and {high:.3g} °C, its "
        f"level included (1 sigma, rms over the range: {each}; worst {axes[int(worst)]} "
        f"{text(known.sigma[k, worst] * factor)} at {known.T[k]:.3g} °C)"
    )


def _own_map(facts: FamilyMapFacts) -> str:
    known, unit = facts.known, facts.unit
    low, high = known.band.low, known.band.high
    start, stop = known.family.knots.domain
    share = (min(high, stop) - max(low, start)) / (stop - start)
    soak = (
        f"its own soak saw {low:.3g} to {high:.3g} °C ({100 * max(share, 0.0):.0f} % of the range) in "
        f"{known.hours:.3g} h"
    )
    if facts.own is None:
        return f"{soak}, too little for a map of its own"
    inside = known.inside
    if not np.any(inside):
        return f"{soak}, none of it in the family's range: only noise and lot are the unit's own"
    T = np.clip(known.T[inside], *facts.own.domain)
    own, both = (float(np.max(rms(v))) * unit.factor for v in (facts.own.sigma(T), known.sigma[inside]))
    return (
        f"{soak}: there its own map knows the curve to {text(own)} {unit.shown}, its level apart, and with the family "
        f"curve and level are known to {text(both)} {unit.shown}"
    )


def _family(facts: FamilyMapFacts) -> str:
    known, factor = facts.known, facts.unit.factor
    outside = ~known.inside
    if not np.any(outside):
        return "the whole range of the family was soaked: the family only smooths the map"
    before, after = (rms(values[outside]) * factor for values in (known.before, known.sigma))
    axis = int(np.argmax(after))
    return (
        f"beyond that it is the family of {known.family.units} units that tells: {known.family.axes[axis]} differs "
        f"there by {text(before[axis])} {facts.unit.shown} (1 sigma), of which the soak leaves {text(after[axis])}"
    )


def _distance(known: UnitPosterior) -> list[str]:
    if known.far is None:
        return []
    odd = [axis for axis, far in zip(known.family.axes, known.far, strict=True) if far > 1]
    if not odd:
        return ["what was soaked looks like the family"]
    return [
        f"what was soaked of {', '.join(odd)} is further from the family than that of 99 in 100 of its units: the map "
        "may be off by more than its sigma where nothing was soaked; soak the whole range"
    ]


GAUSSIAN = "sigma stands on a Gaussian law: too few units saw the whole range to measure it on them"


def measured_on(units: int) -> str:
    """Return the basis of a measured sigma."""
    return f"sigma is as measured on {units} units left out of the family"


def _measured(known: UnitPosterior) -> str:
    if known.family.bands is None:
        return GAUSSIAN
    low, high = float(np.min(known.band.factors[1])), float(np.max(known.band.factors[1]))
    times = " to ".join(dict.fromkeys((f"{low:.2f}", f"{high:.2f}")))  # one number where they are alike
    where = f"{times} times that of a Gaussian law where nothing was soaked"
    return f"{measured_on(known.family.bands.units)}: 95 of 100 lay within 1.96 sigma ({where})"


def rms(values: Array) -> Array:
    """Return the root mean square (d,) of values (N, d)."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def table(facts: FamilyMapFacts) -> TextTable:
    """Return sigma of the worst axis over the temperature: of the family, of the own map, and of both."""
    known, factor = facts.known, facts.unit.factor
    sigmas = [np.max(sigma, axis=1) for sigma in (known.before, facts["own_sigma"], known.sigma)]
    rows = [
        [f"{known.T[k]:.1f}", *("" if np.isnan(v[k]) else text(float(v[k]) * factor) for v in sigmas)]
        for k in np.linspace(0, len(known.T) - 1, PLACES).astype(int)
    ]
    title = f"sigma over the range, worst axis [{facts.unit.shown}]"
    return TextTable(("°C", "family alone", "own map", "both"), rows, title, texts=0, whole=False)


def chart(facts: FamilyMapFacts) -> Chart:
    """Return, of each axis, the map with its band beside the unit's own and the family's mean; and what is known."""
    known, factor = facts.known, facts.unit.factor
    mean = known.family.knots.values(known.T) @ known.family.marginal(known.lot).c.T * factor
    curve, own = facts["bias"] * factor, facts["own_bias"] * factor

    def lines(k: int) -> Iterator[Line]:
        yield band(known.T, mean[:, k], 2 * known.before[:, k] * factor, "family", "sigma")
        yield band(known.T, curve[:, k], 2 * known.sigma[:, k] * factor, "both")
        yield Line(known.T, own[:, k], "own map", "data", style="dashed")

    soaked = (Shade(known.band.low, known.band.high, "soaked", "hole"),)
    panels = axis_panels(known.family.axes, lines, "bias", facts.unit.shown, shades=soaked, height=1.3)
    return Chart(panels, "temperature [°C]", "Map by its own soak and its family", "bands: two sigma")


def as_json(facts: FamilyMapFacts) -> dict[str, Any]:
    """Return the numbers, in SI."""
    known = facts.known
    own = None if facts.own is None else rms(facts.own.sigma(np.linspace(*facts.own.domain, 200)))
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
