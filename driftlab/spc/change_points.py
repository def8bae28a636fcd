"""Change points of a line: steps in the mean of values in the order in which they were made.

The line is cut where a part of it is least like the rest, and each piece again, until no part is (circular binary
segmentation: Olshen, Venkatraman, Lucito and Wigler, Biostatistics 5 (2004) 557). Parts are all that begin with the
piece, so one step is a cut in two; of each length so many that any two neighbouring changes have one between them
(Kovacs, Buhlmann, Li and Munk, Biometrika 110 (2023) 249); and lots, which begin and end a level of their own. In a
piece the values count by their normal scores (van der Waerden), so what is found does not hang on the law of the
values, and no single unit moves it; with normal values nothing is lost. Of the values i to j of L, weights a and scores
y, the share of the squares that a level of their own takes is::

    r = (A_j - A_i - s A_L)^2 / ( W_L s (1 - s) sum y^2 ),    s = (W_j - W_i) / W_L
    A_k = sum_{i<k} a_i y_i,    W_k = sum_{i<k} a_i^2

with the likelihood ratio L log(1 / (1 - r)). Its probability by chance is that of Student's t, times the number of
places looked at (Bonferroni): at the few parts in a thousand that a chart may err this is nearly exact, and the search
is correlated enough that it is never too low.

Whether what was found is steps, a trend, or units that resemble those before them, is a comparison of likelihoods, the
residuals e of each model about its fit being AR(1)::

    n log sum (e_i - phi e_{i-1})^2 + p log n,    p = 0 (a level), 1 (a straight line), 2 (a step: its size, its place)

The likeliest has phi (a step costs 3 there, since its place was looked for); where that is more than chance, steps are
searched again in z_i - phi z_{i-1}, in which the noise is white again, at the same price. Steps that are found are a
trend where a line is likelier. n values in all, L in a piece, P parts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from driftlab.spc.capability import without_bias
from driftlab.spc.charts import huber
from fusion_core.chunk import Array, Integers

SHORTEST = 5  # values on either side of a step: fewer are odd units, not a change of the line
DECAY = np.sqrt(0.5)  # of the length from one layer of parts to the next
SET = 7.35  # (1 - exp(-SET / 2))^2 = 0.95: what a log likelihood ratio gains by chance over that of the true place

RESEMBLING = 2.0  # deviations (1 / sqrt(n)) of an autocorrelation beyond which it is not chance
MOST = 0.95  # autocorrelation: what is nearer to 1 is a wandering line
FAR = 3.0  # sigmas to which a residual counts
PLACES = 50  # of a step, that are compared
PHI = np.linspace(0.0, MOST, 96)


@dataclass(frozen=True)
class LevelStep:
    """A change of the mean.

    Attributes
    ----------
    at : int
        The first value after it.
    low, high : int
        First values of the 95 % interval of `at`.
    p : float
        Probability, at most, of such a step, or a larger one, anywhere in so many values that are all alike.
    """

    at: int
    low: int
    high: int
    p: float


@dataclass(frozen=True)
class Course:
    """The course of a line.

    Attributes
    ----------
    steps : tuple of LevelStep
    slope : (2,) array or None
        Level in the middle, and half of the rise from the first to the last value, where it is a trend; then there are
        no steps.
    phi : float
        Autocorrelation of neighbouring values about it, 0 where it may be chance.
    """

    steps: tuple[LevelStep, ...] = ()
    slope: Array | None = None
    phi: float = 0.0


def course_of(x: Array, sigma: Array, alpha: float, blocks: Iterable[tuple[int, int]] = ()) -> Course:
    """Return steps, or a trend, or neither, of values x (n,) with deviations sigma (n,).

    With probability alpha at most there is either of values that have neither, whether or not neighbours resemble one
    another. `blocks` are those of `steps`.
    """
    if not np.all(sigma > 0) or len(x) < 2 * SHORTEST:
        return Course()
    z, a, known = (x - np.median(x)) / sigma, np.median(sigma) / sigma, list(blocks)
    found = steps(z, a, alpha, known)
    line = _line(x, sigma)
    models = [_residuals(x, sigma, np.full(len(x), np.median(x))), _residuals(x, sigma, line)]
    models += [_residuals(x, sigma, _levels(x, sigma, found))] if found else []
    costs = [_cost(e, p) for e, p in zip(models, (0, 1, 3 * len(found)), strict=False)]
    phi = min(without_bias(min(costs)[1], len(x)), MOST)
    if phi < RESEMBLING / np.sqrt(len(x)):
        phi = 0.0
    if found and phi:
        shifted = [(max(i - 1, 0), j - 1) for i, j in known]
        again = steps(z[1:] - phi * z[:-1], a[1:], alpha, shifted)
        found = [LevelStep(step.at + 1, step.low + 1, step.high + 1, step.p) for step in again]
    if not found:
        return Course(phi=phi)
    of_line, of_steps = (
        _cost(_residuals(x, sigma, fit), p)[0] for fit, p in ((line, 1), (_levels(x, sigma, found), 2 * len(found)))
    )
    if of_line < of_steps:
        return Course((), np.array([np.mean(line), (line[-1] - line[0]) / 2]), phi)
    return Course(tuple(found), None, phi)


def _line(x: Array, sigma: Array) -> Array:
    """Return the straight line (n,) through values x (n,) that no single odd one moves."""
    X = np.column_stack([np.ones(len(x)), np.linspace(-1.0, 1.0, len(x))])
    return X @ huber(X, x, sigma, np.array([np.median(x), 0.0]))


def _levels(x: Array, sigma: Array, found: Sequence[LevelStep]) -> Array:
    """Return the levels (n,) between steps, each step where it is likeliest within its interval."""
    edges = [0, *(step.at for step in found), len(x)]
    for k, step in enumerate(found, 1):
        start, stop = edges[k - 1], edges[k + 1]
        ends = max(step.low, start + SHORTEST), min(step.high, stop - SHORTEST)
        some = sorted({*np.linspace(*ends, PLACES).astype(int).tolist(), step.at}) if ends[0] <= ends[1] else []
        part = slice(start, stop)
        costs = [_cost_of_step(x[part], sigma[part], at - start) for at in some]
        edges[k] = some[int(np.argmin(costs))] if some else edges[k]
    return np.concatenate([_level(x[i:j]) for i, j in pairwise(edges)])


def _cost_of_step(x: Array, sigma: Array, at: int) -> float:
    """Return the sum of squares about the levels of values x (n,) before and after a place."""
    return float(np.sum(_residuals(x, sigma, np.concatenate([_level(x[:at]), _level(x[at:])])) ** 2))


def _level(x: Array) -> Array:
    middle = np.median(x)
    reach = FAR * 1.4826 * float(np.median(np.abs(x - middle)))
    return np.full(len(x), middle + np.mean(np.clip(x - middle, -reach, reach)))


def _residuals(x: Array, sigma: Array, fit: Array) -> Array:
    e = (x - fit) / sigma
    reach = FAR * 1.4826 * float(np.median(np.abs(e)))
    return np.clip(e, -reach, reach) if reach > 0 else e


def _cost(e: Array, p: int) -> tuple[float, float]:
    """Return the price of residuals e (n,) of a model with p parameters beside its level, and their phi."""
    n, own, cross = len(e), float(e @ e), float(e[1:] @ e[:-1])
    middle = own - float(e[0] ** 2 + e[-1] ** 2)
    left = own + PHI**2 * middle - 2 * PHI * cross  # sum of squares of e_i - phi e_{i-1}, e_0 by its own law
    likely = n * np.log(np.maximum(left, 1e-300)) - np.log(1 - PHI**2)
    best = int(np.argmin(likely))
    return float(likely[best]) + p * float(np.log(n)), float(PHI[best])


def steps(z: Array, a: Array, alpha: float, blocks: Iterable[tuple[int, int]] = ()) -> list[LevelStep]:
    """Return the steps in z (n,), in order; where there is none, with probability alpha at most.

    Parameters
    ----------
    z : (n,) array
        Values over their deviations.
    a : (n,) array
        What a change of one unit of the values does to z: weights, one over the deviations.
    alpha : float
    blocks : iterable of (start, stop)
        Values that may have a level of their own, as those of a lot.
    """
    places, pieces, known = set[int](), [(0, len(z))], list(blocks)
    while pieces:
        start, stop = pieces.pop()
        inside = [(max(i, start) - start, min(j, stop) - start) for i, j in known]
        if stop - start < 2 * SHORTEST:
            continue
        i, j, p = least_alike(z[start:stop], a[start:stop], inside)
        if p * len(z) / (stop - start) <= alpha:
            cuts = {start + i, start + j} - {start, stop}
            places |= cuts
            pieces += pairwise([start, *sorted(cuts), stop])
    return _settled(z, a, sorted(places), alpha)


def least_alike(z: Array, a: Array, blocks: Iterable[tuple[int, int]] = ()) -> tuple[int, int, float]:
    """Return begin and end of the part of z (L,) that is least like the rest, and the probability of that by chance."""
    of = parts(len(z), blocks)
    r = shares(z, a, of)
    best = int(np.argmax(r))
    return int(of[best, 0]), int(of[best, 1]), len(of) * _chance(r[best], len(z))


def parts(L: int, blocks: Iterable[tuple[int, int]] = ()) -> Integers:
    """Return begins and ends (P, 2) of the parts of a piece of L, at least 2 SHORTEST, that are looked at."""
    ends, length = np.arange(SHORTEST, L - SHORTEST + 1), float(DECAY * L)
    found = [np.column_stack([np.zeros_like(ends), ends])]
    while length >= SHORTEST:
        size = int(np.ceil(length - 1e-9))
        starts = np.unique(np.round(np.linspace(0, L - size, 2 * int(np.ceil(L / length)) - 1)).astype(int))
        found.append(np.column_stack([starts, starts + size]))
        length *= DECAY
    of = np.concatenate([*found, np.reshape([*blocks], (-1, 2))]).astype(np.intp)
    lengths = of[:, 1] - of[:, 0]
    return of[(lengths >= SHORTEST) & (lengths <= L - SHORTEST)]


def shares(z: Array, a: Array, of: Integers) -> Array:
    """Return r (P,) of the parts `of` (P, 2) of values z (L,)."""
    y, (i, j) = scores(z), of.T
    A, W = (np.concatenate([[0.0], np.cumsum(v)]) for v in (a * y, a**2))
    s = (W[j] - W[i]) / W[-1]
    gain = (A[j] - A[i] - s * A[-1]) ** 2 / (W[-1] * s * (1 - s))
    return np.asarray(np.minimum(gain / max(float(y @ y), 1e-300), 1 - 1e-9))


def scores(z: Array) -> Array:
    """Return the normal scores of z (L,); what is equal shares its ranks."""
    from scipy.special import ndtri

    _, place, count = np.unique(z, return_inverse=True, return_counts=True)
    middle = np.cumsum(count) - count / 2  # of the ranks from 1 on, less one half
    return np.asarray(ndtri(middle[place] / len(z)))


def _chance(r: float, L: int) -> float:
    """Return the probability of a share r of L values at one place, of a step up or down."""
    from scipy.special import stdtr

    return 2 * float(stdtr(L - 2, -np.sqrt((L - 2) * r / (1 - r))))


def _settled(z: Array, a: Array, places: list[int], alpha: float) -> list[LevelStep]:
    """Return the steps, each where it is most likely between its neighbours; one that is no longer sure is dropped.

    Steps that take turns at moving one another are where they were last.
    """
    n, before = len(z), set[tuple[int, ...]]()
    while True:
        edges = [0, *places, n]
        steps_at = [_step(z, a, start, stop, at) for start, at, stop in zip(edges, places, edges[2:], strict=False)]
        moved = [step.at for step in steps_at]
        weakest = max(steps_at, key=lambda step: step.p, default=None)
        if weakest is not None and weakest.p > alpha:
            places = sorted({step.at for step in steps_at if step is not weakest})
        elif moved == places or tuple(moved) in before:
            return sorted({step.at: step for step in steps_at}.values(), key=lambda step: step.at)
        else:
            before.add(tuple(moved))
            places = sorted(set(moved))


def _step(z: Array, a: Array, start: int, stop: int, at: int) -> LevelStep:
    L = stop - start
    if L < 2 * SHORTEST:
        return LevelStep(at, at, at, 1.0)
    places = np.arange(SHORTEST, L - SHORTEST + 1)
    r = shares(z[start:stop], a[start:stop], np.column_stack([np.zeros_like(places), places]))
    best = int(np.argmax(r))
    likely = start + places[L * np.log((1 - r) / (1 - r[best])) <= SET]
    p = min(len(parts(len(z))) * _chance(r[best], L), 1.0)
    return LevelStep(start + int(places[best]), int(likely[0]), int(likely[-1]), p)
