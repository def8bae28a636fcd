"""What a covariance of coefficients over temperature looks like before any unit of the family is seen.

Sigma ~ inverse Wishart with `weight` degrees of freedom about a smooth covariance Psi of a level, a slope, a smooth
curve and a rougher remainder::

    Psi(T, T') = a0^2 + a1^2 u u' + s^2 exp(-(T-T')^2 / 2 l^2) + r^2 (1 + k) exp(-k),   k = sqrt(3) |T-T'| / (3 step)

Its five numbers are those under which the scatter of the units is likeliest: with n units of scatter S that likelihood
is the matrix-variate t (Gupta & Nagar 2000, section 4.2), but for what does not depend on Psi::

    log p = nu/2 log det(nu Psi) - (nu+n)/2 log det(nu Psi + S),    nu = q + 6

whose maximum over all Psi is S/n. In Sigma it counts as WEIGHT units. The same likelihood, taken over nu too, chooses a
prior that is all but certain for families of up to some 100 units, and maps of left-out units are then up to twice as
far off. q coefficients at the temperatures `peaks`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fusion_core.chunk import Array

WEIGHT = 5.0  # units


@dataclass(frozen=True, eq=False)
class SmoothPrior:
    """An inverse Wishart law: `mean` (q, q) is its expectation, of the logarithms `numbers` of a0, a1, s, l, r."""

    mean: Array
    numbers: Array

    @property
    def scatter(self) -> Array:
        """What it adds to a scatter matrix (q, q)."""
        return WEIGHT * self.mean


def smooth(peaks: Array, numbers: Array) -> Array:
    """Return Psi (q, q) of the logarithms of a0, a1, s, l [K], r."""
    a0, a1, s, length, r = np.exp(numbers)
    distance = np.abs(peaks[:, None] - peaks)
    u = (peaks - peaks.mean()) / max(np.ptp(peaks) / 2, 1e-9)
    k = np.sqrt(3.0) * distance / (3 * max(peaks[1] - peaks[0], 1e-9))
    found = a0**2 + a1**2 * np.outer(u, u) + s**2 * np.exp(-0.5 * (distance / length) ** 2)
    return np.asarray(found + r**2 * (1 + k) * np.exp(-k) + 1e-9 * (a0**2 + a1**2 + s**2) * np.eye(len(peaks)))


def first_guess(peaks: Array, spread: float) -> SmoothPrior:
    """Return a prior for units that spread by about `spread`; a rough one, which has curves go on nowhere."""
    numbers = np.log([spread, spread, spread, np.ptp(peaks) / 4, 0.3 * spread])
    return SmoothPrior(smooth(peaks, numbers), numbers)


def fitted(peaks: Array, scatter: Array, count: float, start: SmoothPrior) -> SmoothPrior:
    """Return the prior under which a scatter (q, q) of `count` draws is likeliest, sought from `start`."""
    from scipy.optimize import Bounds, minimize

    scale = np.log(np.sqrt(np.trace(scatter) / (len(peaks) * count)))
    low = np.array([scale - 9] * 3 + [np.log(2 * (peaks[1] - peaks[0])), scale - 9])
    high = np.array([scale + 4] * 3 + [np.log(3 * np.ptp(peaks)), scale + 1])
    begin: npt.NDArray[np.float64] = np.clip(start.numbers, low + 1e-6, high - 1e-6)

    def cost(numbers: npt.NDArray[np.float64]) -> float:
        return -_likelihood(peaks, scatter, count, numbers) / count

    best = minimize(cost, begin, method="L-BFGS-B", bounds=Bounds(low, high), options={"maxiter": 25}).x
    return SmoothPrior(smooth(peaks, best), best)


def _likelihood(peaks: Array, scatter: Array, count: float, numbers: Array) -> float:
    """Return log p of the module's text."""
    nu = len(peaks) + 6.0
    own = nu * smooth(peaks, numbers)
    return nu / 2 * _log_det(own) - (nu + count) / 2 * _log_det(own + scatter)


def _log_det(matrix: Array) -> float:
    scale = np.sqrt(np.diag(matrix))
    return float(np.linalg.slogdet(matrix / np.outer(scale, scale))[1] + 2 * np.log(scale).sum())
