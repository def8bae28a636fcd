"""Evidence for shapes of memories, the noise left open: Bayes factors averaged over laws and sizes of the noise.

With contrasts u (m,) and weights w = 1 / (r own + 1) of one law and one ratio r, all in the law's eigenvectors::

    Q = sum w u^2,   A = sum w z^2,   B = sum w z u,   t^2 = B^2 / A
    L_0 = prod w^1/2  Q^(-m/2)
    L_1 = prod w^1/2  (1 + g)^(-1/2)  (Q - g / (1 + g) t^2)^(-m/2)

L_1 is that of z gamma where gamma ~ N(0, g s^2 / A) and s is free (Zellner's g-prior). An input (a lag, a play) shows
the curve that is fitted to temperature; with even odds the whole curve follows it instead, without a coefficient
(`Contrasts.followed`). All are averaged over all laws and ratios, so that neither a loop that may be a slow noise nor a
slow noise that may be a loop is taken for the other; then over the shapes, all kinds alike, over pairs of some of them,
and over SIZES, each axis having the memory or not with even odds. So all that was tried is priced: where there is no
memory the mean of this factor is 1.

R noises (laws times ratios), J shapes, d axes.

Sources: A. Zellner, in Bayesian Inference and Decision Techniques, North-Holland (1986) 233; R. E. Kass and A. E.
Raftery, J. Am. Stat. Assoc. 90 (1995) 773; J. W. Miller and D. B. Dunson, J. Am. Stat. Assoc. 114 (2019) 1113, for
likelihoods to a power where no model is the true one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from driftlab.maps.hysteresis.contrasts import RATIOS, SIZES, THIN, SoakContrasts, log_mean
from driftlab.soak.sweeps import Index
from fusion_core.chunk import Array

SEEN = np.log(100.0)  # of the evidence: one soak in 1,000 of all noises drawn has more
POWER = 1.645  # deviations, one-sided 95 %
MAX_T = 12.0  # t up to which the evidence is worked out
HALVINGS = 6  # of these, until it is
TINY = 1e-300
TEMPER = 0.25  # of the evidence of two shapes against one, by which likelihoods of shapes lose power
FORM = 0.02  # of a size: what the true form may have more or less than the shapes of a grid
FORMED = 0.08  # the same of inputs, of whose grid every other is tried; their curves' own covariance apart
COARSE = 4  # every so many of the shapes of a kind make pairs
LEFT = 1e-5  # of a shape's squares, that the curve, levels and drift leave: less says nothing


@dataclass(frozen=True, eq=False)
class ShapeEvidence:
    """Evidence for shapes in the contrasts of a soak.

    Attributes
    ----------
    log_w, Q, A, B : (R,), (R, d), (R, J, d) and (R, J, d) arrays
        The sums above, log_w half of that of log w.
    m : int
        Number of contrasts.
    prior : (J,) array
        Of the shapes; its sum is 1.
    thin, both : (R',) and (2, P) arrays of int
        Noises and shapes of which there are pairs.
    gram : (R', P, d) array
        Inner products of these under these.
    followed : (2, R', I, d) array
        Log-likelihoods where the whole curve, and a part of it, follow an input, of the last I shapes.
    """

    log_w: Array
    Q: Array
    A: Array
    B: Array
    m: int
    prior: Array
    thin: Index
    both: Index
    gram: Array
    followed: Array

    @classmethod
    def of(
        cls, contrasts: SoakContrasts, z: Array, kinds: tuple[str, ...], followed: Array | None = None
    ) -> ShapeEvidence:
        """Return that of shapes z (m, J, d), of these kinds (J,), the last of them inputs that are `followed`.

        Those that are no inputs are alike on all axes.
        """
        logs, Q, gram = [], [], []
        names = np.array(kinds)
        m, J, d = z.shape
        added = J if followed is None else J - followed.shape[2]
        places = [np.flatnonzero(names == kind) for kind in dict.fromkeys(kinds)]
        some = np.concatenate([own[(own < added) | (own[0] >= added)][::COARSE] for own in places]).astype(np.int64)
        i, k = np.triu_indices(len(some), 1)
        i, k = i[some[i] < added], k[some[i] < added]
        for own, V in contrasts.laws:
            w = contrasts.weights(own)
            logs.append(np.sum(np.log(w), axis=1) / 2)
            Q.append(w @ (V.T @ contrasts.u) ** 2)
            few = (V.T @ z[:, some].reshape(m, -1)).reshape(m, -1, d)
            gram.append((w[::THIN] @ (few[:, i] * few[:, k]).reshape(m, -1)).reshape(-1, len(i), d))
        prior = np.array([1.0 / np.sum(names == kind) for kind in kinds]) / len(set(kinds))
        R = np.arange(len(contrasts.laws) * len(RATIOS)).reshape(-1, len(RATIOS))[:, ::THIN].ravel()
        sums = [np.concatenate(part) for part in (logs, Q, gram)]
        each = zip(_sums(contrasts, z[:, :added, :1]), _sums(contrasts, z[:, added:]), strict=True)
        A, B = (np.concatenate(both, axis=1) for both in each)
        whole = np.empty((2, len(R), 0, d)) if followed is None else followed
        return cls(sums[0], sums[1], A, B, m, prior, R, np.stack([some[i], some[k]]), sums[2], whole)

    def made(self, contrasts: SoakContrasts, z: Array) -> ShapeEvidence:
        """Return that of inputs (m, I, d) whose forms the soak made: for their sizes alone."""
        A, B = _sums(contrasts, z)
        old = self.A[:, : self.added], self.B[:, : self.added]
        return replace(self, A=np.concatenate([old[0], A], axis=1), B=np.concatenate([old[1], B], axis=1))

    @cached_property
    def none(self) -> Array:
        """Log-likelihood of each noise without a memory (R, d)."""
        return np.asarray(self.log_w[:, None] - self.m / 2 * np.log(np.maximum(self.Q, TINY)))

    @cached_property
    def t2(self) -> Array:
        """Squares of coefficients over their deviations, times s^2 (R, J, d)."""
        return np.asarray(self.B**2 / np.maximum(self.A, TINY))

    @cached_property
    def of_shapes(self) -> Array:
        """Log evidence of each shape (J,), its prior apart."""
        each = self._of(self.log_w, self.Q, self.t2, 1)
        either = log_mean(log_mean(self.followed)) - log_mean(self.none[self.thin])
        either = np.sum(np.logaddexp(0.0, either) - np.log(2), axis=1)
        each[self.added :] = np.logaddexp(each[self.added :], either) - np.log(2)
        return each

    @property
    def added(self) -> int:
        """Number of shapes that add to the bias: two inputs of one curve at once look like a sharp bend of it."""
        return int(self.A.shape[1] - self.followed.shape[2])

    @cached_property
    def pairs(self) -> tuple[Array, Array]:
        """t^2 of each of `both` (R', P, d), and their log evidence (P,), its prior apart."""
        i, k = self.both
        A, B, single = (values[self.thin] for values in (self.A, self.B, self.t2))
        a, b, c = A[:, i], A[:, k], self.gram
        det = a * b - c**2
        apart = det > LEFT * a * b
        t2 = (b * B[:, i] ** 2 + a * B[:, k] ** 2 - 2 * c * B[:, i] * B[:, k]) / np.where(apart, det, np.inf)
        t2 = np.maximum(np.where(apart, t2, 0.0), np.maximum(single[:, i], single[:, k]))
        return t2, self._of(self.log_w[self.thin], self.Q[self.thin], t2, 2)

    def _of(self, log_w: Array, Q: Array, t2: Array, p: int) -> Array:
        """Return the log evidence (J,) of t^2 (R, J, d) of p coefficients on an axis each."""
        base, logs = log_mean(log_w[:, None] - self.m / 2 * np.log(np.maximum(Q, TINY))), []
        for g in SIZES:
            left = np.maximum(Q[:, None] - g / (1 + g) * t2, TINY)
            with_it = log_mean(log_w[:, None, None] - self.m / 2 * np.log(left)) - p * np.log1p(g) / 2
            logs.append(np.sum(np.logaddexp(0.0, with_it - base), axis=1) - Q.shape[1] * np.log(2))
        return log_mean(np.array(logs))

    @cached_property
    def single(self) -> float:
        """Log evidence of a memory of one shape against none."""
        return float(log_mean(self.of_shapes + np.log(self.prior * len(self.prior))))

    @cached_property
    def total(self) -> float:
        """Log evidence of a memory of one shape or two, with even odds, against none."""
        each = self.pairs[1]
        prior = np.prod(self.prior[self.both], axis=0)
        double = log_mean(each + np.log(prior / prior.mean())) if len(each) else self.single
        return float(np.logaddexp(self.single, double) - np.log(2))

    @cached_property
    def weights(self) -> Array:
        """Probability of each shape, if there is a memory (J,)."""
        return shares(self.of_shapes + np.log(self.prior))

    def tempered(self, power: float) -> Array:
        """Return the same (J,), their likelihoods to a power."""
        return shares(power * self.of_shapes + np.log(self.prior))

    def as_they_are(self, which: NDArray[np.bool_]) -> float:
        """Return the log evidence of the likeliest of some inputs (J,) as they are, or of all the curve; 0 without."""
        if not np.any(which):
            return 0.0
        left = np.maximum(self.Q[:, None] - 2 * self.B[:, which] + self.A[:, which], TINY)
        each = log_mean(self.log_w[:, None, None] - self.m / 2 * np.log(left)) - log_mean(self.none)
        whole = log_mean(self.followed[0][:, which[self.added :]]) - log_mean(self.none[self.thin])
        return float(np.max(np.sum(np.maximum(each, whole), axis=1)))

    @cached_property
    def left(self) -> Array:
        """Squares Q that are left (R, d): with the likeliest shape, or two, where a memory is seen; NaN: not tried."""
        if self.total <= SEEN:
            return self.Q
        t2, each = self.pairs
        if not len(each) or np.max(each) <= np.max(self.of_shapes):
            return np.maximum(self.Q - self.t2[:, int(np.argmax(self.weights))], TINY)
        squares = np.full_like(self.Q, np.nan)
        squares[self.thin] = np.maximum(self.Q[self.thin] - t2[:, int(np.argmax(each))], TINY)
        return squares

    @cached_property
    def noises(self) -> Array:
        """Probability of each noise (R, d)."""
        like = self.log_w[:, None] - self.m / 2 * np.log(np.maximum(self.left, TINY))
        return shares(np.where(np.isnan(like), -np.inf, like))

    @cached_property
    def estimates(self) -> tuple[Array, Array]:
        """Coefficients and their variances (J, d), any size as probable as any other beforehand."""
        left = np.maximum(self.Q[:, None] - self.t2, TINY)
        A = np.maximum(self.A, TINY)
        share = shares(self.log_w[:, None, None] - np.log(A) / 2 - (self.m - 1) / 2 * np.log(left))
        each = self.B / A
        mean = np.sum(share * each, axis=0)
        return mean, np.sum(share * (left / (self.m - 3) / A + (each - mean) ** 2), axis=0)

    def would_show(self, alike: Array) -> Array:
        """Return the coefficients (J, d) that would have been seen with 95 %, on one axis alone.

        `alike` (J, J, d): squares of the correlations of shapes under the likeliest noise. An axis without a memory is
        taken to speak against one as much as it does at t = 1.
        """
        d, prior = self.Q.shape[1], np.log(self.prior * len(self.prior))[:, None]
        prior = prior - np.log(2) * (np.arange(len(prior)) >= self.added)[:, None]  # or the whole curve follows
        still = np.logaddexp(0.0, SIZES / (1 + SIZES) / 2 - np.log1p(SIZES) / 2) - np.log(2)
        needed = np.empty(self.A.shape[1:])
        for axis in range(d):
            low, high = np.zeros(len(prior)), np.full(len(prior), MAX_T)
            for _ in range(HALVINGS):
                t = (low + high) / 2
                each = []
                for g, other in zip(SIZES, still, strict=True):
                    t2 = t**2 * alike[:, :, axis]
                    factor = np.log1p(np.exp(g / (1 + g) * t2 / 2 - np.log1p(g) / 2)) - np.log(2)
                    each.append(log_mean(factor + prior) + (d - 1) * other)
                reached = log_mean(np.array(each)) >= SEEN + np.log(2)  # beside pairs of even odds
                low, high = np.where(reached, low, t), np.where(reached, t, high)
            needed[:, axis] = np.where(low > 0.99 * MAX_T, np.inf, high)
        spread = np.sum((self.noises * np.nan_to_num(self.left) / self.m)[:, None] / np.maximum(self.A, TINY), axis=0)
        return np.where(spread > 0, (needed + POWER) * np.sqrt(np.maximum(spread, TINY)), 0.0)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Estimates of the likeliest pairs of shapes, `which` (P, 2), with the log-likelihood of each (P,).

    `evidence` is that of two shapes against one; coefficients are (P, 2, d), covariances (P, 2, 2, d).
    """

    which: Index
    likelihoods: Array
    mean: Array
    covariance: Array
    evidence: float

    @property
    def power(self) -> float:
        """Power to which likelihoods of shapes count: 1 where one shape is all there is, less where it is not.

        Where two shapes are likelier than one, one is not the true one, and so two need not be (Miller and Dunson).
        """
        return float(1 / (1 + TEMPER * max(self.evidence, 0.0)))

    @property
    def weights(self) -> Array:
        """Probability of each pair, if there are two (P,)."""
        return shares(self.power * self.likelihoods)

    @classmethod
    def of(cls, shapes: ShapeEvidence, noise: Index, contrasts: SoakContrasts, z: Array, most: int) -> Pairs:
        """Return those of two of the shapes z (m, J, d), the `most` likeliest, each axis (d,) under its noise."""
        J, d = z.shape[1:]
        i, k = np.triu_indices(J, 1)
        i, k = i[i < shapes.added], k[i < shapes.added]
        total, mean, covariance = np.zeros(len(i)), np.empty((len(i), 2, d)), np.empty((len(i), 2, 2, d))
        single = np.zeros(J)
        for axis, r in enumerate(noise):
            G, B, Q = contrasts.gram(int(r), z[:, :, axis]), shapes.B[r, :, axis], shapes.Q[r, axis]
            a, b, c = G[i, i], G[k, k], G[i, k]
            det = a * b - c**2
            some = det > LEFT * a * b
            det = np.where(some, det, np.inf)
            inverse = np.array([[b, -c], [-c, a]]) / det
            pair = np.einsum("ijP,jP->Pi", inverse, np.array([B[i], B[k]]))
            t2 = pair[:, 0] * B[i] + pair[:, 1] * B[k]
            mean[:, :, axis] = pair
            rest = np.maximum(Q - t2, TINY)
            covariance[..., axis] = np.moveaxis(inverse * rest / (shapes.m - 4), 2, 0)
            g = max(float(np.max(t2)) / Q * shapes.m, SIZES[0])  # a price that grows with what is there
            total += np.where(some, -shapes.m / 2 * np.log(rest), -np.inf) - np.log1p(g)
            single += -shapes.m / 2 * np.log(np.maximum(Q - shapes.t2[r, :, axis], TINY)) - np.log1p(g) / 2
        total += np.log(shapes.prior[i] * shapes.prior[k] * 2)
        single += np.log(shapes.prior)
        order = np.argsort(-total)[:most]
        evidence = float(np.logaddexp.reduce(total) - np.logaddexp.reduce(single))
        which = np.stack([i, k], axis=1).astype(np.int64)[order]
        return cls(which, total[order], mean[order], covariance[order], evidence)


def _sums(contrasts: SoakContrasts, z: Array) -> tuple[Array, Array]:
    """Return A and B (R, J, d) of shapes z (m, J, d), or (m, J, 1) where all axes have the same."""
    m, J, _ = z.shape
    A, B = [], []
    for own, V in contrasts.laws:
        w, turned = contrasts.weights(own), (V.T @ z.reshape(m, -1)).reshape(m, J, -1)
        both = turned * (V.T @ contrasts.u)[:, None]
        B.append((w @ both.reshape(m, -1)).reshape(-1, *both.shape[1:]))
        A.append(np.broadcast_to((w @ (turned**2).reshape(m, -1)).reshape(len(w), J, -1), B[-1].shape))
    return np.concatenate(A), np.concatenate(B)


def shares(x: Array) -> Array:
    """Return exp(x), its sum over the first axis 1."""
    weights = np.exp(x - x.max(axis=0))
    return np.asarray(weights / weights.sum(axis=0))
