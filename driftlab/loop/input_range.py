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

from driftlab.loop.gates import WORSE
from driftlab.loop.least_squares import AxisFit, LeastSquares, Model, Term
from driftlab.loop.left_out import FEWEST, given
from driftlab.loop.state import Search, Trial
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

END = 0.2  # of the range: rows at either end that are left out
SURE = 3.0  # deviations of the coefficients
RIGHT = 0.1  # of what an effect says beyond the rest of a range: by how much it may be off and go on beyond the whole

Rows = NDArray[np.bool_]


def does_not_carry_over(found: Search, trial: Trial) -> str:
    """Return of which channel the ends are predicted worse with the candidate than without; nothing where none is."""
    squares, model = found.squares, trial.model
    for name in inputs(trial.term.effect):
        both = [rows for u in _channel(found, name).T for rows, _ in _ends(u)]
        ends = [rows for rows in both if FEWEST <= np.sum(rows) <= len(rows) - FEWEST]
        logs = []
        for axis in found.axes:
            with_it, without = 0.0, 0.0
            for rows in ends:
                fit, other = (squares.fit_rows(one, axis, ~rows) for one in (model, model[:-1]))
                error = _squares(squares, model, axis, rows, fit)
                before = _squares(squares, model[:-1], axis, rows, other)
                shown = squares.columns.W[np.ix_(rows, squares.columns.of(trial.term.effect).columns[axis])]
                with_it += max(error - SURE**2 * _chance(squares, model, axis, rows, fit, shown), min(error, before))
                without += before
            logs += [float(np.log(with_it / without))] if with_it > 0 and without > 0 else []
        ratio = float(np.exp(np.mean(logs))) if logs else 1.0
        if ratio > WORSE:
            change = 100 * (float(np.sqrt(ratio)) - 1)
            return f"predicts the ends of the range of {name} {change:+.0f} %, fitted on the rest of it"
    return ""


def reach(found: Search, term: Term) -> float:
    """Return how far an effect of the model may go on beyond what it was fitted on, as a share of the range.

    It is what is left out at an end over what is left, where each end of all that is held is predicted: fitted on the
    rest, all of it is off by at most a part `RIGHT` of what holding would have missed, beyond noise and with three
    deviations of the coefficients. Else it is 0.
    """
    effect, columns = term.effect, found.columns
    alone = set(effect.requires) <= {"temperature"} and len(columns.penalty) > 0 and not _remembers(effect)
    if effect.acts_on_input or alone or not effect.requires:
        return 0.0
    model = (*(other for other in found.model if other != term), term)
    ends = list(_held_ends(found, effect))
    if not ends or not all(FEWEST <= np.sum(rows) <= len(rows) - FEWEST for rows, _ in ends):
        return 0.0
    shown = columns.of(effect)
    for rows, missed in ends:
        off, size = 0.0, 0.0
        for axis in found.axes:
            own = shown.columns[axis]
            fit = found.squares.fit_rows(model, axis, ~rows)
            stop = len(found.squares.fixed(model, axis))
            beyond = missed[rows, axis][:, shown.places[axis]] / columns.scale[own]
            e = found.squares.residual(axis, fit) ** 2
            off += max(float(np.sum(e[rows]) - np.sum(rows) * np.mean(e[~rows])), 0.0)
            off += SURE**2 * _chance(found.squares, model, axis, rows, fit, beyond)
            size += float(np.sum((beyond @ fit.beta[stop - len(own) : stop]) ** 2))
        if off > RIGHT**2 * size:
            return 0.0
    return END / (1 - END)


def _held_ends(found: Search, effect: Effect) -> Iterator[tuple[Rows, Array]]:
    """Yield the rows at both ends of all that is held of an effect, and what holding them misses of it (n, d, p)."""
    evidence = found.columns.evidence
    signature = evidence.rows([effect.signature(chunk, None)[0] for chunk in evidence.chunks])
    if _remembers(effect):
        each = {tuple(u): u for u in np.moveaxis(signature, 0, -1).reshape(-1, len(signature)) if np.any(u)}
        for u in each.values():
            same = np.all(signature == u[:, None, None], axis=0)
            for rows, ends in _ends(u):
                yield rows, np.where(same, signature - np.clip(signature, *ends), 0.0)
        return
    for name in dict.fromkeys(effect.requires):
        for j, u in enumerate(_channel(found, name).T):
            for rows, ends in _ends(u):
                inside = [chunk.having(**{name: _clipped(chunk[name], j, ends)}) for chunk in evidence.chunks]
                held = evidence.rows([effect.signature(chunk, None)[0] for chunk in inside])
                yield rows, signature - held


def _clipped(values: Array, j: int, ends: tuple[float, float]) -> Array:
    """Return a channel (N,) or (N, k) with its column j within the ends."""
    if values.ndim == 1:
        return np.clip(values, *ends)
    return np.where(np.arange(values.shape[1]) == j, np.clip(values, *ends), values)


def inputs(effect: Effect) -> tuple[str, ...]:
    """Return the channels of an effect whose range is looked at."""
    alone = set(effect.requires) <= {"temperature"} and not _remembers(effect)
    return () if alone or effect.acts_on_input else tuple(dict.fromkeys(effect.requires))


def _remembers(effect: Effect) -> bool:
    return effect.fades or effect.memory_span is not None


def _channel(found: Search, name: str) -> Array:
    """Return the rows (n, k) of a channel."""
    evidence = found.columns.evidence
    return evidence.rows([chunk[name].reshape(len(chunk), -1) for chunk in evidence.chunks])


def _ends(u: Array) -> Iterator[tuple[Rows, tuple[float, float]]]:
    """Yield the rows (n,) in the highest and in the lowest part of u (n,), and the ends of what is left."""
    low, high = float(u.min()), float(u.max())
    part = END * (high - low)
    yield u > high - part, (low, high - part)
    yield u < low + part, (low + part, high)


def _squares(squares: LeastSquares, model: Model, axis: int, rows: Rows, fit: AxisFit) -> float:
    """Return the sum of squares of the errors of rows, in the columns' scale, the coefficients as a fit has them."""
    columns = squares.columns
    known = given(squares, model, axis, fit, columns.everything)
    total = 0.0
    for r, own in enumerate(columns.evidence.slices):
        at = np.flatnonzero(rows[own]) + own.start
        cols = np.concatenate([columns.y[axis : axis + 1], known.cols, known.starts[:, r]])
        W = columns.W[np.ix_(at, cols)] + columns.means[r, cols]
        e = W[:, 0] - W[:, 1:] @ np.concatenate([known.beta, known.a[:, r]]) - known.levels[r]
        total += float(e @ e)
    return total


def _chance(squares: LeastSquares, model: Model, axis: int, rows: Rows, fit: AxisFit, Z: Array) -> float:
    """Return the sum of squares that the uncertainty of the last term's coefficients makes of its columns Z (m, p)."""
    stop, p = len(squares.fixed(model, axis)), Z.shape[1]
    own = np.arange(stop - p, stop)
    unit = np.zeros((len(fit.cols), p))
    unit[own, np.arange(p)] = 1.0
    noise = float(squares.colour[axis]) * fit.cost / max(int(np.sum(~rows)), 1)
    return noise * float(np.sum(fit.equations.solve(unit)[own] * (Z.T @ Z)))
