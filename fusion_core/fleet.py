"""Many units of one config: they share every gain, so that many steps of all units are one matrix product.

P and K of a time-invariant model depend on neither the data nor the unit. With the closed-loop transition
A_k = (I - K_k H) F, L steps of one unit are::

    x_{k+L} = A_{k+L} .. A_{k+1} x_k + sum_j A_{k+L} .. A_{k+j+1} (K_{k+j} z_{k+j} + (I - K_{k+j} H) u_{k+j})

The sum over j is one product of what the unit measured over L steps with a matrix that all units share. While the
covariance still moves, that matrix is made anew for each L steps, from the covariance recursion; then it stays.
U units, T samples, n states, m components.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Transition
from fusion_core.model import State
from fusion_core.steady import SETTLED

SLAB = 250  # units that one thread has in work at once


@dataclass(frozen=True)
class FleetEstimates:
    """States of U units after every L-th of T samples.

    Attributes
    ----------
    x : (T / L, n, U) array
    sigma : (T / L, n) array
        The same for every unit.
    P : (n, n) array
        After the last sample.
    """

    x: Array
    sigma: Array
    P: Array


@dataclass(frozen=True)
class _Lift:
    """L steps as one: x after = A x before + B inputs + c, and P after them."""

    A: Array  # (n, n)
    B: Array  # (n, L i), i = m, or m + n where every unit has its own drift
    c: Array  # (n, 1)
    P: Array


def run_fleet(
    state: State, transition: Transition, H: Array, R: Array, z: Array, *, u: Array | None = None, every: int = 32
) -> FleetEstimates:
    """Run the same time-invariant filter over the samples of many units.

    Units are the last axis, so that the samples of L steps are a matrix as they are. No sample is refused: a unit
    that moves is to be run alone (`fusion_core.filter.estimate`).

    Parameters
    ----------
    state : State
        Before the first step; x is (n,) or (n, U).
    transition : Transition
        F and Q (n, n); its u (n,) is a drift that all units share.
    H, R : (m, n) and (m, m) arrays
    z : (T, m, U) array
        Measurements.
    u : (T, n, U) array, optional
        Known drift of each unit's steps, in place of the shared one.
    every : int
        L; T must be a multiple of it.

    Raises
    ------
    ValueError
        If the model is not time-invariant, or T is no multiple of `every`.
    """
    T, _, U = z.shape
    if not transition.invariant:
        raise ValueError("a fleet shares its gains: F and Q must be the same for every step")
    if T % every:
        raise ValueError(f"{T} samples are no multiple of every = {every}; leave the rest for the next call")
    n, blocks = len(transition.F), T // every
    lifts = _lifts(state.P, transition, H, R, every, blocks, own_drift=u is not None)
    inputs = (z if u is None else np.concatenate([z, u], axis=1)).reshape(blocks, -1, U)
    start = np.broadcast_to(state.x if state.x.ndim == 2 else state.x[:, None], (n, U))
    out = np.empty((blocks, n, U))

    def work(first: int) -> None:
        units = slice(first, first + SLAB)
        x = start[:, units]
        for k in range(blocks):
            lift = lifts[min(k, len(lifts) - 1)]
            x = lift.A @ x + lift.B @ inputs[k, :, units] + lift.c
            out[k, :, units] = x

    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    # one thread a slab of units: BLAS's own threads would wait for one another at every block
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(work, range(0, U, SLAB)))
    P = np.array([lifts[min(k, len(lifts) - 1)].P for k in range(blocks)])
    return FleetEstimates(out, np.sqrt(np.diagonal(P, axis1=1, axis2=2)), P[-1])


def _lifts(
    P: Array, transition: Transition, H: Array, R: Array, every: int, blocks: int, *, own_drift: bool
) -> list[_Lift]:
    """Return the lift of each block, up to the first that starts from a settled covariance: it stays."""
    lifts = [_lift(P, transition, H, R, every, own_drift)]
    while len(lifts) < blocks:
        scale = np.sqrt(np.diag(lifts[-1].P))
        settled = np.all(np.abs(lifts[-1].P - P) <= 0.1 * SETTLED * np.outer(scale, scale))
        P = lifts[-1].P
        lifts.append(_lift(P, transition, H, R, every, own_drift))
        if settled:
            break
    return lifts


def _lift(P: Array, transition: Transition, H: Array, R: Array, L: int, own_drift: bool) -> _Lift:
    """Return L steps from covariance P as one."""
    F, Q = transition.F, transition.Q
    one, steps = np.eye(len(F)), []
    for _ in range(L):
        P = F @ P @ F.T + Q
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        B = one - K @ H
        P = B @ P @ B.T + K @ R @ K.T
        P = (P + P.T) / 2
        steps.append((K, B))
    after, parts, c = one, [], np.zeros(len(F))
    for K, B in reversed(steps):
        parts.append(after @ (np.hstack([K, B]) if own_drift else K))
        c = c if own_drift else c + after @ (B @ transition.u)
        after = after @ (B @ F)
    return _Lift(after, np.hstack(parts[::-1]), c[:, None], P)
