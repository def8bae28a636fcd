"""An effect that the units of a family share: its sizes in each unit, over all of them, and by lot.

n units, d axes, q coefficients an axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    model_serializer,
)

from driftlab.family.contrasts import EffectContrasts, UnitRows, columns_of, seen_temperatures
from driftlab.family.partitions import Partitions, UnitOfLot, by_lot
from driftlab.family.shared_effect_search import Offer, between, chances, mean_of, noise_of, together
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import densities_of
from driftlab.identification.acceptance import nats_of
from driftlab.identification.result import described, parameters
from driftlab.units import BiasUnit
from fusion_core.chunk import Array, Integers
from fusion_core.contracts import Effect
from fusion_core.errors import MissingChannel
from fusion_core.host.registry import Installed
from fusion_core.thermal.curve_error import Numbers
from fusion_core.threads import one_thread

DIFFERS = 1e-3  # probability that lots of one law differ as much, below which they are distinguished
HAS = 5.0  # nats beyond log of the number of lots, that a lot has it
MIN_UNITS = 2  # of a lot, for a law of its own
NAMED = 6  # lots that are named one by one
SIGNS = 2.0  # spread over mean, beyond which signs differ


class UnitDensities(NamedTuple):
    """Densities of the white noise and of the walk (d,) of a unit, SI."""

    white: Array
    walk: Array


class EffectDistribution(BaseModel):
    """Law of the coefficients (d, q) over units: N(mean, spread^2), `sigma` of the mean; SI."""

    model_config = ConfigDict(frozen=True, validate_by_name=True, serialize_by_alias=True)

    mean: Numbers
    sigma: Annotated[Numbers, Field(alias="mean_sigma")]
    spread: Numbers

    def shrunken(self, c: Array, v: Array) -> tuple[Array, Array]:
        """Return a unit's coefficients and deviations, by its own c with variances v (infinite: unseen) and the law."""
        prior = np.maximum(self.spread**2, 1e-12 * (self.mean**2 + self.sigma**2) + 1e-300)
        weight = 1 / (1 / prior + 1 / v)
        return (self.mean / prior + np.where(np.isfinite(v), c / v, 0.0)) * weight, np.sqrt(weight)


class OfLot(BaseModel):
    """An effect in a lot: units, mean and deviation (d, q), evidence (nats), and whether that is enough."""

    model_config = EffectDistribution.model_config

    lot: str
    units: int
    mean: Numbers
    sigma: Annotated[Numbers, Field(alias="mean_sigma")]
    evidence: float
    has: bool


class LotEffects(EffectDistribution):
    """The laws of an effect: of the units that have it, of those that have it not, and of lots."""

    # of the units of the lots that have it not; None where every lot is one law's
    others: Annotated[EffectDistribution | None, Field(alias="other_lots")] = None
    lots: tuple[OfLot, ...] = ()  # in the order of their names; none where no lots are known
    differs: float = 1.0  # probability that lots of one law differ as much

    def has(self, lot: str) -> bool:
        """Return True if the units of a lot have the effect."""
        return self.others is None or any(one.lot == lot and one.has for one in self.lots)

    def law_of(self, lot: str) -> EffectDistribution:
        """Return the law of the units of a lot."""
        return self if self.others is None or self.has(lot) else self.others


def _of_kind(value: Any) -> Effect:
    return value if isinstance(value, Effect) else TypeAdapter(Annotated[Effect, Installed()]).validate_python(value)


def _settings(effect: Effect) -> dict[str, Any]:
    return effect.model_dump(mode="json", exclude_none=True)


class SharedEffect(LotEffects):
    """One effect with its laws, as `family.json` has it."""

    effect: Annotated[Effect, PlainValidator(_of_kind), PlainSerializer(_settings)]  # with its hyper-parameters
    unit: str  # of the coefficients
    evidence: float  # that it is there, nats
    of_mean: float  # the same of the mean of the units' coefficients alone
    of_size: float  # the same of their squares alone
    price: float  # threshold of the evidence
    left_out: float  # mean gain of a unit that had no part in the law nor in the hyper-parameters, nats
    in_other_lots: float | None  # the same of whole lots
    indistinguishable_from: tuple[str, ...]  # effects that predict left-out units as well

    @model_serializer(mode="wrap")
    def _described(self, inner: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the content of the file: what the effect says of itself stands beside it."""
        effect = self.effect
        about = {"kind": effect.kind, "channel": effect.subject, "parameters": parameters(effect)}
        return {**about, **inner(self), "explanation": effect.explanation}


def without_effects(
    soaked: UnitInformation, lot: str, effects: Sequence[SharedEffect], noise: UnitDensities | None = None
) -> UnitInformation:
    """Return the information of the soaks on the curve where the unit has the effects, and its `noise` beside them.

    The noise is estimated where it is None: an effect passes for a walk where it is not in the model.
    """
    if noise is None:
        densities = densities_of(_without(soaked, lot, effects).recordings, soaked.knots.step)
        noise = UnitDensities(densities.white, densities.likely)
    return _without(replace(soaked, white=noise.white, walk=noise.walk), lot, effects)


def _without(soaked: UnitInformation, lot: str, effects: Sequence[SharedEffect]) -> UnitInformation:
    """Return the information of the soaks on the curve where the unit has the effects, each drawn from its law.

    With Z their columns and c ~ N(m, D), -2 log L of the curve alone is that of y - Z m under S + Z D Z'. The rows are
    without the effects at their most likely coefficients.
    """
    have = set(soaked.recordings[0].channels) | {"temperature"}
    effects = [effect for effect in effects if set(effect.effect.requires) <= have]
    coefficient = [effect for effect in effects if not effect.effect.acts_on_input]
    laws, d, q = [one.law_of(lot) for one in coefficient], len(soaked.axes), soaked.knots.q
    mean = np.concatenate([np.zeros((d, 0)), *(law.mean for law in laws)], axis=1)
    spread = np.concatenate([np.zeros((d, 0)), *(law.spread for law in laws)], axis=1)
    Z = columns_of([one.effect for one in coefficient], soaked)
    T = seen_temperatures(soaked, [effect.effect for effect in effects])
    J, h = soaked.J.copy(), soaked.h.copy()
    bias = [rows.bias.copy() for rows in soaked.recordings]
    for axis in range(d):
        N = _products(soaked, axis, T, [z[:, axis] for z in Z], mean[axis], spread[axis])
        V = N[q + 1 :, q + 1 :] + np.eye(mean.shape[1])
        S = N[: q + 1, : q + 1] - N[: q + 1, q + 1 :] @ np.linalg.solve(V, N[q + 1 :, : q + 1])
        J[axis], h[axis] = S[:q, :q], S[:q, q]
        curve = np.linalg.lstsq(J[axis], h[axis], rcond=1e-10)[0]
        beyond = np.linalg.solve(V, N[q + 1 :, q] - N[q + 1 :, :q] @ curve)
        for one, z in zip(bias, Z, strict=True):
            one[:, axis] -= z[:, axis] @ (mean[axis] + spread[axis] * beyond)
    rows = tuple(replace(one, T=t, bias=y) for one, t, y in zip(soaked.recordings, T, bias, strict=True))
    return replace(soaked, J=J, h=h, recordings=rows)


def _products(
    soaked: UnitInformation, axis: int, T: Sequence[Array], Z: Sequence[Array], mean: Array, spread: Array
) -> Array:
    """Return the products of splines, bias less effects at their means, and effects a spread each."""
    total = np.zeros(())
    for k, (rows, t, z) in enumerate(zip(soaked.recordings, T, Z, strict=True)):
        columns = np.column_stack([soaked.knots.values(t), rows.bias[:, axis] - z @ mean, z * spread])
        X = rows.whitened(columns, soaked.white[axis], soaked.walk[axis], free=k > 0)
        total = total + X.T @ X
    return total


@dataclass(frozen=True, eq=False)
class OfUnit:
    """An effect in a unit: coefficients and deviations (d, q), shrunken to the law."""

    c: Array
    sigma: Array


class _UnitContrast(NamedTuple):
    """Coefficients (d, q) and variances (d, q) of an effect beside all others, and its contrasts."""

    c: Array
    v: Array
    contrasts: EffectContrasts


def sizes(
    units: Partitions[Sequence[UnitOfLot]], taken: Sequence[Offer]
) -> tuple[list[LotEffects], dict[str, tuple[OfUnit, ...]], dict[str, UnitDensities]]:
    """Return the laws of effects over all units, the effects in each unit, and its noise beside them."""
    found = [one for own in units.map(partial(_effects_of_units, taken)) for one in own]
    names, lots, densities, rows = zip(*found, strict=True)
    laws, of_units = [], []
    for offer, column in zip(taken, zip(*rows, strict=True), strict=True):
        contrasts = together([one.contrasts for one in column])
        c, v = np.stack([one.c for one in column]), np.stack([one.v for one in column]) * _excess_noise(contrasts)
        law = _laws(offer.effect, c, v, contrasts, lots)
        laws.append(law)
        of_units.append([
            OfUnit(*law.law_of(lot).shrunken(one, variance)) for one, variance, lot in zip(c, v, lots, strict=True)
        ])  # fmt: skip
    return laws, dict(zip(names, zip(*of_units, strict=True), strict=True)), dict(zip(names, densities, strict=True))


def _effects_of_units(
    taken: Sequence[Offer], units: Sequence[UnitOfLot]
) -> list[tuple[str, str, UnitDensities, list[_UnitContrast]]]:
    """Return of each unit its name, its lot, its noise beside the effects, and its contrast of each."""
    found = []
    with one_thread():
        for soaked, lot in units:
            quiet = _with_noise_beside(soaked, [offer.effect for offer in taken])
            contrasts = [_contrast(quiet, taken, k) for k in range(len(taken))]
            found.append((soaked.unit, lot, UnitDensities(quiet.white, quiet.walk), contrasts))
    return found


def _with_noise_beside(soaked: UnitInformation, effects: Sequence[Effect]) -> UnitInformation:
    """Return the unit with its noise beside the effects: with them it passes for one that walks more."""
    bias = [rows.bias.copy() for rows in soaked.recordings]
    for k, effect in enumerate(effects):
        if effect.acts_on_input:
            continue
        try:
            c = UnitRows(soaked, [*effects[:k], *effects[k + 1 :]]).estimates(effect)[0]
        except MissingChannel:
            continue
        for own, z in zip(bias, columns_of([effect], soaked), strict=True):
            own -= np.einsum("rdq,dq->rd", z, c)
    T = seen_temperatures(soaked, effects)
    rows = [replace(one, T=t, bias=own) for one, t, own in zip(soaked.recordings, T, bias, strict=True)]
    densities = densities_of(rows, soaked.knots.step)
    return replace(soaked, white=densities.white, walk=densities.likely)


def _contrast(soaked: UnitInformation, taken: Sequence[Offer], k: int) -> _UnitContrast:
    columns = UnitRows(soaked, [offer.effect for place, offer in enumerate(taken) if place != k])
    contrasts = columns.contrasts([taken[k].effect], [taken[k].size])
    try:
        c, covariance = columns.estimates(taken[k].effect)
    except MissingChannel:
        return _UnitContrast(np.zeros_like(contrasts.c), np.full_like(contrasts.c, np.inf), contrasts)
    return _UnitContrast(c, np.diagonal(covariance, axis1=1, axis2=2), contrasts)


def _excess_noise(contrasts: EffectContrasts) -> Array:
    """Return the noise (n, d, 1) along placebos over that of the units' models, half of it that of all units."""
    own = noise_of(contrasts.placebos)[0].mean(axis=-1, keepdims=True)
    return np.asarray((own + own.mean(axis=0)) / 2)


def _laws(effect: Effect, c: Array, v: Array, contrasts: EffectContrasts, lots: Sequence[str]) -> LotEffects:
    known = {name: units for name, units in by_lot(lots).items() if name and len(units) >= MIN_UNITS}
    whole = _law(effect, c, v, np.arange(len(lots)))
    if len(known) < 2:
        return LotEffects(**dict(whole))
    differs, of_lots = _differ(c, v, list(known.values())), []
    for name, units in known.items():
        one, evidence = _law(effect, c, v, units, lag=False), _evidence(effect, c, v, contrasts, units)
        has = evidence > HAS + float(np.log(len(known)))
        of_lots.append(OfLot(lot=name, units=len(units), mean=one.mean, sigma=one.sigma, evidence=evidence, has=has))
    having = [one.lot for one in of_lots if one.has]
    if differs > DIFFERS or not having or len(having) == len(of_lots):
        return LotEffects(**dict(whole), lots=tuple(of_lots), differs=differs)
    inside = np.array([lot in having for lot in lots])
    law, others = (_law(effect, c, v, np.flatnonzero(part)) for part in (inside, ~inside))
    return LotEffects(**dict(law), others=others, lots=tuple(of_lots), differs=differs)


def _law(effect: Effect, c: Array, v: Array, units: Integers, *, lag: bool = True) -> EffectDistribution:
    """Return the law of some units; that of a lag is known, unless the measured one is asked for."""
    d, q = c.shape[1:]
    own, variance = c[units].reshape(len(units), -1), v[units].reshape(len(units), -1)
    s2 = between(own, variance)
    m, sigma, _ = mean_of(own, variance, s2)
    if lag and effect.acts_on_input:
        m, s2 = np.ones(d * q), np.zeros(d * q)
    mean, sigma, spread = (values.reshape(d, q) for values in (m, sigma, np.sqrt(s2)))
    return EffectDistribution(mean=mean, sigma=sigma, spread=spread)


def _evidence(effect: Effect, c: Array, v: Array, contrasts: EffectContrasts, units: Integers) -> float:
    """Return - log of the probability that the coefficients of some units are noise, nats.

    Their means under their variances, or under their scatter where that is more; or, of as many as it takes, as the
    search weighs them.
    """
    n = len(units)
    c, w = c[units].reshape(n, -1), 1 / v[units].reshape(n, -1)
    W = w.sum(axis=0)
    if not np.any(W > 0):
        return 0.0
    c, w, W = c[:, W > 0], w[:, W > 0], W[W > 0]
    m = (w * c).sum(axis=0) / W
    scatter = float(np.sum(w * (c - m) ** 2)) / ((n - 1) * len(W))
    means = nats_of(float(np.sum(m**2 * W)) / max(scatter, 1.0), len(W))
    weighed = chances([Offer(effect, contrasts.c.shape[-1])], contrasts, units)[0][2]
    return max(means, weighed) - float(np.log(2))


def _differ(c: Array, v: Array, groups: Sequence[Integers]) -> float:
    """Return the probability that lots of one law differ as much: an F ratio an axis, weighted, all multiplied."""
    from scipy.special import chdtrc, fdtrc

    n = len(c)
    c, v = c.reshape(n, -1), v.reshape(n, -1)
    w = np.where(np.isfinite(v), 1 / (np.where(np.isfinite(v), v, 1.0) + between(c, v)), 0.0)
    total, freedom = np.zeros((2, c.shape[1])), np.zeros((2, c.shape[1]))
    members = np.concatenate(groups)
    m = (w * c)[members].sum(axis=0) / np.maximum(w[members].sum(axis=0), 1e-300)
    for group in groups:
        W = w[group].sum(axis=0)
        own = (w * c)[group].sum(axis=0) / np.maximum(W, 1e-300)
        total += np.stack([W * (own - m) ** 2, (w[group] * (c[group] - own) ** 2).sum(axis=0)])
        freedom += np.stack([np.where(W > 0, 1.0, 0.0), np.maximum((w[group] > 0).sum(axis=0) - 1.0, 0.0)])
    freedom[0] -= 1
    used = (freedom > 0).all(axis=0) & (total[1] > 0)
    if not np.any(used):
        return 1.0
    ratio = (total[0] / np.maximum(freedom[0], 1))[used] / (total[1] / np.maximum(freedom[1], 1))[used]
    logs = np.log(np.maximum(fdtrc(freedom[0][used], freedom[1][used], ratio), 1e-304))
    return float(chdtrc(2 * len(logs), -2 * logs.sum()))


def of_effect(effect: SharedEffect, unit: BiasUnit, axes: Sequence[str]) -> list[str]:
    """Return an effect with its sizes and its evidence, in sentences."""
    name = described(effect.effect)
    lines = [
        f"{name}: {_where(effect)}, {_sizes(effect, effect, unit, axes)}; log-likelihood "
        f"{effect.evidence:.0f} ({effect.price:.0f} needed), {effect.left_out:.2g} more for a unit that was left out."
    ]
    if effect.others is not None:
        lines.append(f"{name}: in the other lots {_sizes(effect, effect.others, unit, axes)}.")
    if effect.indistinguishable_from:
        lines.append(f"{name}: cannot be distinguished from {', '.join(effect.indistinguishable_from)} on these soaks.")
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
    lines = []
    for axis, name in enumerate(axes):
        for k in range(law.mean.shape[1]):
            place = axis * law.mean.shape[1] + k
            mean, sigma, spread = (float(v[axis, k]) * unit.factor for v in (law.mean, law.sigma, law.spread))
            term = effect.effect.terms[k]
            about = f"{name} {term}".strip()
            lines.append(f"{about} {mean:.2g} ± {sigma:.1g} {units[place]} (units spread {spread:.1g})")
    signs = bool(np.all(law.spread > SIGNS * np.abs(law.mean)))
    return ("of either sign, " if signs else "") + ", ".join(lines)
