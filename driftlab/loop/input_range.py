"""Whether an effect carries over from one part of its inputs' range to the rest: left-out parts by range, not by time.

Of each channel that an effect reads, the rows in the highest fifth of its range are left out, then those in the lowest.
The coefficients come from the other rows; given these, map and levels are fitted to all, and the rows left out are
predicted with the effect and without. What the other rows do not show of the coefficients is taken for nothing: each
combination c_i of variance v_i (noise as slow as the residual's) counts as c_i max(0, 1 - v_i / c_i^2). So an effect
that is merely not seen in a part of the range does no harm there, and one that is seen and wrong does.

What is a function of temperature alone is the map's, whose own domain holds it. n rows, p coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from driftlab.loop.gates import WORSE
from driftlab.loop.least_squares import AxisFit, LeastSquares, Model
from driftlab.loop.left_out import FEWEST, given
from driftlab.loop.state import Search, Trial
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

END = 0.2  # of the range: rows at either end that are left out

Rows = NDArray[np.bool_]


def does_not_carry_over(found: Search, trial: Trial) -> str:
    """Return of which channel the ends are predicted worse with the candidate than without; nothing where none is."""
    for name in inputs(trial.term.effect):
        logs = []
        for axis in found.axes:
            squares = np.zeros(2)
            for ends in _ends(found, name):
                for k, model in enumerate((trial.model, trial.model[:-1])):
                    squares[k] += np.sum(_errors(found.squares, model, axis, ends, candidate=k == 0) ** 2)
            if np.all(squares > 0):
                logs.append(float(np.log(squares[0] / squares[1])))
        ratio = float(np.exp(np.mean(logs))) if logs else 1.0
        if ratio > WORSE:
            change = 100 * (float(np.sqrt(ratio)) - 1)
            return f"predicts the ends of the range of {name} {change:+.0f} %, fitted on the rest of it"
    return ""


def inputs(effect: Effect) -> tuple[str, ...]:
    """Return the channels of an effect whose range is looked at."""
    remembers = effect.fades or effect.memory_span is not None
    alone = set(effect.requires) <= {"temperature"} and not remembers
    return () if alone or effect.acts_on_input else tuple(dict.fromkeys(effect.requires))


def _ends(found: Search, name: str) -> Iterator[Rows]:
    """Yield the rows (n,) in the highest and in the lowest part of each column of a channel, where there are enough."""
    evidence = found.columns.evidence
    values = evidence.rows([chunk[name].reshape(len(chunk), -1) for chunk in evidence.chunks])
    for u in values.T:
        low, high = float(u.min()), float(u.max())
        for rows in (u > high - END * (high - low), u < low + END * (high - low)):
            if FEWEST <= np.sum(rows) <= len(u) - FEWEST:
                yield rows


def _errors(squares: LeastSquares, model: Model, axis: int, rows: Rows, *, candidate: bool) -> Array:
    """Return the errors of the rows that are left out, in the columns' scale; `candidate`: the last term is one."""
    columns = squares.columns
    fit = squares.fit_rows(model, axis, ~rows)
    if candidate:
        fit = _as_far_as_seen(squares, model, axis, fit, int(np.sum(~rows)))
    known = given(squares, model, axis, fit, columns.everything)
    errors = []
    for r, own in enumerate(columns.evidence.slices):
        at = np.flatnonzero(rows[own]) + own.start
        cols = np.concatenate([columns.y[axis : axis + 1], known.cols, known.starts[:, r]])
        W = columns.W[np.ix_(at, cols)] + columns.means[r, cols]
        errors.append(W[:, 0] - W[:, 1:] @ np.concatenate([known.beta, known.a[:, r]]) - known.levels[r])
    return np.concatenate(errors)


def _as_far_as_seen(squares: LeastSquares, model: Model, axis: int, fit: AxisFit, rows: int) -> AxisFit:
    """Return the fit with the coefficients of the last term as far as its rows show them."""
    p = len(squares.columns.of(model[-1].effect).columns[axis])
    stop = len(squares.fixed(model, axis))
    own = np.arange(stop - p, stop)
    unit = np.zeros((len(fit.cols), p))
    unit[own, np.arange(p)] = 1.0
    noise = float(squares.colour[axis]) * fit.cost / max(rows, 1)
    variance, turn = np.linalg.eigh(noise * fit.equations.solve(unit)[own])
    c = turn.T @ fit.beta[own]
    seen = np.maximum(0.0, 1 - np.maximum(variance, 0.0) / np.maximum(c**2, 1e-300))
    beta = fit.beta.copy()
    beta[own] = turn @ (seen * c)
    return replace(fit, beta=beta)
