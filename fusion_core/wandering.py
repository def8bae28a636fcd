"""Bounds of the mean square that the wandering of a bias makes, from one recording of it.

Rows r (K,) are what is left of a bias after a linear answer H to it was taken off, P = I - H: a map, or a level. With W
the covariance of what the bias wanders by and white noise of variance w an average, of which a row has n::

    r ~ N(0, w / n P P' + w rho P W P'),    E(w, rho) = w (a + rho b)

E is a mean square that follows from w, rho and W: of the rows themselves, or of a prediction. One recording has few
independent squares of the slow part. So E lies between the least and the largest of all w and rho by which r is nearly
as likely as by the best: 2 log-likelihood within REACH of the largest, 95 % on one side. W is of a random walk, of
flicker noise or of a first-order Gauss-Markov process, whichever is not far less likely than another. P W P' = V L V'
is turned into contrasts V' r first, in which white noise is close to independent too. What no map follows is taken for
wandering.

Source: W. Q. Meeker and L. A. Escobar, Teaching about approximate confidence regions based on maximum likelihood
estimation, The American Statistician 49 (1995) 48.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from fusion_core.chunk import Array, locked

REACH = 1.96**2  # of twice the log-likelihood: 1.645^2 were 93 % on one side, of so few squares as these
UNLIKELY = 6.0  # of twice the log-likelihood: a law so far below the best is left out
TAUS = (1 / 60, 1 / 15, 1 / 4)  # correlation times, of the length of the recording
OCTAVES = tuple(4.0**k for k in range(-5, 2))  # correlation times of processes that are flicker noise together
RATIOS = np.concatenate([[0.0], np.logspace(-4, 4, 161)])  # rho
SCALES = np.exp(np.linspace(-0.7, 0.7, 57))[:, None]  # of w about its most likely value
TAKEN = 0.1  # of the white noise of a contrast: of one of which less is left, nothing is inferred


@dataclass(frozen=True)
class BiasWalk:
    """A law that a bias wanders by from `start` on over `span` s.

    The mean of Gauss-Markov processes of the correlation times `taus`, s; a random walk where there are none.
    """

    start: float
    span: float
    taus: tuple[float, ...]

    def covariance(self, t: Array, lasted: float) -> Array:
        """Return the covariance (N, N) of means over `lasted` s at t (N,), which do not overlap."""
        apart = np.abs(t[:, None] - t[None, :])
        if not self.taus:
            covariance = (np.minimum(t[:, None], t[None, :]) - self.start) * (2 / self.span)
            return np.asarray(covariance - np.eye(len(t)) * (lasted / (3 * self.span)))  # a mean varies less
        covariance = np.zeros((len(t), len(t)))
        for tau in self.taus:
            covariance += gauss_markov(apart, lasted, tau) / len(self.taus)
        return covariance


def gauss_markov(apart: Array, lasted: float, tau: float) -> Array:
    """Return the covariance of means over `lasted` s, so far `apart` (N, N), s, of a process of correlation time tau.

    The process has a variance of 1; means overlap wholly or not at all.
    """
    x = lasted / tau
    own = 2 * (x + np.expm1(-x)) / x**2
    beside = (np.expm1(-x) / x) ** 2 * np.exp(-np.maximum(apart - lasted, 0.0) / tau)
    return np.asarray(np.where(apart < lasted / 2, own, beside))


@dataclass(frozen=True, eq=False)
class BiasMeans:
    """Means of a bias over even stretches of a recording.

    Attributes
    ----------
    t : (K,) array
        Their middles, s.
    lasted : float
        How long each is, s.
    size : int
        Averages in each, of equal length.
    within : (d,) array
        Sum of the squares of the averages about their rows.
    count : int
        Of all averages.
    """

    t: Array
    lasted: float
    size: int
    within: Array
    count: int

    @property
    def laws(self) -> list[BiasWalk]:
        """Laws of what a bias may wander by, each of a mean variance of about 1 over the recording."""
        start, span = self.t[0] - self.lasted / 2, self.lasted + self.t[-1] - self.t[0]
        kinds = [(part,) for part in TAUS]
        return [
            BiasWalk(start, span, ()),
            *(BiasWalk(start, span, tuple(p * span for p in kind)) for kind in (OCTAVES, *kinds)),
        ]

    @property
    def covariances(self) -> list[Array]:
        """The covariance (K, K) of the rows by each law."""
        return _of_laws(self.t.tobytes(), self.lasted, self.size)[0]

    @property
    def inside(self) -> list[float]:
        """The variance of averages about their row by each law."""
        return _of_laws(self.t.tobytes(), self.lasted, self.size)[1]


@lru_cache(maxsize=8)
def _of_laws(t: bytes, lasted: float, size: int) -> tuple[list[Array], list[float]]:
    """Return the covariances of rows and the variances inside: once for all recordings of a line that are as long."""
    rows, step = BiasMeans(np.frombuffer(t), lasted, size, np.empty(0), 0), lasted / size
    within = rows.t[0] + step * (np.arange(size) - (size - 1) / 2)
    both = (rows.t, lasted), (within, step)
    covariances, inside = ([locked(law.covariance(*of)) for law in rows.laws] for of in both)
    return covariances, [float(np.trace(C) - np.mean(C) * size) / max(size - 1, 1) for C in inside]


def rows_of(t: Array, averages: Array, most: int) -> tuple[BiasMeans, Array]:
    """Return averages (n, d) at even times t (n,) as at most about `most` rows, and the rows (K, d)."""
    size = -(-len(t) // most)
    cuts = np.arange(0, max(len(t) - size, 0) + 1, size)
    n = np.diff(cuts, append=len(t))[:, None]
    rows = np.add.reduceat(averages, cuts) / n
    within = np.sum(averages**2, axis=0) - np.sum(n * rows**2, axis=0)
    step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    middles = np.add.reduceat(t, cuts) / n[:, 0]
    return BiasMeans(middles, size * step, size, np.maximum(within, 0.0), len(t)), rows


@dataclass(frozen=True, eq=False)
class WalkContrasts:
    """Contrasts V' (m, K) of the residual rows, with the variance of each of white noise and of wandering (m,).

    `inside` is the variance of what wanders within a row.
    """

    V: Array
    of_white: Array
    of_wandering: Array
    inside: float

    @cached_property
    def variances(self) -> tuple[Array, Array]:
        """The variance of each under RATIOS, where white noise has one of 1 (R, m), and the sum of logarithms (R,)."""
        v = self.of_white + RATIOS[:, None] * self.of_wandering
        return v, np.sum(np.log(v), axis=1)


def contrasts(rows: BiasMeans, P: Array, Z: Array | None = None) -> list[WalkContrasts]:
    """Return the contrasts of what P (K, K) leaves of rows, by each law; Z (K, m), orthonormal, may span all that."""
    Z, each = np.eye(len(P)) if Z is None else Z, []
    left = P.T @ Z
    for W, inside in zip(rows.covariances, rows.inside, strict=True):
        value, V = np.linalg.eigh(left.T @ W @ left)
        of_white = np.sum((left @ V) ** 2, axis=0) / rows.size
        free_of_map = of_white > TAKEN / rows.size
        wandering = np.maximum(value[free_of_map], 0.0)
        each.append(WalkContrasts((Z @ V).T[free_of_map], of_white[free_of_map], wandering, inside))
    return each


def mean_squares(rows: BiasMeans, P: Array) -> list[tuple[float, float]]:
    """Return the mean squares a and b that P (K, K) leaves of all averages, of white noise and of wandering, by law."""
    free, square = rows.count - len(P), P.T @ P
    white = (free + float(np.trace(square))) / rows.count
    laws = zip(rows.covariances, rows.inside, strict=True)
    return [(white, float(np.sum(square * W)) / len(P) + free * inside / rows.count) for W, inside in laws]


def contrasts_about_level(rows: BiasMeans) -> list[WalkContrasts]:
    """Return the contrasts of rows about their mean: once for all recordings of a line that are as long."""
    return _about_level((rows.t - rows.t[0]).tobytes(), rows.lasted, rows.size, rows.count)


@lru_cache(maxsize=8)
def _about_level(t: bytes, lasted: float, size: int, count: int) -> list[WalkContrasts]:
    rows = BiasMeans(np.frombuffer(t), lasted, size, np.empty(0), count)
    return contrasts(rows, np.eye(len(rows.t)) - 1 / len(rows.t))


def bounds(
    rows: BiasMeans, each: Sequence[WalkContrasts], r: Array, within: float, wanted: Sequence[tuple[float, float]]
) -> tuple[float, float]:
    """Return the least and the largest mean square E that rows r (K,) of one axis allow.

    `within` is theirs of `rows.within`; `wanted` are a and b by each of the laws, of which `each` are the contrasts.
    """
    free = rows.count - len(r) if rows.size > 1 else 0
    best, each_law = np.inf, []
    for one, (a, b) in zip(each, wanted, strict=True):
        (v, log_v), v_inside = one.variances, 1 + RATIOS * one.inside
        squares = np.sum((one.V @ r) ** 2 / v, axis=1) + within / v_inside
        n = len(one.V) + free
        likely = np.maximum(squares, np.finfo(float).tiny) / n  # w (R,)
        cost = n * (np.log(SCALES) + 1 / SCALES) + (n * np.log(likely) + log_v + free * np.log(v_inside))  # (S, R)
        each_law.append((cost, SCALES * (likely * (a + RATIOS * b))))
        best = min(best, float(np.min(cost)))
    near = [E[cost <= np.min(cost) + REACH] for cost, E in each_law if np.min(cost) <= best + UNLIKELY]
    return min(float(np.min(E)) for E in near), max(float(np.max(E)) for E in near)
