"""Repeatability of a unit: the difference of warming and cooling, and of one soak and another.

Between warming and cooling: the rows are a curve of the family's basis and, by the way the temperature last went by
more than PLAY, half of a difference of three shapes, by least squares (a walk that is estimated beside a loop takes the
loop for its own). Between soaks: the curves of the soaks, each without its level, which is another with every turn-
on. Both are the rms over temperature, beside the rms expected of white noise and walk. A linear estimate H y of rows
with white noise of the density s and a walk of the density k has the covariance::

    s^2 H diag(1 / span) H' + k^2 G diag(dt) G',    G_ij = sum of H_il over l >= j

d axes, R rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftlab.family.basis import SplineBasis
from driftlab.family.record import Figure
from driftlab.family.unit_noise import densities_of
from driftlab.soak.blocks import SoakRows
from fusion_core.chunk import Array
from fusion_core.recursions import play

PLAY = 2.0  # K
SHAPES = 3  # of the difference between warming and cooling: level, slope and curvature over temperature
EACH_WAY = 0.2  # of the rows that must warm, and cool
COMMON = 0.3  # of their range, that two soaks must have in common
CUT = 1e-6  # of the largest singular value


def hysteresis_of(recordings: Sequence[SoakRows], white: Array, walk: Array, step: float) -> Figure:
    """Return the difference (d,) between warming and cooling, rms, and that expected of noise; None if one way.

    `white` and `walk` (d,) are densities, SI/sqrt(Hz) and SI/sqrt(s); knots are `step` K apart.
    """
    d = recordings[0].bias.shape[1]
    ways = [_way(rows.T) for rows in recordings]
    warms = float(np.mean(np.concatenate(ways) > 0))
    if not EACH_WAY <= warms <= 1 - EACH_WAY:
        return Figure(value=(None,) * d, sigma=(None,) * d)
    T = np.concatenate([rows.T for rows in recordings])
    knots = SplineBasis.over(T, step)
    u = (2 * T - T.min() - T.max()) / max(float(np.ptp(T)), 1e-9)
    half = 0.5 * np.concatenate(ways)[:, None] * np.polynomial.legendre.legvander(u, SHAPES - 1)
    which = np.repeat(np.arange(len(recordings)), [len(rows.T) for rows in recordings])
    levels = np.eye(len(recordings))[which][:, 1:]
    H = np.linalg.pinv(np.hstack([half, levels, knots.values(T)]), rcond=CUT)[:SHAPES]
    size = np.sqrt(1 / (2 * np.arange(SHAPES) + 1))[:, None]  # rms of a Legendre polynomial
    value = np.sqrt(np.sum((size * H @ np.concatenate([rows.bias for rows in recordings])) ** 2, axis=0))
    sigma = np.sqrt(_covariance(size * H, recordings, white, walk))
    return Figure.of(value, sigma)


def soaks_of(recordings: Sequence[SoakRows], step: float) -> Figure:
    """Return the largest difference (d,), rms, of the curves of a unit's first and any further soak; None of one soak.

    The noise is that of each soak on its own: of two units under one name a joint one would be a wide walk. The walk is
    the likely one: a short soak that does not show any does not exclude one.
    """
    d = recordings[0].bias.shape[1]
    nothing = Figure(value=(None,) * d, sigma=(None,) * d)
    if len(recordings) == 1:
        return nothing
    noise, differences = [densities_of([rows], step) for rows in recordings], []
    for other in range(1, len(recordings)):
        both = (0, other)
        low = max(float(recordings[k].T.min()) for k in both)
        high = min(float(recordings[k].T.max()) for k in both)
        if high - low < COMMON * max(float(np.ptp(recordings[k].T)) for k in both):
            continue
        at = np.linspace(low, high, 25)
        H = {k: _curve(recordings[k], at, step) for k in both}
        apart = H[0] @ recordings[0].bias - H[other] @ recordings[other].bias
        parts = ((H[k] / np.sqrt(len(at)), recordings[k], noise[k]) for k in both)
        variance = [_covariance(own, [rows], known.white, known.likely) for own, rows, known in parts]
        differences.append((np.sqrt(np.mean(apart**2, axis=0)), np.sqrt(variance[0] + variance[1])))
    if not differences:
        return nothing
    value, sigma = (np.array(part) for part in zip(*differences, strict=True))
    largest = np.argmax(value / sigma, axis=0), np.arange(d)
    return Figure.of(value[largest], sigma[largest])


def _curve(rows: SoakRows, at: Array, step: float) -> Array:
    """Return the matrix (25, R) that makes of rows their curve at temperatures `at`, less its mean."""
    knots = SplineBasis.over(rows.T, 2 * step)
    H = knots.values(at) @ np.linalg.pinv(knots.values(rows.T), rcond=CUT)
    return np.asarray(H - H.mean(axis=0))


def _way(T: Array) -> Array:
    """Return the way (R,) that the temperature last went by more than PLAY: from -1 to 1, as a play operator has it."""
    return np.asarray((T - play(np.ascontiguousarray(T), PLAY, float(T[0]))) / (PLAY / 2))


def _covariance(H: Array, recordings: Sequence[SoakRows], white: Array, walk: Array) -> Array:
    """Return the sum (d,) of the variances of the estimates H (k, R) y."""
    total, at = np.zeros(len(white)), 0
    for rows in recordings:
        own = H[:, at : at + len(rows.t)]
        G = np.cumsum(own[:, ::-1], axis=1)[:, ::-1]
        steps = np.diff(rows.t, prepend=rows.t[0])
        total += white**2 * np.sum(own**2 / rows.span) + walk**2 * np.sum(G**2 * steps)
        at += len(rows.t)
    return total
