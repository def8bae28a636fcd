"""Which effects the units of a family have in common: evidence, what was left out, and which one is taken.

Of every candidate the units' coefficients are weighed twice (`driftlab.family.shared_effect_tests`), all axes together,
and both chances multiplied (R. A. Fisher, Statistical Methods for Research Workers, section 21.1). A candidate pays
where - log of the chance exceeds log M + CHANCE, M all that was tried: candidates, and candidates times lots where the
units of one lot are looked at alone. Then it has to predict: mean and spread from four fifths of the units make the
coefficients of the others likelier than noise does. Of those that do, the one that predicts best is taken; a simpler
one that is within one standard deviation of it (of the units' differences) before it; who is within two is a rival.

What a family may have in common: all that the installed effects propose for some of its units.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pydantic import ValidationError

from driftlab.family.contrasts import EffectColumns, EffectContrasts, chunks_of, of_each_axis, own_curve
from driftlab.family.parallel import ParallelMap, serial
from driftlab.family.shared_effect_tests import (
    between,
    chance_of_means,
    chance_of_sizes,
    gains,
    mean_of,
    of_mean,
    of_size,
    variances,
)
from driftlab.family.unit_information import UnitInformation
from driftlab.identification.candidates import installed
from driftlab.identification.state import name_of
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import FusionError, MissingChannel
from fusion_core.host.registry import kind_of

CHANCE = 5.0  # nats beyond the price, as in the loop
FOLDS = 5
IN_LOT = 6  # units of a lot, at least, to look at it alone
RIVAL, SIMPLER = 2.0, 1.0  # deviations of the difference of what is predicted
LEFT_OUT = 3.0  # nats that left-out units have to become likelier by

Indices = np.ndarray[tuple[int], np.dtype[np.intp]]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate and its evidence, nats.

    Attributes
    ----------
    mean, size : float
        Of the mean of the coefficients, and of their squares.
    chance, price : float
        Of both, and of all that was tried.
    lot : str
        The lot that was looked at alone; empty: all.
    left_out : (n,) array
        By how much the coefficients of each unit are likelier, predicted from others.
    """

    offer: Offer
    mean: float
    size: float
    chance: float
    price: float
    lot: str
    left_out: Array

    @property
    def effect(self) -> Effect:
        """The effect."""
        return self.offer.effect

    @property
    def total(self) -> float:
        """Of all units."""
        return float(self.left_out.sum())

    @property
    def pays(self) -> bool:
        """Whether there is enough evidence, and left-out units are predicted."""
        return self.chance > self.price + CHANCE and self.total > LEFT_OUT


def contrasts_of(
    sample: Iterable[UnitInformation], offers: Sequence[Offer], beside: Sequence[Effect], each: ParallelMap = serial
) -> EffectContrasts:
    """Return what the units show of all offers beside what is named: arrays over (n, d, K)."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    effects, sizes = [offer.effect for offer in offers], [offer.size for offer in offers]
    with threadpool_limits(1):
        found = list(each(partial(_contrasts, effects, sizes, beside), sample))
    return together(found)


def _contrasts(
    effects: Sequence[Effect], sizes: Sequence[int], beside: Sequence[Effect], soaked: UnitInformation
) -> EffectContrasts:
    return EffectColumns(soaked, beside).contrasts(effects, sizes)


def together(found: Sequence[EffectContrasts]) -> EffectContrasts:
    """Return the contrasts of units as arrays over units."""
    return EffectContrasts(
        *(np.stack([getattr(one, name) for one in found]) for name in ("c", "information", "placebos"))
    )


def evaluate(offers: Sequence[Offer], shown: EffectContrasts, lots: Sequence[str]) -> list[Candidate]:
    """Return every offer with its evidence: of all units, or of the one lot that has it most clearly."""
    names = [name for name, count in zip(*np.unique(lots, return_counts=True), strict=True) if count >= IN_LOT]
    everyone = np.arange(len(lots))
    groups = {"": everyone}
    if len(set(lots)) > 1:
        groups |= {str(name): np.flatnonzero(np.array(lots) == name) for name in names if name}
    of_groups = {name: chances(offers, shown, units) for name, units in groups.items()}
    left_out = _left_out(offers, shown, everyone)
    found = []
    for k, offer in enumerate(offers):
        price = {name: float(np.log(len(offers) * (len(groups) if name else 1))) for name in groups}
        best = max(groups, key=lambda name: of_groups[name][k][2] - price[name])
        own = left_out[:, k]
        if best and of_groups[best][k][2] > price[best] + CHANCE:
            own = np.zeros(len(lots))
            own[groups[best]] = _left_out([offer], _part(offers, shown, k), groups[best])[:, 0]
            if own.sum() < left_out[:, k].sum() and of_groups[""][k][2] > price[""] + CHANCE:
                best, own = "", left_out[:, k]
        else:
            best = ""
        found.append(Candidate(offer, *of_groups[best][k], price[best], best, own))
    return found


def chosen(found: Sequence[Candidate]) -> tuple[Candidate, list[Candidate]] | None:
    """Return which candidate is taken and its rivals, the best of each kind; None where none pays."""
    best: dict[tuple[str, str], Candidate] = {}
    for one in found:
        key = one.offer.family
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
    """Return by how many deviations one candidate predicts units worse than another."""
    difference = first.left_out - other.left_out
    spread = float(np.std(difference)) * np.sqrt(len(difference))
    return float(difference.sum()) / spread if spread > 0 else 0.0


def nested(offers: Sequence[Offer], shown: EffectContrasts, taken: Candidate, units: Indices) -> float:
    """Return the gain on units that had no part in choosing the hyper-parameters either, nats."""
    of_kind = [k for k, offer in enumerate(offers) if offer.family == taken.offer.family]
    parts = [_part(offers, shown, k) for k in of_kind]
    total = 0.0
    for fold in range(FOLDS):
        test, train = units[np.arange(len(units)) % FOLDS == fold], units[np.arange(len(units)) % FOLDS != fold]
        known = [_left_out([offers[k]], part, train)[:, 0].sum() for k, part in zip(of_kind, parts, strict=True)]
        best = int(np.argmax(known))
        total += float(_predicted(offers[of_kind[best]], parts[best], train, test).sum())
    return total


def between_lots(offer: Offer, shown: EffectContrasts, lots: Sequence[str]) -> float | None:
    """Return the gain, mean a unit, in lots that had no part in the mean and the spread; None of one lot."""
    names = sorted(set(lots))
    if len(names) < 2:
        return None
    gained = []
    for name in names:
        test = np.flatnonzero(np.array(lots) == name)
        train = np.flatnonzero(np.array(lots) != name)
        gained.append(_predicted(offer, shown, train, test).sum())
    return float(np.sum(gained)) / len(lots)


def refined(
    sample: Sequence[UnitInformation],
    taken: Candidate,
    grid: Collection[Offer],
    beside: Sequence[Effect],
    each: ParallelMap = serial,
) -> Effect:
    """Return the effect with each continuous hyper-parameter at the top of a parabola between its neighbours."""
    effect = _of_right_size(sample, taken, beside, each)
    for name, value in effect.hyper_parameters.items():
        known = sorted({offer.effect.hyper_parameters[name] for offer in grid if offer.family == taken.offer.family})
        if len(known) < 2:
            continue
        x = np.linspace(-1, 1, 9) * float(np.min(np.diff(np.log(known))))
        tries = [
            replace(taken.offer, effect=effect.model_copy(update={name: value * float(np.exp(step))})) for step in x
        ]
        if effect.acts_on_input:  # exactly, where the first look had the map's slope
            total = np.array([-_squares(sample, [*beside, one.effect], each) / 2 for one in tries])
        else:
            total = _left_out(tries, contrasts_of(sample, tries, beside, each), np.arange(len(sample))).sum(axis=0)
        k = int(np.clip(np.argmax(total), 1, len(x) - 2))
        a, b, c = total[k - 1 : k + 2]
        bend = a - 2 * b + c
        top = x[k] + (0.5 * (a - c) / bend * (x[1] - x[0]) if bend < 0 else 0.0)
        effect = effect.model_copy(update={name: value * float(np.exp(np.clip(top, x[0], x[-1])))})
    return effect


def _squares(sample: Sequence[UnitInformation], effects: Sequence[Effect], each: ParallelMap) -> float:
    """Return the sum of squares that curves and effects leave in the units, in their noise."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        return sum(each(partial(_square, effects), sample))


def _square(effects: Sequence[Effect], soaked: UnitInformation) -> float:
    return sum(float(r @ r) for r in EffectColumns(soaked, effects).r)


def _of_right_size(
    sample: Sequence[UnitInformation], taken: Candidate, beside: Sequence[Effect], each: ParallelMap
) -> Effect:
    """Return the effect; a lag as long as its size says."""
    if not taken.effect.acts_on_input:
        return taken.effect
    shown = contrasts_of(sample, [taken.offer], beside, each)
    flat = shown.c.reshape(len(sample), -1)
    v = variances(shown.information.reshape(flat.shape), shown.placebos.reshape(*flat.shape, -1))
    size = float(_scale(shown.c, v.reshape(shown.c.shape))[0])
    longer = {name: value * size for name, value in taken.effect.hyper_parameters.items() if size > 0}
    return taken.effect.model_copy(update=longer)


def chances(offers: Sequence[Offer], shown: EffectContrasts, units: Indices) -> list[tuple[float, float, float]]:
    """Return evidence of mean, of size and of both of each offer in some units, nats."""
    from scipy.stats import chi2

    c, information, placebos = shown.c[units], shown.information[units], shown.placebos[units]
    n, d, K = c.shape
    flat = (n, d * K)
    c, information, placebos = c.reshape(flat), information.reshape(flat), placebos.reshape(*flat, -1)
    z, noise = (values.reshape(d, K) for values in of_mean(c, variances(information, placebos), placebos))
    sizes = of_size(c, information, placebos).reshape(d, K)
    found, at = [], 0
    for offer in offers:
        own = slice(at, at + offer.size)
        at += offer.size
        mean = chance_of_means(z[:, own].ravel(), noise[:, own].ravel())
        # of a lag the size is known; a walk has the course of any effect of time, of whatever sign
        one = offer.effect.acts_on_input or offer.effect.walks
        size = 0.0 if one else chance_of_sizes(sizes[:, own].ravel())
        found.append((mean, size, mean if one else -float(chi2.logsf(2 * (mean + size), 4))))
    return found


def _part(offers: Sequence[Offer], shown: EffectContrasts, k: int) -> EffectContrasts:
    at = sum(offer.size for offer in offers[:k])
    own = slice(at, at + offers[k].size)
    return EffectContrasts(shown.c[..., own], shown.information[..., own], shown.placebos[..., own, :])


def _left_out(offers: Sequence[Offer], shown: EffectContrasts, units: Indices) -> Array:
    """Return the gains (n, offers) of each of some units, predicted from the other folds of these."""
    folds = np.arange(len(units)) % FOLDS
    total = np.zeros((len(units), len(offers)))
    for fold in range(FOLDS):
        total[folds == fold] = _gains(offers, shown, units[folds != fold], units[folds == fold])
    return total


def _predicted(offer: Offer, shown: EffectContrasts, train: Indices, test: Indices) -> Array:
    return _gains([offer], shown, train, test)[:, 0]


def _scale(c: Array, v: Array) -> Array:
    """Return one size (K,) of coefficients (n, d, K) for all units and axes, at least 0."""
    w = 1 / v
    return np.asarray(np.maximum((w * c).sum(axis=(0, 1)) / np.maximum(w.sum(axis=(0, 1)), 1e-300), 0.0))


def _gains(offers: Sequence[Offer], shown: EffectContrasts, train: Indices, test: Indices) -> Array:
    """Return gains (units of test, offers) with mean and spread from others, all axes together.

    A lag that is half as long as it is taken to be shows about half as much: its size is one for all units and
    axes.
    """
    n, d, K = shown.c.shape
    v = variances(shown.information.reshape(n, -1), shown.placebos.reshape(n, d * K, -1))
    c = shown.c.reshape(n, -1)
    s2 = between(c[train], v[train])
    m = mean_of(c[train], v[train], s2)[0]
    lag = np.tile(np.repeat([o.effect.acts_on_input for o in offers], [o.size for o in offers]), d)
    size = np.tile(_scale(c[train].reshape(-1, d, K), v[train].reshape(-1, d, K)), d)
    gained = gains(c[test], v[test], np.where(lag, size, m), np.where(lag, 0.0, s2)).reshape(len(test), d, K)
    edges = np.cumsum([0, *(offer.size for offer in offers)])[:-1]
    return np.asarray(np.add.reduceat(gained.sum(axis=1), edges, axis=1))


MOST = 3  # coefficients an axis: with more, an effect is a map, or one's guess


@dataclass(frozen=True, eq=False)
class Offer:
    """An effect with hyper-parameters, and how many coefficients an axis it has here; a lag's one is 1."""

    effect: Effect
    size: int

    @property
    def family(self) -> tuple[str, str]:
        """What it has in common with those that differ by hyper-parameters alone."""
        return name_of(self.effect), self.effect.variant

    @property
    def parameters(self) -> tuple[int, int]:
        """How simple it is: coefficients; and hyper-parameters, with one for a memory of what came before."""
        return self.size, len(self.effect.continuous) + int(self.effect.fades)


def offered(sample: Sequence[UnitInformation], without: Collection[str]) -> tuple[list[Offer], dict[str, str]]:
    """Return what is offered, and why kinds of effects are not.

    Lines are not: their phase is the chamber's at the time, and no unit's.
    """
    channels = Counter(frozenset(soaked.recordings[0].channels) for soaked in sample)
    alike = [s for s in sample if frozenset(s.recordings[0].channels) == channels.most_common(1)[0][0]]
    chunks = [chunk for soaked in alike for chunk in _with_residual(soaked)]
    found: list[Offer] = []
    refused: dict[str, str] = {}
    for cls in installed():
        kind = kind_of(cls)
        if kind in without:
            refused[kind] = "not wanted"
        elif cls.course == "line":
            refused[kind] = "its phase is no property of a unit"
        else:
            try:
                found += _of(cls, sample[0].axes, chunks)
            except MissingChannel:
                continue
            except FusionError as error:
                refused[kind] = f"broken: {error}"
    return found, refused


def _of(cls: type[Effect], axes: tuple[str, ...], chunks: Sequence[Chunk]) -> list[Offer]:
    try:
        blank = cls(axes=axes)  # type: ignore[call-arg]
    except ValidationError:
        return []
    found = []
    for proposed in blank.proposals(chunks):
        effect = proposed.beside_map(None) if set(proposed.requires) <= set(chunks[0].channels) else None
        if effect is None:
            continue
        size = 1 if effect.acts_on_input else _coefficients(effect, chunks[0])
        if 0 < size <= MOST:
            found.append(Offer(effect, size))
    return found


def _coefficients(effect: Effect, chunk: Chunk) -> int:
    """Return how many coefficients an axis an effect has; 0 where those of one axis show on another."""
    shown = effect.signature(chunk.part(0, min(len(chunk), 500)), None)[0]
    d, p = shown.shape[1:]
    if p % d:
        return 0
    own = of_each_axis(shown)
    return p // d if np.isclose(np.sum(own**2), np.sum(shown**2)) else 0


def _with_residual(soaked: UnitInformation) -> list[Chunk]:
    curve = own_curve(soaked)
    parts = [rows.bias - soaked.knots.values(rows.T) @ curve.T for rows in soaked.recordings]
    spread = np.maximum(np.std(np.concatenate(parts), axis=0), 1e-300)
    return [chunk.having(residual=part / spread) for chunk, part in zip(chunks_of(soaked), parts, strict=True)]
