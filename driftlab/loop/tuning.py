"""Hyper-parameters by training error: which of a family's candidates fits some segments best beside a base.

With base columns B (map, levels, effects that stay) taken out once, the sum of squares that any candidate leaves is a
problem of its own few columns: the candidates' reduced inner products are the Schur complement::

    R = G - G[:, B] (G[B, B] + K)^-1 G[B, :],    cost = R_yy - R_yc (R_cc + ridge)^-1 R_cy

A candidate that acts on the map's input has other map columns, and is fitted whole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftlab.loop.least_squares import LeastSquares, Model, Term
from driftlab.loop.normal_equations import Indices, left_with_starts
from fusion_core.chunk import Array


class Tuning:
    """Costs of candidates beside one base, over some segments."""

    def __init__(self, squares: LeastSquares, base: Model, segments: tuple[int, ...]) -> None:
        self.squares, self.base, self.segments = squares, base, segments
        columns = squares.columns
        G = columns.gram(segments)
        self.size = G.shape[0]
        self.rows = squares.rows(segments)
        self._reduced: list[Array] = []
        known: dict[bytes, Array] = {}
        for axis in range(len(columns.y)):
            fit = squares.fit(base, axis, segments)
            key = fit.cols.tobytes() + fit.equations.A.tobytes()
            if key not in known:  # axes whose columns are alike share it
                known[key] = fit.equations.take_out(G, fit.cols)
            self._reduced.append(known[key])

    def cost(self, terms: Sequence[Term]) -> float:
        """Return n/2 log of the sum of squares that the terms leave beside the base, summed over the axes (nats)."""
        return (
            0.5
            * self.rows
            * sum(float(np.log(max(self._left(terms, axis), 1e-300))) for axis in range(len(self.squares.columns.y)))
        )

    def _left(self, terms: Sequence[Term], axis: int) -> float:
        columns, squares = self.squares.columns, self.squares
        if any(term.effect.acts_on_input for term in terms):
            return squares.fit((*self.base, *terms), axis, self.segments).cost
        own: list[Indices] = [columns.of(term.effect).columns[axis] for term in terms]
        starts = [squares.starts(term, self.segments) for term in terms]
        sizes = np.array([len(s) for s in starts])
        cols = np.concatenate([*own, *starts])
        colour = float(squares.colour[axis])
        return float(left_with_starts(self._reduced[axis], int(columns.y[axis]), cols, sizes, self.rows, colour))


def best(tuning: Tuning, choices: Sequence[Sequence[Term]]) -> tuple[Term, ...]:
    """Return one term of each family, those of least cost together, by coordinate descent from several starts."""
    if len(choices) == 1:
        return (min(choices[0], key=lambda term: tuning.cost((term,))),)
    found: list[tuple[float, tuple[Term, ...]]] = []
    for share in (0.15, 0.5, 0.85):
        chosen = [family[int(share * (len(family) - 1))] for family in choices[:-1]]
        chosen.append(min(choices[-1], key=lambda term: tuning.cost((*chosen, term))))
        cost = tuning.cost(chosen)
        while True:
            for k, family in enumerate(choices):
                chosen[k] = min(family, key=lambda term: tuning.cost((*chosen[:k], term, *chosen[k + 1 :])))
            lower = tuning.cost(chosen)
            if lower >= cost - 1e-9:
                break
            cost = lower
        found.append((cost, tuple(chosen)))
    return min(found, key=lambda pair: pair[0])[1]
