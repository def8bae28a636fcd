"""Calibration of a triad by placements, its input of known length and in a direction that only the triad itself shows.

An accelerometer at rest in P placements, u_p the direction of the specific force in its axes, g its length::

    f = L_p + c(T) + g u_p h(T) + noise        on each axis, with levels L_p = g (1 + s) u_p + b

c(T) is the change of the bias from its mean over all samples, one curve for all placements; h(T) that of the scale
factor, which is separable from c where placements show the axis in different parts of the force. All are estimated
at once, so a placement need not see all temperatures. Bias b and scale factor s follow from the levels: the part of b
that these do not determine stays zero, where it is one with the tilt of the unit. N samples in K blocks, d axes.

Bias and scale factor of a triad from its mean readings in P placements under an input of known length::

    | (L_p - b) / (1 + s) | = g,    b ~ N(0, (BIAS g)^2),    s ~ N(0, SCALE^2)        on each of d axes

by Gauss-Newton steps. A scale factor that the placements leave to its prior stays zero in the solution, and counts in
the deviation of b: along the input of a single placement the two are one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array, Integers
from fusion_core.thermal.curve_uncertainty import with_errors
from fusion_core.thermal.fitted_map import FittedMap
from fusion_core.thermal.penalised import penalised, smooth_lines
from fusion_core.thermal.soak_noise import Blocks, Contrasts, Smoother, blocks_of

WIDER = 2.0  # times: by more, telling the scale from the bias would widen the curve
PASSES = 2  # the first has not yet taken the bias off the directions
FLAT = 0.2  # of the input, on an axis: with less nothing of its scale shows


@dataclass(frozen=True, eq=False)
class ScaleChange:
    """Change of the scale factor of one axis, from the coldest to the warmest temperature."""

    determined: bool  # whether the placements separate it from the change of the bias
    value: float = 0.0  # where determined
    sigma: float = 0.0  # its deviation


@dataclass(frozen=True, eq=False)
class Placements:
    """Estimates from P placements."""

    up: Array  # (P, d): direction of the input in each
    levels: Levels  # of bias and scale factor
    changes: tuple[ScaleChange, ...]  # of the scale factor of each axis
    blocks: Blocks  # the samples
    # (K, r) an axis: root of the covariance of the blocks' errors, their noise less what levels and scale have taken
    errors: tuple[Array, ...]

    def widened(self, fitted: FittedMap, smoother: Smoother) -> FittedMap:
        """Return the map with the errors of levels and scale in the error of its curve.

        The fit was made without them, and so without a part of the noise.
        """
        return with_errors(fitted, self.blocks, smoother, self.errors)


def placed(T: Array, reading: Array, placement: Integers, length: float, unsure: float) -> tuple[Array, Placements]:
    """Return the bias (N, d) of samples, and the estimates.

    Parameters
    ----------
    T, reading : (N,) and (N, d) arrays
        Temperature in degC, which moves, and the readings of the triad.
    placement : (N,) array of int
        From 0 on; each is there.
    length, unsure : float
        Of the input, and its deviation.
    """
    P = int(placement.max()) + 1
    counts = np.bincount(placement, minlength=P)
    means = np.stack([np.bincount(placement, column, minlength=P) / counts for column in reading.T], axis=1)
    blocks = blocks_of(T, reading - means[placement], placement)
    design = _Design(blocks, blocks.shares(placement, P).toarray())
    force = means
    for _ in range(PASSES):
        up = force / np.linalg.norm(force, axis=1)[:, None]
        axes = _solved(design, up)
        level = means + np.stack([axis.level for axis in axes], axis=1)
        levels = solved(level, [axis.level_root for axis in axes], length, unsure)
        force = (level - levels.bias) / (1 + levels.scale)
    bias = np.empty_like(reading)
    for k, axis in enumerate(axes):
        bias[:, k] = reading[:, k] - (level[:, k] - levels.bias[k])[placement]
        if axis.change.determined:
            bias[:, k] -= up[placement, k] * (design.bends(T) @ axis.scale)
    changes = tuple(ScaleChange(a.change.determined, a.change.value / length, a.change.sigma / length) for a in axes)
    return bias, Placements(up, levels, changes, blocks, tuple(axis.error for axis in axes))


class _Design:
    """The columns of all axes: curve B (K, q), placements Z (K, P), and the means (P, K) of blocks over placements."""

    def __init__(self, blocks: Blocks, means: Array) -> None:
        self.blocks, self.means = blocks, means
        self.Z = (means > 0).T.astype(np.float64)
        self.low, self.high = float(blocks.fine[0]), float(blocks.fine[-1])
        basis = smooth_lines((self.low, self.high))
        self.B, self.penalty = blocks.over @ basis.values(blocks.fine), basis.penalty
        self._off = np.zeros(2)
        self._off = blocks.n @ (blocks.over @ self.bends(blocks.fine)) / np.sum(blocks.n)
        self.free = np.eye(len(blocks.T)) - self.Z @ means  # takes the means of the placements off

    def bends(self, T: Array) -> Array:
        """Return the two curves (N, 2) of a scale factor, less their means over the samples."""
        x = 2 * (T - self.low) / (self.high - self.low) - 1
        return np.asarray(np.stack([x, x**2], axis=1) - self._off)


@dataclass(frozen=True, eq=False)
class _Solved:
    """One axis: levels (P,) less the placements' means, scale (2,), its change, and roots of their errors."""

    level: Array
    level_root: Array  # (P, r)
    scale: Array
    change: ScaleChange
    error: Array  # (K, r), of the blocks less levels and scale


def _solved(design: _Design, up: Array) -> list[_Solved]:
    """Return the estimates of each axis, `up` (P, d) the direction of the input in each placement."""
    blocks, bends = design.blocks, design.blocks.over @ design.bends(design.blocks.fine)
    scales = [(design.Z @ part)[:, None] * bends for part in up.T]
    columns = [np.hstack([design.Z, *([H] if _determined(design, H) else [])]) for H in scales]
    free = [Contrasts(blocks, own) for own in columns]
    one = np.eye(len(blocks.T))
    noises = [contrasts.noise(y, one) for contrasts, y in zip(free, blocks.y.T, strict=True)]
    roots = [
        np.hstack([np.sqrt(n.walk) * c.walk, np.diag(np.sqrt(n.white * c.white))])
        for n, c in zip(noises, free, strict=True)
    ]
    return [_axis(design, y, own, root) for y, own, root in zip(blocks.y.T, columns, roots, strict=True)]


def _axis(design: _Design, y: Array, columns: Array, root: Array) -> _Solved:
    """Return the estimates of an axis by the curve and `columns` (K, P), (K, P + 2) where its scale is determined."""
    q, P = design.B.shape[1], design.Z.shape[1]
    X = np.hstack([design.B, columns])
    penalty = np.zeros((X.shape[1], X.shape[1]))
    penalty[:q, :q] = design.penalty
    operator = penalised(X, y, design.blocks.n, penalty).operator @ design.free
    mean = design.blocks.n @ design.B / np.sum(design.blocks.n)
    levels = operator[q : q + P] + mean @ operator[:q]
    scale = operator[q + P :]
    taken, change = design.Z @ (design.means + levels) + columns[:, P:] @ scale, ScaleChange(determined=False)
    if len(scale):
        ends = np.diff(design.bends(np.array([design.low, design.high])), axis=0)[0]
        change = ScaleChange(True, float(ends @ scale @ y), float(np.linalg.norm(ends @ scale @ root)))
    return _Solved(levels @ y, (design.means + levels) @ root, scale @ y, change, root - taken @ root)


def _determined(design: _Design, H: Array) -> bool:
    """Return True if scale columns H (K, 2) are so far from the span of curve and placements that these stay as sure.

    The residual of a column, as a part of it, is the variance of the curve without it to that with it.
    """
    if np.max(np.abs(H)) < FLAT:
        return False
    weight = np.sqrt(design.blocks.n)[:, None]
    X, own = weight * np.hstack([design.B, design.Z]), weight * H
    left = own - X @ np.linalg.lstsq(X, own, rcond=1e-9)[0]
    return bool(np.linalg.eigvals(np.linalg.solve(own.T @ own, left.T @ left)).real.min() >= 1 / WIDER**2)


BIAS, SCALE = 0.05, 0.01  # of g, and of 1: deviations of units of which nothing is known
DETERMINED = 0.1  # of that deviation: a parameter that is known better is determined
FREE = 0.5  # of it: a scale factor that is known no better stays zero
STEPS = 20


@dataclass(frozen=True, eq=False)
class Levels:
    """Bias and scale factor of d axes from P placements."""

    bias: Array  # (d,): in the mean over the samples
    sigma: Array  # (d,): its deviation; scale factors that are not determined are part of that
    given_scale: Array  # (d,): the deviation where scale factors that are not determined are what they should be
    scale: Array  # (d,): scale factor less 1
    scale_sigma: Array  # (d,): its deviation
    lengths: Array  # (P,): residuals of the lengths, in the unit of the bias
    expected: Array  # (P,): their deviation by the noise of the levels
    prior: float  # deviation of a bias of which nothing is known

    @property
    def scale_determined(self) -> Array:
        """True where a scale factor is determined (d,)."""
        return np.asarray(self.scale_sigma < DETERMINED * SCALE)

    def level(self, axis: int) -> str:
        """Return the state of an axis' level: `told`, `scale` (but for its scale factor), or `tilt`."""
        if self.sigma[axis] < DETERMINED * self.prior:
            return "told"
        return "scale" if self.given_scale[axis] < DETERMINED * self.prior else "tilt"


def solved(level: Array, roots: Sequence[Array], length: float, unsure: float) -> Levels:
    """Return bias and scale factor from the levels (P, d) of the placements.

    `roots` (P, r), one an axis, are of the covariance of the levels; `length` is that of the input and `unsure` its
    deviation, the same in all placements.
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
    most = max(len(level) - int(np.sum(np.sqrt(np.diag(given)) < DETERMINED * deviation)), 1)
    worse = np.sqrt(max(1.0, float(left @ np.linalg.solve(spread, left)) / most))
    sigma = np.where(sigma < DETERMINED * deviation, worse * sigma, sigma)
    sigma_given, expected = worse * np.sqrt(np.diag(given))[:d], np.sqrt(np.diag(spread))
    return Levels(theta[:d], sigma[:d], sigma_given, theta[d:], sigma[d:], left, expected, BIAS * length)


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
