"""Cross-validation: predictions of recordings that were left out, open loop, as a user meets them.

Each recording, and each half of each, is left out in turn. Coefficients and hyper-parameters are those of the rest
(transfer); given these, map and levels are fitted to all (refitting the map without the part would measure its
extrapolation). Of a single recording five parts are left out, the map with them. Where a memory's start is unknown it
is estimated as a unit is aligned: from the first minutes of the part, with what the other recordings say of levels::

    e(t) = l + sum a f(t) + noise,    l ~ N(mean of the others' levels, repeatability^2),    a ~ N(0, sd^2)

Its noise is what a run has there: the declared white noise and the walk that the model leaves. The error is what is
left, less its mean. n rows of a part, d axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from driftlab.identification.columns import EffectRegressors
from driftlab.identification.least_squares import AxisFit, LeastSquares, Model
from driftlab.noise.local_level import LocalLevel
from fusion_core.chunk import Array, Integers

MIN_ROWS = 8  # of a part that is predicted


@dataclass(frozen=True)
class LeftOutPart:
    """Rows of one recording that are left out, and of which segments the model is learned."""

    record: int  # number of the recording
    rows: slice  # that are left out
    whole: bool  # whether they are all of the recording
    rest: tuple[int, ...]  # segments that effects are fitted on
    refit: tuple[int, ...]  # segments that map and levels are fitted on, the effects given
    window: slice  # rows in which the unit is aligned


@dataclass(frozen=True)
class Conditioned:
    """A model on one axis with everything but the starts of the part that is left out."""

    cols: Integers  # (k,) columns of map and effects
    beta: Array  # (k,) their coefficients
    starts: Integers  # (terms, R) columns of the free terms' starts
    sd: Array  # (terms,) their deviations
    a: Array  # (terms, R) the starts, as all recordings show them
    levels: Array  # (R,) of the recordings, less map, effects and starts


def parts(columns: EffectRegressors) -> tuple[LeftOutPart, ...]:
    """Return the parts that are left out in turn: whole recordings where there are several, then segments."""
    segments, evidence = columns.segments, columns.evidence
    alone = len(evidence.records) == 1
    whole = [] if alone else list(enumerate(evidence.slices))
    each = [(r, rows, tuple(k for k, s in enumerate(segments) if s.record != r)) for r, rows in whole]
    each += [(s.record, s.rows, columns.all_but(k)) for k, s in enumerate(segments)]
    long_enough = []
    for r, rows, rest in each:
        t, first = evidence.records[r].t, evidence.slices[r].start
        at = t[rows.start - first] + evidence.align
        stop = first + int(np.searchsorted(t, at, side="right"))
        window = slice(rows.start, max(stop, rows.start + 2))
        if rows.stop - window.stop >= MIN_ROWS:
            is_whole = rows.stop - rows.start == len(t)
            long_enough.append(LeftOutPart(r, rows, is_whole, rest, rest if alone else columns.everything, window))
    return tuple(long_enough)


def error(squares: LeastSquares, model: Model, axis: int, part: LeftOutPart, noise: LocalLevel) -> Array:
    """Return the error (n,) of the model's prediction of one part, from the end of its alignment on, less its mean.

    `noise` is that of the model's residual.
    """
    columns = squares.columns
    fit = squares.fit(model, axis, part.rest)
    known = condition(squares, model, axis, fit, part.refit)
    cols = np.concatenate([columns.y[axis : axis + 1], known.cols, known.starts[:, part.record]])
    W = columns.W[part.rows, cols] + columns.means[part.record, cols]
    stop = 1 + len(known.cols)
    e = W[:, 0] - W[:, 1:stop] @ known.beta
    split = part.window.stop - part.rows.start
    if len(known.sd):
        f = W[:, stop:]
        others = np.delete(known.levels, part.record)
        left = float(np.sqrt(fit.cost / squares.rows(part.rest)))
        mean, spread = level_prior(others, known.levels, left)
        white = columns.declared_white[axis]
        noise = noise if np.isnan(white) else LocalLevel.of(white, noise.walk)
        e = e - f @ starts_aligned(e[:split], f[:split], mean, spread, known.sd, noise)
    return np.asarray(e[split:] - e[split:].mean())


def condition(squares: LeastSquares, model: Model, axis: int, fit: AxisFit, refit: tuple[int, ...]) -> Conditioned:
    """Fit map, levels and starts on some segments, the effects' coefficients given as another fit has them."""
    columns, means = squares.columns, squares.columns.means
    fixed, y = squares.fixed(model, axis), columns.y[axis : axis + 1]
    q, R = len(columns.penalty), len(columns.levels)
    theta = fit.beta[q + R : len(fixed)]
    free = [k for k, sd in enumerate(fit.sd) if sd > 0]
    starts = np.array([columns.of(model[k].effect).starts for k in free], dtype=np.intp).reshape(len(free), R)
    own = np.concatenate([fixed[: q + R], starts.ravel()])
    equations = columns.equations(refit, np.concatenate([own, fixed[q + R :]]), y).given(theta)
    equations = equations.raised(squares.ridge(axis, fixed[: q + R], equations.A))
    weights = np.repeat([fit.slow / fit.sd[k] ** 2 for k in free], R)
    beta = equations.raised(np.concatenate([np.zeros(q + R), weights])).solution
    cols, coefficients = np.concatenate([fixed[:q], fixed[q + R :]]), np.concatenate([beta[:q], theta])
    a = beta[q + R :].reshape(len(free), R)
    levels = beta[q : q + R] + means[:, y[0]] - means[:, cols] @ coefficients
    for place, start in zip(starts, a, strict=True):
        levels = levels - means[:, place] @ start
    return Conditioned(cols, coefficients, starts, fit.sd[free], a, levels)


def level_prior(others: Array, levels: Array, left: float) -> tuple[float, float]:
    """Return mean and deviation of the level of one more recording, from those of others and how all of them spread.

    The deviation is that which holds 68 % of a Student's t (two recordings tell little of a spread), and the model's
    residual, `left` (rms).
    """
    if len(levels) < 2:
        return 0.0, np.inf
    spread = float(np.std(levels, ddof=1)) * float(np.sqrt(1 + 1 / max(len(others), 1)))
    return float(np.mean(others)), float(np.hypot(spread * stdtrit(len(levels) - 1, 0.8413), left))


def starts_aligned(e: Array, f: Array, mean: float, spread: float, sd: Array, noise: LocalLevel) -> Array:
    """Return the best linear estimate of the starts a (terms,) from the rows e (n,) in which a unit is aligned.

    f (n, terms) is the response to a start of 1, mean and spread the level's prior, sd (terms,) that of the starts.
    """
    H = np.concatenate([np.ones((len(e), 1)), f], axis=1)
    # a level of which nothing is known: wide beside anything that is seen
    wide = spread if np.isfinite(spread) else 1e3 * float(np.max(np.abs(e)) + np.max(sd) + 1e-300)
    P = np.diag(np.concatenate([[wide], sd]) ** 2)
    S = H @ P @ H.T + noise.covariance(len(e))
    return np.asarray((P @ H.T @ np.linalg.solve(S, e - mean))[1:])
