"""Many units of one config: they share every gain, and go through the samples side by side.

P and K of a time-invariant model depend on neither the data nor the unit. What is left for each unit are the states,
and the units' states are as many lanes of the same arithmetic. U units, T samples, n states, m components.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from fusion_core.chunk import Array
from fusion_core.fast.steady import Gains, Invariant, invariant
from fusion_core.model import State, Transition

SLAB = 2048  # units in work at once: their states stay in the cache


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


def run_fleet(
    state: State, transition: Transition, H: Array, R: Array, z: Array, *, u: Array | None = None, every: int = 32
) -> FleetEstimates:
    """Run the same time-invariant filter over the samples of many units.

    Units are the last axis. No sample is refused: a unit that moves is to be run alone
    (`fusion_core.kalman.estimate`).

    Parameters
    ----------
    state : State
        Before the first step; x is (n,) or (n, U).
    transition : Transition
        F and Q (n, n); its u (n,) is a drift that all units share.
    H, R : (m, n) and (m, m) arrays
        R diagonal.
    z : (T, m, U) array
        Measurements.
    u : (T, n, U) array, optional
        Known drift of each unit's steps, in place of the shared one.
    every : int
        L; T must be a multiple of it.

    Raises
    ------
    ValueError
        If the model is not time-invariant, R is not diagonal, z is empty, or T is no multiple of `every`.
    """
    from fusion_core.fast.loop import fleet

    T, _, U = z.shape
    if not transition.invariant:
        raise ValueError("a fleet shares its gains: F and Q must be the same for every step")
    if np.any(np.diag(np.diag(R)) != R):
        raise ValueError("a fleet needs a diagonal R: multiply z and H by the inverse of R's Cholesky factor first")
    if T == 0 or U == 0:
        raise ValueError(f"z has {T} samples of {U} units, at least one of each was expected")
    if T % every:
        raise ValueError(f"{T} samples are no multiple of every = {every}; leave the rest for the next call")
    model = invariant(transition.F, transition.Q, H, np.diag(R), state.P)
    n, groups = len(transition.F), model.groups
    P = groups.blocks(groups.arranged(state.P, states=(0, 1)))
    x = np.broadcast_to(state.x if state.x.ndim == 2 else state.x[:, None], (n, U))
    shared = groups.arranged(transition.u if u is None else np.zeros(n), states=(0,))
    threads = min(os.cpu_count() or 1, len(groups.states))
    found = []
    with ThreadPoolExecutor(threads) as pool:
        for units in (slice(first, first + SLAB) for first in range(0, U, SLAB)):
            now = groups.arranged(x[:, units], states=(0,)).copy()
            given = groups.arranged(z[:, :, units], components=(1,))
            own = groups.arranged(u[:, :, units], states=(1,)) if u is not None else np.empty((0, len(now), 0))
            out = np.empty((T // every, *now.shape))
            for start, stop, gains in _stretches(model, P, T, every):
                steps = (*groups.size, now, model.F, model.H, gains.kinds, gains.K, shared, own[start:stop])
                rest = (given[start:stop], threads, every, out[start // every : stop // every])
                list(pool.map(partial(fleet, *steps, *rest), range(threads)))
            found.append(out)
    sigma = np.empty((T // every, groups.states.size))
    for start, stop, gains in _stretches(model, P, T, every):
        deviations = gains.sigma()
        sigma[start // every : stop // every] = deviations if len(deviations) == 1 else deviations[every - 1 :: every]
        last = gains.last
    states = np.concatenate(found, axis=2) if len(found) > 1 else found[0]
    if not groups.ordered:
        states, sigma = states[:, groups.places[0]], sigma[:, groups.places[0]]
    return FleetEstimates(states, sigma, groups.whole(last))


def _stretches(model: Invariant, P: Array, T: int, every: int) -> Iterator[tuple[int, int, Gains]]:
    """Yield from and to which sample which gains hold; covariances P (G, s, s) are those before the first."""
    start = 0
    while start < T:
        gains, length = model.ahead(P, T - start, every)
        yield start, start + length, gains
        start, P = start + length, gains.last
