"""Change points of a line: steps in the mean of values in the order in which they were made.

Every stretch of the line is tested for a step. Stretches are those of seeded binary segmentation
(Kovacs, Buhlmann, Li and Munk, Biometrika 110 (2023) 249): of each length so many that any two neighbouring changes
have one that holds one of them alone. In a stretch the values count by their normal scores (van der Waerden), so what
is found does not hang on the law of the values, and no single unit moves it; with normal values nothing is lost. Of a
step before value k of L, weights a and scores y, the share of the squares that it takes is::

    r_k = (A_k - W_k / W_L A_L)^2 / ( W_k (1 - W_k / W_L) sum y^2 )
    A_k = sum_{i<k} a_i y_i,    W_k = sum_{i<k} a_i^2

The likelihood ratio is L log(1 / (1 - r_k)). Of stretches of any length the surest is that whose largest r_k is least
likely at its place: T, the deviations of a normal value that is as unlikely as r by Student's t. The price of having
looked everywhere is in p, the probability of as large a T anywhere in n exchangeable values (`probability`).
n values in all, L in a stretch.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fusion_core.chunk import Array

SHORTEST = 5  # values on either side of a step: fewer are odd units, not a change of the line
OF_BUMPS = 0.2  # of the false discovery rate: for parts that are unlike all the rest
DECAY = np.sqrt(0.5)  # of the length from one layer of stretches to the next
TAILS = (0.1, 0.01, 0.001)
PRICES = {
    10: (1.63, 2.61, 2.93),
    14: (2.15, 3.01, 3.53),
    20: (2.73, 3.48, 3.77),
    35: (3.09, 3.67, 4.10),
    60: (3.29, 3.90, 4.39),
    100: (3.48, 4.07, 4.50),
    200: (3.72, 4.28, 4.76),
    400: (3.93, 4.46, 4.94),
    1000: (4.18, 4.68, 5.18),
    2500: (4.37, 4.88, 5.36),
}  # by n, the largest T, which is passed with the probabilities TAILS (`benchmarks/change_points.py`)
SET = 7.35  # (1 - exp(-SET / 2))^2 = 0.95: what a log likelihood ratio gains by chance over that of the true place


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
        Probability of such a step, or a larger one, anywhere in so many values that are all alike.
    """

    at: int
    low: int
    high: int
    p: float


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
    n = len(z)
    places: list[int] = []
    rest = sorted(strongest(z, a), reverse=True)
    while rest and probability(rest[0][0], n) <= (1 - OF_BUMPS) * alpha:
        at = rest[0][1]
        places.append(at)
        rest = [one for one in rest if not one[2] < at < one[3]]
    for start, stop in pairwise([0, *sorted(places), n]):
        inside = [(max(i, start), min(j, stop)) for i, j in blocks]
        places += [at for at in _bump(z, a, start, stop, OF_BUMPS * alpha, inside) if start < at < stop]
    return _settled(z, a, sorted(set(places)), alpha)


def _bump(z: Array, a: Array, start: int, stop: int, alpha: float, blocks: list[tuple[int, int]]) -> tuple[int, ...]:
    """Return begin and end of the part of a stretch that is least like the rest of it; nothing if that is chance.

    Two steps that take each other back show less in what lies about each of them than in all of the rest. The price is
    Bonferroni's.
    """
    L = stop - start
    parts = [(i, i + size) for size, starts in stretches(L) for i in starts.tolist()]
    parts = [(i, j) for i, j in [*parts, *((i - start, j - start) for i, j in blocks)] if SHORTEST <= j - i <= L // 2]
    if not parts:
        return ()
    y = scores(z[None, start:stop])[0]
    A, W = (np.concatenate([[0.0], np.cumsum(v)]) for v in (a[start:stop] * y, a[start:stop] ** 2))
    i, j = np.array(parts).T
    share = (W[j] - W[i]) / W[-1]
    gain = (A[j] - A[i] - share * A[-1]) ** 2 / (W[-1] * share * (1 - share))
    r = np.minimum(gain / max(float(y @ y), 1e-300), 1 - 1e-9)
    best = int(np.argmax(r))
    chance = 2 * len(parts) * (len(z) / L) * _tail(r[best : best + 1], L)[0]
    return (start + parts[best][0], start + parts[best][1]) if chance <= alpha else ()


def probability(T: float, n: int) -> float:
    """Return the probability of a largest T of at least T in n exchangeable values.

    Its logarithm is drawn through the quantiles of PRICES over T^2, straight between and beyond them: the true tail
    falls faster, so what is rarer than 0.1 % has a p that is too large rather than too small.
    """
    sizes = np.log(np.array(list(PRICES)))
    places = np.array(
        [np.interp(np.log(n), sizes, np.array(column) ** 2) for column in zip(*PRICES.values(), strict=True)]
    )
    if n > max(PRICES):  # the quantiles of T^2 grow with the logarithm of n
        last, before = (np.array(PRICES[size]) ** 2 for size in sorted(PRICES)[:-3:-1])
        places = last + (last - before) * (np.log(n) - sizes[-1]) / (sizes[-1] - sizes[-2])
    logs = np.log(TAILS)
    piece = int(np.clip(np.searchsorted(places, T**2) - 1, 0, len(TAILS) - 2))
    slope = (logs[piece + 1] - logs[piece]) / (places[piece + 1] - places[piece])
    return float(np.exp(min(logs[piece] + slope * (T**2 - places[piece]), 0.0)))


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
            places = [at for at in moved if at != weakest.at]
        elif moved == places or tuple(moved) in before:
            return sorted({step.at: step for step in steps_at}.values(), key=lambda step: step.at)
        else:
            before.add(tuple(moved))
            places = sorted(set(moved))


def _step(z: Array, a: Array, start: int, stop: int, at: int) -> LevelStep:
    if stop - start < 2 * SHORTEST:
        return LevelStep(at, at, at, 1.0)
    r = shares(z[None, start:stop], a[None, start:stop])[0]
    best, L = int(np.argmax(r)), stop - start
    place = start + SHORTEST + np.flatnonzero(L * np.log((1 - r) / (1 - r[best])) <= SET)
    p = probability(float(_unlikely(r[best : best + 1], L)[0]), len(z))
    return LevelStep(start + SHORTEST + best, int(place[0]), int(place[-1]), p)


def strongest(z: Array, a: Array) -> Iterator[tuple[float, int, int, int]]:
    """Yield of each stretch its T, the place of its step, and where the stretch starts and stops."""
    for length, starts in stretches(len(z)):
        places = starts[:, None] + np.arange(length)
        r = shares(z[places], a[places])
        best = np.argmax(r, axis=1)
        T = _unlikely(r[np.arange(len(r)), best], length)
        for row, start in enumerate(starts):
            yield float(T[row]), int(start + SHORTEST + best[row]), int(start), int(start) + length


def stretches(n: int) -> Iterator[tuple[int, Array]]:
    """Yield lengths, and where stretches of each start, half a length apart."""
    length = float(n)
    while length >= 2 * SHORTEST:
        size = int(np.ceil(length - 1e-9))
        count = max(2 * int(np.ceil(n / length)) - 1, 1)
        yield size, np.unique(np.round(np.linspace(0, n - size, count)).astype(int))
        length *= DECAY


def shares(z: Array, a: Array) -> Array:
    """Return r_k of each row of z (S, L): steps before value SHORTEST to L - SHORTEST."""
    y = scores(z)
    A, W = np.cumsum(a * y, axis=1), np.cumsum(a**2, axis=1)
    part = W / W[:, -1:]
    inner = slice(SHORTEST - 1, y.shape[1] - SHORTEST)
    gain = ((A - part * A[:, -1:]) ** 2)[:, inner] / (W * (1 - part))[:, inner]
    squares = np.sum(y**2, axis=1, keepdims=True)
    return np.asarray(np.minimum(gain / np.where(squares > 0, squares, 1.0), 1 - 1e-9))


def _unlikely(r: Array, L: int) -> Array:
    """Return T of shares r (S,) of stretches of L."""
    from scipy.special import ndtri

    return np.asarray(-ndtri(_tail(r, L)))


def _tail(r: Array, L: int) -> Array:
    from scipy.special import stdtr

    return np.maximum(stdtr(L - 2, -np.sqrt((L - 2) * r / (1 - r))), 1e-300)


def scores(z: Array) -> Array:
    """Return the normal scores of each row of z (S, L); what is equal shares its ranks."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    rank = np.argsort(np.argsort(z, axis=1), axis=1) + 1.0
    tied = np.any(np.diff(np.sort(z, axis=1), axis=1) == 0, axis=1)
    if np.any(tied):
        rank[tied] = rankdata(z[tied], axis=1)
    return np.asarray(ndtri((rank - 0.5) / z.shape[1]))
