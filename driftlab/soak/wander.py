"""Wander of the bias in several recordings of one unit, beside their common curve.

The blocks of all recordings (`fusion_core.thermal.soak_noise`) are::

    y = f(T) + o_r + g_r(T) + walk + white,    f = line + N(0, rho^2 P^+),    o_r ~ N(0, tau^2)

with walk and white as there. f are straight lines between knots, whose bends have the penalty P; recording r has its
level o_r and its shape g_r, a random walk over temperature of the variance eta^2 over the range: a bias that lags or
remembers has another curve in each kind of soak. White noise and walk are the means over their restricted likelihood
beside a free curve and free levels, rho, tau and eta the likeliest beside these; tau is at least what the walk makes in
the time of a recording, since it goes on in a pause, too.

Each recording says its means in cells of temperature. The mean of o_r + g_r + walk, given these, is taken off samples:
by the equations of the mixed model, least squares on the rest are generalised least squares on the means, whichever
kind of map is fitted. So a recording has weight by what it knows of the curve at a temperature, and not by its number
of samples. Blocks of their own would say more if the bias were a curve and a walk; but one that lags or remembers
follows the temperature less within minutes than it does over hours, and passes up and down have to be averaged.
N samples, K blocks, R recordings, m means, d axes.

Source: C. R. Henderson, Best linear unbiased estimation and prediction under a selection model, Biometrics 31 (1975)
423; G. K. Robinson, That BLUP is a good thing: the estimation of random effects, Statistical Science 6 (1991) 15.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.curve_uncertainty import LITTLE, KnownErrors, answered, curve_error
from fusion_core.thermal.penalised import smooth_lines
from fusion_core.thermal.soak_noise import MIN_BLOCKS, Contrasts, Smoother, blocks_of
from fusion_core.threads import one_thread

CELLS = 8, 40  # of temperature, fewest and most
MEANS = 240  # in cells of all recordings, about
LINE = 2  # means that a line passes through
STRAIGHT = 1e-9  # of the largest eigenvalue of the penalty: a shape that bends less is a line
TRIED = np.arange(-20.0, 5.0, 6.0)  # logarithms of rho^2, tau^2 and eta^2 by the blocks' variance, to begin from
LEAST, MOST = -24.0, 8.0
NOTHING = 1e-30  # SI, of a channel that is zero


class WanderNoise(NamedTuple):
    """Variances of one axis: of the walk over all samples, of white noise of a mean block, and rho^2, tau^2, eta^2."""

    walk: float
    white: float
    bends: float
    levels: float
    shapes: float


@dataclass(frozen=True, eq=False)
class Wander:
    """Wander (N, d) that is taken off the samples of recordings, and the errors of what is left in their blocks."""

    taken: Array
    noises: tuple[WanderNoise, ...]
    errors: KnownErrors

    def densities(self, dt: float) -> tuple[Array, Array]:
        """Return the densities (d,) of white noise and walk, of samples that are `dt` apart in s."""
        n, variances = self.errors.blocks.n, np.array(self.noises)
        return np.sqrt(variances[:, 1] * np.mean(n) * dt), np.sqrt(variances[:, 0] / (np.sum(n) * dt))


def fitted_jointly(
    settings: ThermalMap, T: Array, bias: Array, about: Mapping[str, str], found: Wander | None
) -> FittedMap:
    """Return the map of samples T (N,) and bias (N, d) less what they have wandered, if that was found.

    Its residual is that of the samples as they are; its error is worked out anew, from the noise that was found.
    """
    fitted = settings.fit(T, bias if found is None else bias - found.taken, about)
    if found is None:
        return fitted
    residual = tuple(np.sqrt(np.mean((bias - fitted.bias(T)) ** 2, axis=0)).tolist())
    if fitted.record.error is None:
        return fitted.noting(residual=residual)
    left = bias - found.taken
    with one_thread():
        error = curve_error(settings.kind, T, left, fitted.bias, settings.smoother(T, left), found.errors)
    return fitted.noting(residual=residual, error=error)


def wander_of(T: Array, bias: Array, starts: Sequence[int]) -> Wander | None:
    """Return the wander of bias (N, d) at T (N,) in the recordings that begin at `starts`; None if they are short."""
    if np.ptp(T) == 0:
        return None
    with one_thread():
        design = WanderDesign(T, bias - bias.mean(axis=0), starts)
        if not design.separates:
            return None
        y = design.blocks.y
        noises = tuple(design.noise(column) for column in y.T)
        operators, roots = zip(*map(design.left, noises), strict=True)
    taken = np.stack([W @ column for W, column in zip(operators, y.T, strict=True)], axis=1)
    errors = KnownErrors(design.blocks, roots, [noise.white for noise in noises])
    return Wander(taken[design.blocks.of_sample], noises, errors)


def expected_joint_error(
    parts: Sequence[Array], dt: float, noises: Sequence[tuple[float, ...]], smoother: Smoother
) -> CurveError:
    """Return the error of a curve that is fitted jointly to recordings at T (N_r,) each, samples `dt` apart in s.

    `noises` are, of each axis, the densities of white noise and walk, and rho^2, tau^2 and eta^2.
    """
    T, starts = np.concatenate(parts), np.cumsum([0, *map(len, parts)])[:-1].tolist()
    with one_thread():
        design = WanderDesign(T, np.zeros((len(T), len(noises))), starts)
        n, roots = design.blocks.n, []
        for white, walk, *kinds in noises:
            noise = WanderNoise(walk**2 * np.sum(n) * dt, white**2 / (float(np.mean(n)) * dt), *kinds)
            roots.append(design.left(noise)[1])
        return answered(T, design.blocks, roots, smoother)


class WanderDesign:
    """Blocks of samples T (N,) and bias (N, d), their `means` (m, K), and covariances (K, K) of 1 of what they hold.

    `line` (K, 2) are columns of a free line, `kinds` the covariances of bends, levels and shapes of recordings.
    """

    def __init__(self, T: Array, bias: Array, starts: Sequence[int]) -> None:
        self.R = R = len(starts)
        recording = np.repeat(np.arange(R), np.diff([*starts, len(T)]))
        self.blocks = blocks = blocks_of(T, bias, recording)
        Z = np.asarray(blocks.shares(recording, R).toarray().T > 0, dtype=np.float64)
        self.contrasts, same = Contrasts(blocks, Z), Z @ Z.T
        u, x = (blocks.T - blocks.T.min()) / np.ptp(blocks.T), blocks.fine - blocks.fine[0]
        basis = smooth_lines((float(blocks.fine[0]), float(blocks.fine[-1])))
        curve = blocks.over @ basis.values(blocks.fine)
        bends = curve @ np.linalg.pinv(basis.penalty, rcond=STRAIGHT, hermitian=True) @ curve.T
        self.line = blocks.over @ np.stack([np.ones_like(x), x / x[-1]], axis=1)
        self.kinds = bends, same, same * np.minimum.outer(u, u)
        cells = int(np.clip(MEANS // R, *CELLS))
        cell = np.argmax(Z, axis=1) * cells + np.minimum((u * cells).astype(np.int64), cells - 1)
        means = (cell == np.unique(cell)[:, None]) * blocks.n
        self.means = means / np.sum(means, axis=1, keepdims=True)

    @property
    def separates(self) -> bool:
        """True where there are blocks enough to separate walk from white noise, and means that bend."""
        return len(self.means) > LINE and len(self.blocks.T) - len(self.contrasts.knots) - self.R >= MIN_BLOCKS

    def noise(self, y: Array) -> WanderNoise:
        """Return the variances in blocks y (K,)."""
        from scipy.optimize import minimize

        A, found, scale = self.means, self.contrasts.noise(y, np.eye(len(y))), float(np.mean(y**2))
        if scale < NOTHING:
            return WanderNoise(0.0, 0.0, 0.0, 0.0, 0.0)
        X = np.column_stack([A @ self.line, A @ y])
        of_noise = A @ found.root @ found.root.T @ A.T + LITTLE * scale * np.eye(len(A))
        kinds = [scale * A @ C @ A.T for C in self.kinds]

        def cost(logs: tuple[float, ...] | Array) -> float:
            """Minus twice the logarithm of the restricted likelihood."""
            L = np.linalg.cholesky(of_noise + sum(np.exp(log) * C for log, C in zip(logs, kinds, strict=True)))
            R = np.linalg.qr(np.linalg.solve(L, X))[1]
            return float(2 * np.sum(np.log(np.diag(L))) + 2 * np.sum(np.log(np.abs(np.diag(R)[:2]))) + R[2, 2] ** 2)

        paused = float(np.clip(np.log(max(found.walk, 1e-300) / self.R / scale), LEAST, MOST - 1))
        begin: Array = np.array(min(((r, max(t, paused), g) for r in TRIED for t in TRIED for g in TRIED), key=cost))
        bounds = [(LEAST, MOST), (paused, MOST), (LEAST, MOST)]
        inwards = np.where(begin + 1 < MOST, 1.0, -1.0)  # scipy's own simplex is flat at a bound below zero
        simplex = np.vstack([begin, begin + np.diag(inwards)])
        how: Any = {"xatol": 0.05, "fatol": 0.01, "initial_simplex": simplex}
        logs = minimize(cost, begin, method="Nelder-Mead", bounds=bounds, options=how).x
        return WanderNoise(found.walk, found.white, *(scale * np.exp(logs)).tolist())

    def left(self, noise: WanderNoise) -> tuple[Array, Array]:
        """Return the operator (K, K) that takes blocks to their wander, and a root (K, K) of the errors that it leaves.

        The wander is the mean of level, shape and walk, less that over all samples.
        """
        bends, levels, shapes = (
            size * C for size, C in zip((noise.bends, noise.levels, noise.shapes), self.kinds, strict=True)
        )
        wander, A, n = noise.walk * self.contrasts.covariance + levels + shapes, self.means, self.blocks.n
        least = LITTLE * (noise.walk + noise.white + noise.levels) + NOTHING  # of samples without noise
        white, X = np.diag(noise.white * self.contrasts.white + least), A @ self.line
        solved = np.linalg.solve(A @ (wander + white + bends) @ A.T, np.hstack([X, A]))
        line = np.linalg.solve(X.T @ solved[:, :2], solved[:, :2].T @ A)
        W = wander @ A.T @ (solved[:, 2:] - solved[:, :2] @ line)
        W -= n @ W / np.sum(n)
        rest = np.eye(len(n)) - W
        return W, np.linalg.cholesky(rest @ (wander + white) @ rest.T + W @ bends @ W.T + least * np.eye(len(n)))
