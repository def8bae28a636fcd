"""Oddness of a planted unit, given the law that its family was drawn from and its own noise.

No project code. The rows of an axis are a curve of the law, a level for each soak, walk and white noise, in which

- a level has the chance of one as far out among levels of the law, on its side, twice;
- a walk (or white noise) of `TIMES` the usual is tried against the law of walks by their likelihoods, and has the
  chance of a ratio as large among soaks of ordinary units, drawn: what a soak does not know of its walk is in it;
- all other errors are a signal of known shape beside curves of the law (`Truth.modes`), each of any size; of rows with
  the unit's own noise it has the chance of Gauss.

Its chance is of the one thing that was planted: nothing is paid for what else was looked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import erfc

import numpy as np
from scipy.special import logsumexp

TIMES, DRAWS = 3.0, 40_000
MODES, LEAST = 14, 1e-6  # of a law's curves, and of the largest: what is less is none
STRONGEST = 200  # eigenvalues of a walk, of which the rest is white noise alone


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of a planted unit and its family; S soaks, R rows in all.

    Attributes
    ----------
    odd : str
        `level`, `walk`, `noise`, or anything else for a signal.
    level : float
        Of the unit, in the units of `levels` (M,), which are drawn from the law.
    t, T, bias : sequences of (R_s,) arrays
        Of the odd axis, each soak.
    modes : (G, M) array
        Curves of the law over `grid` (G,), degC.
    signal : sequence of (R_s,) arrays
        What was added to the bias.
    white, walk : float
        Of the unit; SI/sqrt(Hz) and SI/sqrt(s).
    usual, spread : float
        Of a walk or noise that is odd: median and deviation of the logarithm over units.
    """

    odd: str
    level: float
    levels: np.ndarray
    t: Sequence[np.ndarray]
    T: Sequence[np.ndarray]
    bias: Sequence[np.ndarray]
    grid: np.ndarray
    modes: np.ndarray
    signal: Sequence[np.ndarray]
    white: float
    walk: float
    usual: float
    spread: float

    @property
    def free(self) -> np.ndarray:
        """Basis without prior knowledge (R, M + S), orthonormal: curves of the law, and a level for each soak."""
        curves = [np.stack([np.interp(T, self.grid, mode) for mode in self.modes.T], axis=1) for T in self.T]
        U, size, _ = np.linalg.svd(np.hstack([np.vstack(curves), _levels(self.t)]), full_matrices=False)
        return U[:, size > 1e-9 * size[0]]

    def chance(self, seed: int) -> float:
        """Return its probability by chance."""
        if self.odd == "level":
            beyond = min(np.sum(self.levels >= self.level), np.sum(self.levels <= self.level))
            return min(2.0 * (1 + float(beyond)) / (1 + len(self.levels)), 1.0)
        return self._of_noise(seed) if self.odd in ("walk", "noise") else self._of_signal()

    def _of_signal(self) -> float:
        y, d, step = np.concatenate(self.bias), np.concatenate(self.signal), float(self.t[0][1] - self.t[0][0])
        L = np.linalg.cholesky(self.walk**2 * _walks(self.t) + self.white**2 / step * np.eye(len(y)))
        found = np.linalg.solve(L, np.column_stack([self.free, y, d]))
        U = np.linalg.qr(found[:, :-2])[0]
        y, d = (found[:, -2:] - U @ (U.T @ found[:, -2:])).T
        return erfc(abs(float(d @ y)) / np.sqrt(2 * float(d @ d) + 1e-300))

    def _of_noise(self, seed: int) -> float:
        rng, U, step = np.random.default_rng([seed, 77]), self.free, float(self.t[0][1] - self.t[0][0])
        walks = _walks(self.t)
        walks -= U @ (U.T @ walks)
        own, V = np.linalg.eigh(walks - (walks @ U) @ U.T)
        own, V = own[::-1], V[:, ::-1]
        if self.odd == "walk":
            own, V = own[:STRONGEST], V[:, :STRONGEST]
        else:
            own, V = own[: -U.shape[1]], V[:, : -U.shape[1]]  # the rest is free
        nodes, weights = np.polynomial.hermite_e.hermegauss(9)

        def variances(of: np.ndarray) -> np.ndarray:
            white, walk = (self.white, of[:, None]) if self.odd == "walk" else (of[:, None], self.walk)
            return np.asarray(white**2 / step + walk**2 * np.maximum(own, 0.0))

        def likely(squares: np.ndarray, times: float) -> np.ndarray:
            var = variances(times * self.usual * np.exp(self.spread * nodes))
            cost = squares @ (1 / var).T + np.sum(np.log(var), axis=1)
            return np.asarray(logsumexp(np.log(weights) - cost / 2, axis=1))

        def ratio(squares: np.ndarray) -> np.ndarray:
            return likely(squares, TIMES) - likely(squares, 1.0)

        beyond, mine = 0, float(ratio((V.T @ np.concatenate(self.bias))[None] ** 2)[0])
        for _ in range(10):
            usual = self.usual * np.exp(self.spread * rng.normal(size=DRAWS // 10))
            drawn = rng.normal(size=(len(usual), len(own))) ** 2
            beyond += int(np.sum(ratio(drawn * variances(usual)) >= mine))
        return (1 + beyond) / (1 + DRAWS)


def modes_of(curves: np.ndarray) -> np.ndarray:
    """Return the modes (G, M) in which curves (n, G) of a law differ."""
    U, size, _ = np.linalg.svd((curves - curves.mean(axis=0)).T, full_matrices=False)
    return np.asarray(U[:, :MODES][:, size[:MODES] > LEAST * size[0]])


def _walks(t: Sequence[np.ndarray]) -> np.ndarray:
    found, at = np.zeros((sum(map(len, t)),) * 2), 0
    for own in t:
        found[at : at + len(own), at : at + len(own)] = np.minimum.outer(own, own)
        at += len(own)
    return found


def _levels(t: Sequence[np.ndarray]) -> np.ndarray:
    return np.repeat(np.eye(len(t)), [len(own) for own in t], axis=0)
