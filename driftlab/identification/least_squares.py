"""Joint least squares of map, levels, effects and the unknown starts of memories, on any segments of the rows.

On each axis, for a recording r::

    y = X c + l_r + sum Z theta + sum a_r f + e

X the map's curves, l_r the recording's level, Z an effect's signature, f a memory's response to a start of 1. c has
the map's own penalty and theta none. a_r ~ N(0, sd^2): sd^2 is the mean of a^2 - S V over the recordings that are
fitted, V the variance of a for noise of density 1 and S the density of the residual at low frequencies (method of
moments); it acts as a ridge S / sd^2, and where sd^2 is 0 the memory is taken to start at equilibrium. S is the mean
square of the residual times `colour`, which is that of the present model and stays while candidates are compared.
All is in the columns' own scale (`driftlab.identification.columns`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from driftlab.identification.columns import EffectRegressors, NormalEquations, free_starts
from fusion_core.chunk import Array, Flags, Integers
from fusion_core.contracts import Effect

LOW = 8  # lowest frequencies of a recording whose power is that of slow noise


@dataclass(frozen=True)
class Term:
    """An effect of a model, and whether its start is unknown (free) or equilibrium."""

    effect: Effect
    free: bool = False


Model = tuple[Term, ...]


def without_term(model: Model, k: int) -> Model:
    """Return the model without its k-th term."""
    return (*model[:k], *model[k + 1 :])


@dataclass(frozen=True)
class AxisFit:
    """A model fitted on one axis."""

    cols: Integers  # (k,) columns
    beta: Array  # (k,) their coefficients
    equations: NormalEquations  # of the columns, ridges added
    sd: Array  # (terms,) deviation of the starts of each term; 0 where it starts at equilibrium
    slow: float  # density of the residual at low frequencies, S
    cost: float  # sum of squares left, with what the ridge adds


@dataclass
class LeastSquares:
    """Fits of models on one set of columns."""

    columns: EffectRegressors
    smoothing: Array  # (d,) weight of the map's penalty, of its curves' own
    colour: Array  # (d,) density of the residual at low frequencies, over its mean square
    _fits: dict[tuple[Model, int, tuple[int, ...]], AxisFit] = field(default_factory=dict)
    _penalties: dict[bytes, Array] = field(default_factory=dict)  # of the map, their trace 1, by its columns

    def fit(self, model: Model, axis: int, segments: tuple[int, ...]) -> AxisFit:
        """Fit a model on one axis over some segments."""
        key = (model, axis, segments)
        if key not in self._fits:
            fixed, starts = self._columns(model, axis, segments)
            cols = np.concatenate([fixed, *starts])
            equations = self.columns.equations(segments, cols, self.columns.y[axis : axis + 1])
            self._fits[key] = self._fit(axis, fixed, starts, equations, self.rows(segments))
        return self._fits[key]

    def forget(self) -> None:
        """Let go of fits: smoothing or noise are others."""
        self._fits.clear()

    def fit_rows(self, model: Model, axis: int, rows: Flags) -> AxisFit:
        """Fit a model on one axis over some rows (n,) of all recordings."""
        fixed, starts = self._columns(model, axis, self.columns.everything)
        cols = np.concatenate([fixed, *starts, self.columns.y[axis : axis + 1]])
        W = self.columns.W[np.ix_(rows, cols)]
        return self._fit(axis, fixed, starts, NormalEquations.of(W.T @ W), len(W))

    def _columns(self, model: Model, axis: int, segments: tuple[int, ...]) -> tuple[Integers, list[Integers]]:
        """Return the fixed columns of a model, and those of each term's starts in the segments' recordings."""
        for term in model:
            self.columns.of(term.effect)
        self.columns.of_map([term.effect for term in model])
        return self.fixed(model, axis), [self.starts(term, segments) for term in model]

    def _fit(
        self, axis: int, fixed: Integers, starts: Sequence[Integers], equations: NormalEquations, rows: int
    ) -> AxisFit:
        """Solve the equations of the fixed columns and the starts of each term, over so many rows."""
        all_cols, k = np.concatenate([fixed, *starts]), len(fixed)
        equations = equations.raised(self.ridge(axis, fixed, equations.A))
        sd, slow = np.zeros(len(starts)), 0.0
        if any(map(len, starts)):
            sd, slow = free_starts(equations, k, starts, rows, float(self.colour[axis]))
        weights = [np.full(len(s), slow / one**2 if one > 0 else 0.0) for s, one in zip(starts, sd, strict=True)]
        some = np.concatenate([np.ones(k, dtype=bool), *(w > 0 for w in weights)])
        equations = equations.raised(np.concatenate([np.zeros(k), *weights])).restricted(some)
        return AxisFit(all_cols[some], equations.solution, equations, sd, slow, equations.left)

    def fixed(self, model: Model, axis: int) -> Integers:
        """Return the columns of map, levels and effects: all but the starts."""
        effects = [term.effect for term in model]
        own = [self.columns.of(effect).columns[axis] for effect in effects]
        return np.concatenate([self.columns.of_map(effects), self.columns.levels, *own])

    def ridge(self, axis: int, fixed: Integers, G: Array) -> Array:
        """Return the map's penalty (q, q) on the first of the fixed columns, G the inner products of all of these."""
        q = len(self.columns.penalty)
        key = fixed[:q].tobytes()
        if key not in self._penalties:
            scale = self.columns.scale[fixed[:q]]
            P = self.columns.penalty / np.outer(scale, scale)
            self._penalties[key] = P / (float(np.trace(P)) or 1.0)
        return np.asarray(self.smoothing[axis] * float(np.trace(G[:q, :q])) * self._penalties[key])

    def starts(self, term: Term, segments: Sequence[int]) -> Integers:
        """Return the columns of a term's unknown starts in the recordings of the segments."""
        starts = self.columns.of(term.effect).starts
        if not term.free or starts is None:
            return np.zeros(0, dtype=np.intp)
        return starts[sorted({self.columns.segments[s].record for s in segments})]

    def rows(self, segments: Sequence[int]) -> int:
        """Return the number of rows of some segments."""
        return sum(self.columns.segments[s].rows.stop - self.columns.segments[s].rows.start for s in segments)

    def residual(self, axis: int, fit: AxisFit) -> Array:
        """Return the residual of a fit over all rows (n,)."""
        W = self.columns.W
        return np.asarray(W[:, self.columns.y[axis]] - W[:, fit.cols] @ fit.beta)


def slow_density(parts: Sequence[Array]) -> float:
    """Return the density of noise (of one row, as if it were white) at the lowest frequencies of residuals (n,)."""
    power = []
    for e in parts:
        spectrum = np.abs(np.fft.rfft(e - e.mean())) ** 2 / len(e)
        power.append(spectrum[1 : 1 + LOW])
    return float(np.mean(np.concatenate(power)))
