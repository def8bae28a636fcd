"""Residual of a map in averages of its soak, and the limits of the root of its mean square.

The residual of another such soak of the unit in the mean follows from `fusion_core.wandering`: P is the map's residual
operator on noise, and E = trace of the covariance of the residual / n. A map that chooses its stiffness by the samples
may be stiffer next time, and leave more: its E is that of a cubic, and the wandering is inferred from the residual of a
curve of order 24. A misfit and a hysteresis are in the residual too, and taken for wandering. N samples, n averages, d
axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.soak.blocks import means, runs
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.thermal.soak_noise import summed
from fusion_core.wandering import BiasMeans, WalkContrasts, bounds, contrasts, mean_squares, rows_of

AVERAGED = 30.0  # s: as the reference of every table of errors
MAX_ROWS = 120  # rows whose covariance is written down
STIFF, FREE = 3, 24  # orders between which a map is that chooses its stiffness
CHOSEN = 1e-6  # the answer of a map that chooses is no projection
MIN_ROWS = 40  # with fewer nothing is inferred of the wandering


@dataclass(frozen=True, eq=False)
class Residual:
    """The rms (d,) of what a map leaves of averages, between `low` and `high` (d,) by 95 % on either side."""

    rms: Array
    low: Array
    high: Array

    def as_record(self, lasted: float) -> dict[str, object]:
        """Return the fields of a map's record; the samples lasted so many s."""
        bounds = tuple(zip(self.low.tolist(), self.high.tolist(), strict=True))
        fields = {"averaged_residual": tuple(self.rms.tolist()), "averaged_over": AVERAGED, "lasted": lasted}
        return {**fields, "averaged_bounds": bounds if np.all(np.isfinite(self.high)) else None}


def residual_of(
    fitted: FittedMap, settings: ThermalMap, T: Array, bias: Array, starts: Sequence[int], interval: float
) -> Residual:
    """Return the residual of a map on samples T (N,) and bias (N, d), in the order of time, `interval` s apart.

    Each recording begins at one of `starts`; at most a whole one is averaged, where it is shorter than AVERAGED.
    """
    cuts = runs(starts, len(T), max(1, round(AVERAGED / interval)))
    T, left = means(T, cuts), means(bias - fitted.bias(T), cuts)
    rms = np.sqrt(np.mean(left**2, axis=0))
    rows, joined = rows_of(np.arange(0, AVERAGED * len(T), AVERAGED, dtype=np.float64), left, MAX_ROWS)
    if len(joined) < MIN_ROWS or np.ptp(T) == 0:
        return Residual(rms, np.zeros_like(rms), np.full_like(rms, np.inf))
    row = np.minimum(np.arange(len(T)) // rows.size, len(joined) - 1)
    blocks, smoother = summed(T, left, row), settings.smoother(T, left + fitted.bias(T))
    squares, taken = [], np.empty(0)
    one = np.eye(len(joined))
    chosen: tuple[list[WalkContrasts], Array] | None = None  # of a map that chooses, alike for all axes
    for axis, r in enumerate(joined.T):
        answer = smoother(blocks, blocks.T, axis)
        if not np.array_equal(answer, taken):
            taken = answer
            if np.allclose(answer @ answer, answer, atol=CHOSEN):
                each, P = contrasts(rows, one - answer), one - answer
            else:
                chosen = chosen or _of_polynomials(rows, blocks.T)
                each, P = chosen
            wanted = mean_squares(rows, P)
        squares.append(bounds(rows, each, r, float(rows.within[axis]), wanted))
    low, high = np.sqrt(np.array(squares)).T
    return Residual(rms, np.minimum(low, rms), np.maximum(high, rms))


def _of_polynomials(rows: BiasMeans, T: Array) -> tuple[list[WalkContrasts], Array]:
    """Return the contrasts of rows at T (K,) beside a polynomial of the order FREE, and what one of STIFF leaves."""
    low, high = float(T.min()), float(T.max())
    V = np.linalg.qr(np.polynomial.chebyshev.chebvander((2 * T - low - high) / (high - low), FREE), mode="complete")[0]
    free, stiff = V[:, FREE + 1 :], V[:, STIFF + 1 :]
    return contrasts(rows, free @ free.T, free), stiff @ stiff.T
