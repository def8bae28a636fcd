"""Least error of a model that knows the truth: least squares of a smooth map, true signatures and levels.

::

    z[rec, t] = level[rec] + B(T) c + S(t) theta + e,    penalty lambda |D2 c|^2

Its signatures come with their true hyper-parameters; lambda is the one with which each recording is best predicted
from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from loop_cases.answer import spread
from loop_cases.case import Array

MEAN = 20  # rows of which the mean is taken
INTERVALS = 40
LAMBDAS = 10.0 ** np.arange(-3, 6)


@dataclass(frozen=True)
class Told:
    """One recording as the oracle sees it: z (N, d), the temperature of the map (N,), signatures (N, k)."""

    z: Array
    T: Array
    S: Array

    def where(self, rows: Array) -> Told:
        return Told(self.z[rows], self.T[rows], self.S[rows])

    def means(self) -> Told:
        n = len(self.T) // MEAN * MEAN
        return Told(*(a[:n].reshape(n // MEAN, MEAN, *a.shape[1:]).mean(axis=1) for a in (self.z, self.T, self.S)))


def basis(T: Array, low: float, high: float) -> Array:
    """Return cubic B-splines of T (N,), clamped to the domain: (N, INTERVALS + 3)."""
    step = (high - low) / INTERVALS
    knots = low + step * np.arange(-3, INTERVALS + 4)
    return BSpline.design_matrix(np.clip(T, low, high - 1e-9 * step), knots, 3).toarray()


def _solve(parts: Sequence[Told], B: Sequence[Array], penalty: float) -> Array:
    """Return coefficients of map and signatures, each recording's mean taken out: (p, d)."""
    rows = [np.hstack([b, part.S]) for b, part in zip(B, parts, strict=True)]
    A = np.vstack([a - a.mean(axis=0) for a in rows])
    z = np.vstack([part.z - part.z.mean(axis=0) for part in parts])
    bends = np.zeros((INTERVALS + 1, A.shape[1]))
    bends[:, : INTERVALS + 3] = np.diff(np.eye(INTERVALS + 3), 2, axis=0)
    stiff = np.sqrt(penalty) * bends
    return np.linalg.lstsq(np.vstack([A, stiff]), np.vstack([z, np.zeros((len(stiff), z.shape[1]))]), rcond=None)[0]


def error_of_told(fitted: Sequence[Told], holdout: Told, bias: Array) -> float:
    """Return the error on the holdout against its true bias (N, d), norm over the axes."""
    parts = [part.means() for part in fitted]
    low, high = (float(f([f(part.T) for part in parts])) for f in (np.min, np.max))
    B = [basis(part.T, low, high) for part in parts]

    def left_out(penalty: float) -> float:
        total = 0.0
        for k, part in enumerate(parts):
            rest = [i for i in range(len(parts)) if i != k]
            found = _solve([parts[i] for i in rest], [B[i] for i in rest], penalty)
            total += spread(part.z - np.hstack([B[k], part.S]) @ found) ** 2
        return total

    found = _solve(parts, B, min(LAMBDAS, key=left_out))
    return spread(np.hstack([basis(holdout.T, low, high), holdout.S]) @ found - bias)


def error_told_of_measured(fitted: Sequence[Told], holdout: Told) -> float:
    """Return the error on the holdout against its own means, where nobody knows the true bias."""
    means = holdout.means()
    return error_of_told(fitted, means, means.z)
