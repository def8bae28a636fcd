"""How much a planned recording would say of each effect, and how much of it is left beside another effect.

Made white by the noise of the rows (`driftlab.noise.local_level`), with the map's curves B and the level taken out,

::

    nats of a shape s:                  1/2 |M s|^2,    M = I - B (B'B + ridge)^-1 B'
    left where Z may take its part:     1/2 |M s|^2 - 1/2 s'M Z (Z'M Z)^-1 Z'M s

the expectation of the generalised likelihood ratio. What another effect leaves is taken at the hyper-parameters with
which it imitates best. K columns of shapes, each one SI unit from its lowest to its highest.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from driftlab.identification.normal_equations import NormalEquations
from driftlab.identification.state import Search
from driftlab.noise.local_level import one_step
from driftlab.planning.simulated_search import UnrecordedUnit, noises, shapes
from fusion_core.chunk import Array
from fusion_core.contracts import Effect


class Information:
    """What a planned recording says of the shapes of effects.

    Attributes
    ----------
    effects : tuple of Effect
        The effects.
    G : (d, K, K) array
        Inner products of the columns, white, with map and level taken out.
    b : (d, K) array
        Theirs with what was measured.
    """

    def __init__(self, found: Search, unit: UnrecordedUnit, effects: Sequence[Effect]) -> None:
        self.effects = tuple(effects)
        own = [[shapes(found, unit, effect, axis) for effect in effects] for axis in range(len(unit.axes))]
        ends = np.cumsum([0, *(part.shape[1] for part in own[0])])
        self._places = [np.arange(a, b) for a, b in pairwise(ends)]
        columns = found.columns
        B = columns.of_map([])
        self.G, self.b = np.zeros((len(unit.axes), ends[-1], ends[-1])), np.zeros((len(unit.axes), ends[-1]))
        for axis, noise in enumerate(noises(unit, columns.evidence.interval)):
            q, y = len(B), columns.y[axis]
            whole = np.column_stack([columns.W[:, B], *own[axis], columns.W[:, y] * columns.scale[y]])
            parts = one_step([whole[rows] for rows in columns.evidence.slices], noise.gain)
            white = np.concatenate(parts) / np.sqrt(noise.variance)
            squares = white.T @ white
            ridge = found.squares.ridge(axis, B, columns.gram(found.everything, B)) / noise.variance
            equations = NormalEquations(squares[:q, :q], np.zeros(q), 0.0).raised(ridge)
            left = squares[q:, q:] - squares[q:, :q] @ equations.solve(squares[:q, q:])
            self.G[axis], self.b[axis] = left[:-1, :-1], left[:-1, -1]

    def size(self, k: int) -> tuple[Array, Array]:
        """Return the sizes (d,) of the k-th effect, of one column, in what was measured, and their deviations, SI."""
        (place,) = self._places[k]
        squares = np.maximum(self.G[:, place, place], 1e-300)
        return self.b[:, place] / squares, 1 / np.sqrt(squares)

    def columns_of(self, k: int) -> int:
        """Return how many columns the k-th effect has."""
        return len(self._places[k])

    def direction(self, k: int) -> Array:
        """Return coefficients (p,) of the k-th effect's columns: of what it may show, what is seen middling well."""
        own = self._places[k]
        values, vectors = np.linalg.eigh(self.G[:, own][:, :, own].sum(axis=0))
        return np.asarray(vectors[:, len(values) // 2])

    def nats(self, k: int, theta: Array) -> float:
        """Return the nats of the k-th effect with coefficients theta (p,) on every axis alike."""
        own = self._places[k]
        return 0.5 * max(float(np.sum(theta @ self.G[:, own][:, :, own] @ theta)), 0.0)

    def left(self, k: int, theta: Array, others: Sequence[int]) -> float:
        """Return the nats that are left where one of the other effects takes its part, the one that takes most."""
        own = self._places[k]
        least = self.nats(k, theta)
        for j in others:
            Z = self._places[j]
            taken = 0.0
            for G in self.G:
                b = G[np.ix_(Z, own)] @ theta
                taken += float(b @ np.linalg.pinv(G[np.ix_(Z, Z)], rcond=1e-9, hermitian=True) @ b)
            least = min(least, self.nats(k, theta) - 0.5 * taken)
        return max(least, 0.0)
