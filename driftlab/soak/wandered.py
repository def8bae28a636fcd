"""Wander of the bias in several recordings of one unit, beside their common curve.

The blocks of all recordings (`fusion_core.thermal.soak_noise`) are::

    y = f(T) + o_r + walk + white,    o_r ~ N(0, tau^2) in each recording,    f = line + N(0, rho^2 P^+)

with walk and white as there, and f straight lines between knots, whose bends have the penalty P. White noise and walk
are the means over their restricted likelihood beside a free curve and free levels, tau and rho the likeliest beside
these; tau is at least what the walk makes in the time of a recording, since it goes on in a pause, too.

Each recording says its means in cells of temperature. The mean of o_r and walk, given these, is taken off the samples:
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
from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.curve_uncertainty import KnownErrors, answered, curve_error
from fusion_core.thermal.penalised import smooth_lines
from fusion_core.thermal.soak_noise import CELLS, MIN_BLOCKS, Contrasts, Smoother, blocks_of
from fusion_core.threads import one_thread

STRAIGHT = 1e-9  # of the largest eigenvalue of the penalty: a shape that bends less is a line
TRIED = np.arange(-20.0, 5.0, 4.0)  # logarithms of rho^2 and tau^2 by the blocks' variance, to begin from
LEAST, MOST = -24.0, 8.0


class WanderNoise(NamedTuple):
    """Variances of one axis: the walk over all samples, white noise of a mean block, bends (rho^2), levels (tau^2)."""

    walk: float
    white: float
    bends: float
    levels: float


@dataclass(frozen=True, eq=False)
class Wandered:
    """Wander (N, d) that is taken off the samples of recordings, and the errors of what is left in their blocks."""

    taken: Array
    noises: tuple[WanderNoise, ...]
    errors: KnownErrors

    def densities(self, dt: float) -> tuple[Array, Array]:
        """Return the densities (d,) of white noise and walk, of samples that are `dt` apart in s."""
        n, variances = self.errors.blocks.n, np.array(self.noises)
        return np.sqrt(variances[:, 1] * np.mean(n) * dt), np.sqrt(variances[:, 0] / (np.sum(n) * dt))


def fitted_jointly(
    settings: ThermalMap, T: Array, bias: Array, about: Mapping[str, str], found: Wandered | None
) -> FittedMap:
    """Return the map of samples T (N,) and bias (N, d) less what they have wandered, if that was found.

    Its residual is that of the samples as they are.
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


def wandered(T: Array, bias: Array, starts: Sequence[int]) -> Wandered | None:
    """Return the wander of bias (N, d) at T (N,) in the recordings that begin at `starts`; None if they are short."""
    if np.ptp(T) == 0:
        return None
    with one_thread():
        design = WanderDesign(T, bias - bias.mean(axis=0), starts)
        if not design.separates:
            return None
        y = design.blocks.y
        noises = tuple(design.noise(column) for column in y.T)
        operators = [design.taken(noise) for noise in noises]
        roots = [design.left(noise, W) for noise, W in zip(noises, operators, strict=True)]
    taken = np.stack([W @ column for W, column in zip(operators, y.T, strict=True)], axis=1)
    errors = KnownErrors(design.blocks, roots, [noise.white for noise in noises])
    return Wandered(taken[design.blocks.of_sample], noises, errors)


def expected_joint_error(
    parts: Sequence[Array], dt: float, noises: Sequence[tuple[float, ...]], smoother: Smoother
) -> CurveError:
    """Return the error of a curve that is fitted jointly to recordings at T (N_r,) each, samples `dt` apart in s.

    `noises` are, of each axis, the densities of white noise and walk, and the variances of bends and levels.
    """
    T, starts = np.concatenate(parts), np.cumsum([0, *map(len, parts)])[:-1].tolist()
    with one_thread():
        design = WanderDesign(T, np.zeros((len(T), len(noises))), starts)
        n, roots = design.blocks.n, []
        for white, walk, bends, levels in noises:
            noise = WanderNoise(walk**2 * np.sum(n) * dt, white**2 / (float(np.mean(n)) * dt), bends, levels)
            roots.append(design.left(noise, design.taken(noise)))
        return answered(T, design.blocks, roots, smoother)


class WanderDesign:
    """Blocks of samples T (N,) and bias (N, d), their `means` (m, K), and the columns of their curve and levels.

    `groups` are columns of a free line (K, 2), of bends (K, q), and of levels (K, R - 1): contrasts of the recordings,
    since their mean is of the line. `columns` (m, p) are the means of all.
    """

    def __init__(self, T: Array, bias: Array, starts: Sequence[int]) -> None:
        R = len(starts)
        recording = np.repeat(np.arange(R), np.diff([*starts, len(T)]))
        self.blocks = blocks = blocks_of(T, bias, recording)
        Z = np.asarray(blocks.shares(recording, R).toarray().T > 0, dtype=np.float64)
        self.contrasts = Contrasts(blocks, Z)
        low, high = float(blocks.fine[0]), float(blocks.fine[-1])
        basis = smooth_lines((low, high))
        e, U = np.linalg.eigh(basis.penalty)
        some = e > STRAIGHT * e[-1]
        bends = basis.values(blocks.fine) @ (U[:, some] / np.sqrt(e[some]))
        line = np.stack([np.ones_like(blocks.fine), (blocks.fine - low) / (high - low)], axis=1)
        apart = np.linalg.qr(np.hstack([np.ones((R, 1)), np.eye(R)[:, 1:]]))[0][:, 1:]
        self.groups = blocks.over @ line, blocks.over @ bends, Z @ apart
        cell = np.minimum(((blocks.T - low) * (CELLS / (high - low))).astype(np.int64), CELLS - 1)
        place = np.unique(np.argmax(Z, axis=1) * CELLS + cell, return_inverse=True)[1]
        means = (place == np.arange(np.max(place) + 1)[:, None]) * blocks.n
        self.means = means / np.sum(means, axis=1, keepdims=True)
        self.columns, self.sizes = self.means @ np.hstack(self.groups), [group.shape[1] for group in self.groups]

    @property
    def separates(self) -> bool:
        """True where there are blocks enough to separate walk from white noise."""
        return len(self.blocks.T) - len(self.contrasts.knots) - self.sizes[2] >= MIN_BLOCKS

    def noise(self, y: Array) -> WanderNoise:
        """Return the variances in blocks y (K,)."""
        from scipy.optimize import minimize

        found = self.contrasts.noise(y, np.eye(len(y)))
        scale = float(np.mean(y**2)) or 1.0
        root = np.linalg.qr((self.means @ found.root).T)[1].T
        white = np.linalg.solve(root, np.column_stack([self.columns, self.means @ y]))
        N = white.T @ white
        G, b, varied = N[:-1, :-1], N[:-1, -1], self.sizes[0]

        def cost(logs: tuple[float, float] | Array) -> float:
            """Minus twice the logarithm of the restricted likelihood."""
            precision = np.repeat([0.0, *np.exp(-np.asarray(logs)) / scale], self.sizes)
            L = np.linalg.cholesky(G + np.diag(precision))
            explained = np.linalg.solve(L, b)
            return float(2 * np.sum(np.log(np.diag(L))) - np.sum(np.log(precision[varied:])) - explained @ explained)

        paused = float(np.clip(np.log(max(found.walk, 1e-300) / (self.sizes[2] + 1) / scale), LEAST, MOST - 1))
        begin: Array = np.array(min(((r, max(t, paused)) for r in TRIED for t in TRIED), key=cost))
        bounds = [(LEAST, MOST), (paused, MOST)]
        logs = minimize(cost, begin, method="Nelder-Mead", bounds=bounds, options={"xatol": 0.05, "fatol": 0.01}).x
        bends, levels = (scale * np.exp(logs)).tolist()
        return WanderNoise(found.walk, found.white, bends, levels)

    def taken(self, noise: WanderNoise) -> Array:
        """Return the operator (K, K) that takes blocks to the mean of their levels and walk, less that over all."""
        A, walk = self.means, noise.walk * self.contrasts.covariance
        least = 1e-9 * (noise.walk + noise.white) + 1e-12 * (noise.bends + noise.levels)  # of samples without noise
        V = A @ (walk + np.diag(noise.white * self.contrasts.white + least)) @ A.T
        solved = np.linalg.solve(V, np.hstack([self.columns, A]))
        p = self.columns.shape[1]
        precision = np.repeat([0.0, 1 / noise.bends, 1 / noise.levels], self.sizes)
        operator = np.linalg.solve(self.columns.T @ solved[:, :p] + np.diag(precision), solved[:, :p].T @ A)
        W = walk @ A.T @ (solved[:, p:] - solved[:, :p] @ operator) + self.groups[2] @ operator[p - self.sizes[2] :]
        return np.asarray(W - self.blocks.n @ W / np.sum(self.blocks.n))

    def left(self, noise: WanderNoise, taken: Array) -> Array:
        """Return a root (K, r) of the errors that are left where so much is `taken` (K, K), of the curve, too."""
        white = np.diag(np.sqrt(noise.white * self.contrasts.white))
        of_noise = [self.contrasts.walk * np.sqrt(noise.walk), self.groups[2] * np.sqrt(noise.levels), white]
        errors = np.hstack(of_noise)
        return np.hstack([errors - taken @ errors, taken @ self.groups[1] * np.sqrt(noise.bends)])
