"""What the units of a family have in common that none of them can show alone.

Effects are added one by one (`driftlab.family.shared_effect_search`) to what a sample of the units shows, until none
pays; what does not pay any more beside what was added later goes. Sizes are then those of all units.

n units, d axes, q coefficients an axis of an effect.

What the units of a family have in common, in words.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from driftlab.family.parallel import ParallelMap, serial
from driftlab.family.shared_effect import SharedEffect, UnitDensities, without_effects
from driftlab.family.shared_effect_search import (
    CHANCE,
    Candidate,
    Indices,
    Offer,
    between_lots,
    chosen,
    contrasts_of,
    evaluate,
    nested,
    offered,
    refined,
)
from driftlab.family.shared_effect_sizes import DIFFERS, OfUnit, sizes
from driftlab.family.unit_information import UnitInformation
from driftlab.identification.result import described
from fusion_core.contracts import Effect

if TYPE_CHECKING:
    from collections.abc import Sequence

    from driftlab.family.shared_effect import EffectDistribution
    from driftlab.units import BiasUnit


SAMPLE = 400  # units that are searched
PROPOSING = 12  # of these, whose recordings say which hyper-parameters are worth trying
TUNING = 100  # of these, on which they are refined
MOST = 4  # effects
FEWEST = 10  # units


@dataclass(frozen=True, eq=False)
class SharedEffects:
    """What was found.

    Attributes
    ----------
    verdict : str
        `nothing_common`, `explained`, or `ambiguous`: rivals cannot be told apart.
    effects : tuple of CommonEffect
    rejected : tuple of (str, str)
        The best of every other kind, and why it was not added.
    tried, units, searched : int
        Candidates; units in all; and units that were searched.
    of_units : mapping of str to tuple of OfUnit
        By unit, of each effect: coefficients and deviations (d, q), shrunken to the law.
    noise : mapping of str to Noise
        By unit, beside the effects.
    """

    verdict: str
    effects: tuple[SharedEffect, ...]
    rejected: tuple[tuple[str, str], ...]
    tried: int
    units: int
    searched: int
    of_units: Mapping[str, tuple[OfUnit, ...]] = field(default_factory=dict)
    noise: Mapping[str, UnitDensities] = field(default_factory=dict)

    def apart(self, soaked: UnitInformation, lot: str = "") -> UnitInformation:
        """Return what a unit's soaks say of its curve with the effects in the model; itself where there are none."""
        if not self.effects:
            return soaked
        return without_effects(soaked, lot, self.effects, self.noise.get(soaked.unit))

    def of_unit(self, unit: str) -> SharedEffects:
        """Return the effects with the sizes and the noise of one unit alone."""
        of_units = {name: self.of_units[name] for name in (unit,) if name in self.of_units}
        return replace(self, of_units=of_units, noise={name: self.noise[name] for name in of_units})

    def as_json(self) -> dict[str, Any]:
        """Return it for `family.json`, without the units."""
        return {
            "verdict": self.verdict,
            "effects": [effect.as_json() for effect in self.effects],
            "rejected": [{"effect": name, "reason": reason} for name, reason in self.rejected],
            "tried": self.tried,
            "units": self.units,
            "searched": self.searched,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return what `as_json` wrote; raises ValidationError where an effect is not installed."""
        return cls(
            content["verdict"],
            tuple(SharedEffect.from_json(effect) for effect in content["effects"]),
            tuple((one["effect"], one["reason"]) for one in content["rejected"]),
            *(content[name] for name in ("tried", "units", "searched")),
        )


@dataclass(eq=False)
class _Search:
    """What is known while effects are added: of each the candidate as it was chosen, and its rivals."""

    sample: list[UnitInformation]
    lots: list[str]
    offers: list[Offer]
    taken: list[tuple[Candidate, Effect, tuple[str, ...]]]
    seen: dict[str, Candidate]
    each: ParallelMap

    @property
    def named(self) -> list[Effect]:
        return [effect for _, effect, _ in self.taken]


def find_common(
    units: Iterable[tuple[UnitInformation, str]],
    *,
    bias_unit: str = "rad/s",
    without: Collection[str] = (),
    seed: int = 0,
    sample: int = SAMPLE,
    each: ParallelMap = serial,
) -> SharedEffects:
    """Return the effects that units have in common.

    Parameters
    ----------
    units : iterable of (Soaked, str)
        Units and their lots; gone through more than once, each time in the same order.
    bias_unit : str
        SI unit of the bias.
    without : kinds of effects that are not tried
    seed : int
        Of the sample, where there are more units than `sample`.
    each : Each, optional
        Who goes through the units.
    """
    drawn, count = _drawn(units, sample, seed)
    if len(drawn) < FEWEST:
        why = f"{len(drawn)} units; {FEWEST} are needed to tell what they have in common"
        return SharedEffects("nothing_common", (), (("all", why),), 0, count, len(drawn))
    found = _Search([soaked for soaked, _ in drawn], [lot for _, lot in drawn], [], [], {}, each)
    found.offers, refused = offered(found.sample[:: max(1, len(drawn) // PROPOSING)], without)
    if found.offers:
        _add(found)
    rejected = [*_rejected(found), *refused.items()]
    return _with_sizes(found, units, count, bias_unit, tuple(rejected))


def _drawn(
    units: Iterable[tuple[UnitInformation, str]], most: int, seed: int
) -> tuple[list[tuple[UnitInformation, str]], int]:
    """Return at most some units at random, in their order, and how many there are; that many are ever held."""
    rng = np.random.default_rng(seed)
    kept: dict[int, tuple[UnitInformation, str]] = {}
    count = 0
    for number, unit in enumerate(units):  # reservoir sampling
        count += 1
        if len(kept) < most:
            kept[number] = unit
        elif (place := int(rng.integers(count))) < most:
            del kept[list(kept)[place]]
            kept[number] = unit
    return [kept[number] for number in sorted(kept)], count


def _add(found: _Search) -> None:
    while len(found.taken) < MOST:
        named = {effect.kind for effect in found.named if not effect.several}
        acting = any(effect.acts_on_input for effect in found.named)
        offers = [o for o in found.offers if o.effect.kind not in named and not (acting and o.effect.acts_on_input)]
        shown = contrasts_of(found.sample, offers, found.named, found.each)
        candidates = evaluate(offers, shown, found.lots)
        found.seen = {}
        for one in candidates:
            name = " ".join(one.offer.family).strip()
            if name not in found.seen or _margin(one) > _margin(found.seen[name]):
                found.seen[name] = one
        best = chosen(candidates)
        if best is None:
            break
        taken, rivals = best
        where = np.arange(len(found.lots)) if not taken.lot else np.flatnonzero(np.array(found.lots) == taken.lot)
        ahead = nested(offers, shown, taken, where)
        if ahead <= 0:
            break
        step = max(1, len(where) // TUNING)
        effect = refined([found.sample[k] for k in where[::step]], taken, offers, found.named, found.each)
        found.taken.append((taken, effect, tuple(described(rival.effect) for rival in rivals)))
    _drop(found)


def _margin(one: Candidate) -> float:
    return one.chance - one.price


def _drop(found: _Search) -> None:
    """Drop what does not pay beside what was added later; weigh the others anew beside one another."""
    for k in reversed(range(len(found.taken) - 1)):
        old, effect, rivals = found.taken[k]
        offer = replace(old.offer, effect=effect)
        others = [one for place, one in enumerate(found.named) if place != k]
        new = evaluate([offer], contrasts_of(found.sample, [offer], others, found.each), found.lots)[0]
        price = float(np.log(len(found.offers))) if not old.lot else old.price
        if new.chance <= price + CHANCE or new.total <= 0:
            del found.taken[k]
        else:
            found.taken[k] = (replace(new, price=price), effect, rivals)


def _rejected(found: _Search) -> list[tuple[str, str]]:
    """Return the best of every kind that was not added in the last round, and why."""
    kept = {effect.kind for effect in found.named if not effect.several}
    reasons = []
    for one in sorted(found.seen.values(), key=lambda one: -_margin(one)):
        if one.effect.kind in kept:
            continue
        if one.pays:
            why = "predicts no more than others do"
        elif one.chance > one.price + CHANCE:
            why = f"{one.chance:.0f} nats, and left-out units are not predicted better ({one.total:+.0f} nats)"
        else:
            why = f"{one.chance:.1f} nats of {one.price + CHANCE:.1f} needed"
        reasons.append((described(one.effect), why))
    return reasons


def _with_sizes(
    found: _Search,
    units: Iterable[tuple[UnitInformation, str]],
    count: int,
    bias_unit: str,
    rejected: tuple[tuple[str, str], ...],
) -> SharedEffects:
    if not found.taken:
        return SharedEffects("nothing_common", (), rejected, len(found.offers), count, len(found.sample))
    effects = []
    laws, of_units, noise = sizes(units, [(taken.offer, effect) for taken, effect, _ in found.taken], found.each)
    for k, ((taken, effect, rivals), law) in enumerate(zip(found.taken, laws, strict=True)):
        others = [one for place, one in enumerate(found.named) if place != k]
        offer = replace(taken.offer, effect=effect)
        shown = contrasts_of(found.sample, [offer], others, found.each)
        where: Indices = np.flatnonzero([law.has(lot) for lot in found.lots])
        left_out = nested([offer], shown, taken, where) / max(len(where), 1)
        lots = between_lots(offer, shown, found.lots) if law.others is None else None
        unit = ", ".join(dict.fromkeys(effect.units_of(bias_unit))) or bias_unit
        effects.append(
            SharedEffect(
                effect, unit, law.law, law.others, law.lots, law.differs, taken.chance, taken.mean, taken.size,
                taken.price + CHANCE, left_out, lots, rivals,
            )
        )  # fmt: skip
    verdict = "ambiguous" if any(effect.indistinguishable_from for effect in effects) else "explained"
    return SharedEffects(
        verdict, tuple(effects), rejected, len(found.offers), count, len(found.sample), of_units, noise
    )


NAMED = 6  # lots that are named one by one
SPREAD = 2.0  # times the mean, beyond which signs differ


def sentences(common: SharedEffects, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
    """Return the verdict in sentences, sizes in the unit of tables."""
    if not common.effects:
        if not common.tried:
            return [f"What the units have in common was not asked: {reason}." for _, reason in common.rejected[:1]]
        return [f"No effect of {common.tried} candidates is common to the {common.units:,} units."]
    found = [line for effect in common.effects for line in of_effect(effect, unit, axes)]
    if common.searched < common.units:
        found.append(f"Searched in {common.searched} units drawn at random; sizes are of all {common.units:,}.")
    return found


def of_effect(effect: SharedEffect, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
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


def _where(effect: SharedEffect) -> str:
    if effect.others is None:
        if len(effect.lots) < 2:
            return "in the units"
        return "in all lots alike" if effect.differs > DIFFERS else "in all lots, in some more than in others"
    having = [lot.lot for lot in effect.lots if lot.has]
    if len(having) <= NAMED:
        return f"in lot{'s' if len(having) > 1 else ''} {', '.join(having)}"
    return f"in {len(having)} of {len(effect.lots)} lots"


def _sizes(effect: SharedEffect, law: EffectDistribution, unit: BiasUnit, axes: Sequence[str]) -> str:
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
