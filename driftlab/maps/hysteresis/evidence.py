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

from driftlab.filtering.setup import SEEN
from driftlab.maps.hysteresis.contrasts import SIZES, THIN, TINY, SoakContrasts, log_mean
from fusion_core.chunk import Array, Integers

POWER = 1.645  # deviations, one-sided 95 %
MAX_T = 12.0  # t up to which the evidence is worked out
HALVINGS = 6  # of these, until it is
TEMPER = 0.25  # of the evidence of two shapes against one, by which likelihoods of shapes lose power
FORM = 0.02  # of a size: what the true form may have more or less than the shapes of a grid
FORMED = 0.08  # the same of inputs, of whose grid every other is tried; their curves' own covariance apart
COARSE = 4  # every so many of the shapes of a kind make pairs
LEFT = 1e-5  # of a shape's squares, that the curve, levels and drift leave: less says nothing


@dataclass(frozen=True, eq=False)
class ShapeEvidence:
    """Evidence for J shapes in the contrasts of a soak; A, B and Q are the sums above, R' noises are thinned."""

    contrasts: SoakContrasts
    z: Array  # (m, J, d): the shapes; those that add to the bias, the first, are alike on all axes
    kinds: tuple[str, ...]  # (J,)
    # (2, R', I, d): log-likelihoods where the whole curve, and a part of it, follow an input, of the last I shapes
    followed: Array

    @property
    def m(self) -> int:
        """Number of contrasts."""
        return len(self.z)

    @property
    def Q(self) -> Array:
        """Squares (R, d) without a memory."""
        return self.contrasts.Q

    @cached_property
    def _sums(self) -> tuple[Array, Array]:
        """A and B (R, J, d)."""
        of_inputs = self._sums_of(self.z[:, self.added :])
        A, B = (np.concatenate(both, axis=1) for both in zip(self._of_added, of_inputs, strict=True))
        return A, B

    @cached_property
    def _of_added(self) -> tuple[Array, Array]:
        return self._sums_of(self.z[:, : self.added, :1])

    def with_inputs(self, z: Array) -> ShapeEvidence:
        """Return the evidence with other shapes (m, I, d) of the inputs."""
        other = replace(self, z=np.concatenate([self.z[:, : self.added], z], axis=1))
        vars(other)["_of_added"] = self._of_added
        return other

    def _sums_of(self, z: Array) -> tuple[Array, Array]:
        """Return A and B (R, J, d) of shapes z (m, J, d), or (m, J, 1) where all axes have the same."""
        m, J, d = z.shape
        A, B = [], []
        for own, V in self.contrasts.laws:
            w, turned = self.contrasts.weights(own), (V.T @ z.reshape(m, -1)).reshape(m, J, d)
            both = turned * (V.T @ self.contrasts.u)[:, None]
            B.append((w @ both.reshape(m, -1)).reshape(len(w), *both.shape[1:]))
            A.append(np.broadcast_to((w @ (turned**2).reshape(m, -1)).reshape(len(w), J, d), B[-1].shape))
        return np.concatenate(A), np.concatenate(B)

    @cached_property
    def prior(self) -> Array:
        """Prior probability (J,) of the shapes."""
        return np.array([1.0 / self.kinds.count(kind) for kind in self.kinds]) / len(set(self.kinds))

    @property
    def added(self) -> int:
        """Number of shapes that add to the bias: two inputs of one curve at once look like a sharp bend of it."""
        return int(self.z.shape[1] - self.followed.shape[2])

    @cached_property
    def _both(self) -> Integers:
        """Shapes (2, P) of which there are pairs."""
        names = np.array(self.kinds)
        places = [np.flatnonzero(names == kind) for kind in dict.fromkeys(self.kinds)]
        some = np.concatenate([own[(own < self.added) | (own[0] >= self.added)][::COARSE] for own in places])
        i, k = np.triu_indices(len(some), 1)
        return np.stack([some[i], some[k]])[:, some[i] < self.added]

    @cached_property
    def t2(self) -> Array:
        """Squares of coefficients over their deviations, times s^2 (R, J, d)."""
        return np.asarray(self.B**2 / np.maximum(self.A, TINY))

    @cached_property
    def of_shapes(self) -> Array:
        """Log evidence of each shape (J,), its prior apart."""
        each = self._of(slice(None), self.t2, 1)
        either = log_mean(log_mean(self.followed)) - log_mean(self.contrasts.without[self.contrasts.thin])
        either = np.sum(np.logaddexp(0.0, either) - np.log(2), axis=1)
        each[self.added :] = np.logaddexp(each[self.added :], either) - np.log(2)
        return each

    @cached_property
    def pairs(self) -> tuple[Array, Array]:
        """t^2 of each pair of shapes (R', P, d), and their log evidence (P,), its prior apart."""
        (i, k), (A, B) = self._both, (values[self.contrasts.thin] for values in self._sums)
        single, a, b, c = self.t2[self.contrasts.thin], A[:, i], A[:, k], self._gram
        det = a * b - c**2
        apart = det > LEFT * a * b
        t2 = (b * B[:, i] ** 2 + a * B[:, k] ** 2 - 2 * c * B[:, i] * B[:, k]) / np.where(apart, det, np.inf)
        t2 = np.maximum(np.where(apart, t2, 0.0), np.maximum(single[:, i], single[:, k]))
        return t2, self._of(self.contrasts.thin, t2, 2)

    @property
    def A(self) -> Array:
        """Squares (R, J, d) of the shapes."""
        return self._sums[0]

    @property
    def B(self) -> Array:
        """Products (R, J, d) of the shapes with the bias."""
        return self._sums[1]

    @property
    def _gram(self) -> Array:
        """Inner products (R', P, d) of the shapes of each pair."""
        gram, (m, _, d), (i, k) = [], self.z.shape, self._both
        alike, some = k < self.added, np.unique(self._both)  # those that add are alike on all axes
        first, other = some[some < self.added], some[some >= self.added]
        i, k, inputs = np.searchsorted(some, i), np.searchsorted(some, k), np.flatnonzero(~alike)
        for own, V in self.contrasts.laws:
            added = V.T @ self.z[:, first, 0]
            follows = (V.T @ self.z[:, other].reshape(m, -1)).reshape(m, -1, d)
            w = self.contrasts.weights(own)[::THIN]
            each = np.empty((len(w), len(i), d))
            each[:, alike] = (w @ (added[:, i[alike]] * added[:, k[alike]]))[:, :, None]
            mixed = added[:, i[inputs], None] * follows[:, k[inputs] - len(first)]
            each[:, inputs] = (w @ mixed.reshape(m, -1)).reshape(len(w), -1, d)
            gram.append(each)
        return np.concatenate(gram)

    def _of(self, noises: Integers | slice, t2: Array, p: int) -> Array:
        """Return the log evidence (J,) of t^2 (R, J, d), under some noises, of p coefficients on an axis each."""
        base, logs = log_mean(self.contrasts.without[noises]), []
        for g in SIZES:
            with_it = log_mean(self.contrasts.likelihood(self.Q[noises, None] - g / (1 + g) * t2, noises))
            logs.append(
                np.sum(np.logaddexp(0.0, with_it - p * np.log1p(g) / 2 - base), axis=1) - t2.shape[2] * np.log(2)
            )
        return log_mean(np.array(logs))

    @cached_property
    def single(self) -> float:
        """Log evidence of a memory of one shape against none."""
        return float(log_mean(self.of_shapes + np.log(self.prior * len(self.prior))))

    @cached_property
    def total(self) -> float:
        """Log evidence of a memory of one shape or two, with even odds, against none."""
        each = self.pairs[1]
        prior = np.prod(self.prior[self._both], axis=0)
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
        left, none = self.Q[:, None] - 2 * self.B[:, which] + self.A[:, which], self.contrasts.without
        each = log_mean(self.contrasts.likelihood(left)) - log_mean(none)
        whole = log_mean(self.followed[0][:, which[self.added :]]) - log_mean(none[self.contrasts.thin])
        return float(np.max(np.sum(np.maximum(each, whole), axis=1)))

    def alone(self, which: NDArray[np.bool_]) -> float:
        """Return the log evidence of one or two of some shapes (J,) alone, of which none is likelier than another."""
        if not np.any(which):
            return 0.0
        both = which[self._both].all(axis=0)
        each = [self.of_shapes[which], *([self.pairs[1][both]] if np.any(both) else [])]
        return max(float(log_mean(logs)) for logs in each)

    @cached_property
    def left(self) -> Array:
        """Squares Q that are left (R, d): with the likeliest shape, or two, where a memory is seen; NaN: not tried."""
        if self.total <= SEEN:
            return self.Q
        t2, each = self.pairs
        if not len(each) or np.max(each) <= np.max(self.of_shapes):
            return np.maximum(self.Q - self.t2[:, int(np.argmax(self.weights))], TINY)
        squares = np.full_like(self.Q, np.nan)
        squares[self.contrasts.thin] = np.maximum(self.Q[self.contrasts.thin] - t2[:, int(np.argmax(each))], TINY)
        return squares

    @cached_property
    def noises(self) -> Array:
        """Probability of each noise (R, d)."""
        like = self.contrasts.likelihood(self.left)
        return shares(np.where(np.isnan(like), -np.inf, like))

    @cached_property
    def estimates(self) -> tuple[Array, Array]:
        """Coefficients and their variances (J, d), any size as probable as any other beforehand."""
        left = np.maximum(self.Q[:, None] - self.t2, TINY)
        A = np.maximum(self.A, TINY)
        share = shares(self.contrasts.log_w[:, None, None] - np.log(A) / 2 - (self.m - 1) / 2 * np.log(left))
        each = self.B / A
        mean = np.sum(share * each, axis=0)
        return mean, np.sum(share * (left / (self.m - 3) / A + (each - mean) ** 2), axis=0)

    def would_show(self, alike: Array) -> Array:
        """Return the coefficients (J, d) that would have been seen with 95 %, on one axis alone.

        `alike` (J, J, d): squares of the correlations of shapes under the likeliest noise. An axis without a memory is
        taken to speak against one as much as it does at t = 1.
        """
        d, weight = self.Q.shape[1], self.prior / 2
        weight[self.added :] /= 2  # or the whole curve follows
        still = np.logaddexp(0.0, SIZES / (1 + SIZES) / 2 - np.log1p(SIZES) / 2) - np.log(2)
        needed = np.empty(self.z.shape[1:])
        for axis in range(d):
            low, high = np.zeros(len(weight)), np.full(len(weight), MAX_T)
            for _ in range(HALVINGS):
                t = (low + high) / 2
                t2 = t**2 * alike[:, :, axis]
                factors = [weight @ (1 + np.exp(g / (1 + g) * t2 / 2) / np.sqrt(1 + g)) for g in SIZES]
                least = 2 * len(SIZES) * np.exp(SEEN)  # beside pairs of even odds
                reached = np.exp((d - 1) * still) @ factors >= least
                low, high = np.where(reached, low, t), np.where(reached, t, high)
            needed[:, axis] = np.where(low > 0.99 * MAX_T, np.inf, high)
        spread = np.sum(
            (self.noises * np.nan_to_num(self.left) / self.m)[:, None] / np.maximum(self._sums[0], TINY), axis=0
        )
        return np.where(spread > 0, (needed + POWER) * np.sqrt(np.maximum(spread, TINY)), 0.0)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Estimates of the likeliest pairs of shapes, `which` (P, 2), with the log-likelihood of each (P,).

    `evidence` is that of two shapes against one; coefficients are (P, 2, d), covariances (P, 2, 2, d).
    """

    which: Integers
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
    def of(cls, shapes: ShapeEvidence, noise: Integers, most: int) -> Pairs:
        """Return those of two of the shapes, the `most` likeliest, each axis (d,) under its noise."""
        J, d = shapes.z.shape[1:]
        i, k = np.triu_indices(J, 1)
        i, k = i[i < shapes.added], k[i < shapes.added]
        total, mean, covariance = np.zeros(len(i)), np.empty((len(i), 2, d)), np.empty((len(i), 2, 2, d))
        single = np.zeros(J)
        for axis, r in enumerate(noise):
            G, B = shapes.contrasts.gram(int(r), shapes.z[:, :, axis]), shapes.B[r, :, axis]
            Q = shapes.Q[r, axis]
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


def shares(x: Array) -> Array:
    """Return exp(x), its sum over the first axis 1."""
    weights = np.exp(x - x.max(axis=0))
    return np.asarray(weights / weights.sum(axis=0))
