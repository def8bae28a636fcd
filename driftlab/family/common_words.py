"""What the units of a family have in common, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftlab.family.common_sizes import DIFFERS
from driftlab.loop.words import described

if TYPE_CHECKING:
    from collections.abc import Sequence

    from driftlab.family.common_effect import CommonEffect, Law
    from driftlab.family.common_effects import CommonEffects
    from driftlab.units import BiasUnit

NAMED = 6  # lots that are named one by one
SPREAD = 2.0  # times the mean, beyond which signs differ


def sentences(common: CommonEffects, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
    """Return the verdict in sentences, sizes in the unit of tables."""
    if not common.effects:
        if not common.tried:
            return [f"What the units have in common was not asked: {reason}." for _, reason in common.rejected[:1]]
        return [f"No effect of {common.tried} candidates is common to the {common.units:,} units."]
    found = [line for effect in common.effects for line in of_effect(effect, unit, axes)]
    if common.searched < common.units:
        found.append(f"Searched in {common.searched} units drawn at random; sizes are of all {common.units:,}.")
    return found


def of_effect(effect: CommonEffect, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
    """Return what is known of an effect, in sentences."""
    name = described(effect.effect)
    lines = [
        f"{name}: {_where(effect)}, {_sizes(effect, effect.law, unit, axes)}; {effect.evidence:.0f} nats "
        f"({effect.price:.0f} needed), and a unit that was left out is predicted {effect.left_out:.2g} nats better."
    ]
    if effect.others is not None:
        lines.append(f"{name}: in the other lots {_sizes(effect, effect.others, unit, axes)}.")
    if effect.indistinguishable_from:
        lines.append(f"{name}: cannot be told from {', '.join(effect.indistinguishable_from)} on these soaks.")
    return lines


def _where(effect: CommonEffect) -> str:
    if effect.others is None:
        if len(effect.lots) < 2:
            return "in the units"
        return "in all lots alike" if effect.differs > DIFFERS else "in all lots, in some more than in others"
    having = [lot.lot for lot in effect.lots if lot.has]
    if len(having) <= NAMED:
        return f"in lot{'s' if len(having) > 1 else ''} {', '.join(having)}"
    return f"in {len(having)} of {len(effect.lots)} lots"


def _sizes(effect: CommonEffect, law: Law, unit: BiasUnit, axes: Sequence[str]) -> str:
    if effect.effect.acts_on_input:
        return "the same in each"
    units = effect.effect.units_of(unit.shown)
    said = []
    for axis, name in enumerate(axes):
        for k in range(law.mean.shape[1]):
            place = axis * law.mean.shape[1] + k
            mean, sigma, spread = (float(v[axis, k]) * unit.factor for v in (law.mean, law.sigma, law.spread))
            term = effect.effect.terms[k]
            about = f"{name} {term}".strip()
            said.append(f"{about} {mean:.2g} ± {sigma:.1g} {units[place]} (units spread {spread:.1g})")
    signs = bool(np.all(law.spread > SPREAD * np.abs(law.mean)))
    return ("of either sign, " if signs else "") + ", ".join(said)
