"""Each family at its best beside the model so far: hyper-parameters, left-out errors, evidence.

Hyper-parameters by training error: which of a family's candidates fits some segments best beside a base.

With base columns B (map, levels, effects that stay) taken out once, the sum of squares that any candidate leaves is a
problem of its own few columns: of the candidates' reduced inner products, the Schur complement, only theirs::

    R = G - V V',    V = G[:, B] U^-1,  U'U = G[B, B] + K,    cost = R_yy - R_yc (R_cc + ridge)^-1 R_cy

A candidate that acts on the map's input has other map columns, and is fitted whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import log
from os import cpu_count
from typing import NamedTuple

import numpy as np

from driftlab.identification.acceptance import CandidateEvidence, accept, fast_evidence
from driftlab.identification.candidates import Family, family_of
from driftlab.identification.columns import EffectRegressors, left_with_starts
from driftlab.identification.least_squares import LeastSquares, Model, Term
from driftlab.identification.records import move_together
from driftlab.identification.state import Errors, Search, Trial
from driftlab.noise.local_level import LocalLevel, effective
from fusion_core.chunk import Array, Integers
from fusion_core.contracts import Effect

WORTH = 0.97  # of the sum of squares in the fit itself: a candidate that gains less is not cross-validated
AS_GOOD = 3.0  # nats: less likely by less than 20 times
BLOCKS = 6  # of each part, for the uncertainty of a left-out error


def difference(trial: Trial, other: Trial) -> float:
    """Return the log of the ratio of two trials' left-out errors, mean over the axes."""
    return float(np.mean(np.log(trial.blocks.sum(axis=1) / other.blocks.sum(axis=1))))


def uncertainty(trial: Trial, other: Trial) -> float:
    """Return the standard deviation of `difference`, as it varies from block to block; every row counts twice.

    What is left moves all axes at once where they have one cause, so that a block is one draw, and not one an axis.
    """
    a, b = (t.blocks / t.blocks.sum(axis=1, keepdims=True) for t in (trial, other))
    return float(np.sqrt(2 * np.sum(np.mean(a - b, axis=0) ** 2)))


def as_good(trial: Trial, chosen: Trial) -> bool:
    """Return True if neither left-out errors nor likelihood tell a trial from the chosen one."""
    close = difference(trial, chosen) < 2 * uncertainty(trial, chosen)
    return close and trial.likelihood > chosen.likelihood - AS_GOOD


def contains(columns: EffectRegressors, wide: Term, term: Term) -> bool:
    """Return True if a term's columns are combinations of another's, on every axis."""
    if wide.effect.acts_on_input or term.effect.acts_on_input or wide is term:
        return False
    pairs = zip(columns.of(term.effect).columns, columns.of(wide.effect).columns, strict=True)
    return all(columns.within(inner, outer) for inner, outer in pairs)


def is_copy(search: Search, effect: Effect, other: Effect) -> bool:
    """Return True if an effect is another one of channels that move with that one's."""
    own, theirs = set(effect.requires) - set(other.requires), set(other.requires) - set(effect.requires)
    if type(effect) is not type(other) or not own or len(own) != len(theirs):
        return False
    return all(any(move_together(search.evidence.chunks, a, b) for a in own) for b in theirs)


def tried(search: Search, base: Model, families: dict[Family, list[Term]]) -> list[Trial]:
    """Return the trial of each family beside a base."""
    for terms in families.values():  # columns are made by one thread
        for term in terms:
            search.columns.of(term.effect)
            search.columns.of_map([term.effect])
    for segments in {search.everything, *(part.rest for part in search.left_out)}:
        search.columns.gram(segments)
    tunings: dict[tuple[Model, tuple[int, ...]], Tuning] = {}
    without = search.left_out_errors([base] * len(search.left_out), search.noises)

    def work(terms: list[Term]) -> Trial:
        slots = [k for k, term in enumerate(base) if _retuned(search, term, terms[0])]
        fixed = tuple(term for k, term in enumerate(base) if k not in slots)
        choices = [[*families.get(family_of(search, base[k]), []), base[k]] for k in slots] + [terms]

        def chosen(segments: tuple[int, ...]) -> Model:
            key = fixed, segments
            if key not in tunings:
                tunings[key] = Tuning(search.squares, fixed, segments)
            anew = best(tunings[key], choices)
            place = dict(zip(slots, anew, strict=False))
            return (*(place.get(k, term) for k, term in enumerate(base)), anew[-1])

        model = chosen(search.everything)
        noises, ratio = search.noises_of(model), _in_sample(search, base, model)
        if ratio > WORTH:
            return _not_worth_it(search, base, model, noises, ratio)
        errors = search.left_out_errors([chosen(part.rest) for part in search.left_out], noises)
        return _trial(search, base, model, noises, without, errors)

    with ThreadPoolExecutor(cpu_count() or 1) as pool:
        return list(pool.map(work, families.values()))


def _in_sample(search: Search, base: Model, model: Model) -> float:
    """Return the ratio of the costs of two fits on all recordings, mean over the axes."""
    fits = [[search.fit(one, axis).cost for axis in search.axes] for one in (model, base)]
    costs = np.log(np.maximum(fits, 1e-300))
    return float(np.exp(np.mean(costs[0] - costs[1])))


def _not_worth_it(search: Search, base: Model, model: Model, noises: list[LocalLevel], ratio: float) -> Trial:
    """Return the trial of a candidate that hardly fits the recordings themselves: it is not cross-validated."""
    price = float(np.log(max(search.tried, 1)))
    evidence = CandidateEvidence(ratio, 0.0, len(search.left_out), 1.0, bool(base), -price, 0.0, -price, price)
    reason = f"fits the recordings themselves {100 * (float(np.sqrt(ratio)) - 1):+.1f} %: there is nothing to predict"
    blocks = np.ones((len(search.axes), BLOCKS * len(search.left_out)))
    return Trial(model, evidence, blocks, _likelihood(search, model, noises), passes=False, reason=reason)


def _retuned(search: Search, term: Term, candidate: Term) -> bool:
    """Return True if a term of the base is to be chosen anew with a candidate: both have a memory."""
    both = [search.columns.of(t.effect).starts is not None for t in (term, candidate)]
    return all(both) and term not in search.declared and not term.effect.acts_on_input


def _trial(
    search: Search, base: Model, model: Model, noises: list[LocalLevel], without: Errors, errors: Errors
) -> Trial:
    """Judge a candidate by its left-out errors and its matched filter."""
    effect, price = model[-1].effect, float(np.log(max(search.tried, 1)))
    fast = fast_evidence(search.squares, model[:-1], model[-1], noises)
    evidence = evidence_of(search, effect, errors, without, fast, price, beside=bool(base))
    passes, reason = accept(effect, evidence, search.named)
    return Trial(model, evidence, blocks_of(errors, search.axes), _likelihood(search, model, noises), passes, reason)


def evidence_of(
    search: Search, effect: Effect, errors: Errors, without: Errors, fast: tuple[float, float], price: float, *,
    beside: bool = False, gained: bool = True,
) -> CandidateEvidence:  # fmt: skip
    """Return the figures of an effect by the errors of all parts with it and without.

    `fast` are chance and gain of its matched filter (nats), `price` is log M, `beside` whether the base has effects.
    The left-out gain is slow to work out; unless it is `gained`, it is infinite.
    """
    squares = [[[np.sum(part[axis] ** 2) for part in side] for axis in search.axes] for side in (errors, without)]
    new, old = np.maximum(squares, 1e-300)  # (d, parts)
    logs, steps = np.log(new.sum(axis=1) / old.sum(axis=1)), np.mean(np.log(new / old), axis=0)
    steady = float(np.mean(steps) / max(np.std(steps, ddof=1) / np.sqrt(len(steps)), 1e-12))
    whole = [float(np.exp(step)) for step, part in zip(steps, search.left_out, strict=True) if part.whole]
    left_out = np.inf
    if gained:
        pairs = [[(one[axis], other[axis] - one[axis]) for one, other in zip(errors, without, strict=True)]
                 for axis in search.axes]  # fmt: skip
        rows = [sum(effective(e, added, walking=effect.walks) for e, added in own) for own in pairs]
        left_out = -float(np.sum(np.array(rows) / 4 * logs)) - price
    (chance, gain), ratio = fast, float(np.exp(np.mean(logs)))
    poorest = max(whole, default=0.0)
    return CandidateEvidence(ratio, steady, len(steps), poorest, beside, left_out, chance, gain - price, price)


def with_uncertain_map(search: Search, trial: Trial) -> Trial:
    """Return a trial judged by what it shows at fast times where the base is as uncertain as noise and walk make it.

    What the walk of the recordings puts into the map of least squares is the same at each return of the temperature,
    and a slow column finds it, as sure as it is no effect.
    """
    noises, old = search.noises_of(trial.model), trial.evidence
    chance, gain = fast_evidence(search.squares, trial.base, trial.term, noises, generalised=True)
    evidence = replace(old, chance=min(chance, old.chance), gain=min(gain - old.price, old.gain))
    passes, reason = accept(trial.term.effect, evidence, search.named)
    return replace(trial, evidence=evidence, passes=passes and trial.passes, reason=trial.reason or reason)


def blocks_of(errors: Errors, axes: Sequence[int]) -> Array:
    """Return the sums of squares (d, blocks) of left-out errors."""
    return np.array([
        np.concatenate([[float(np.sum(b**2)) for b in np.array_split(part[axis], BLOCKS)] for part in errors])
        for axis in axes
    ])  # fmt: skip


def _likelihood(search: Search, model: Model, noises: Sequence[LocalLevel]) -> float:
    """Return the log-likelihood of a model's one-step errors beyond that of the present one, parameters paid for."""
    n, axes = len(search.evidence), search.axes
    gain = sum(0.5 * n * float(np.log(search.noises[axis].variance / noises[axis].variance)) for axis in axes)
    term = model[-1]
    starts = len(search.columns.levels) if term.free else 0
    number = sum(len(search.columns.of(term.effect).columns[axis]) + starts for axis in axes)
    return gain - 0.5 * (number + len(term.effect.continuous)) * float(np.log(n))


class CandidateColumns(NamedTuple):
    """A term that is tried over some segments, with its columns on each axis, and those of its starts there."""

    term: Term
    columns: tuple[Integers, ...]
    starts: Integers


class Tuning:
    """Costs of candidates beside one base, over some segments."""

    def __init__(self, squares: LeastSquares, base: Model, segments: tuple[int, ...]) -> None:
        self.squares, self.base, self.segments = squares, base, segments
        self.axes, self.rows = range(len(squares.columns.y)), squares.rows(segments)
        self._G = G = squares.columns.gram(segments)
        self._explained: list[Array] = []
        known: dict[bytes, Array] = {}
        for axis in self.axes:
            fit = squares.fit(base, axis, segments)
            key = fit.cols.tobytes() + fit.equations.A.tobytes()
            if key not in known:  # axes whose columns are alike share it
                known[key] = fit.equations.explained(G[fit.cols])
            self._explained.append(known[key])

    def candidates(self, terms: Sequence[Term]) -> list[CandidateColumns]:
        """Return the terms with their columns."""
        columns, squares = self.squares.columns, self.squares
        return [CandidateColumns(t, columns.of(t.effect).columns, squares.starts(t, self.segments)) for t in terms]

    def cost(self, candidates: Sequence[CandidateColumns]) -> float:
        """Return n/2 log of the sum of squares that they leave beside the base, summed over the axes (nats)."""
        if any(one.term.effect.acts_on_input for one in candidates):
            model = (*self.base, *(one.term for one in candidates))
            left = [self.squares.fit(model, axis, self.segments).cost for axis in self.axes]
        else:
            starts = [one.starts for one in candidates]
            sizes = np.array([len(s) for s in starts])
            left = [
                self._left(axis, [*(one.columns[axis] for one in candidates), *starts], sizes) for axis in self.axes
            ]
        return 0.5 * self.rows * sum(log(max(squares, 1e-300)) for squares in left)

    def _left(self, axis: int, cols: Sequence[Integers], sizes: Integers) -> float:
        base, y, colour = self._explained[axis], int(self.squares.columns.y[axis]), float(self.squares.colour[axis])
        return float(left_with_starts(self._G, base, y, np.concatenate(cols), sizes, self.rows, colour))


def best(tuning: Tuning, families: Sequence[Sequence[Term]]) -> tuple[Term, ...]:
    """Return one term of each family, those of least cost together, by coordinate descent from several starts."""
    choices = [tuning.candidates(terms) for terms in families]
    if len(choices) == 1:
        return (min(choices[0], key=lambda one: tuning.cost((one,))).term,)
    ends: list[tuple[float, list[CandidateColumns]]] = []
    for share in (0.15, 0.5, 0.85):
        chosen = [family[int(share * (len(family) - 1))] for family in choices[:-1]]
        chosen.append(min(choices[-1], key=lambda one: tuning.cost((*chosen, one))))
        cost = tuning.cost(chosen)
        while True:
            for k, family in enumerate(choices):
                chosen[k] = min(family, key=lambda one: tuning.cost((*chosen[:k], one, *chosen[k + 1 :])))
            lower = tuning.cost(chosen)
            if lower >= cost - 1e-9:
                break
            cost = lower
        ends.append((cost, chosen))
    return tuple(one.term for one in min(ends, key=lambda pair: pair[0])[1])
