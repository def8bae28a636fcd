"""Bias and scale factor of a triad from what it shows, on average, in P placements under an input of known length.

::

    | (L_p - b) / (1 + s) | = g,    b ~ N(0, (BIAS g)^2),    s ~ N(0, SCALE^2)        on each of d axes

by Gauss-Newton steps. A scale factor that the placements leave to its prior stays zero in the solution, and counts in
the deviation of b: along the input of a single placement the two are one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array

BIAS, SCALE = 0.05, 0.01  # of g, and of 1: deviations of units of which nothing is known
TOLD = 0.1  # of that deviation: what is known better has been told
FREE = 0.5  # of it: a scale factor that is known no better stays zero
STEPS = 20


@dataclass(frozen=True, eq=False)
class Levels:
    """What P placements tell of d axes.

    Attributes
    ----------
    bias, sigma : (d,) arrays
        In the mean over the samples, and its deviation; scale factors that are not told are part of that.
    given_scale : (d,) array
        The deviation where scale factors that are not told are what they should be.
    scale, scale_sigma : (d,) arrays
        Scale factor less 1.
    lengths : (P,) array
        What the solution leaves of the lengths, in the unit of the bias.
    expected : (P,) array
        Its deviation by the noise of the levels.
    prior : float
        Deviation of a bias of which nothing is known.
    """

    bias: Array
    sigma: Array
    given_scale: Array
    scale: Array
    scale_sigma: Array
    lengths: Array
    expected: Array
    prior: float

    @property
    def scale_told(self) -> Array:
        """Whether each scale factor is told (d,)."""
        return np.asarray(self.scale_sigma < TOLD * SCALE)

    def level(self, axis: int) -> str:
        """Return what is known of the level of an axis: `told`, `scale` (but for its scale factor), or `tilt`."""
        if self.sigma[axis] < TOLD * self.prior:
            return "told"
        return "scale" if self.given_scale[axis] < TOLD * self.prior else "tilt"


def solved(level: Array, roots: Sequence[Array], length: float, unsure: float) -> Levels:
    """Return bias and scale factor from the levels (P, d) of the placements.

    Parameters
    ----------
    level : (P, d) array
    roots : (P, r) arrays, one an axis
        Of the covariance of the levels.
    length, unsure : float
        Of the input, and its deviation, the same in all placements.
    """
    d = level.shape[1]
    deviation = np.concatenate([np.full(d, BIAS * length), np.full(d, SCALE)])
    covariances = [root @ root.T for root in roots]
    free = np.ones(2 * d, dtype=bool)
    _, known = _solution(level, covariances, length, unsure, deviation, free)
    sigma = np.sqrt(np.diag(known))
    free[d:] = sigma[d:] < FREE * SCALE
    theta, given = _solution(level, covariances, length, unsure, deviation, free)
    left, _, spread = _equations(theta, level, covariances, length, unsure)
    # lengths that differ by more than noise explains: axes that are not square, say
    most = max(len(level) - int(np.sum(np.sqrt(np.diag(given)) < TOLD * deviation)), 1)
    worse = np.sqrt(max(1.0, float(left @ np.linalg.solve(spread, left)) / most))
    told = sigma < TOLD * deviation
    sigma = np.where(told, worse * sigma, sigma)
    return Levels(
        theta[:d], sigma[:d], worse * np.sqrt(np.diag(given))[:d], theta[d:], sigma[d:], left,
        np.sqrt(np.diag(spread)), BIAS * length,
    )  # fmt: skip


def _solution(
    level: Array, covariances: Sequence[Array], length: float, unsure: float, deviation: Array, free: Array
) -> tuple[Array, Array]:
    """Return bias and scale factor (2 d,) and their covariance, those that are not `free` (2 d,) at zero."""
    theta: Array = np.zeros(len(deviation))
    prior = np.diag(1 / np.where(free, deviation, 1e-9 * deviation) ** 2)
    covariance = np.diag(deviation**2)
    for _ in range(STEPS):
        left, J, spread = _equations(theta, level, covariances, length, unsure)
        weighted = np.linalg.solve(spread, J)
        covariance = np.asarray(np.linalg.inv(weighted.T @ J + prior), dtype=np.float64)
        step = covariance @ (-weighted.T @ left - prior @ theta)
        theta = np.asarray(theta + step, dtype=np.float64)
        if np.all(np.abs(step) < 1e-9 * deviation):
            break
    return theta, covariance


def _equations(
    theta: Array, level: Array, covariances: Sequence[Array], length: float, unsure: float
) -> tuple[Array, Array, Array]:
    """Return the lengths' errors (P,), their derivatives (P, 2 d), and the covariance (P, P) that noise gives them."""
    d = level.shape[1]
    scale = 1 + theta[d:]
    v = (level - theta[:d]) / scale
    size = np.linalg.norm(v, axis=1)
    towards = v / size[:, None] / scale
    J = np.hstack([-towards, -towards * v])
    spread = np.full((len(level), len(level)), unsure**2) + (1e-9 * length) ** 2 * np.eye(len(level))
    for axis, covariance in enumerate(covariances):
        spread += np.outer(towards[:, axis], towards[:, axis]) * covariance
    return size - length, J, spread
