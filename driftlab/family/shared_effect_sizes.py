"""How large common effects are: in each unit, over all of them, and by lot.

n units, d axes, q coefficients an axis.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from driftlab.family.contrasts import EffectColumns, EffectContrasts, chunks_of, seen_temperatures, shown
from driftlab.family.parallel import ParallelMap, serial
from driftlab.family.shared_effect import EffectDistribution, OfLot, UnitDensities
from driftlab.family.shared_effect_search import Indices, Offer, chances, together
from driftlab.family.shared_effect_tests import between, mean_of, noise_of
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import densities_of
from fusion_core.chunk import Array
from fusion_core.contracts import Effect
from fusion_core.errors import MissingChannel

DIFFERS = 1e-3  # probability that lots of one law differ as much, below which they are told apart
HAS = 5.0  # nats beyond log of the number of lots, that a lot has it
FEWEST = 2  # units of a lot, of which something can be said


@dataclass(frozen=True, eq=False)
class OfUnit:
    """What a unit has of an effect: coefficients and deviations (d, q), shrunken to the law; `own`, what it shows."""

    c: Array
    sigma: Array
    own: Array
    own_sigma: Array


@dataclass(frozen=True, eq=False)
class LotEffects:
    """The law of an effect, that of the lots that have it not, and what each lot has."""

    law: EffectDistribution
    others: EffectDistribution | None
    lots: tuple[OfLot, ...]
    differs: float

    def has(self, lot: str) -> bool:
        """Return whether the units of a lot are of the law."""
        return self.others is None or any(one.lot == lot and one.has for one in self.lots)

    def of(self, lot: str) -> EffectDistribution:
        """Return the law of the units of a lot."""
        return self.law if self.others is None or self.has(lot) else self.others


class _Seen(NamedTuple):
    """Coefficients (d, q) and variances (d, q) of an effect beside all others, and its contrasts."""

    c: Array
    v: Array
    shown: EffectContrasts


def sizes(
    units: Iterable[tuple[UnitInformation, str]], taken: Sequence[tuple[Offer, Effect]], each: ParallelMap = serial
) -> tuple[list[LotEffects], dict[str, tuple[OfUnit, ...]], dict[str, UnitDensities]]:
    """Return the laws of effects over all units, what each unit has of them, and its noise beside them."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    names: list[str] = []
    lots: list[str] = []
    rows = []
    noise = {}
    with threadpool_limits(1):
        for name, lot, own_noise, found in each(partial(_looked_at, taken), units):
            names.append(name)
            lots.append(lot)
            noise[name] = own_noise
            rows.append(found)
    laws, of_units = [], []
    for k, (_, effect) in enumerate(taken):
        own = [row[k] for row in rows]
        seen = together([one.shown for one in own])
        c, v = np.stack([one.c for one in own]), np.stack([one.v for one in own]) * _noise(seen)
        law = _laws(effect, c, v, seen, lots)
        laws.append(law)
        of_units.append([
            OfUnit(*law.of(lot).shrunken(one, variance), one, np.sqrt(variance))
            for one, variance, lot in zip(c, v, lots, strict=True)
        ])  # fmt: skip
    return laws, {name: tuple(of[i] for of in of_units) for i, name in enumerate(names)}, noise


def _looked_at(
    taken: Sequence[tuple[Offer, Effect]], unit: tuple[UnitInformation, str]
) -> tuple[str, str, UnitDensities, list[_Seen]]:
    """Return the name of a unit, its lot, its noise beside the effects, and what it shows of each."""
    soaked, lot = unit
    quiet = _with_own_noise(soaked, [effect for _, effect in taken])
    return (
        soaked.unit,
        lot,
        UnitDensities(quiet.white, quiet.walk),
        [_of_unit(quiet, taken, k) for k in range(len(taken))],
    )


def _with_own_noise(soaked: UnitInformation, effects: Sequence[Effect]) -> UnitInformation:
    """Return the unit with the noise that it has beside the effects: with them it passes for one that walks more."""
    chunks = chunks_of(soaked)
    bias = [rows.bias.copy() for rows in soaked.recordings]
    for k, effect in enumerate(effects):
        if effect.acts_on_input:
            continue
        try:
            c = EffectColumns(soaked, [*effects[:k], *effects[k + 1 :]]).estimates(effect)[0]
        except MissingChannel:
            continue
        for own, z in zip(bias, shown(effect, soaked, chunks), strict=True):
            own -= np.einsum("rdq,dq->rd", z, c)
    T = seen_temperatures(soaked, effects)
    rows = [replace(one, T=t, bias=own) for one, t, own in zip(soaked.recordings, T, bias, strict=True)]
    densities = densities_of(rows, soaked.knots.step)
    return replace(soaked, white=densities.white, walk=densities.likely)


def _of_unit(soaked: UnitInformation, taken: Sequence[tuple[Offer, Effect]], k: int) -> _Seen:
    offer, effect = taken[k]
    columns = EffectColumns(soaked, [other for place, (_, other) in enumerate(taken) if place != k])
    seen = columns.contrasts([effect], [offer.size])
    try:
        c, covariance = columns.estimates(effect)
    except MissingChannel:
        return _Seen(np.zeros_like(seen.c), np.full_like(seen.c, np.inf), seen)
    return _Seen(c, np.diagonal(covariance, axis1=1, axis2=2), seen)


def _noise(shown: EffectContrasts) -> Array:
    """Return by how much (n, d, 1) placebos show more noise than the units' models have, half of it that of all."""
    own = noise_of(shown.placebos)[0].mean(axis=-1, keepdims=True)
    return np.asarray((own + own.mean(axis=0)) / 2)


def _laws(effect: Effect, c: Array, v: Array, shown: EffectContrasts, lots: Sequence[str]) -> LotEffects:
    names = list(dict.fromkeys(lots))
    members = {name: np.flatnonzero([lot == name for lot in lots]) for name in names}
    everyone = np.arange(len(lots))
    whole = _law(effect, c, v, everyone)
    known = [name for name in names if name and len(members[name]) >= FEWEST]
    if len(known) < 2:
        return LotEffects(whole, None, (), 1.0)
    differs = _differ(c, v, [members[name] for name in known])
    found = []
    for name in known:
        one = _law(effect, c, v, members[name], lag=False)
        evidence = _evidence(effect, c, v, shown, members[name])
        has = evidence > HAS + float(np.log(len(known)))
        found.append(OfLot(name, len(members[name]), one.mean, one.sigma, evidence, has))
    having = [one.lot for one in found if one.has]
    if differs > DIFFERS or not having or len(having) == len(found):
        return LotEffects(whole, None, tuple(found), differs)
    inside = np.flatnonzero([lot in having for lot in lots])
    outside = np.setdiff1d(everyone, inside)
    return LotEffects(_law(effect, c, v, inside), _law(effect, c, v, outside), tuple(found), differs)


def _law(effect: Effect, c: Array, v: Array, units: Indices, *, lag: bool = True) -> EffectDistribution:
    """Return the law of some units; that of a lag is known, unless what was measured is asked for."""
    d, q = c.shape[1:]
    own, variance = c[units].reshape(len(units), -1), v[units].reshape(len(units), -1)
    s2 = between(own, variance)
    m, sigma, _ = mean_of(own, variance, s2)
    if lag and effect.acts_on_input:
        return EffectDistribution(np.ones((d, q)), sigma.reshape(d, q), np.zeros((d, q)))
    return EffectDistribution(m.reshape(d, q), sigma.reshape(d, q), np.sqrt(s2).reshape(d, q))


def _evidence(effect: Effect, c: Array, v: Array, shown: EffectContrasts, units: Indices) -> float:
    """Return - log of the probability that what some units have is noise, nats.

    Their means under their variances, or under their scatter where that is more; or, of as many as it takes, as the
    search weighs them.
    """
    from scipy.stats import chi2

    n = len(units)
    c, w = c[units].reshape(n, -1), 1 / v[units].reshape(n, -1)
    W = w.sum(axis=0)
    if not np.any(W > 0):
        return 0.0
    c, w, W = c[:, W > 0], w[:, W > 0], W[W > 0]
    m = (w * c).sum(axis=0) / W
    scatter = float(np.sum(w * (c - m) ** 2)) / ((n - 1) * len(W))
    means = -float(chi2.logsf(float(np.sum(m**2 * W)) / max(scatter, 1.0), len(W)))
    weighed = chances([Offer(effect, shown.c.shape[-1])], shown, units)[0][2]
    return max(means, weighed) - float(np.log(2))


def _differ(c: Array, v: Array, groups: Sequence[Indices]) -> float:
    """Return the probability that lots of one law differ as much: an F ratio an axis, weighted, all multiplied."""
    from scipy.stats import chi2, f

    n = len(c)
    c, v = c.reshape(n, -1), v.reshape(n, -1)
    w = np.where(np.isfinite(v), 1 / (np.where(np.isfinite(v), v, 1.0) + between(c, v)), 0.0)
    total = np.zeros((2, c.shape[1]))
    freedom = np.zeros((2, c.shape[1]))
    groups = [group for group in groups if len(group)]
    members = np.concatenate(groups)
    m = (w * c)[members].sum(axis=0) / np.maximum(w[members].sum(axis=0), 1e-300)
    for group in groups:
        W = w[group].sum(axis=0)
        own = (w * c)[group].sum(axis=0) / np.maximum(W, 1e-300)
        total += np.stack([W * (own - m) ** 2, (w[group] * (c[group] - own) ** 2).sum(axis=0)])
        freedom += np.stack([np.where(W > 0, 1.0, 0.0), np.maximum((w[group] > 0).sum(axis=0) - 1.0, 0.0)])
    freedom[0] -= 1
    held = (freedom > 0).all(axis=0) & (total[1] > 0)
    if not np.any(held):
        return 1.0
    ratio = (total[0] / np.maximum(freedom[0], 1))[held] / (total[1] / np.maximum(freedom[1], 1))[held]
    logs = np.maximum(f.logsf(ratio, freedom[0][held], freedom[1][held]), -700.0)
    return float(chi2.sf(-2 * logs.sum(), 2 * len(logs)))
