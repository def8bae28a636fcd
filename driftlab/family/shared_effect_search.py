"""Search for the effects that the units of a family share: offers, evidence, units left out, and the choice.

Of every offer the units' coefficients c_i are tested twice for N(m, s^2) against (0, 0), all axes together, and both
probabilities multiplied (R. A. Fisher, Statistical Methods for Research Workers, section 21.1). Neither test stands on
the variances alone that the units' noise models give:

- of the mean m, by the scatter of the c_i between units, whatever makes it (Student's t of a weighted mean with the
  sandwich variance). The same rows along placebos, mean over units, must be as noise is, or it counts less.
- of the size of the c_i, whatever their signs: c_i^2 against the placebos of the same unit, an F ratio each, as
  normal scores whose sum is normal: a unit whose noise is not that of its model is measured by its own noise.

An offer pays where - log of the probability exceeds log M + CHANCE, M the number of trials: offers, and offers times
lots where the units of one lot are looked at alone. Then it has to predict: mean and spread from four fifths of the
units make the coefficients of the others likelier than noise does. Of those that do, the one that predicts best is
taken; a simpler one that is within one standard deviation of it (of the units' differences) before it; one that is
within two is a rival.

n units, d axes, K coefficients (columns), J placebos. Sources: R. C. Paule and J. Mandel, J. Res. NBS 87 (1982) 377
(s^2); P. J. Huber, Proc. 5th Berkeley Symp. 1 (1967) 221 (sandwich); S. A. Stouffer et al., The American Soldier (1949)
45.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.family.contrasts import EffectContrasts, UnitRows, chunks_of, of_each_axis, own_curve
from driftlab.family.partitions import Partition, Partitions, UnitOfLot, by_lot, tree
from driftlab.family.unit_information import UnitInformation
from driftlab.identification.acceptance import nats_of
from driftlab.identification.candidates import installed, offers_by_kind, proposals
from driftlab.identification.records import with_residuals
from driftlab.identification.state import name_of
from fusion_core.chunk import Array, Chunk, Integers
from fusion_core.contracts import Effect
from fusion_core.host.registry import kind_of
from fusion_core.threads import one_thread

CHANCE = 5.0  # nats beyond the price, as in the loop
FOLDS = 5
IN_LOT = 6  # units of a lot, at least, to look at it alone
RIVAL, SIMPLER = 2.0, 1.0  # deviations of the difference of the predictions
LEFT_OUT = 3.0  # nats that left-out units have to become likelier by
MAX_COEFFICIENTS = 3  # an axis: with more, an effect is a map, or one's guess
HALVINGS = 36  # of the interval that holds s^2
MIN_UNITS = 5  # for a mean and its scatter
MIN_PLACEBOS = 3  # for the noise of a unit


@dataclass(frozen=True, eq=False)
class Offer:
    """An effect with hyper-parameters, and how many coefficients an axis it has here; a lag's one is 1."""

    effect: Effect
    size: int

    @property
    def group(self) -> tuple[str, str]:
        """Name and variant, common to offers that differ by hyper-parameters alone."""
        return name_of(self.effect), self.effect.variant

    @property
    def parameters(self) -> tuple[int, int]:
        """Number of coefficients; and of hyper-parameters, with one for a memory of the past."""
        return self.size, len(self.effect.continuous) + int(self.effect.fades)


@dataclass(frozen=True, eq=False)
class Candidate:
    """An offer and its evidence, nats."""

    offer: Offer
    mean: float  # of the mean of the coefficients
    size: float  # of their squares
    chance: float  # of both
    price: float  # of all trials
    lot: str  # that was looked at alone; empty: all
    left_out: Array  # (n,) gain in the log-likelihood of the coefficients of each unit, predicted from others

    @property
    def effect(self) -> Effect:
        """The effect."""
        return self.offer.effect

    @property
    def total(self) -> float:
        """Gain of all units."""
        return float(self.left_out.sum())

    @property
    def pays(self) -> bool:
        """True if there is enough evidence, and left-out units are predicted."""
        return self.chance > self.price + CHANCE and self.total > LEFT_OUT


def offers_for(units: Partition[Sequence[UnitOfLot]]) -> tuple[list[Offer], dict[str, str]]:
    """Return the offers of the installed effects, and why kinds of effects have none.

    Lines have none: their phase is the chamber's at the time, and no unit's.
    """
    sample = [soaked for soaked, _ in units.read()]
    channels = Counter(frozenset(soaked.recordings[0].channels) for soaked in sample)
    alike = [s for s in sample if frozenset(s.recordings[0].channels) == channels.most_common(1)[0][0]]
    chunks = [chunk for soaked in alike for chunk in _with_residual(soaked)]
    lines = [kind_of(cls) for cls in installed() if cls.course == "line"]
    refused = dict.fromkeys(lines, "its phase is no property of a unit")
    broken: dict[str, str] = {}
    kinds = offers_by_kind(partial(_offers_of, sample[0].axes, chunks), refused, broken)
    offers = [offer for _, of_kind in kinds for offer in of_kind]
    return offers, {**refused, **{kind: f"broken: {why}" for kind, why in broken.items()}}


def _offers_of(axes: tuple[str, ...], chunks: Sequence[Chunk], cls: type[Effect]) -> list[Offer]:
    sized = [
        Offer(effect, 1 if effect.acts_on_input else _coefficients(effect, chunks[0]))
        for effect in proposals(cls, axes, chunks, None)
    ]
    return [offer for offer in sized if 0 < offer.size <= MAX_COEFFICIENTS]


def _coefficients(effect: Effect, chunk: Chunk) -> int:
    """Return the number of coefficients an axis of an effect; 0 where those of one axis show on another."""
    signature = effect.signature(chunk.part(0, min(len(chunk), 500)), None)[0]
    d, p = signature.shape[1:]
    own = np.sum(of_each_axis(signature) ** 2) if p % d == 0 else np.nan
    return p // d if np.isclose(own, np.sum(signature**2)) else 0


def _with_residual(soaked: UnitInformation) -> list[Chunk]:
    curve = own_curve(soaked)
    parts = [rows.bias - soaked.knots.values(rows.T) @ curve.T for rows in soaked.recordings]
    return with_residuals(chunks_of(soaked), parts)


def contrasts_of(
    sample: Partitions[Sequence[UnitOfLot]], offers: Sequence[Offer], beside: Sequence[Effect]
) -> EffectContrasts:
    """Return the contrasts of the units for all offers beside the effects in the model: arrays over (n, d, K)."""
    effects, sizes = [offer.effect for offer in offers], [offer.size for offer in offers]
    found = [one for own in sample.map(partial(_contrasts, effects, sizes, beside)) for one in own]
    return together([contrasts for contrasts, _ in found], [lot for _, lot in found])


def _contrasts(
    effects: Sequence[Effect], sizes: Sequence[int], beside: Sequence[Effect], units: Sequence[UnitOfLot]
) -> list[tuple[EffectContrasts, str]]:
    with one_thread():
        return [(UnitRows(soaked, beside).contrasts(effects, sizes), lot) for soaked, lot in units]


def together(units: Sequence[EffectContrasts], lots: Sequence[str] = ()) -> EffectContrasts:
    """Return the contrasts of units, and their lots, as arrays over units."""
    arrays = (np.stack([getattr(unit, name) for unit in units]) for name in ("c", "information", "placebos"))
    return EffectContrasts(*arrays, lots=tuple(lots))


def evaluate(offers: Sequence[Offer], contrasts: EffectContrasts) -> list[Candidate]:
    """Return every offer with its evidence: of all units, or of the one lot that has it most clearly."""
    lots = contrasts.lots
    everyone, members = np.arange(len(lots)), sorted(by_lot(lots).items())
    groups = {"": everyone}
    if len(members) > 1:
        groups |= {name: units for name, units in members if name and len(units) >= IN_LOT}
    of_groups = {name: chances(offers, contrasts, units) for name, units in groups.items()}
    price = {name: float(np.log(len(offers) * (len(groups) if name else 1))) for name in groups}
    gained = _left_out(offers, contrasts, everyone)
    candidates = []
    for k, offer in enumerate(offers):
        lot, of_all = max(groups, key=lambda name: of_groups[name][k][2] - price[name]), gained[:, k]
        left_out = of_all
        if lot and of_groups[lot][k][2] > price[lot] + CHANCE:
            left_out = np.zeros(len(lots))
            left_out[groups[lot]] = _left_out([offer], _part(offers, contrasts, k), groups[lot])[:, 0]
            if left_out.sum() < of_all.sum() and of_groups[""][k][2] > price[""] + CHANCE:
                lot, left_out = "", of_all
        else:
            lot = ""
        candidates.append(Candidate(offer, *of_groups[lot][k], price[lot], lot, left_out))
    return candidates


def choose(candidates: Sequence[Candidate]) -> tuple[Candidate, list[Candidate]] | None:
    """Return the candidate that is taken and its rivals, the best of each kind; None where none pays."""
    best: dict[tuple[str, str], Candidate] = {}
    for one in candidates:
        key = one.offer.group
        if one.pays and (key not in best or one.total > best[key].total):
            best[key] = one
    if not best:
        return None
    first = max(best.values(), key=lambda one: one.total)
    near = [one for one in best.values() if one is not first and deficit(first, one) < SIMPLER]
    simpler = [one for one in near if one.offer.parameters < first.offer.parameters]
    taken = min(simpler, key=lambda one: (one.offer.parameters, -one.total)) if simpler else first
    rivals = [one for one in best.values() if one is not taken and deficit(first, one) < RIVAL]
    return taken, sorted(rivals, key=lambda one: -one.total)


def deficit(first: Candidate, other: Candidate) -> float:
    """Return the deficit of one candidate's predictions of units against another's, in its deviations."""
    difference = first.left_out - other.left_out
    spread = float(np.std(difference)) * np.sqrt(len(difference))
    return float(difference.sum()) / spread if spread > 0 else 0.0


def nested(offers: Sequence[Offer], contrasts: EffectContrasts, taken: Candidate, units: Integers) -> float:
    """Return the gain on units that had no part in choosing the hyper-parameters either, nats."""
    of_kind = [k for k, offer in enumerate(offers) if offer.group == taken.offer.group]
    parts = [_part(offers, contrasts, k) for k in of_kind]
    total, folds = 0.0, np.arange(len(units)) % FOLDS
    for fold in range(FOLDS):
        test, train = units[folds == fold], units[folds != fold]
        gained = [_left_out([offers[k]], part, train)[:, 0].sum() for k, part in zip(of_kind, parts, strict=True)]
        best = int(np.argmax(gained))
        total += float(_gains([offers[of_kind[best]]], parts[best], train, test).sum())
    return total


def between_lots(offer: Offer, contrasts: EffectContrasts) -> float | None:
    """Return the gain, mean a unit, in lots that had no part in the mean and the spread; None of one lot."""
    if len(set(lots := contrasts.lots)) < 2:
        return None
    return float(_left_out([offer], contrasts, np.arange(len(lots)), np.array(lots)).sum()) / len(lots)


def refine(
    sample: Partitions[Sequence[UnitOfLot]], taken: Candidate, grid: Collection[Offer], beside: Sequence[Effect]
) -> Effect:
    """Return the effect with each continuous hyper-parameter at the top of a parabola between its neighbours."""
    effect = _of_right_size(sample, taken, beside)
    for name, value in effect.hyper_parameters.items():
        known = sorted({offer.effect.hyper_parameters[name] for offer in grid if offer.group == taken.offer.group})
        if len(known) < 2:
            continue
        x = np.linspace(-1, 1, 9) * float(np.min(np.diff(np.log(known))))
        tries = [
            replace(taken.offer, effect=effect.model_copy(update={name: value * float(np.exp(step))})) for step in x
        ]
        if effect.acts_on_input:  # exactly, where the first look had the map's slope
            total = np.array([-tree(sample.map(partial(_squares, [*beside, one.effect]))) / 2 for one in tries])
        else:
            total = _left_out(tries, contrasts_of(sample, tries, beside), np.arange(len(sample))).sum(axis=0)
        k = int(np.clip(np.argmax(total), 1, len(x) - 2))
        a, b, c = total[k - 1 : k + 2]
        bend = a - 2 * b + c
        top = x[k] + (0.5 * (a - c) / bend * (x[1] - x[0]) if bend < 0 else 0.0)
        effect = effect.model_copy(update={name: value * float(np.exp(np.clip(top, x[0], x[-1])))})
    return effect


def _squares(effects: Sequence[Effect], units: Sequence[UnitOfLot]) -> float:
    """Return the sum of squares that curves and effects leave in units, in their noise."""
    with one_thread():
        return sum(float(r @ r) for soaked, _ in units for r in UnitRows(soaked, effects).r)


def _of_right_size(sample: Partitions[Sequence[UnitOfLot]], taken: Candidate, beside: Sequence[Effect]) -> Effect:
    """Return the effect; a lag as long as its size says."""
    if not taken.effect.acts_on_input:
        return taken.effect
    contrasts = contrasts_of(sample, [taken.offer], beside)
    size = float(_scale(contrasts.c, variances(*contrasts.flat()[1:]).reshape(contrasts.c.shape))[0])
    longer = {name: value * size for name, value in taken.effect.hyper_parameters.items() if size > 0}
    return taken.effect.model_copy(update=longer)


def chances(offers: Sequence[Offer], contrasts: EffectContrasts, units: Integers) -> list[tuple[float, float, float]]:
    """Return evidence of mean, of size and of both of each offer in some units, nats."""
    d, K = contrasts.c.shape[1:]
    c, information, placebos = contrasts.flat(units)
    z, noise = (values.reshape(d, K) for values in of_mean(c, variances(information, placebos), placebos))
    sizes, evidence = of_size(c, information, placebos).reshape(d, K), []
    for offer, own in zip(offers, _columns(offers), strict=True):
        mean = chance_of_means(z[:, own].ravel(), noise[:, own].ravel())
        # of a lag the size is known; a walk has the course of any effect of time, of whatever sign
        one = offer.effect.acts_on_input or offer.effect.walks
        size = 0.0 if one else chance_of_sizes(sizes[:, own].ravel())
        evidence.append((mean, size, mean if one else nats_of(2 * (mean + size), 4)))
    return evidence


def _columns(offers: Sequence[Offer]) -> list[slice]:
    """Return the columns of each offer."""
    return [slice(int(a), int(b)) for a, b in pairwise(np.cumsum([0, *(offer.size for offer in offers)]))]


def _part(offers: Sequence[Offer], contrasts: EffectContrasts, k: int) -> EffectContrasts:
    return contrasts.of(_columns(offers)[k])


def _left_out(
    offers: Sequence[Offer], contrasts: EffectContrasts, units: Integers, folds: NDArray[Any] | None = None
) -> Array:
    """Return the gains (n, offers) of each of some units, predicted from the other folds (n,) of these."""
    folds = np.arange(len(units)) % FOLDS if folds is None else folds
    total = np.zeros((len(units), len(offers)))
    for fold in np.unique(folds):
        total[folds == fold] = _gains(offers, contrasts, units[folds != fold], units[folds == fold])
    return total


def _scale(c: Array, v: Array) -> Array:
    """Return one size (K,) of coefficients (n, d, K) for all units and axes, at least 0."""
    w = 1 / v
    return np.asarray(np.maximum((w * c).sum(axis=(0, 1)) / np.maximum(w.sum(axis=(0, 1)), 1e-300), 0.0))


def _gains(offers: Sequence[Offer], contrasts: EffectContrasts, train: Integers, test: Integers) -> Array:
    """Return gains (units of test, offers) with mean and spread from others, all axes together.

    A lag that is half as long as it is taken to be shows about half as much: its size is one for all units and
    axes.
    """
    d, K = contrasts.c.shape[1:]
    c, information, placebos = contrasts.flat()
    v = variances(information, placebos)
    s2 = between(c[train], v[train])
    m = mean_of(c[train], v[train], s2)[0]
    lag = np.tile(np.repeat([o.effect.acts_on_input for o in offers], [o.size for o in offers]), d)
    size = np.tile(_scale(c[train].reshape(-1, d, K), v[train].reshape(-1, d, K)), d)
    gained = gains(c[test], v[test], np.where(lag, size, m), np.where(lag, 0.0, s2)).reshape(len(test), d, K)
    return np.asarray(np.add.reduceat(gained.sum(axis=1), [own.start for own in _columns(offers)], axis=1))


def noise_of(placebos: Array) -> tuple[Array, Array]:
    """Return the mean squares (..., K) of placebos, 1 where there are hardly any, and degrees of freedom of each."""
    count = np.count_nonzero(placebos, axis=-1)
    enough = count >= MIN_PLACEBOS
    square = np.sum(placebos**2, axis=-1) / np.maximum(count, 1)
    return np.where(enough, square, 1.0), np.where(enough, count, 0.0)


def variances(information: Array, placebos: Array) -> Array:
    """Return variances (n, K) of coefficients, by the noise that placebos show; infinite where nothing is seen.

    A unit's own mean square counts as much as that of all units.
    """
    seen = information > 0
    own = noise_of(placebos)[0]
    count = np.maximum(seen.sum(axis=0), 1)
    pooled = np.where(seen, own, 0.0).sum(axis=0) / count
    return np.where(seen, (own + pooled) / 2, np.inf) / np.where(seen, information, 1.0)


def between(c: Array, v: Array) -> Array:
    """Return the variance s^2 (K,) between units of c (n, K) with variances v, by Paule and Mandel; at least 0."""
    seen = np.isfinite(v)
    n = seen.sum(axis=0)
    lowest = np.min(v, axis=0, initial=np.inf)
    scale = np.where(np.isfinite(lowest), lowest, 1.0)

    def excess(s2: Array) -> Array:
        w = np.where(seen, 1 / (np.where(seen, v, 1.0) + s2), 0.0)
        m = (w * c).sum(axis=0) / np.maximum(w.sum(axis=0), 1e-300)
        return np.asarray((w * (c - m) ** 2).sum(axis=0) - (n - 1))

    low = np.zeros_like(scale)
    high = np.where(seen, c**2, 0.0).sum(axis=0) + scale
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        more = excess(middle) > 0
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.where(excess(np.zeros_like(scale)) > 0, (low + high) / 2, 0.0)


def mean_of(c: Array, v: Array, s2: Array) -> tuple[Array, Array, Array]:
    """Return means m (K,) of c (n, K), their deviations by the scatter between units, and degrees of freedom."""
    seen = np.isfinite(v)
    w = np.where(seen, 1 / (np.where(seen, v, 1.0) + s2), 0.0)
    w = w / np.maximum(w.sum(axis=0), 1e-300)
    m = (w * c).sum(axis=0)
    count = 1 / np.maximum((w**2).sum(axis=0), 1e-300)
    spread = (w**2 * (c - m) ** 2).sum(axis=0)
    sigma = np.sqrt(spread * count / np.maximum(count - 1, 1e-3))
    return m, sigma, np.maximum(count - 1, 1e-3)


def scores(m: Array, sigma: Array, freedom: Array) -> Array:
    """Return means over their deviations as normal scores (K,): what is as unlikely as Student's t."""
    from scipy.special import ndtri, stdtr

    ratio = np.where(sigma > 0, np.abs(m) / np.where(sigma > 0, sigma, 1.0), 0.0)
    p = np.maximum(stdtr(freedom, -ratio), 1e-304)
    return np.asarray(np.sign(m) * np.maximum(-ndtri(p), 0.0))


def of_mean(c: Array, v: Array, placebos: Array) -> tuple[Array, Array]:
    """Return normal scores (K,) of the means, and mean squares (K,) of those of the placebos."""
    n, K = c.shape
    seen = np.isfinite(v)
    if n < MIN_UNITS:
        return np.zeros(K), np.ones(K)
    z = np.where(seen.sum(axis=0) >= MIN_UNITS, scores(*mean_of(c, v, between(c, v))), 0.0)
    own = np.sqrt(noise_of(placebos)[0])[:, :, None]
    b = np.where(seen[:, :, None], placebos / own, 0.0)
    total = np.sqrt(np.maximum((b**2).sum(axis=0), 1e-300))
    return z, noise_of(np.where(total > 1e-100, b.sum(axis=0) / total, 0.0))[0]


def of_size(c: Array, information: Array, placebos: Array) -> Array:
    """Return normal scores (K,) of the squares of coefficients against those of the placebos of the same unit."""
    from scipy.special import fdtr, ndtri

    noise, freedom = noise_of(placebos)
    seen = (information > 0) & (freedom > 0)
    ratio = np.where(seen, c**2 * information / noise, 0.0)
    p = np.clip(fdtr(1, np.maximum(freedom, 1.0), ratio), 1e-9, 1 - 1e-9)
    z = np.where(seen, ndtri(p), 0.0)
    n = seen.sum(axis=0)
    return np.where(n >= MIN_UNITS, z.sum(axis=0) / np.sqrt(np.maximum(n, 1)), 0.0)


def chance_of_means(z: Array, noise: Array) -> float:
    """Return - log of the probability that scores of means (K,) are no more than chance, placebos' squares known."""
    held = z != 0
    if not np.any(held):
        return 0.0
    return nats_of(float(np.sum(z[held] ** 2)) / max(float(np.mean(noise[held])), 1.0), int(held.sum()))


def chance_of_sizes(z: Array) -> float:
    """Return - log of the probability that scores of sizes (K,) are no more than chance."""
    from scipy.special import log_ndtr

    held = z != 0
    return -float(log_ndtr(-np.sum(z[held]) / np.sqrt(held.sum()))) if np.any(held) else 0.0


def gains(c: Array, v: Array, m: Array, s2: Array) -> Array:
    """Return the log-likelihood ratio of each coefficient (n, K) as a draw from N(m, s^2) to noise, nats."""
    seen = np.isfinite(v)
    own = np.where(seen, v, 1.0)
    wide = own + s2
    return np.where(seen, 0.5 * (c**2 / own - (c - m) ** 2 / wide - np.log(wide / own)), 0.0)
