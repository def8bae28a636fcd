"""The common part of the maps: binned samples of a soak, and the record of a fit with the error of its curve.

The mean of the n samples in a bin has the variance

::

    sigma_s^2 / n + sigma_b^2

sigma_s is the scatter within the bins. sigma_b is what averaging does not remove: a gyro's bias wanders over
hours, so ten thousand samples at one temperature are not ten thousand independent ones. Without it a long
stay at one temperature would outweigh all the others. N samples, m bins, d axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.contracts import MapRecord, record_of
from fusion_core.thermal.curve_uncertainty import Curve, curve_error
from fusion_core.thermal.soak_noise import Smoother
from fusion_core.thermal.thermometer import steps_of
from fusion_core.threads import one_thread


@dataclass(frozen=True, eq=False)
class Bins:
    """Samples averaged over narrow ranges of temperature: T (m,), bias and variance (m, d); the bin of each (N,)."""

    T: Array
    bias: Array
    variance: Array
    of_sample: NDArray[np.int64]


def bin_samples(T: Array, bias: Array, count: int) -> Bins:
    """Average T (N,) and bias (N, d) over at most `count` bins of equal width; empty ones are left out."""
    low = T.min()
    index = np.minimum(((T - low) * (count / np.ptp(T))).astype(np.intp), count - 1)
    n_all = np.bincount(index, minlength=count)
    n = n_all[n_all > 0]

    def mean(values: Array) -> Array:
        return np.bincount(index, values, minlength=count)[n_all > 0] / n

    centre, means = mean(T), np.stack([mean(column) for column in bias.T], axis=1)
    offset = bias.mean(axis=0)  # the squares below lose digits to a large constant
    squares = np.stack([mean((column - o) ** 2) for column, o in zip(bias.T, offset, strict=True)], axis=1)
    within = np.maximum(squares - (means - offset) ** 2, 0.0)
    scatter = n @ within / max(len(T) - len(n), 1)
    variance = scatter / n[:, None] + _between(centre, means, scatter / n[:, None])
    smallest = np.finfo(float).eps ** 2 * np.mean(bias**2, axis=0) + np.finfo(float).tiny  # samples without noise
    place = np.cumsum(n_all > 0) - 1
    return Bins(centre, means, np.maximum(variance, smallest), place[index].astype(np.int64))


def _between(T: Array, means: Array, variance: Array) -> Array:
    """Estimate sigma_b^2 (d,): scatter of bin means about their neighbours that `variance` does not explain.

    The median makes it blind to a step in the curve. Source: pseudo-residuals of Gasser, Sroka and
    Jennen-Steinmetz, Residual variance and residual pattern in nonlinear regression, Biometrika 73 (1986).
    """
    if len(T) < 5:
        return np.zeros(means.shape[1])
    right = ((T[1:-1] - T[:-2]) / (T[2:] - T[:-2]))[:, None]
    left = 1 - right
    expected = left**2 * variance[:-2] + right**2 * variance[2:] + variance[1:-1]
    gain = left**2 + right**2 + 1
    residuals = (left * means[:-2] + right * means[2:] - means[1:-1]) ** 2
    median_of_chi2 = 0.4549  # one degree of freedom
    excess: Array = np.median(residuals / gain, axis=0) / median_of_chi2 - np.median(expected / gain, axis=0)
    return np.maximum(excess, 0.0)


def record_fit(
    kind: str, T: Array, bias: Array, provenance: Mapping[str, str], predict: Curve, smoother: Smoother
) -> MapRecord:
    """Return the record of a fit to T (N,) and bias (N, d) with the error of its curve.

    Raises
    ------
    SingularFit
        If the temperatures have a hole that the curve cannot bridge.
    """
    with one_thread():  # a few hundred blocks
        error = curve_error(kind, T, bias, predict, smoother)
    resolution, dither = steps_of(T)
    return record_of(kind, T, bias, predict, provenance, resolution=resolution, dither=dither, error=error)
