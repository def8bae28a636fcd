"""Model of an Allan curve: the shapes of its five terms, their scatter, and curves drawn under them.

A deviation is the spectrum seen through a filter. So a curve is drawn as the sum over frequency bands of the spectrum
times the filter times a gamma variate with one degree for every independent line of the periodogram in the band: all
averaging times jointly, with the correlation and the skewness that they have, at a cost that does not depend on the
length of the recording. A recording with gaps is the mean of its stretches, which scatter independently; those of a
like length share their bands, and their degrees of freedom add.

J averaging times, F bands, S stretches, p <= 5 terms: quantisation, white, bias instability, walk, ramp.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from driftlab.noise.allan_unsteady import DRAWS, Unsteady
from fusion_core.chunk import Array, Flags, Integers

KEYS = ("quantization", "white", "bias_instability", "rate_random_walk", "rate_ramp")
WHITE = KEYS.index("white")
WALK = KEYS.index("rate_random_walk")
RAMP = KEYS.index("rate_ramp")
ENDS = {2: 1.3, 3: 2.2}  # averaging times at the ends of a stretch that say nothing, by the order of the difference
PRESENT = 0.9  # of a window's samples: with fewer, its mean may be that of another time
WHITE_ALIKE, SURE = -0.5, 4.0  # correlation of neighbouring differences of white noise, and deviations that are sure
LINES = 12  # lines of the periodogram that are bands of their own, from the lowest on


@dataclass(frozen=True)
class Bridge:
    """Basis of averaging times where gaps are bridged; of second differences, then of third ones."""

    stretches: Integers  # (S,) samples of each stretch without a gap
    gaps: Integers  # (B,) samples lost in each gap that is bridged
    differences: Array  # (2, J) how many differences count
    white: Array  # (2, J) factor on the variance of white noise, beside that without lost samples
    angle: Array  # (2, J) the same of quantisation
    part: Array  # (2, G, J) of the differences of G groups of spans, the part that counts
    square: Array  # (2, G, J) the same of the pairs of them that tell the same
    pieces: Integers  # (J,) pieces without a gap that is not bridged, which the differences cover
    samples: Integers  # (J,) of these pieces

    def of(self, kept: Flags) -> Bridge:
        """Return the same for some of the averaging times, as `kept` (J,) says."""
        each = {f.name: getattr(self, f.name) for f in fields(self)}
        return Bridge(**{name: v if name in ("stretches", "gaps") else v[..., kept] for name, v in each.items()})


@dataclass(frozen=True)
class AllanCurve:
    """Deviations over averaging times, each (J,): tau in s, deviations in the sensor's unit.

    `stride` says that every so-manyth overlap was taken; `lengths` (S,) are the samples of each stretch without a gap,
    or where there is a `bridge` the places of each span whose gaps are bridged; `dt` is their interval, s. Only
    those of three averaging times or more count for one (`counts`). `parts` (J, PARTS, 2) are sums of squared second
    differences in equal parts of the recording, and their numbers, `tail` is the index of their tail.
    """

    tau: Array
    allan: Array
    hadamard: Array
    stride: Integers
    lengths: Integers
    dt: float
    parts: Array
    tail: float
    bridge: Bridge | None = None

    @property
    def m(self) -> Integers:
        """Samples in each averaging time (J,)."""
        return np.rint(self.tau / self.dt).astype(np.int64)

    @property
    def alike(self) -> Array:
        """Correlation (J,) of neighbouring differences of averages: WHITE_ALIKE of white noise, more of smoothed."""
        return np.asarray(1 - 1.5 * (self.hadamard / self.allan) ** 2)

    @property
    def stretches(self) -> Integers:
        """Samples of each stretch without a gap (S,)."""
        return self.lengths if self.bridge is None else self.bridge.stretches

    @property
    def bridged(self) -> Array:
        """Averaging time from which on each gap is bridged (B,), s, of those that are."""
        if self.bridge is None:
            return np.empty(0)
        least = self.bridge.gaps / (1 - PRESENT) * self.dt
        return np.asarray(least[least <= self.tau[-1] * (1 + 1e-9)])

    @property
    def counts(self) -> Integers:
        """Number of stretches behind each averaging time (J,), bridged ones as one."""
        if self.bridge is not None:
            return self.bridge.pieces
        return np.array([np.sum(self.lengths >= 3 * m) for m in self.m])

    @property
    def used(self) -> Array:
        """Duration of the samples behind each averaging time (J,), s."""
        if self.bridge is not None:
            return np.asarray(self.bridge.samples * self.dt)
        return np.array([np.sum(self.lengths[self.lengths >= 3 * m]) * self.dt for m in self.m])


@dataclass(frozen=True)
class Class:
    """Stretches of like length, and their contribution to the first L averaging times, which alone are short enough."""

    number: int  # how many stretches
    share: Array  # (L,) their part of all differences
    W: Array  # (p, L, F) part of each frequency band in each term; zero for the ramp, which is no noise
    shape: Array  # (F,) independent lines of the periodogram in each band, of all stretches
    power: Array  # (L,) by how much the ends of the stretches widen the scatter of long averaging times

    def since(self, first: int) -> Class:
        """Return the same without the averaging times before number `first`."""
        return Class(self.number, self.share[first:], self.W[:, first:], self.shape, self.power[first:])

    def bands(self, theta: Array) -> Array:
        """Return the variance that each band contributes (L, F) under squared coefficients theta (p,)."""
        return np.asarray(np.einsum("p,pjf->jf", theta, self.W))

    def draw(self, theta: Array, variates: Array) -> Array:
        """Draw contributions (L, DRAWS) of noise from gamma variates of the bands (F, DRAWS)."""
        bands = self.bands(theta)
        mean = np.sum(bands, axis=1)[:, None]
        # einsum and not @: several threads for so small a product cost more than they save
        safe = np.where(mean > 0, mean, 1.0)  # spans that have no differences at some averaging time
        noise = mean * (np.einsum("jf,fd->jd", bands, variates) / safe) ** self.power[:, None]
        return np.asarray(noise * mean / np.where(mean > 0, np.mean(noise, axis=1, keepdims=True), 1.0))

    def beat(self, theta: Array, ramp: Array, normal: Array) -> Array:
        """Draw (L, DRAWS) what the mean of the differences adds to a ramp of variance (L,), from normals (DRAWS,)."""
        lowest = self.share * self.bands(theta)[:, 0] / self.number
        return np.asarray((np.sqrt(2 * ramp * lowest) * self.power)[:, None] * normal)


@dataclass(frozen=True)
class Design:
    """Shapes of the five terms on one kind of curve."""

    tau: Array  # (J,) averaging times, s
    A: Array  # (J, p) variance of each term at coefficient one
    # stretches of like lengths; their W sum to A over bands and classes, where that is no loss
    classes: tuple[Class, ...]
    unsteady: Unsteady | None = None

    @cached_property
    def variates(self) -> list[Array]:
        """Gamma variates of mean one (F, DRAWS): the same for every trial value, so that limits are found smoothly."""
        rng = np.random.default_rng(952)
        shapes = [one.shape[:, None] for one in self.classes]
        return [rng.gamma(shape, 1 / shape, (len(shape), DRAWS)) for shape in shapes]

    @cached_property
    def normals(self) -> Array:
        """Normal variates: (J, DRAWS) of the model's error and a line of the mean of the differences a class."""
        return np.random.default_rng(1139).normal(size=(len(self.tau) + len(self.classes), DRAWS))

    def since(self, first: int) -> Design:
        """Return the same without the averaging times before number `first`."""
        left = tuple(one.since(first) for one in self.classes if len(one.power) > first)
        return replace(self, tau=self.tau[first:], A=self.A[first:], classes=left)

    def smoothed(self) -> Design:
        """Return the same with what a filter takes off in the place of the quantisation, averaging times beyond it.

        The angle of white noise through a filter H grows within tau by the variance N^2 (tau - a), where a is the
        integral of (1 - |H|^2) / (2 pi^2 f^2) over all f: a quantisation with the square -N^2 a / 2, for |H| <= 1.
        """
        classes = tuple(replace(one, W=one.W * (np.arange(len(one.W)) > 0)[:, None, None]) for one in self.classes)
        return Design(self.tau, self.A * np.where(np.arange(self.A.shape[1]) > 0, 1.0, -1.0), classes)

    def spread(self, theta: Array) -> Array:
        """Relative standard deviation of the variances (J,) under squared coefficients theta (p,)."""
        variance = np.zeros(len(self.tau))
        for one in self.classes:
            variance[: len(one.power)] += np.sum(one.bands(theta) ** 2 / one.shape, axis=1) * one.power**2
        return np.asarray(np.sqrt(variance) / (np.maximum(self.A, 0) @ theta))

    def shared(self, theta: Array) -> Array:
        """Part of the variances (J,) under theta (p,) that is unsteady."""
        if self.unsteady is None:
            return np.zeros(len(self.tau))
        terms = (np.maximum(self.A, 0) * theta)[:, :RAMP]
        return np.asarray(terms @ self.unsteady.part / np.maximum(np.sum(terms, axis=1), np.finfo(float).tiny))

    def draw(self, theta: Array, model_error: float) -> Array:
        """Draw curves (J, DRAWS) under theta."""
        J = len(self.tau)
        noise = np.zeros((J, DRAWS))
        for one, variates in zip(self.classes, self.variates, strict=True):
            noise[: len(one.power)] += one.draw(theta, variates)
        mean = np.mean(noise, axis=1, keepdims=True)
        if self.unsteady is not None:
            noise = self.unsteady.scattered(noise, mean, self.shared(theta)[:, None])
        if self.A.shape[1] > RAMP and theta[RAMP] > 0:
            ramp = self.A[:, RAMP] * theta[RAMP]
            noise += ramp[:, None]
            for one, normal in zip(self.classes, self.normals[J:], strict=True):
                L = len(one.power)
                noise[:L] += one.beat(theta, ramp[:L], normal)
        noise = noise * (1 + model_error * self.normals[:J])
        drawn = np.maximum(noise, 0.01 * mean)
        if np.all(self.A >= 0):
            return np.asarray(drawn)
        return np.asarray(drawn * np.maximum(self.A @ theta / (np.maximum(self.A, 0) @ theta), 0.01)[:, None])


def design(curve: AllanCurve, hadamard: bool) -> Design:
    """Return the terms on the Allan curve, or (without the ramp) on the Hadamard curve."""
    tau = curve.tau
    one = np.ones_like(tau)
    if hadamard:
        terms = [10 / 3 / tau**2, 1 / tau, np.log(256 / 27) / (2 * np.pi) * one, tau / 6]
    else:
        terms = [3 / tau**2, 1 / tau, 2 * np.log(2) / np.pi * one, tau / 3, tau**2 / 2]
    A = np.stack(terms, axis=1)
    if curve.bridge is not None:
        A[:, 0] *= curve.bridge.angle[int(hadamard)]
        A[:, 1] *= curve.bridge.white[int(hadamard)]
    return Design(tau, A, tuple(_classes(curve, A, 3 if hadamard else 2)))


def alike(correlation: float, n: int, white: float, tolerance: float) -> bool:
    """Return True if n neighbouring differences correlate by more than `white`, that of noise that is not smoothed.

    The deviation of such a correlation is 1 / sqrt(n).
    """
    return bool(correlation - white > max(tolerance, SURE / np.sqrt(n)))


def octaves(lengths: Integers) -> Integers:
    """Return by how many factors of two, rounded down, each of lengths (S,) is shorter than the longest: 0, 1, ...

    Numbers that none has are left out.
    """
    shorter = np.floor(np.log2(np.max(lengths) / lengths))
    return np.unique(shorter, return_inverse=True)[1].astype(np.int64)


def _classes(curve: AllanCurve, A: Array, order: int) -> Iterator[Class]:
    """Yield the stretches by length, the longest first, in steps of a factor of two."""
    lengths, numbers = np.unique(curve.lengths, return_counts=True)
    group, m = octaves(lengths), curve.m
    sizes = [(lengths[group == g], numbers[group == g].astype(np.int64)) for g in range(int(group.max()) + 1)]
    each = np.array([[_differences(N, n, k, order) for k in m] for N, n in sizes])  # (G, J, 2)
    if curve.bridge is not None:
        each *= np.stack([curve.bridge.part[order - 2], curve.bridge.square[order - 2]], axis=2)
    total = np.sum(each[:, :, 0], axis=0)
    for (N, n), (own, square) in zip(sizes, each.transpose(0, 2, 1), strict=True):
        L = int(np.sum(3 * m <= N[-1]))
        if not L:
            return
        own, square = own[:L], square[:L]
        number, samples = int(np.sum(n)), float(n @ N)
        share = own / total[:L]
        W, shape = _bands(curve.tau[:L], curve.dt, samples / number * curve.dt, order)
        if curve.bridge is not None:  # what the two sides of a gap add to quantisation is white
            own_part = 1 / curve.bridge.angle[order - 2, :L, None]
            W[0] = own_part * W[0] + (1 - own_part) * W[1]
        W = np.concatenate([W, np.zeros((A.shape[1] - len(W), *W.shape[1:]))]) * (A[:L].T * share)[:, :, None]
        power = np.sqrt(samples * square) / np.where(own > 0, own, np.inf)
        yield Class(number, share, W, number * shape, power)


def _differences(N: Integers, n: Integers, m: int, order: int) -> tuple[float, float]:
    """Return the number of differences of n stretches of N samples, and the sum of their squares, by information.

    The mean over one stretch has a relative variance of c / (N - ENDS m): for differences at all places, fewer than
    c / (N - order m) would have it, since those at the ends overlap less.
    """
    long = 3 * m <= N
    N, n = N[long], n[long]
    count = N - order * m + 1
    return float(n @ count), float(n @ (count**2 / (N - ENDS[order] * m)))


def _bands(tau: Array, dt: float, T: float, order: int) -> tuple[Array, Array]:
    """Return the parts (4, L, F) of four terms in each band of a stretch of T s, and the independent lines (F,)."""
    top = 0.5 / dt
    low = (np.arange(min(LINES, int(top * T)) + 1) + 0.5) / T
    count = max(2, int(12 * np.log10(max(top / low[-1], 1.2))))
    edges = np.concatenate([low, np.geomspace(low[-1], max(top, 1.01 * low[-1]), count)[1:]])
    inside = (np.arange(24) + 0.5) / 24
    f = edges[:-1, None] + np.diff(edges)[:, None] * inside  # (F, 24)
    g = np.sin(np.pi * f * dt) / (np.pi * dt)  # f, as differences of samples see it
    gain = np.sin(np.pi * tau[:, None, None] * f) ** (2 * order) / g**2 * np.diff(edges)[:, None]
    W = np.stack([np.mean(gain * g**exponent, axis=2) for exponent in (2, 0, -1, -2)])
    return W / np.sum(W, axis=2, keepdims=True), T * np.diff(edges)
