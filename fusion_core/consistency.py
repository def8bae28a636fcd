"""Is the filter as good as it says: tests on its innovations.

Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), sec. 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from fusion_core.chunk import Array


@dataclass(frozen=True)
class NisTest:
    """Mean NIS per measured component (1 where the model is right) and the bounds that it should keep."""

    mean: float
    low: float
    high: float

    @property
    def consistent(self) -> bool:
        """Whether the mean is within its bounds."""
        return self.low <= self.mean <= self.high


def gate_of(m: int, false_alarm: float) -> float:
    """Return the nis that a right model with m components exceeds with probability `false_alarm`."""
    return float(special.chdtri(m, false_alarm))


def nis_test(nis: Array, m: int, level: float = 0.99) -> NisTest:
    """Compare the mean of nis (N,) with its two-sided bounds at `level`."""
    N = len(nis)
    if N == 0:
        return NisTest(np.nan, np.nan, np.nan)
    tail = (1 - level) / 2
    low, high = (float(special.chdtri(N * m, p)) / (N * m) for p in (1 - tail, tail))
    return NisTest(float(np.mean(nis)) / m, low, high)


def autocorrelation(white: Array, lags: int) -> Array:
    """Return the autocorrelation (lags, m) of innovations (N, m) at lags 1 to `lags`, by FFT."""
    N = len(white)
    centred = white - white.mean(axis=0)
    spectrum = np.fft.rfft(centred, n=2 * N, axis=0)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[: lags + 1]
    return covariance[1:] / np.where(covariance[0] > 0, covariance[0], 1.0)


def whiteness_p(white: Array, lags: int = 20) -> Array:
    """Return the p-value (m,) of the hypothesis that innovations (N, m) are white.

    Ljung and Box, Biometrika 65 (1978) 297: small values speak against whiteness. NaN where N is too small.
    """
    N, m = white.shape
    lags = min(lags, N // 4)
    if lags < 1:
        return np.full(m, np.nan)
    rho = autocorrelation(white, lags)
    weights = N * (N + 2) / (N - np.arange(1, lags + 1))
    return np.asarray(special.chdtrc(lags, weights @ rho**2))
