"""The zero-velocity (ZUPT) model: what an inertial unit at rest tells about its biases.

Attitude and velocity are frozen at the alignment. What the unit's own integration then shows as motion is error
(Fontanella et al. 2018, sec. 2.1)::

    attitude error  psi_k = psi_{k-1} + tau (omega_k - omega_ie) - int b_g        (rad)
    velocity error  v_k   = v_{k-1}   + tau (f_k - f_ref)        - int b_a        (m/s)
    measured        0 = psi_k + r_psi,     0 = v_k + r_v

in the axes of the unit as they were frozen: since the reference attitude is known, specific force is resolved through
it and not through the drifting one, so that no small-angle limit holds and the triads do not mix. The integrals of
the biases over the tau seconds that were integrated, with rho = tau / dt and the block's x_k = F x_{k-1} + u + w::

    int b = tau C (rho/2 x_{k-1} + (1 - rho/2) x_k + rho/2 u),     left out: tau^2 (rho/3 - rho^2/4) C Q C'

which is exact for a random walk, gaps included. The known drift u leads from the mean of one epoch to that of the
next, as the channels are means that it is made of: it counts in full, and x_k has the known part of the epoch's middle.
States: velocity error, attitude error (3 each), then the blocks of the accelerometer and gyro bias models: 12 for two
random walks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array, Chunk, constant
from fusion_core.contracts import Alignment, Measurement, Sensor, Transition
from fusion_core.fast import compiled
from fusion_core.statespace import StateSpace


@compiled
def _turned(tau: Array, values: Array, given: Array, drift: Array, integral: Array) -> None:
    """Write tau (values - given - drift) into integral (N, d): with NumPy rows of three are ten times as slow."""
    for k in range(len(values)):
        k_u = min(k, len(drift) - 1)
        for j in range(values.shape[1]):
            integral[k, j] = tau[k] * (values[k, j] - given[j] - drift[k_u, j])


@dataclass(frozen=True)
class Triad:
    """One triad of sensors: the integral of its error, and the model of its bias."""

    sensor: Sensor
    integral: str  # what the integral is called
    unit: str  # of the integral
    shake: Array  # (d,) deviation of the frozen reference


class ZeroVelocity:
    """The equations of the triads: integrals first, then the bias blocks, in the same order."""

    def __init__(self, triads: Sequence[Triad], space: StateSpace) -> None:
        self.triads, self.space = triads, space
        self.m = sum(len(t.sensor.axes) for t in triads)
        self._H, self._R = np.eye(self.m, space.n), np.diag(np.concatenate([t.shake**2 for t in triads]))
        self._still: Measurement | None = None  # the last of `measurement`
        self._kept: tuple[tuple[bytes, ...], tuple[Array, Array]] | None = None  # the last F and Q that did not vary

    def measurement(self, N: int) -> Measurement:
        """Zero motion, N times."""
        still = self._still
        if still is None or len(still.z) != N:
            self._still = still = Measurement(np.zeros((N, self.m)), self._H, self._R, np.ones(N, dtype=bool))
        return still

    def transition(self, chunk: Chunk, steps: Sequence[Transition], alignment: Alignment) -> Transition:
        """Put the bias models' steps and the integrals of the epochs together."""
        dt, lasting = chunk.dt, chunk["tau"]
        tau = constant(lasting)
        if dt.ndim == tau.ndim == 0 and all(step.invariant for step in steps):  # nearly always, and then the same
            arrays = [dt, tau, *[a for step in steps for a in (step.F, step.Q, step.C) if a is not None]]
            key = tuple([a.tobytes() for a in arrays])
            if self._kept is None or self._kept[0] != key:
                self._kept = key, self._matrices(dt, tau, steps)
            F, Q = self._kept[1]
        else:
            F, Q = self._matrices(dt, tau, steps)
        u, places = np.empty((len(lasting), self.space.n)), self.space.places
        for triad, step in zip(self.triads, steps, strict=True):
            values, given = chunk[triad.sensor.channel], alignment.inputs[triad.sensor.channel]
            integral, drift = u[:, places[triad.integral]], u[:, places[triad.sensor.block.name]]
            drift[:] = step.u
            if step.C is not None:
                drift = np.atleast_2d(np.einsum("...ij,...j->...i", step.C, step.u))
            _turned(lasting, values, given, drift, integral)
        return Transition(F, Q, u)

    def _matrices(self, dt: Array, tau: Array, steps: Sequence[Transition]) -> tuple[Array, Array]:
        """Return F and Q: (n, n), or (N, n, n) where anything in them differs from step to step."""
        rho, parts, coupling, noise = tau / dt, {}, {}, {}
        early, late = (tau * rho / 2)[..., None, None], (tau * (1 - rho / 2))[..., None, None]
        left_out = (tau**2 * (rho / 3 - rho**2 / 4))[..., None, None]
        for triad, step in zip(self.triads, steps, strict=True):
            integral, bias = triad.integral, triad.sensor.block.name
            C = np.eye(len(triad.sensor.axes)) if step.C is None else step.C
            CQ = C @ step.Q
            parts[bias] = step
            coupling[integral, bias] = -(early * C + late * (C @ step.F))
            noise[integral, bias] = -late * CQ
            white = tau[..., None, None] * np.diag(triad.sensor.noise**2)
            noise[integral, integral] = (late**2 + left_out) * (CQ @ np.swapaxes(C, -1, -2)) + white
        whole = self.space.transition(parts, coupling, noise)
        return whole.F, whole.Q

    def white(self, chunk: Chunk) -> Array:
        """Return the part of Q that is the triads' white noise: (n, n), or (N, n, n) where tau is not constant."""
        density = self.space.vector({triad.integral: triad.sensor.noise**2 for triad in self.triads})
        return np.asarray(constant(chunk["tau"])[..., None, None] * np.diag(density))
