"""Which effects a profile could tell apart, and which not, before anything is recorded.

Every effect that the loop would try on the recording is looked at with the map beside it: how many nats one of a stated
size has, from which size on the loop would find it, and how many nats are left when another effect may take its part.
Lines of the spectrum do not depend on a profile, and what is a function of the temperature alone is the map's.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.loop.gates import CHANCE
from driftlab.loop.offers import offered
from driftlab.loop.recorded import one_way
from driftlab.loop.state import Search
from driftlab.loop.trials import AS_GOOD
from driftlab.planning.detection import Bench, bench
from driftlab.planning.information import Information
from driftlab.planning.recording import Body, Unit, measured, planned, shapes
from driftlab.units import BiasUnit
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

STATED = 10.0  # of the white noise of a minute's mean: the size whose nats are given
TWICE = 2.0  # of the smallest size that is found: the size at which effects are to be told apart
ALIKE = 0.2  # of the nats, left at most where one with other hyper-parameters is to stand for an effect
OF_GRID = (0.0, 0.5, 1.0)  # of an effect's hyper-parameters: where the smallest size is looked for


@dataclass(frozen=True)
class Foretold:
    """What a planned recording would say of one effect.

    Attributes
    ----------
    name : str
        What the loop calls it.
    effect : Effect
        In the middle of its hyper-parameters.
    nats : float
        Of one of the stated size.
    threshold : float
        Nats that the loop asks for at short times; it asks for better predictions of left-out parts too.
    found_from : float
        Smallest size in SI, from lowest to highest on each axis, that the loop would find in half of all recordings;
        infinite where none.
    best, worst : float
        The same, the smallest and the largest over its hyper-parameters.
    nats_found : float
        Of one of twice the smallest size; 0 where none is found.
    left : dict of str to float
        Share of the nats that is left where another effect may take its part.
    """

    name: str
    effect: Effect
    nats: float
    threshold: float
    found_from: float
    best: float
    worst: float
    nats_found: float
    left: dict[str, float]

    @property
    def found(self) -> bool:
        """Whether the loop would find one of any size."""
        return bool(np.isfinite(self.found_from))

    @property
    def confused_with(self) -> tuple[str, ...]:
        """Effects that a likelihood would hardly tell from this one where it is twice the smallest size."""
        return tuple(name for name, share in self.left.items() if self.found and self.nats_found * share < AS_GOOD)


@dataclass(frozen=True)
class Outlook:
    """What a planned recording would say of effects.

    Attributes
    ----------
    effects : tuple of Foretold
        The effects, what is found at the smallest size first.
    silent : tuple of str
        Effects that the recording cannot show at all.
    size : float
        The size whose nats are given, from lowest to highest, SI.
    shown : BiasUnit
        Unit of the bias.
    still : tuple of str
        Channels that are held: what follows them is not seen.
    curve_known : bool
        Whether the map's curve is the unit's own.
    only : str
        `warms up` or `cools down`, where the recording does nothing else.
    """

    effects: tuple[Foretold, ...]
    silent: tuple[str, ...]
    size: float
    shown: BiasUnit
    still: tuple[str, ...]
    curve_known: bool
    only: str


def foretell(
    unit: Unit, body: Body, duration: float, kinds: Collection[str] = (), still: Sequence[str] = ()
) -> Outlook:
    """Return what a recording of `duration` s with the temperatures `body(t)` would say of effects.

    Of all, or of `kinds`; `still` are channels that are held where they are.
    """
    found = planned(unit, body, duration)
    everything = families(found)
    price = float(np.log(max(len({repr(effect) for own in everything.values() for effect in own}), 1)))
    asked = {name: own for name, own in everything.items() if not kinds or own[0].kind in kinds}
    of_name = [(name, effect) for name, own in asked.items() for effect in own]
    information = Information(found, unit, [effect for _, effect in of_name])
    places = {name: [k for k, (other, _) in enumerate(of_name) if other == name] for name in asked}
    twins = bench(found, unit, price)
    size = STATED * float(np.sqrt(np.mean(unit.white**2) / 60.0))
    effects = [_foretold(information, places, name, size, twins) for name in asked]
    silent = sorted(set(_by_turning(unit, duration, kinds)) - set(asked))
    order = sorted(effects, key=lambda one: (one.found_from, one.name))
    T = body(np.linspace(0.0, duration, 2000))
    return Outlook(tuple(order), tuple(silent), size, unit.shown, tuple(still), unit.curve_known, one_way([T]))


def families(found: Search) -> dict[str, list[Effect]]:
    """Return the effects that the loop would try on a planned recording, by name, each with its hyper-parameters."""
    own: dict[str, list[Effect]] = {}
    for (name, *_), terms in offered(found).items():
        effect = terms[0].effect
        if not terms[0].free and effect.course != "line" and not _of_map(found, effect):
            own.setdefault(name, []).extend(term.effect for term in terms)
    return own


def _of_map(found: Search, effect: Effect) -> bool:
    """Return whether an effect is a function of the temperature alone: run backwards, it shows the same backwards."""
    chunk = found.columns.evidence.chunks[0]
    back = chunk.having(temperature=chunk["temperature"][::-1].copy())
    shown = effect.signature(chunk, None)[0]
    return bool(np.any(shown)) and np.allclose(effect.signature(back, None)[0][::-1], shown, rtol=1e-9, atol=0.0)


def _by_turning(unit: Unit, duration: float, kinds: Collection[str]) -> list[str]:
    """Return the effects that the loop would try on a recording that goes up and down over the same time."""
    found = planned(unit, lambda t: 30.0 * np.abs(1 - np.abs(1 - 4 * t / duration)), duration, rows=200)
    return [name for name, own in families(found).items() if not kinds or own[0].kind in kinds]


def _foretold(information: Information, places: dict[str, list[int]], name: str, size: float, twins: Bench) -> Foretold:
    own = places[name]
    sizes = _smallest(information, own, twins)
    k = own[round(0.5 * (len(own) - 1))]
    theta, unit_nats = _one(information, k, twins)
    smallest, whole = sizes[OF_GRID.index(0.5)], max(information.nats(k, theta), 1e-300)
    left = {other: information.left(k, theta, at) / whole for other, at in places.items() if other != name}
    found = unit_nats * (TWICE * smallest) ** 2 if np.isfinite(smallest) else 0.0
    best, worst = min(sizes), max(sizes)
    return Foretold(
        name, information.effects[k], unit_nats * size**2, twins.price + CHANCE, smallest, best, worst, found, left
    )


def _one(information: Information, k: int, twins: Bench) -> tuple[Array, float]:
    """Return coefficients of an effect that is one SI unit from lowest to highest, and its nats."""
    theta = information.direction(k)
    theta = theta / max(float(np.max(np.ptp(_shape(twins, information.effects[k], theta), axis=0))), 1e-300)
    return theta, information.nats(k, theta)


def _smallest(information: Information, own: list[int], twins: Bench) -> list[float]:
    """Return the smallest sizes that are found, over the grid of hyper-parameters."""
    at = [own[round(share * (len(own) - 1))] for share in OF_GRID]
    shapes, starts, alike = [], [], np.ones((len(at), len(own)), dtype=bool)
    for j, k in enumerate(at):
        theta, nats = _one(information, k, twins)
        shapes.append(_shape(twins, information.effects[k], theta, whole=True))
        starts.append(float(np.sqrt(10.0 / nats)) if nats > 0 else 0.0)
        alike[j] = [information.left(k, theta, [other]) <= ALIKE * nats for other in own]
    return twins.smallest([information.effects[k] for k in own], shapes, starts, alike)


def _shape(twins: Bench, effect: Effect, theta: Array, *, whole: bool = False) -> Array:
    axes = range(len(twins.unit.axes))
    return np.stack([shapes(twins.found, twins.unit, effect, a, whole=whole) @ theta for a in axes], axis=1)


@dataclass(frozen=True)
class Seen:
    """How large an effect may be in what was recorded, from lowest to highest, on the axis that shows it best, SI.

    `sure` is whether it has as many nats as the loop asks for; `sigma` is infinite where temperature never shows it.
    """

    name: str
    axis: str
    size: float
    sigma: float
    sure: bool


def seen_so_far(
    unit: Unit, recordings: Sequence[tuple[Array, Array]], dt: float, kinds: Collection[str] = ()
) -> tuple[Seen, ...]:
    """Return how large effects are in recordings, T (N,) and bias (N, d) of each, one sample each dt in s.

    Each by itself beside the map, with the hyper-parameters that fit best; but for those on the map's input, whose size
    is that of the map's slope.
    """
    found = measured(unit, recordings, dt)
    every = families(found)
    price = float(np.log(max(sum(map(len, every.values())), 1)))
    seen = []
    for name, own in every.items():
        if own[0].acts_on_input or (kinds and own[0].kind not in kinds):
            continue
        information = Information(found, unit, own)
        single = [information.size(k) for k in range(len(own)) if information.columns_of(k) == 1]
        if not single:
            continue
        size, sigma = max(single, key=lambda pair: float(np.sum((pair[0] / pair[1]) ** 2)))
        nats = 0.5 * float(np.sum((size / sigma) ** 2))
        axis = int(np.argmax(np.abs(size) / sigma))
        sure = nats > price + CHANCE
        seen.append(Seen(name, unit.axes[axis], abs(float(size[axis])), float(sigma[axis]), sure))
    turning = _by_turning(unit, len(recordings[0][0]) * dt, kinds)
    never = (Seen(name, "", np.nan, np.inf, sure=False) for name in sorted(set(turning) - set(every)))
    return (*seen, *never)
