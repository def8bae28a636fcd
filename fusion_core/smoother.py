"""Fixed-interval smoothing: the states given all measurements, past and future.

In the form of Bryson and Frazier (G. J. Bierman, Automatica 9 (1973) 503), one component after the other. It returns
what the Rauch-Tung-Striebel smoother returns, but needs no inverse of the predicted covariance, which is singular where
a state is known exactly. From the last sample to the first, with B = I - K h of each component::

    x_k|N = x_k - P_k lam,            P_k|N = P_k - P_k Lam P_k
    lam <- B' lam - h' y / S,         Lam <- B' Lam B + h' h / S
    lam <- F' lam,                    Lam <- F' Lam F
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_core.checks import checked_measurement, checked_reset, checked_state, checked_transition, flags
from fusion_core.chunk import Array, Flags
from fusion_core.fast import compiled, inlined
from fusion_core.model import Estimates, Measurement, State, Transition

Size = tuple[float, ...]

BLOCK = 16_384  # samples whose gains are held at once


def smooth(
    state: State,
    transition: Transition,
    measurement: Measurement,
    estimates: Estimates,
    *,
    reset: Flags | None = None,
) -> tuple[Array, Array]:
    """Return the smoothed x (N, n) and its deviations sigma (N, n).

    Parameters
    ----------
    state, transition, measurement, reset
        What `fusion_core.kalman.estimate` was given.
    estimates : Estimates
        What it returned: the smoother leaves out what the gate refused.
    """
    return Smoother(len(state.x), reset=reset).back(state, transition, measurement, estimates.used)


class Smoother:
    """A recording smoothed stretch by stretch, the last one first: memory for one stretch, whatever their number.

    Parameters
    ----------
    n : int
        States.
    reset : (n,) array of bool
        As `fusion_core.kalman.estimate` was given it.

    Attributes
    ----------
    lam, Lam : (n,) and (n, n) arrays
        What the measurements after the stretch say: the gradient and curvature of their likelihood.
    """

    def __init__(self, n: int, *, reset: Flags | None = None) -> None:
        self.reset = checked_reset(reset, n)
        self.lam, self.Lam = np.zeros(n), np.zeros((n, n))

    def back(self, state: State, transition: Transition, measurement: Measurement, used: Flags) -> tuple[Array, Array]:
        """Return x and sigma (N, n) of the stretch before the one that was smoothed last.

        Parameters
        ----------
        state : State
            Before the first step of the stretch.
        transition, measurement
            Those of the stretch.
        used : (N,) array of bool
            `Estimates.used` of the stretch.
        """
        from fusion_core.kalman import estimate

        begins = [checked_state(state)]
        n = len(begins[0].x)
        given = checked_measurement(measurement, n)
        N = len(given.z)
        given = replace(given, used=given.used & flags("used", used, (N,), "of the estimates")[:, None])
        steps = checked_transition(transition, n, N)
        x, sigma = np.empty((N, n)), np.empty((N, n))
        blocks = [slice(k, k + BLOCK) for k in range(0, N, BLOCK)]
        for rows in blocks[:-1]:
            begins.append(estimate(begins[-1], steps.part(rows), given.part(rows), reset=self.reset).state)
        for rows, begin in zip(reversed(blocks), reversed(begins[: len(blocks)]), strict=True):
            self._block(begin, steps.part(rows), given.part(rows), SmoothedArrays(x[rows], sigma[rows]))
        return x, sigma

    def _block(self, begin: State, transition: Transition, measurement: Measurement, out: SmoothedArrays) -> None:
        """Filter a block again, now with the gains kept, and go back through it."""
        from fusion_core.fast.groups import find_groups
        from fusion_core.fast.job import Job, whitened
        from fusion_core.fast.loop import Data

        model, z, _ = whitened(transition, measurement)
        groups = find_groups(model.F, model.Q, model.H, np.abs(begin.P) + np.abs(self.Lam))
        data = Data(z, measurement.used, np.full(z.shape[1] + 1, np.inf), self.reset)
        job = Job(begin, model, groups, data, keep_P=True, keep_K=True)
        job.recursive(0, len(z))
        places, run, states = job.places, job.results, groups.states
        lam, Lam = np.append(self.lam, 0.0)[states], groups.blocks(self.Lam, states, states)
        backward(
            places.s, Passed(
                places.states, places.rows, self.reset, run.used, model.F, model.H, run.x, run.white, run.P,
                run.K, run.root,
            ), lam, Lam, out,
        )  # fmt: skip
        wide = np.empty(groups.n + 1)
        wide[states] = lam
        self.lam, self.Lam = wide[:-1], groups.whole(Lam)


class Passed(NamedTuple):
    """The filter's results of N samples, G groups of s states and c components; K is N, or 1 for F and H."""

    states: NDArray[np.uint64]  # (G, s) places of the states, n where filled up
    rows: NDArray[np.uint64]  # (G, c)
    reset: Flags  # (n,)
    used: Flags  # (N,)
    F: Array  # (K, n, n)
    H: Array  # (K, m, n)
    x: Array  # (N, n)
    white: Array  # (N, m)
    P: Array  # (N, G, s, s)
    K: Array  # (N, G, c, s)
    root: Array  # (N, G, c)


class SmoothedArrays(NamedTuple):
    """The results of each sample."""

    x: Array  # (N, n)
    sigma: Array  # (N, n)


@inlined
def uncorrect(s: Size, lam: Array, Lam: Array, h: Array, K: Array, y_S: float, inverse: float, w: Array) -> None:
    """Do lam <- B' lam - h' y / S and Lam <- B' Lam B + h' h / S in place, with B = I - K h; w (s,) is scratch."""
    gain, curve = y_S, inverse
    for i in range(len(s)):
        gain += K[i] * lam[i]
        total = 0.0
        for j in range(len(s)):
            total += Lam[i, j] * K[j]
        w[i] = total
        curve += K[i] * total
    for i in range(len(s)):
        lam[i] -= h[i] * gain
        for j in range(len(s)):
            Lam[i, j] += h[i] * curve * h[j] - h[i] * w[j] - w[i] * h[j]


@inlined
def unpredict(s: Size, lam: Array, Lam: Array, F: Array, A: Array, w: Array) -> None:
    """Do lam <- F' lam and Lam <- F' Lam F in place; A (s, s) and w (s,) are scratch."""
    for j in range(len(s)):
        w[j] = lam[j]
        for i in range(len(s)):
            total = 0.0
            for q in range(len(s)):
                total += Lam[i, q] * F[q, j]
            A[i, j] = total
    for j in range(len(s)):
        total = 0.0
        for i in range(len(s)):
            total += F[i, j] * w[i]
        lam[j] = total
        for q in range(j, len(s)):
            total = 0.0
            for i in range(len(s)):
                total += F[i, j] * A[i, q]
            Lam[j, q] = Lam[q, j] = total


@inlined
def smoothed(s: Size, i: int, x: float, P: Array, lam: Array, Lam: Array) -> tuple[float, float]:
    """Return state i, x before it is smoothed, as x - P lam, and its variance in P - P Lam P."""
    variance = P[i, i]
    for j in range(len(s)):
        x -= P[i, j] * lam[j]
        total = 0.0
        for q in range(len(s)):
            total += Lam[j, q] * P[q, i]
        variance -= P[i, j] * total
    return x, variance


@compiled
def backward(s: Size, passed: Passed, lam: Array, Lam: Array, out: SmoothedArrays) -> None:
    """Go from the last sample to the first; lam (G, s) and Lam (G, s, s) are changed in place."""
    G, c = passed.rows.shape
    n, m = np.uint64(passed.F.shape[1]), np.uint64(passed.H.shape[1])
    h, w, F, A = np.zeros(len(s)), np.zeros(len(s)), np.zeros((len(s), len(s))), np.zeros((len(s), len(s)))
    for back in range(len(passed.x)):
        k = len(passed.x) - 1 - back
        k_F, k_H = min(k, len(passed.F) - 1), min(k, len(passed.H) - 1)
        for g in range(G):
            for i in range(len(s)):
                at = passed.states[g, i]
                keep = at < n and (passed.used[k] or not passed.reset[at])  # else it starts again, whatever was before
                for j in range(len(s)):
                    before = passed.states[g, j]
                    F[i, j] = passed.F[k_F, at, before] if keep and before < n else 0.0
                if at < n:
                    x, variance = smoothed(s, i, passed.x[k, at], passed.P[k, g], lam[g], Lam[g])
                    out.x[k, at], out.sigma[k, at] = x, np.sqrt(max(variance, 0.0))
            if passed.used[k]:
                for b in range(c):
                    row, root = passed.rows[g, c - 1 - b], passed.root[k, g, c - 1 - b]
                    if row == m or root == 0.0:
                        continue
                    for j in range(len(s)):
                        before = passed.states[g, j]
                        h[j] = passed.H[k_H, row, before] if before < n else 0.0
                    y_S = passed.white[k, row] * root
                    uncorrect(s, lam[g], Lam[g], h, passed.K[k, g, c - 1 - b], y_S, root * root, w)
            unpredict(s, lam[g], Lam[g], F, A, w)
