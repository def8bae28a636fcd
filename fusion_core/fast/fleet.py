"""Many units of one time-invariant model: the gains are worked out once, and the units' states are lanes.

P and K depend on neither the data nor the unit, so what is left of a unit is x. U units, T samples, n states, m
components.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from fusion_core.boundary import checked_state, checked_transition
from fusion_core.chunk import Array
from fusion_core.fast.fleet_loop import SLAB, Counts, Data, Found, Known, Sizes, fleet
from fusion_core.fast.steady import Gains, Invariant, invariant
from fusion_core.model import State, Transition

STEPS = 4  # that go through the registers together
FEW = 64  # units, for which it does not pay to begin a thread


@dataclass(frozen=True)
class FleetEstimates:
    """What the filter gives back for U units.

    Attributes
    ----------
    x : (T // every, n, U) array
        States after each so many samples.
    sigma : (T // every, n) array
        Their deviations, which are the same for every unit.
    P : (n, n) array
        Covariance after the last sample.
    last : (n, U) array
        States after the last sample.
    refused : (U,) array of int
        The first sample whose nis is beyond the gate or is no number; T where there is none.
    """

    x: Array
    sigma: Array
    P: Array
    last: Array
    refused: Counts


def run_fleet(
    state: State, transition: Transition, H: Array, R: Array, z: Array, *,
    u: Array | None = None, gate: float = np.inf, every: int = 32, threads: int | None = None,
) -> FleetEstimates:  # fmt: skip
    """Run the same time-invariant filter over the samples of many units.

    Every sample is used. A unit of which one is `refused` has another covariance from there on, and is to be run alone
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
    gate : float
        The nis beyond which a sample is refused.
    every : int
        After how many samples the states are written down.
    threads : int, optional
        As many as there are cores, if not given.

    Returns
    -------
    FleetEstimates

    Raises
    ------
    ValueError
        If an array has another shape than is said here, the model varies, P, Q or R is no covariance, or R is not
        diagonal.
    """
    z = np.ascontiguousarray(z, dtype=np.float64)
    T, n, U = _shape(transition, H, R, z, every)
    x = np.asarray(state.x, dtype=np.float64)
    if x.shape not in ((n,), (n, U)) or (u is not None and u.shape != (T, n, U)):
        own = "" if u is None else f" and u {u.shape}"
        raise ValueError(f"run_fleet: x is {x.shape}{own}, ({n},) or ({n}, {U}) and ({T}, {n}, {U}) were expected")
    P = checked_state(State(np.zeros(n), state.P)).P
    shared = np.zeros(n) if u is not None else transition.u
    steps = checked_transition(Transition(transition.F, transition.Q, shared), n, T)
    model = invariant(steps.F, steps.Q, np.asarray(H, dtype=np.float64), np.diag(R), P)
    units = _Units(model, np.broadcast_to(x.reshape(n, -1), (n, U)), steps.u, z, u, gate, every)
    return units.run(P, min(threads or os.cpu_count() or 1, -(-U // FEW)))


def _shape(transition: Transition, H: Array, R: Array, z: Array, every: int) -> tuple[int, int, int]:
    """Return T, n and U."""
    n, m = len(transition.F), len(R)
    if not transition.invariant or np.ndim(transition.u) != 1:
        raise ValueError("run_fleet: units share their gains, F, Q and u the same for every step were expected")
    if np.shape(R) != (m, m) or np.any(np.diag(np.diag(R)) != R) or not np.all(np.diag(R) > 0):
        raise ValueError(
            "run_fleet: R is not diagonal and positive; multiply z and H by the inverse of its Cholesky factor first"
        )
    if z.ndim != 3 or z.shape[1] != m or z.size == 0 or np.shape(H) != (m, n):
        raise ValueError(f"run_fleet: z is {z.shape} and H {np.shape(H)}, (T, {m}, U) and ({m}, {n}) were expected")
    if every < 1:
        raise ValueError(f"run_fleet: every is {every}, 1 or more was expected")
    return len(z), n, z.shape[2]


class _Units:
    """U units in progress, in slabs: what was measured, their states, and what was found so far."""

    def __init__(
        self, model: Invariant, x: Array, shared: Array, z: Array, u: Array | None, gate: float, every: int
    ) -> None:
        self.model, self.groups = model, model.groups
        (T, _, self.U), (s, c, _), even = z.shape, self.groups.size, self.groups.even
        wide = self.groups.n + (not even)
        own = np.empty((0, wide, self.U)) if u is None else np.ascontiguousarray(u, dtype=np.float64)
        if not even:  # where a place is filled up, nothing is measured and nothing drifts
            z = np.pad(z, ((0, 0), (0, 1), (0, 0)))
            own = own if u is None else np.pad(own, ((0, 0), (0, 1), (0, 0)))
        self.data = Data(z, own, self.groups.rows, self.groups.states, float(gate))
        self.found = Found(np.empty((T // every, wide, self.U)), np.full(self.U, T), every)
        self.shared = np.append(shared, 0.0)[self.groups.states]
        self.x = np.append(x, np.zeros((1, self.U)), axis=0)[self.groups.states]  # (G, s, U)
        # an own drift is one more array of each state in the loop, too many for several steps at once
        steps = 1 if u is not None else STEPS
        self.sizes = Sizes.of(s, c, steps, own=u is not None), Sizes.of(s, c, 1, own=u is not None)

    def run(self, P: Array, threads: int) -> FleetEstimates:
        """Run all units over all samples, from the covariance P (n, n) on."""
        groups, (T, every) = self.groups, (len(self.data.z), self.found.every)
        blocks, sigma = groups.blocks(P, groups.states, groups.states), np.empty((T // every, groups.n))
        count = max(threads, -(-self.U // SLAB))
        slabs = [(self.U * k // count, self.U * (k + 1) // count) for k in range(count)]
        with ThreadPoolExecutor(threads) as pool:
            for start, stop, gains in _stretches(self.model, blocks, T):
                work = partial(self._advance, self._known(gains), start, stop)
                list(pool.map(work, slabs) if threads > 1 else map(work, slabs))
                ends = np.arange(start + every - start % every, stop + 1, every)  # samples done by then
                deviations = gains.sigma(groups)
                sigma[ends // every - 1] = deviations if len(deviations) == 1 else deviations[ends - start - 1]
                blocks = gains.last
        last = np.empty((groups.n + 1, self.U))
        last[groups.states] = self.x
        return FleetEstimates(
            self.found.x[:, : groups.n], sigma, groups.whole(blocks), last[: groups.n], self.found.refused
        )

    def _known(self, gains: Gains) -> Known:
        """Return model and gains group by group; a component that is filled up tells nothing."""
        root = np.where(self.groups.rows < self.groups.m, gains.root[:, gains.kind], 0.0)
        return Known(self.model.F, self.model.H, self.shared, np.ascontiguousarray(gains.K[:, gains.kind]), root)

    def _advance(self, known: Known, start: int, stop: int, slab: tuple[int, int]) -> None:
        """Run a slab from start to stop."""
        G, s, W = len(known.F), known.F.shape[1], slab[1] - slab[0]
        x = np.zeros((G, s, SLAB))
        x[:, :, :W] = self.x[:, :, slab[0] : slab[1]]
        fleet(*self.sizes, known, self.data, start, stop, slab, x.reshape(G, s * SLAB), self.found)
        self.x[:, :, slab[0] : slab[1]] = x[:, :, :W]


def _stretches(model: Invariant, P: Array, T: int) -> Iterator[tuple[int, int, Gains]]:
    """Yield from and to which sample which gains hold; covariances P (G, s, s) are those before the first."""
    start = 0
    while start < T:
        gains, length = model.ahead(P, T - start)
        yield start, start + length, gains
        start, P = start + length, gains.last
