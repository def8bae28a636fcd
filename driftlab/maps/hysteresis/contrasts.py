"""Contrasts of a soak, free of any curve and level, turned so that each law of its slow noise is diagonal.

K blocks are means of slots that follow one another; a block is of one recording. A bias of d axes is taken as::

    y = X(T) beta + levels + Z(T before) gamma + slow + white

X are cubic splines, averaged over the blocks as the slots are. White noise of a mean block has variance s^2, slow noise
r s^2 C, C the covariance of the blocks' means under one of these laws, each of variance 1:

- Gauss-Markov noise of some correlation times; that of many spans of the soak is a random walk;
- flicker noise, as many of them side by side, evenly over the logarithm of time;
- a steady drift alone; beside each of the others stands one that goes as far over the soak as they do, in deviations.

In the m contrasts u that are free of X and levels, and in the eigenvectors of C there, the noise is independent,
of variances s^2 (r own + 1): a likelihood is a sum. J shapes.

Source: J. A. Barnes and S. Jarvis, NBS Technical Note 604 (1971), for flicker noise as a cascade.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from driftlab.soak.blocks import CELLS, OFF, SoakRows, SoakSummary, means, runs
from fusion_core.chunk import Array, Flags, Integers, locked
from fusion_core.thermal.soak_noise import Complement, basis_of
from fusion_core.wandering import gauss_markov

BLOCKS = 240  # about; half as many miss one more memory in a hundred
MIN_CONTRASTS = 24  # that separate slow noise from white noise, at least
KNOTS = (8, 16, 32, 64)  # of the curve, as many as it needs
GROUP = 3  # blocks to each at least
RATIOS = np.concatenate([[0.0], np.logspace(-3, 4, 22)])  # of slow to white noise, in a mean contrast
RANK = 1e-7  # of the largest singular value: columns that are combinations of others
WALK = 30.0  # spans: a correlation time that is that of a walk
SPANS = (WALK, 0.3, 0.1, 0.03)  # correlation times, of the span
FREE = 1.0  # of the bias: how far a curve may be from the one that is bent by its memory
RANKS = 3  # directions in which such a curve is uncertain
FINEST = 1e-10  # white noise, of the bias: squares, where there is hardly any
ALIKE = 0.5  # of the domain: over which what a part of the curve adds is alike
PARTS = 6  # directions in which it is free
SIZES = np.array([4.0, 20.0, 100.0])  # g: squares of a coefficient, in deviations of its estimate
THIN = 2  # every so many ratios, where all are too many
CASCADE = np.sqrt(10.0)  # between the times of flicker noise
TINY = 1e-300


class FreeCurve:
    """A free curve of temperature: cubic splines with even knots over the domain."""

    def __init__(self, domain: tuple[float, float], count: int) -> None:
        low, high = domain
        self.knots = np.concatenate([[low] * 3, np.linspace(low, high, max(count, 2)), [high] * 3])
        self.domain = domain

    def smooth(self) -> Array:
        """Return directions (p, h) of the coefficients of a smooth curve, each a deviation long: a Gaussian process."""
        centres = np.convolve(self.knots, np.full(3, 1 / 3), mode="valid")[1:-1]
        apart = (centres[:, None] - centres) / (ALIKE * np.ptp(self.domain))
        values, vectors = np.linalg.eigh(np.exp(-(apart**2) / 2))
        some = values > RANK * values[-1]
        return np.asarray(vectors[:, some] * np.sqrt(values[some]))

    def __call__(self, T: Array) -> Array:
        """Return the splines (N, p) at T (N,), held beyond the domain."""
        from scipy.interpolate import BSpline

        return np.asarray(BSpline(self.knots, np.eye(len(self.knots) - 4), 3)(np.clip(T, *self.domain)))


@lru_cache(maxsize=2)
def _laws(t: bytes, span: bytes, recording: bytes) -> tuple[Array, list[Array], tuple[Array, Array]]:
    """Return roots (K, 1) of spans over their mean, the laws times these, and eigenvalues and -vectors of the walk.

    Once for all units of a line that are soaked for the same times.
    """
    blocks = SoakRows(np.frombuffer(t), np.empty(0), np.empty(0), np.frombuffer(span), {})
    root = locked(np.sqrt(blocks.span / np.mean(blocks.span))[:, None])
    laws = [locked(root * C * root.T) for C in laws_of(blocks, np.frombuffer(recording, np.int64))]
    own, V = map(locked, np.linalg.eigh(laws[0]))
    return root, laws, (own, V)


def laws_of(blocks: SoakRows, recording: Integers) -> list[Array]:
    """Return the covariances (K, K) of slow noise of variance 1, one a law; the walk's first."""
    lasted = float(np.median(blocks.span))
    whole = max(float(np.ptp(blocks.t[recording == k])) for k in np.unique(recording)) + lasted
    apart = np.abs(blocks.t[:, None] - blocks.t)
    together = recording[:, None] == recording
    cascade = lasted * CASCADE ** np.arange(np.log(WALK * whole / lasted) / np.log(CASCADE))
    flicker = np.mean([gauss_markov(apart, lasted, tau) for tau in cascade], axis=0)
    wandering = [*(gauss_markov(apart, lasted, share * whole) for share in SPANS), flicker]
    t = (blocks.t - np.mean(blocks.t)) / np.ptp(blocks.t)
    drift = np.outer(t, t)
    return [*(C * together + 2 * (C[0, 0] - C[0, -1]) * drift for C in wandering), drift]


@dataclass(frozen=True, eq=False)
class FollowingCurves:
    """Curves that follow J inputs, as a soak makes them."""

    coefficients: Array  # (J, p, d): of the splines
    partly: NDArray[np.bool_]  # (J, d): whether a part of the curve follows, or all of it
    added: Array  # (S, J, d): the bias that each adds on the slots
    late: Array  # (J, K, p): the splines of the blocks where the curve sees the inputs


class SoakContrasts:
    """The contrasts of one soak.

    `y` (K, d) is the bias of its blocks in `scale` (d,), Z (K, m) are the contrasts, white noise of all blocks alike,
    and `laws` the eigenvalues (m,) and eigenvectors (m, m) of each law.
    """

    def __init__(self, soak: SoakSummary, beside: Array | None = None) -> None:
        """Take the soak; columns `beside` (S, q) on its slots are as free as its levels are."""
        first = np.flatnonzero(np.diff(soak.recording, prepend=-1))
        self.starts = runs(first, len(soak.T), -(-len(soak.T) // BLOCKS))
        blocks, self.soak = soak.coarsened(self.starts), soak
        self.known = self._known(blocks, soak)
        self.blocks, recording = blocks.part(self.known), soak.recording[self.starts][self.known]
        self.laws: list[tuple[Array, Array]] = []
        if len(self.blocks.T) < 2 * MIN_CONTRASTS:
            return
        bias = self.blocks.bias
        self.scale = np.std(bias, axis=0)
        self.scale[self.scale == 0] = 1.0
        self.root, laws, walk = _laws(self.blocks.t.tobytes(), self.blocks.span.tobytes(), recording.tobytes())
        self.y = (bias - bias.mean(axis=0)) / self.scale * self.root
        levels = recording[:, None] == np.unique(recording)[1:]
        self.more = (levels if beside is None else np.column_stack([levels, self.means(beside)])) * self.root
        self.curve, self.splines = self._curve(soak, *walk)
        self.X = np.column_stack([self.splines * self.root, self.more])
        free_of_X = Complement(basis_of(self.X, RANK))
        self.Z = free_of_X.Z
        self.covariances = laws if self.Z.shape[1] >= MIN_CONTRASTS else []
        self.laws = [np.linalg.eigh(free_of_X.both(C)) for C in self.covariances[:-1]]
        self.laws += [_of_drift(C, self.Z) for C in self.covariances[-1:]]
        self._fits: dict[int, tuple[Array, Array, Array]] = {}

    def _known(self, blocks: SoakRows, soak: SoakSummary) -> Flags:
        """Return the blocks (K,) in which the steps of the thermometer hide less than white noise does.

        What T is off by there, times the slope, is alike on all axes, so that d of them tell no more than one.
        """
        off = blocks.channels.get(OFF)
        if off is None:
            return np.ones(len(blocks.T), dtype=bool)
        curve, h = FreeCurve(soak.domain, KNOTS[0]), np.ptp(soak.domain) / CELLS
        c = np.linalg.lstsq(curve(blocks.T), blocks.bias, rcond=RANK)[0]
        slope = (curve(blocks.T + h) - curve(blocks.T - h)) @ c / (2 * h)
        white = soak.white**2 * np.sum(soak.span) / np.sum(soak.count)
        return np.asarray(np.all(len(white) * slope**2 * off[:, None] <= white, axis=1))

    def _curve(self, soak: SoakSummary, own: Array, V: Array) -> tuple[FreeCurve, Array]:
        """Return the curve with as many knots as the soak asks for beside a walk, and its splines (K, p).

        `own` (K,) and V (K, K) are the eigenvalues and eigenvectors of the walk.
        By Akaike's information criterion, from few knots on, as long as twice as many are better: a curve that is too
        stiff leaves more than one that is too free takes.
        """
        weights = [np.sqrt(w) for w in self.weights(np.maximum(own, 0.0))[::3]]
        y, more, best = V.T @ self.y, V.T @ self.more, np.inf
        chosen: list[tuple[FreeCurve, Array]] = []
        for count in KNOTS:
            if chosen and count * GROUP > len(self.y):
                break
            curve = FreeCurve(soak.domain, count)
            splines = self.means(curve(soak.T))
            X = np.column_stack([V.T @ (splines * self.root), more])
            costs = np.array([_cost(X * w[:, None], y * w[:, None]) - 2 * np.sum(np.log(w)) for w in weights])
            cost = np.sum(costs.min(axis=0)) + 2 * y.shape[1] * X.shape[1]
            if cost >= best:
                break
            best = cost
            chosen.append((curve, splines))
        return chosen[-1]

    def means(self, values: Array) -> Array:
        """Return the means (K, ...) of values of the slots (S, ...) over the blocks."""
        return means(values, self.starts, self.soak.span)[self.known]

    @cached_property
    def u(self) -> Array:
        """The bias (m, d) in the contrasts."""
        return np.asarray(self.Z.T @ self.y)

    @cached_property
    def log_w(self) -> Array:
        """Half the sum of log w of each noise (R,)."""
        return np.concatenate([np.sum(np.log(self.weights(own)), axis=1) / 2 for own, _ in self.laws])

    @cached_property
    def thin(self) -> Integers:
        """Every THIN-th ratio of each law (R',), by its number among the noises."""
        return np.arange(len(self.log_w)).reshape(-1, len(RATIOS))[:, ::THIN].ravel()

    @cached_property
    def Q(self) -> Array:
        """Squares (R, d) of the bias under each noise."""
        return np.concatenate([self.weights(own) @ (V.T @ self.u) ** 2 for own, V in self.laws])

    @cached_property
    def without(self) -> Array:
        """Log-likelihood (R, d) of each noise without a memory, but for a constant."""
        return self.likelihood(self.Q)

    def likelihood(self, left: Array, noises: Integers | slice = slice(None)) -> Array:
        """Return the log-likelihood (R, ...) of noises that leave such squares (R, ...), but for a constant."""
        log_w = self.log_w[noises].reshape(-1, *[1] * (left.ndim - 1))
        return np.asarray(log_w - len(self.u) / 2 * np.log(np.maximum(left, TINY)))

    def of(self, values: Array) -> Array:
        """Return values of slots (S, ...) in the contrasts (m, ...)."""
        z = self.Z.T @ (self.means(values.reshape(len(values), -1)) * self.root)
        return np.asarray(z.reshape(len(z), *values.shape[1:]))

    @staticmethod
    def weights(own: Array) -> Array:
        """Return the weights (len(RATIOS), m) of the eigenvectors of a law, `own` (m,) its eigenvalues."""
        return np.asarray(1.0 / (RATIOS[:, None] / np.mean(own) * own + 1.0))

    def under(self, noise: int) -> tuple[Array, Array]:
        """Return weights (m,) and eigenvectors (m, m) of a noise, counted over laws, then ratios."""
        own, V = self.laws[noise // len(RATIOS)]
        return self.weights(own)[noise % len(RATIOS)], V

    def fit(self, noise: int) -> tuple[Array, Array, Array]:
        """Return L (K, K), C^-1 X (K, P) and (X' C^-1 X)^-1 (P, P) of generalised least squares under a noise.

        C = L L' is the covariance of the blocks, whose white part has a variance of 1.
        """
        from scipy.linalg.lapack import dpotrf, dpotrs

        if noise not in self._fits:
            law, ratio = divmod(noise, len(RATIOS))
            C = RATIOS[ratio] / np.mean(self.laws[law][0]) * self.covariances[law]
            C[np.diag_indices(len(C))] += 1.0
            root = dpotrf(C, lower=1)[0]
            solved = dpotrs(root, self.X, lower=1)[0]
            self._fits[noise] = root, solved, np.linalg.pinv(self.X.T @ solved, hermitian=True, rcond=RANK)
        return self._fits[noise]

    def gram(self, noise: int, z: Array) -> Array:
        """Return the inner products (J, J) of shapes z (m, J) under a noise."""
        w, V = self.under(noise)
        turned = V.T @ z
        return np.asarray((turned.T * w) @ turned)

    def curves_under(self, noise: int, axis: int, late: Array, regressors: Array) -> tuple[Array, Array, Array]:
        """Return the curve (P,) of an axis under a noise, those that follow inputs (P, J), and how uncertain they are.

        `late` (J, K, P): what X is where the curve sees the inputs, and `regressors` (J, m, P) in the contrasts.
        Whoever fits a free curve of temperature to what follows an input, bends the curve by a part of the memory. So
        each curve is the one of which generalised least squares would make the curve that they make here: as many
        equations as coefficients, in which nothing of the contrasts' noise is. What these leave open is some
        directions, each a standard deviation long where white noise has one of 1; those that the contrasts show most
        are returned, (P, J, RANKS).
        """
        w, V = self.under(noise)
        _, solved, spread = self.fit(noise)
        bent = spread @ (solved.T @ self.y[:, axis])
        free = FREE**2 / max(float(np.mean(w * (V.T @ self.u[:, axis]) ** 2)), FINEST)
        again = spread @ solved.T @ late
        one, turned = np.eye(len(bent)), np.swapaxes(again, 1, 2)
        gain = np.swapaxes(np.linalg.solve(again @ turned + (spread + RANK * one) / free, again), 1, 2)
        curves = bent + np.einsum("jpq,jq->jp", gain, bent - again @ bent)
        left = free * (one - gain @ again)
        values, vectors = np.linalg.eigh((left + np.swapaxes(left, 1, 2)) / 2)
        half = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
        shown = np.sqrt(w)[:, None] * _turned(V, regressors) @ half
        most = np.linalg.eigh(np.swapaxes(shown, 1, 2) @ shown)[1][:, :, -RANKS:]
        return bent, curves.T, np.swapaxes(half @ most, 0, 1)

    def late(self, inputs: Array) -> tuple[Array, Array]:
        """Return the splines where the curve sees inputs (S, J): of slots (S, J, p), and X of the blocks (J, K, P)."""
        there = self.curve(inputs.ravel()).reshape(*inputs.shape, -1)
        return there, np.stack([np.hstack([one * self.root, self.more]) for one in self.means(there).swapaxes(0, 1)])

    def added_by_inputs(self, inputs: Array, noises: Array) -> tuple[Array, Array, Array, FollowingCurves]:
        """Return the bias that is added where the curve sees other temperatures (S, J).

        The curve is that of each axis under its noise (d,).

        Returns
        -------
        slots, contrasts : (S, J, d) and (m, J, d) arrays
            Of the curve that is fitted to temperature.
        likelihoods : (2, R', J, d) array
            As `followed` and `parts` have them: of all and of a part of the curve that follows.
        curves : FollowingCurves
            The likelier of the two.
        """
        there, late = self.late(inputs)
        regressors = _turned(self.Z, late)  # (J, m, P)
        each = [self.curves_under(int(noise), axis, late, regressors) for axis, noise in enumerate(noises)]
        bent, curves, ways = (np.stack([one[k] for one in each], axis=min(k + 1, 2)) for k in range(3))
        there, p = there - self.curve(self.soak.T)[:, None], self.splines.shape[1]
        slots = there @ bent[:p]
        J, d = slots.shape[1:]
        whole = np.einsum("jmp,pjd->mjd", regressors, curves)
        open_ = (regressors @ ways.swapaxes(0, 1).reshape(J, ways.shape[0], -1)).swapaxes(0, 1)
        followed = self.followed(whole, open_.reshape(-1, J, d, ways.shape[-1]))
        smooth = self.curve.smooth()
        part, parts = self.parts(regressors[:, :, :p] @ smooth, int(noises[0]))
        likelier = log_mean(part) > log_mean(followed)
        coefficients = np.where(likelier[:, None], smooth @ parts, curves[:p].swapaxes(0, 1))
        added = (there.swapaxes(0, 1) @ coefficients).swapaxes(0, 1)
        following = FollowingCurves(coefficients, likelier, added, late[:, :, :p])
        return slots, self.of(slots), np.stack([followed, part]), following

    def form_variances(self, curves: FollowingCurves, noises: Integers, s2: Array, between: Array) -> Array:
        """Return the variances of the form (J, d) of curves that follow inputs, between two of their temperatures.

        `between` (J, d, p): the splines at one less those at the other. Curve and size are fitted together, by
        generalised least squares under the noise (d,) of each axis, whose white part has the variance s2 (d,); a
        coefficient of a spline is off by as much as the bias, beforehand. What of the covariance is along the curve
        itself is that of its size::

            g' (Sigma - a a' / (a' Sigma^-1 a)) g,    Sigma^-1 = S' C^-1 S / s^2 + 1
        """
        from scipy.linalg.lapack import dtrtrs

        S, variances = curves.late, np.zeros(curves.partly.shape)
        J, K, p = S.shape
        for axis, noise in enumerate(noises):
            root, solved, spread = self.fit(int(noise))
            white = dtrtrs(root, S.swapaxes(0, 1).reshape(K, J * p), lower=1)[0].reshape(K, J, p).swapaxes(0, 1)
            of_X, whole = np.swapaxes(S, 1, 2) @ solved, np.swapaxes(white, 1, 2) @ white  # (J, p, P) and (J, p, p)
            free = whole - of_X @ spread @ np.swapaxes(of_X, 1, 2)  # of the contrasts: the curve here is another
            M = np.where(curves.partly[:, axis, None, None], free, whole) / s2[axis] + np.eye(S.shape[2]) / FREE**2
            a, g = curves.coefficients[:, :, axis], between[:, axis]
            along = np.sum(g * a, axis=1) ** 2 / np.maximum(np.einsum("jh,jhi,ji->j", a, M, a), 1e-300)
            variances[:, axis] = np.sum(g * np.linalg.solve(M, g[:, :, None])[:, :, 0], axis=1) - along
        return np.maximum(variances, 0.0)

    def parts(self, shown: Array, noise: int) -> tuple[Array, Array]:
        """Return log-likelihoods (R', J, d) of parts of the curve that follow inputs, and the likeliest a (J, h, d).

        Of y = shown a + noise, shown (J, m, h), in the PARTS directions that show most under a noise. a ~ N(0, g s^2)
        in units in which what is shown most has g, one of SIZES: Zellner's prior of a whole curve.
        """
        w, V = self.under(noise)
        turned = _turned(V, shown)
        most = np.linalg.eigh(np.swapaxes(turned * w[:, None], 1, 2) @ turned)[1][:, :, -PARTS:]
        gram, B, Q = self.products(self.u[:, None], np.moveaxis(shown @ most, 0, 1))
        size, along = np.linalg.eigh(gram)
        size = np.maximum(size, FINEST * size[..., -1:] + TINY)
        B = np.swapaxes(along, 2, 3) @ B / size[..., None]
        g = SIZES[:, None, None, None] * size / size[..., -1:]
        a = (g / (1 + g))[..., None] * B
        like = self._integrated(Q, np.sum(a * B * size[..., None], axis=3), np.sum(np.log1p(g), axis=3))
        top = np.argmax(like.reshape(-1, *like.shape[2:]), axis=0)  # (J, d)
        k, noise_of, j, axis = *np.divmod(top, len(gram)), *np.indices(top.shape)
        return log_mean(like), most @ np.einsum("jdhq,jdq->jhd", along[noise_of, j], a[k, noise_of, j, :, axis])

    def followed(self, z: Array, ways: Array) -> Array:
        """Return log-likelihoods (R', J, d) of curves that follow inputs wholly, z (m, J, d), ways (m, J, d, q).

        Of y = z + ways a + noise, a ~ N(0, s^2).
        """
        m, J, d, q = ways.shape
        gram, B, Q = self.products((self.u[:, None] - z).reshape(m, J * d, 1), ways.reshape(m, J * d, q))
        root = np.linalg.cholesky(gram + np.eye(q))
        explained = np.sum(np.linalg.solve(root, B) ** 2, axis=2)
        log_size = 2 * np.sum(np.log(np.diagonal(root, axis1=2, axis2=3)), axis=2)
        return self._integrated(Q, explained, log_size).reshape(-1, J, d)

    def products(self, y: Array, ways: Array) -> tuple[Array, Array, Array]:
        """Return inner products under every THIN-th ratio (R', J, q, q), (R', J, q, e) and (R', J, e) or (R', 1, e).

        They are of ways (m, J, q) among one another, of these with y (m, J, e) or (m, 1, e), and of y with itself.
        """
        some, other = np.triu_indices(ways.shape[2])
        # shapes last: whole rows are multiplied
        ways, y, each = *(np.ascontiguousarray(x.swapaxes(1, 2)) for x in (ways, y)), []
        for own, V in self.laws:
            w = self.weights(own)[::THIN]
            turned, u = (np.reshape(V.T @ x.reshape(len(x), -1), x.shape) for x in (ways, y))
            products = turned[:, some] * turned[:, other], turned[:, :, None] * u[:, None], u**2
            each.append([(w @ x.reshape(len(u), -1)).reshape(len(w), *x.shape[1:]) for x in products])
        flat, B, Q = (np.moveaxis(np.concatenate(parts), -1, 1) for parts in zip(*each, strict=True))
        gram = np.empty((*flat.shape[:2], *B.shape[2:3] * 2))
        gram[:, :, some, other] = gram[:, :, other, some] = flat
        return gram, B, Q

    def _integrated(self, Q: Array, explained: Array, log_size: Array) -> Array:
        """Return log-likelihoods (..., R', J, e), s and coefficients integrated out.

        The noise has the squares Q (R', J, e), of which so much is `explained`; `log_size` (..., R', J) is that of the
        determinant of coefficients beside noise.
        """
        left = np.maximum(Q - explained, 1e-9 * Q + TINY)
        log_w = self.log_w[self.thin, None]
        return np.asarray((log_w - log_size / 2)[..., None] - len(self.u) / 2 * np.log(left))


def _turned(V: Array, x: Array) -> Array:
    """Return V' x (J, m, p) of V (K, m) and x (J, K, p), by one product of matrices."""
    return np.ascontiguousarray(np.tensordot(V, x, axes=(0, 1)).swapaxes(0, 1))


def _of_drift(C: Array, Z: Array) -> tuple[Array, Array]:
    """Return eigenvalues (m,) and eigenvectors (m, m) of Z' C Z, C of rank 1: Householder's reflection of the last."""
    k = int(np.argmax(np.diag(C)))
    v = Z.T @ (C[k] / np.sqrt(C[k, k]))
    own = np.zeros(len(v))
    own[-1] = v @ v
    v[-1] += np.copysign(np.sqrt(own[-1]), v[-1])
    return own, np.eye(len(v)) - np.outer(v, v * (2 / (v @ v)))


def log_mean(x: Array) -> Array:
    """Return the logarithm of the mean of exp(x) over the first axis."""
    top = x.max(axis=0)
    return np.asarray(top + np.log(np.mean(np.exp(x - top), axis=0)))


def _cost(X: Array, y: Array) -> Array:
    """Return - 2 log-likelihood (d,) of y (K, d) about the best of X (K, p), white noise of any size."""
    R = np.asarray(np.linalg.qr(np.hstack([X, y]), mode="r"))
    left = np.maximum(np.sum(R[X.shape[1] :, X.shape[1] :] ** 2, axis=0), 1e-20 * np.sum(y**2, axis=0))
    return np.asarray(len(y) * np.log(np.maximum(left, 1e-300)))
