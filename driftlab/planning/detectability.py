"""Detectability of effects on a planned recording, and their discrimination, before anything is recorded.

Every effect that the loop would try on the recording is taken beside the map: the nats of one of a stated size, the
smallest size that the loop would find, and the nats that are left when another effect may take its part. Lines of the
spectrum do not depend on a profile, and a function of the temperature alone is the map's.

The smallest size is that of the loop's own acceptance, on simulated noise (`MonteCarlo`). Its criteria are linear or
square in the measurements, so the least-squares fit of a few realisations of the noise, and of the effect alone, gives
for any size the share of the realisations that pass. As in the loop, an effect's hyper-parameters are those with which
it fits best, anew for each part that is left out. m realisations, S shapes that one effect may have, n rows, d axes;
y (n, m + S) is the realisations, then the shapes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.identification.acceptance import CHANCE, accept, matched_on_axes
from driftlab.identification.candidates import candidates_of
from driftlab.identification.cross_validation import LeftOutPart
from driftlab.identification.least_squares import Model, Term
from driftlab.identification.state import Search
from driftlab.identification.trials import AS_GOOD, evidence_of
from driftlab.noise.local_level import one_step
from driftlab.planning.simulated_search import Body, Information, measured, noises, planned, shapes
from driftlab.planning.unit_model import UnitModel
from driftlab.units import BiasUnit
from fusion_core.chunk import Array, Integers
from fusion_core.contracts import Effect
from fusion_core.thermal.sweeps import one_way

STATED = 10.0  # of the white noise of a minute's mean: the size whose nats are given
TWICE = 2.0  # times the smallest size that is found: the size at which effects are to be distinguished
ALIKE = 0.2  # of the nats, left at most where one with other hyper-parameters is to stand for an effect
OF_GRID = (0.0, 0.5, 1.0)  # of an effect's hyper-parameters, for the smallest size
REALISATIONS = 7  # of the noise
POWERS = range(-2, 7)  # of 2, times the size that has ten nats: sizes that are tried
HALVINGS = 3  # of the last factor 2


@dataclass(frozen=True)
class Detectability:
    """Detectability of one effect on a planned recording."""

    name: str  # its name in the loop
    effect: Effect  # in the middle of its hyper-parameters
    nats: float  # of one of the stated size
    threshold: float  # nats that the loop requires at short times; it requires better predictions of left-out parts too
    # smallest size in SI, from lowest to highest on each axis, that is found in half of all recordings; infinite: none
    found_from: float
    best: float  # the smallest of these over its hyper-parameters
    worst: float  # the largest
    nats_found: float  # of one of twice the smallest size; 0 where none is found
    left: dict[str, float]  # share of the nats that is left where another effect may take its part

    @property
    def found(self) -> bool:
        """True if an effect of any size would be identified."""
        return bool(np.isfinite(self.found_from))

    @property
    def confused_with(self) -> tuple[str, ...]:
        """Effects that a likelihood would hardly tell from this one where it is twice the smallest size."""
        return tuple(name for name, share in self.left.items() if self.found and self.nats_found * share < AS_GOOD)


@dataclass(frozen=True)
class DetectabilityReport:
    """Detectability of effects on a planned recording."""

    effects: tuple[Detectability, ...]  # the effects, the one found at the smallest size first
    silent: tuple[str, ...]  # effects that the recording cannot show at all
    size: float  # the size whose nats are given, from lowest to highest, SI
    shown: BiasUnit  # unit of the bias
    still: tuple[str, ...]  # channels that are held: effects that follow them are not seen
    curve_known: bool  # whether the map's curve is the unit's own
    only: str  # `warms up` or `cools down`, where the recording does nothing else


def predict_detectability(
    unit: UnitModel, body: Body, duration: float, kinds: Collection[str] = (), still: Sequence[str] = ()
) -> DetectabilityReport:
    """Return the detectability of effects on a recording of `duration` s with the temperatures `body(t)`.

    Of all, or of `kinds`; `still` are channels that are held where they are.
    """
    search = planned(unit, body, duration)
    everything = families(search)
    price = float(np.log(max(len({repr(effect) for own in everything.values() for effect in own}), 1)))
    asked = {name: own for name, own in everything.items() if not kinds or own[0].kind in kinds}
    of_name = [(name, effect) for name, own in asked.items() for effect in own]
    information = Information(search, unit, [effect for _, effect in of_name])
    places = {name: [k for k, (other, _) in enumerate(of_name) if other == name] for name in asked}
    simulated = MonteCarlo(search, unit, price)
    size = STATED * float(np.sqrt(np.mean(unit.noise**2) / 60.0))
    effects = [_detectability(information, places, name, size, simulated) for name in asked]
    silent = sorted(set(_by_turning(unit, duration, kinds)) - set(asked))
    order = sorted(effects, key=lambda one: (one.found_from, one.name))
    T = body(np.linspace(0.0, duration, 2000))
    return DetectabilityReport(
        tuple(order), tuple(silent), size, unit.unit, tuple(still), unit.curve_known, one_way([T])
    )


def families(search: Search) -> dict[str, list[Effect]]:
    """Return the effects that the loop would try on a planned recording, by name, each with its hyper-parameters."""
    own: dict[str, list[Effect]] = {}
    for (name, *_), terms in candidates_of(search).items():
        effect = terms[0].effect
        if not terms[0].free and effect.course != "line" and not _of_map(search, effect):
            own.setdefault(name, []).extend(term.effect for term in terms)
    return own


def _of_map(search: Search, effect: Effect) -> bool:
    """Return True if an effect is a function of the temperature alone: its signature commutes with time reversal."""
    chunk = search.columns.evidence.chunks[0]
    back = chunk.having(temperature=chunk["temperature"][::-1].copy())
    way, reverse = (effect.signature(one, None)[0] for one in (chunk, back))
    return bool(np.any(way)) and np.allclose(reverse[::-1], way, rtol=1e-9, atol=0.0)


def _by_turning(unit: UnitModel, duration: float, kinds: Collection[str]) -> list[str]:
    """Return the effects that the loop would try on a recording that goes up and down over the same time."""
    search = planned(unit, lambda t: 30.0 * np.abs(1 - np.abs(1 - 4 * t / duration)), duration, rows=200)
    return [name for name, own in families(search).items() if not kinds or own[0].kind in kinds]


def _detectability(
    information: Information, places: dict[str, list[int]], name: str, size: float, simulated: MonteCarlo
) -> Detectability:
    own = places[name]
    sizes = _smallest(information, own, simulated)
    k = own[round(0.5 * (len(own) - 1))]
    theta, unit_nats = _one(information, k, simulated)
    smallest, whole = sizes[OF_GRID.index(0.5)], max(information.nats(k, theta), 1e-300)
    left = {other: information.left(k, theta, at) / whole for other, at in places.items() if other != name}
    nats_found = unit_nats * (TWICE * smallest) ** 2 if np.isfinite(smallest) else 0.0
    return Detectability(
        name, information.effects[k], unit_nats * size**2, simulated.price + CHANCE, smallest, min(sizes), max(sizes),
        nats_found, left,
    )  # fmt: skip


def _one(information: Information, k: int, simulated: MonteCarlo) -> tuple[Array, float]:
    """Return coefficients of an effect that is one SI unit from lowest to highest, and its nats."""
    theta = information.direction(k)
    theta = theta / max(float(np.max(np.ptp(_shape(simulated, information.effects[k], theta), axis=0))), 1e-300)
    return theta, information.nats(k, theta)


def _smallest(information: Information, own: list[int], simulated: MonteCarlo) -> list[float]:
    """Return the smallest sizes that are found, over the grid of hyper-parameters."""
    at = [own[round(share * (len(own) - 1))] for share in OF_GRID]
    shapes, starts, alike = [], [], np.ones((len(at), len(own)), dtype=bool)
    for j, k in enumerate(at):
        theta, nats = _one(information, k, simulated)
        shapes.append(_shape(simulated, information.effects[k], theta, whole=True))
        starts.append(float(np.sqrt(10.0 / nats)) if nats > 0 else 0.0)
        alike[j] = [information.left(k, theta, [other]) <= ALIKE * nats for other in own]
    return simulated.smallest([information.effects[k] for k in own], shapes, starts, alike)


def _shape(simulated: MonteCarlo, effect: Effect, theta: Array, *, whole: bool = False) -> Array:
    axes = range(len(simulated.unit.axes))
    return np.stack([shapes(simulated.search, simulated.unit, effect, a, whole=whole) @ theta for a in axes], axis=1)


@dataclass(frozen=True)
class EffectEstimate:
    """Size of an effect in recordings, from lowest to highest, on the axis that shows it best, SI.

    `sure` is whether it has as many nats as the loop requires; `sigma` is infinite where temperature never shows it.
    """

    name: str
    axis: str
    size: float
    sigma: float
    sure: bool


def effects_in(
    unit: UnitModel, recordings: Sequence[tuple[Array, Array]], dt: float, kinds: Collection[str] = ()
) -> tuple[EffectEstimate, ...]:
    """Return the sizes of effects in recordings, T (N,) and bias (N, d) of each, one sample each dt in s.

    Each by itself beside the map, with the hyper-parameters that fit best; but for those on the map's input, whose size
    is that of the map's slope.
    """
    search = measured(unit, recordings, dt)
    every = families(search)
    price = float(np.log(max(sum(map(len, every.values())), 1)))
    seen = []
    for name, own in every.items():
        if own[0].acts_on_input or (kinds and own[0].kind not in kinds):
            continue
        information = Information(search, unit, own)
        single = [information.size(k) for k in range(len(own)) if information.columns_of(k) == 1]
        if not single:
            continue
        size, sigma = max(single, key=lambda pair: float(np.sum((pair[0] / pair[1]) ** 2)))
        nats = 0.5 * float(np.sum((size / sigma) ** 2))
        axis = int(np.argmax(np.abs(size) / sigma))
        sure = nats > price + CHANCE
        seen.append(EffectEstimate(name, unit.axes[axis], abs(float(size[axis])), float(sigma[axis]), sure))
    turning = _by_turning(unit, len(recordings[0][0]) * dt, kinds)
    never = (EffectEstimate(name, "", np.nan, np.inf, sure=False) for name in sorted(set(turning) - set(every)))
    return (*seen, *never)


class MonteCarlo:
    """Realisations of one planned recording, a search without effects; `price` is the log of the candidates there."""

    def __init__(self, search: Search, unit: UnitModel, price: float) -> None:
        self.search, self.unit, self.price = search, unit, price
        evidence, rng = search.columns.evidence, np.random.default_rng(0)
        interval, shape = evidence.interval, (len(unit.axes), len(evidence), REALISATIONS)
        white = rng.normal(size=shape) * (unit.noise / np.sqrt(interval))[:, None, None]
        walk = np.cumsum(rng.normal(size=shape), axis=1) * (unit.walk * np.sqrt(interval))[:, None, None]
        self.noise, self.noises = white + walk, noises(unit, interval)  # (d, n, m) in SI, and of the rows of each axis
        self.curve = unit.curve(evidence.rows([chunk["temperature"] for chunk in evidence.chunks])).T

    def smallest(
        self, effects: Sequence[Effect], shapes: Sequence[Array], starts: Sequence[float], alike: Array
    ) -> list[float]:
        """Return the sizes in SI from which on most realisations pass, one for each shape; infinite where none helps.

        `effects` are one effect with the hyper-parameters that the loop tries, `shapes` (n, d) its signatures of one SI
        unit; of an effect on the map's input the whole curve, the map's own part with it: with its slope it grows. The
        answers may be near `starts`, and `alike` (S, effects) says which hyper-parameters are near enough to those of a
        shape to count as found.
        """
        case = _Case(self, effects, shapes, alike)
        sizes = [self._smallest(case, j, start) for j, start in enumerate(starts)]
        self.search.squares.forget()  # no other effect asks for these fits
        return sizes

    def _smallest(self, case: _Case, j: int, start: float) -> float:
        power = next((k for k in POWERS if case.passes(j, start * 2.0**k)), None)
        if power is None:
            return float("inf")
        low, high = power - 1.0, float(power)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if case.passes(j, start * 2.0**middle) else (middle, high)
        return float(start * 2.0 ** ((low + high) / 2))


@dataclass(frozen=True)
class _Fit:
    """Fit of a model to all signals on one axis, on some segments: coefficients (k, m + S) and residual squares."""

    cols: Integers
    beta: Array
    left: Array  # (m + S, m + S), with what the ridge adds


class _Case:
    """One effect on the realisations: fits and left-out errors with and without it in the model."""

    def __init__(self, bench: MonteCarlo, effects: Sequence[Effect], shapes: Sequence[Array], alike: Array) -> None:
        self.bench, self.effects, self.alike = bench, list(effects), alike
        acting = effects[0].acts_on_input
        noise = bench.noise + (0.0 if acting else bench.curve[:, :, None])
        self.y = [np.column_stack([noise[axis], *(s[:, axis] for s in shapes)]) for axis in range(len(noise))]
        columns = bench.search.columns
        models: list[Model] = [(), *((Term(effect),) for effect in effects)]
        for model in models:  # columns are made first, since their number is that of the inner products
            columns.of_map([term.effect for term in model])
        W = columns.W
        self._seen = [[W[s.rows].T @ y[s.rows] for s in columns.segments] for y in self.y]
        self._squares = [[y[s.rows].T @ y[s.rows] for s in columns.segments] for y in self.y]
        parts = bench.search.left_out
        sets = [part.rest for part in parts] + [bench.search.everything]
        self._fits = [[[self._fit(m, axis, own) for axis in range(len(self.y))] for own in sets] for m in models]
        self._left_out = [
            [
                [self._error(fit, part, axis) for axis, fit in enumerate(own)]
                for part, own in zip(parts, fits[:-1], strict=True)
            ]
            for fits in self._fits
        ]
        self._white = [self._without_map(axis, y) for axis, y in enumerate(self.y)]  # (n - 1, m + S)

    def passes(self, j: int, size: float) -> bool:
        """Return True if most realisations pass where the effect has the j-th shape and this size."""
        passed = 0
        for k in range(REALISATIONS):
            passed += self._passes(k, REALISATIONS + j, size)
            if passed > REALISATIONS // 2 or passed + REALISATIONS - 1 - k <= REALISATIONS // 2:
                break
        return passed > REALISATIONS // 2

    def _passes(self, k: int, j: int, size: float) -> bool:
        """Return True if realisation k passes, with the j-th signal of this size in it."""
        number, search = self._chosen(-1, k, j, size), self.bench.search
        if not self.alike[j - REALISATIONS, number]:
            return False
        models = [1 + self._chosen(p, k, j, size) for p in range(len(search.left_out))], [0] * len(search.left_out)
        errors, without = (
            [[e[:, k] + size * e[:, j] for e in self._left_out[m][p]] for p, m in enumerate(own)] for own in models
        )
        effect, fast = self.effects[number], self._fast(number, k, j, size)
        given = search, effect, errors, without, fast, self.bench.price
        return all(accept(effect, evidence_of(*given, gained=gained), ())[0] for gained in (False, True))

    def _chosen(self, own: int, k: int, j: int, size: float) -> int:
        """Return the hyper-parameters that fit realisation k best, of one set of segments (-1: all of them)."""
        costs = [
            sum(
                np.log(max(float(f.left[k, k] + 2 * size * f.left[k, j] + size**2 * f.left[j, j]), 1e-300))
                for f in fits[own]
            )
            for fits in self._fits[1:]
        ]
        return int(np.argmin(costs))

    def _fast(self, number: int, k: int, j: int, size: float) -> tuple[float, float]:
        """Return the figures of the matched filter, as `driftlab.identification.acceptance.fast_evidence`."""
        left = (own[:, k] + size * own[:, j] for own in self._white)
        axes = ((e, self._columns(number, axis, k, j, size)) for axis, e in enumerate(left))
        return matched_on_axes(axes, len(self.effects[number].continuous))

    def _columns(self, number: int, axis: int, k: int, j: int, size: float) -> Array:
        """Return an effect's columns (n - 1, p), the map out of them, as white."""
        W, effect = self.bench.search.columns.W, self.effects[number]
        Z = W[:, self.bench.search.columns.of(effect).columns[axis]]
        if effect.acts_on_input:
            base, other = self._fits[0][-1][axis], self._fits[1 + number][-1][axis]
            own = [W[:, f.cols] @ (f.beta[:, k] + size * f.beta[:, j]) for f in (base, other)]
            Z = np.column_stack([Z, own[0] - own[1]])
        return self._without_map(axis, Z)

    def _without_map(self, axis: int, values: Array) -> Array:
        """Return columns (n, p) less what map and level can make of them, as white (n - 1, p)."""
        search = self.bench.search
        fit = search.squares.fit((), axis, search.everything)
        B = search.columns.W[:, fit.cols]
        return one_step([values - B @ fit.equations.solve(B.T @ values)], self.bench.noises[axis].gain)[0]

    def _fit(self, model: Model, axis: int, segments: tuple[int, ...]) -> _Fit:
        fit = self.bench.search.squares.fit(model, axis, segments)
        b = sum(self._seen[axis][k][fit.cols] for k in segments)
        beta = fit.equations.solve(b)
        return _Fit(fit.cols, beta, sum(self._squares[axis][k] for k in segments) - b.T @ beta)

    def _error(self, fit: _Fit, part: LeftOutPart, axis: int) -> Array:
        """Return the errors (n', m + S) of predicting a part from the rest, less their means."""
        e = self.y[axis][part.rows] - self.bench.search.columns.W[part.rows][:, fit.cols] @ fit.beta
        e = e[part.window.stop - part.rows.start :]
        return np.asarray(e - e.mean(axis=0))
