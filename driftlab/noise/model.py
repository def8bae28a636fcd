"""What the five terms of an Allan curve look like, how they scatter, and curves drawn under them.

A deviation is the spectrum seen through a filter. So a curve is drawn as the sum over frequency bands of the spectrum
times the filter times a gamma variate with one degree for every independent line of the periodogram in the band: all
averaging times jointly, with the correlation and the skewness that they have, at a cost that does not depend on the
length of the recording.

J averaging times, F bands, p <= 5 terms: quantisation, white, bias instability, walk, ramp.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array

KEYS = ("quantization", "white", "bias_instability", "rate_random_walk", "rate_ramp")
WALK = KEYS.index("rate_random_walk")
RAMP = KEYS.index("rate_ramp")
DRAWS = 400
LINES = 12  # lines of the periodogram that are bands of their own, from the lowest on


@dataclass(frozen=True)
class Curve:
    """Deviations over averaging times, each (J,): tau in s, deviations in the sensor's unit.

    `stride` says that every so-manyth overlap was taken; `span` is the recording's length and `dt` its interval, s.
    """

    tau: Array
    allan: Array
    hadamard: Array
    stride: NDArray[np.int64]
    span: float
    dt: float


@dataclass(frozen=True)
class Design:
    """What the five terms look like on one kind of curve.

    Attributes
    ----------
    A : (J, p) array
        Variance of each term at coefficient one.
    W : (p, J, F) array
        How each frequency band contributes to it; sums to A over the bands. Zero for the ramp, which is no noise.
    shape : (F,) array
        Independent lines of the periodogram in each band.
    power : (J,) array
        By how much the ends of the recording widen the scatter of long averaging times.
    """

    tau: Array
    A: Array
    W: Array
    shape: Array
    power: Array

    @cached_property
    def variates(self) -> Array:
        """Gamma variates of mean one (F, DRAWS): the same for every trial value, so that limits are found smoothly."""
        shape = self.shape[:, None]
        return np.random.default_rng(952).gamma(shape, 1 / shape, (len(shape), DRAWS))

    @cached_property
    def normals(self) -> Array:
        """Normal variates: (J, DRAWS) of the model's error and one more line of the mean of the differences."""
        return np.random.default_rng(1139).normal(size=(len(self.tau) + 1, DRAWS))

    def since(self, first: int) -> Design:
        """Return the same without the averaging times before number `first`."""
        return Design(self.tau[first:], self.A[first:], self.W[:, first:], self.shape, self.power[first:])

    def spread(self, theta: Array) -> Array:
        """Relative standard deviation of the variances (J,) under squared coefficients theta (p,)."""
        bands = np.einsum("p,pjf->jf", theta, self.W)
        noise = np.sqrt(np.sum(bands**2 / self.shape, axis=1)) * self.power
        return np.asarray(noise / (self.A @ theta))

    def draw(self, theta: Array, model_error: float) -> Array:
        """Draw curves (J, DRAWS) under theta."""
        bands = np.einsum("p,pjf->jf", theta, self.W)
        mean = np.sum(bands, axis=1)[:, None]
        # einsum and not @: several threads for so small a product cost more than they save
        noise = mean * (np.einsum("jf,fd->jd", bands, self.variates) / mean) ** self.power[:, None]
        noise *= mean / np.mean(noise, axis=1, keepdims=True)
        if self.A.shape[1] > RAMP and theta[RAMP] > 0:
            ramp = self.A[:, RAMP, None] * theta[RAMP]
            # the differences' mean adds to the ramp's, and so beats with it
            noise = noise + ramp + np.sqrt(2 * ramp * bands[:, :1]) * self.power[:, None] * self.normals[-1]
        noise = noise * (1 + model_error * self.normals[:-1])
        return np.asarray(np.maximum(noise, 0.01 * mean))


def design(curve: Curve, hadamard: bool) -> Design:
    """Return the terms on the Allan curve, or (without the ramp) on the Hadamard curve."""
    tau = curve.tau
    one = np.ones_like(tau)
    if hadamard:
        terms = [10 / 3 / tau**2, 1 / tau, np.log(256 / 27) / (2 * np.pi) * one, tau / 6]
    else:
        terms = [3 / tau**2, 1 / tau, 2 * np.log(2) / np.pi * one, tau / 3, tau**2 / 2]
    A = np.stack(terms, axis=1)
    T, top = curve.span, 0.5 / curve.dt
    low = (np.arange(min(LINES, int(top * T)) + 1) + 0.5) / T
    count = max(2, int(12 * np.log10(max(top / low[-1], 1.2))))
    edges = np.concatenate([low, np.geomspace(low[-1], max(top, 1.01 * low[-1]), count)[1:]])
    inside = (np.arange(24) + 0.5) / 24
    f = edges[:-1, None] + np.diff(edges)[:, None] * inside  # (F, 24)
    g = np.sin(np.pi * f * curve.dt) / (np.pi * curve.dt)  # f, as differences of samples see it
    gain = np.sin(np.pi * tau[:, None, None] * f) ** (6 if hadamard else 4) / g**2 * np.diff(edges)[:, None]
    W = np.zeros((A.shape[1], *gain.shape[:2]))
    for k, exponent in enumerate((2, 0, -1, -2)):
        bands = np.mean(gain * g**exponent, axis=2)
        W[k] = bands / np.sum(bands, axis=1, keepdims=True) * A[:, k, None]
    power = 1 / np.sqrt(np.maximum(1 - (3 if hadamard else 2) * tau / T, 0.1))
    return Design(tau, A, W, T * np.diff(edges), power)
