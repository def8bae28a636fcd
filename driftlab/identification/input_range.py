"""Whether an effect carries over from one part of its inputs' range to the rest: left-out parts by range, not by time.

Of each channel that an effect reads, the rows in the highest fifth of its range are left out, then those in the lowest.
The coefficients come from the other rows; given these, map and levels are fitted to all, and the rows left out are
predicted with the effect and without. They may be predicted worse by what three deviations of the coefficients make
of them: an effect that is merely not seen in the rest does no harm there, and one that is seen and wrong does.

What is a function of temperature alone is the map's, whose own domain holds it. n rows.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from driftlab.identification.acceptance import WORSE
from driftlab.identification.cross_validation import FEWEST, given
from driftlab.identification.least_squares import AxisFit, LeastSquares, Model
from driftlab.identification.state import Search, Trial
from fusion_core.contracts import Effect

END = 0.2  # of the range: rows at either end that are left out
SURE = 3.0  # deviations of the coefficients

Rows = NDArray[np.bool_]


def does_not_carry_over(found: Search, trial: Trial) -> str:
    """Return of which channel the ends are predicted worse with the candidate than without; nothing where none is."""
    squares, model = found.squares, trial.model
    for name in inputs(trial.term.effect):
        ends = list(_ends(found, name))
        logs = []
        for axis in found.axes:
            with_it, without = 0.0, 0.0
            for rows in ends:
                error, fit = _squares(squares, model, axis, rows)
                before, _ = _squares(squares, model[:-1], axis, rows)
                with_it += max(error - SURE**2 * _chance(squares, model, axis, rows, fit), min(error, before))
                without += before
            logs += [float(np.log(with_it / without))] if with_it > 0 and without > 0 else []
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


def _squares(squares: LeastSquares, model: Model, axis: int, rows: Rows) -> tuple[float, AxisFit]:
    """Return the sum of squares of the errors of rows that are left out, in the columns' scale, and the others' fit."""
    columns = squares.columns
    fit = squares.fit_rows(model, axis, ~rows)
    known = given(squares, model, axis, fit, columns.everything)
    total = 0.0
    for r, own in enumerate(columns.evidence.slices):
        at = np.flatnonzero(rows[own]) + own.start
        cols = np.concatenate([columns.y[axis : axis + 1], known.cols, known.starts[:, r]])
        W = columns.W[np.ix_(at, cols)] + columns.means[r, cols]
        e = W[:, 0] - W[:, 1:] @ np.concatenate([known.beta, known.a[:, r]]) - known.levels[r]
        total += float(e @ e)
    return total, fit


def _chance(squares: LeastSquares, model: Model, axis: int, rows: Rows, fit: AxisFit) -> float:
    """Return the sum of squares that the uncertainty of the last term's coefficients makes of the rows left out."""
    columns = squares.columns.of(model[-1].effect).columns[axis]
    stop, p = len(squares.fixed(model, axis)), len(columns)
    own = np.arange(stop - p, stop)
    unit = np.zeros((len(fit.cols), p))
    unit[own, np.arange(p)] = 1.0
    noise = float(squares.colour[axis]) * fit.cost / max(int(np.sum(~rows)), 1)
    Z = squares.columns.W[np.ix_(rows, columns)]
    return noise * float(np.sum(fit.equations.solve(unit)[own] * (Z.T @ Z)))
