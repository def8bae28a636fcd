"""Effects that the units of a family share, and that none of them can show alone.

Effects are added one by one (`driftlab.family.shared_effect_search`) to the model of a sample of the units, until none
pays; one that does not pay any more beside those that were added later goes. Sizes are then those of all units.

n units, d axes, q coefficients an axis of an effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, InstanceOf

from driftlab.family.partitions import A_FEW, FamilyUnits, Partitions, UnitOfLot, in_partitions
from driftlab.family.shared_effect import OfUnit, SharedEffect, UnitDensities, of_effect, sizes
from driftlab.family.shared_effect_search import (
    CHANCE,
    Candidate,
    between_lots,
    choose,
    contrasts_of,
    evaluate,
    nested,
    offers_for,
    refine,
)
from driftlab.identification.result import described
from driftlab.units import BiasUnit
from fusion_core.contracts import Effect

SAMPLE = 400  # units that are searched
PROPOSING = 12  # of these, whose recordings say which hyper-parameters are worth trying
TUNING = 100  # of these, on which they are refined
MAX_EFFECTS = 4
MIN_UNITS = 10


class RejectedEffect(BaseModel):
    """The best of a kind that was not added, or the kind, and why."""

    model_config = ConfigDict(frozen=True)

    effect: str
    reason: str


class SharedEffects(BaseModel):
    """Result of the search, as `family.json` has it without the units."""

    model_config = ConfigDict(frozen=True)

    verdict: str = "nothing_common"  # `nothing_common`, `explained`, or `ambiguous`: rivals cannot be distinguished
    effects: tuple[SharedEffect, ...] = ()
    rejected: tuple[RejectedEffect, ...] = ()  # the best of every other kind, and why it was not added
    tried: int = 0  # candidates
    units: int = 0  # in all
    searched: int = 0  # units that were searched
    # (d, q) of each effect, by unit
    of_units: Annotated[InstanceOf[dict[str, tuple[OfUnit, ...]]], Field(exclude=True)] = {}
    noise: Annotated[InstanceOf[dict[str, UnitDensities]], Field(exclude=True)] = {}  # by unit, beside the effects


def find_common(units: FamilyUnits, *, bias_unit: str = "rad/s", sample: int = SAMPLE) -> SharedEffects:
    """Return the effects that units share; `sample` of them at most are searched.

    Parameters
    ----------
    units : FamilyUnits
        Units and their lots, with their rows.
    bias_unit : str
        SI unit of the bias.
    """
    units = in_partitions(units)
    count = len(units)
    drawn = units.chosen(np.random.default_rng(0).choice(count, min(count, sample), replace=False).tolist(), A_FEW)
    if len(drawn) < MIN_UNITS:
        why = f"{len(drawn)} units; {MIN_UNITS} are needed to tell what they have in common"
        return SharedEffects(rejected=(RejectedEffect(effect="all", reason=why),), units=count, searched=len(drawn))
    search = _Search(drawn)
    search.run()
    effects = search.measured(units, bias_unit)
    verdict = "ambiguous" if any(effect.indistinguishable_from for effect in effects) else "explained"
    return SharedEffects(
        verdict=verdict if effects else "nothing_common", effects=effects, rejected=search.rejected(),
        tried=len(search.offers), units=count, searched=len(drawn), of_units=search.of_units, noise=search.noise,
    )  # fmt: skip


class _Search:
    """Effects added one by one to the model of the sampled units: of each the candidate, refined, and its rivals."""

    def __init__(self, sample: Partitions[Sequence[UnitOfLot]]) -> None:
        self.sample = sample
        self.taken: list[tuple[Candidate, tuple[str, ...]]] = []
        self.last: dict[str, Candidate] = {}  # of the last round, the best of every kind
        some = sample.chosen(range(0, len(sample), max(1, len(sample) // PROPOSING)))
        ((self.offers, self.refused),) = sample.engine(offers_for, some.parts)
        self.of_units: dict[str, tuple[OfUnit, ...]] = {}
        self.noise: dict[str, UnitDensities] = {}

    def run(self) -> None:
        """Add effects until none pays; then drop what does not pay beside what was added later."""
        while self.offers and len(self.taken) < MAX_EFFECTS and self._add():
            pass
        for k in reversed(range(len(self.taken) - 1)):
            old, rivals = self.taken[k]
            new = evaluate([old.offer], contrasts_of(self.sample, [old.offer], self._others(k)))[0]
            price = float(np.log(len(self.offers))) if not old.lot else old.price
            if new.chance <= price + CHANCE or new.total <= 0:
                del self.taken[k]
            else:
                self.taken[k] = (replace(new, price=price), rivals)

    def _add(self) -> bool:
        """Add the best candidate; return whether one pays."""
        effects = self._others(None)
        kinds = {effect.kind for effect in effects if not effect.several}
        acting = any(effect.acts_on_input for effect in effects)
        offers = [o for o in self.offers if o.effect.kind not in kinds and not (acting and o.effect.acts_on_input)]
        contrasts = contrasts_of(self.sample, offers, effects)
        candidates = evaluate(offers, contrasts)
        self.last = {}
        for one in candidates:
            name = " ".join(one.offer.group).strip()
            if name not in self.last or _margin(one) > _margin(self.last[name]):
                self.last[name] = one
        best = choose(candidates)
        if best is None:
            return False
        taken, rivals = best
        where = np.flatnonzero([taken.lot in ("", lot) for lot in contrasts.lots])
        if nested(offers, contrasts, taken, where) <= 0:
            return False
        tuned = self.sample.chosen(where[:: max(1, len(where) // TUNING)], A_FEW)
        refined = replace(taken.offer, effect=refine(tuned, taken, offers, effects))
        self.taken.append((replace(taken, offer=refined), tuple(described(rival.effect) for rival in rivals)))
        return True

    def _others(self, k: int | None) -> list[Effect]:
        """Return the effects in the model, all but the k-th."""
        return [taken.effect for place, (taken, _) in enumerate(self.taken) if place != k]

    def rejected(self) -> tuple[RejectedEffect, ...]:
        """Return the best of every kind that was not added in the last round, and why; and what was refused."""
        kinds = {effect.kind for effect in self._others(None) if not effect.several}
        reasons = []
        for one in sorted(self.last.values(), key=lambda one: -_margin(one)):
            if one.effect.kind in kinds:
                continue
            if one.pays:
                why = "predicts no more than others do"
            elif one.chance > one.price + CHANCE:
                why = f"log-likelihood {one.chance:.0f}, and left-out units are not predicted better ({one.total:+.0f})"
            else:
                why = f"log-likelihood {one.chance:.1f} of {one.price + CHANCE:.1f} needed"
            reasons.append((described(one.effect), why))
        return tuple(RejectedEffect(effect=name, reason=why) for name, why in (*reasons, *self.refused.items()))

    def measured(self, units: Partitions[Sequence[UnitOfLot]], bias_unit: str) -> tuple[SharedEffect, ...]:
        """Return the effects with their sizes in all units."""
        if not self.taken:
            return ()
        effects = []
        laws, self.of_units, self.noise = sizes(units, [taken.offer for taken, _ in self.taken])
        for k, ((taken, rivals), law) in enumerate(zip(self.taken, laws, strict=True)):
            contrasts = contrasts_of(self.sample, [taken.offer], self._others(k))
            where = np.flatnonzero([law.has(lot) for lot in contrasts.lots])
            effects.append(
                SharedEffect(
                    **dict(law), effect=taken.effect,
                    unit=", ".join(dict.fromkeys(taken.effect.units_of(bias_unit))) or bias_unit,
                    evidence=taken.chance, of_mean=taken.mean, of_size=taken.size, price=taken.price + CHANCE,
                    left_out=nested([taken.offer], contrasts, taken, where) / max(len(where), 1),
                    in_other_lots=between_lots(taken.offer, contrasts) if law.others is None else None,
                    indistinguishable_from=rivals,
                )
            )  # fmt: skip
        return tuple(effects)


def _margin(one: Candidate) -> float:
    return one.chance - one.price


def sentences(common: SharedEffects, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
    """Return the verdict in sentences, sizes in the unit of tables."""
    if not common.effects:
        if not common.tried:
            return [f"What the units have in common was not asked: {one.reason}." for one in common.rejected[:1]]
        return [f"No effect of {common.tried} candidates is common to the {common.units:,} units."]
    lines = [line for effect in common.effects for line in of_effect(effect, unit, axes)]
    if common.searched < common.units:
        lines.append(f"Searched in {common.searched} units drawn at random; sizes are of all {common.units:,}.")
    return lines
