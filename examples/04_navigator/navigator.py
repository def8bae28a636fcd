"""An inertial navigator that stops now and then: 15 error states, corrected by zero velocity at each stop.

The error x is what must be added to the nominal state: truth = nominal + x, and C_nb = exp([psi x]) C_nominal::

    dp' = dv,   dv' = -[f_n x] psi - C db_a - C n_a,   psi' = -C db_g - C n_g,   f_n = C (f_b - b_a)

Frame n is level and does not turn (z up); the Earth's rate, 15 deg/h, is left out of simulation and navigator alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import fusion_core as core
from fusion_core import Array, Measurement, State, Transition

AXES, EYE, NONE, GRAVITY = ("x", "y", "z"), np.eye(3), np.zeros(3), np.array([0.0, 0.0, -9.80665])


class Nominal(NamedTuple):
    """Position, velocity, attitude C_nb and biases: at one moment, or (N, ...) along a path."""

    p: Array
    v: Array
    C: Array
    b_a: Array
    b_g: Array


class Navigator:
    """The equations of one recording: channels `gyro` [rad/s], `accel` [m/s^2] and what the bias models read.

    `models` are those of `accel_bias` and `gyro_bias`, in this order; `noise` the white-noise densities of
    accelerometer and gyro; `sigma` the deviations of position, velocity and attitude before the first step, and that
    of the velocity when the vehicle stands.
    """

    def __init__(
        self, chunk: core.Chunk, used: Array, models: dict[str, core.BiasModel], noise: Array, sigma: Array
    ) -> None:
        def block(name: str, unit: str, deviation: Array) -> core.Block:
            return core.Block(name, AXES, unit, State(NONE, np.diag(deviation * np.ones(3)) ** 2))

        self.chunk, self.used, self.dt, self.noise, self.sigma = chunk, used, float(chunk.dt), noise, sigma
        self.biases = {name: model.transition(chunk, None)[0] for name, model in models.items()}
        self.space = core.StateSpace([
            block("position", "m", sigma[0]),
            block("velocity", "m/s", sigma[1]),
            block("attitude", "rad", sigma[2]),
            core.Block("accel_bias", AXES, "m/s^2", State(NONE, models["accel_bias"].prior().P)),
            core.Block("gyro_bias", AXES, "rad/s", State(NONE, models["gyro_bias"].prior().P)),
        ])  # fmt: skip

    def propagate(self, start: Nominal, rows: slice) -> tuple[Nominal, Transition, Measurement]:
        """Return the path over some samples, the steps of its error, and the velocity that should be zero."""
        dt = self.dt
        b_a, b_g = (
            b + np.cumsum(np.broadcast_to(step.u, (len(self.chunk), 3))[rows], axis=0)
            for b, step in zip((start.b_a, start.b_g), self.biases.values(), strict=True)
        )
        turns = Rotation.from_rotvec((self.chunk["gyro"][rows] - b_g) * dt).as_matrix()
        C = start.C @ running_product(turns)
        f_n = np.einsum("kij,kj->ki", C, self.chunk["accel"][rows] - b_a)
        v = start.v + np.cumsum(f_n + GRAVITY, axis=0) * dt
        p = start.p + np.cumsum((np.vstack([start.v, v[:-1]]) + v) / 2, axis=0) * dt
        white = {"velocity": self.noise[0] ** 2 * dt * EYE, "attitude": self.noise[1] ** 2 * dt * EYE}
        parts = {name: Transition(step.F, step.Q, NONE) for name, step in self.biases.items()}
        coupling = {
            ("position", "velocity"): dt * EYE,
            ("velocity", "attitude"): dt * np.cross(f_n[:, None], EYE),
            ("velocity", "accel_bias"): -dt * C,
            ("attitude", "gyro_bias"): -dt * C,
        }
        error = self.space.transition(parts, coupling, {(name, name): Q for name, Q in white.items()})
        still = Measurement(-v, self.space.output({"velocity": EYE}), self.sigma[3] ** 2 * EYE, self.used[rows])
        return Nominal(p, v, C, b_a, b_g), error, still

    def correct(self, path: Nominal, x: Array) -> Nominal:
        """Return the state at the end of the path without its error."""
        last = Nominal(*(values[-1] for values in path))
        dp, dv, psi, db_a, db_g = (x[place] for place in self.space.places.values())
        turn = Rotation.from_rotvec(psi).as_matrix()
        return Nominal(last.p + dp, last.v + dv, turn @ last.C, last.b_a + db_a, last.b_g + db_g)

    def run(self, start: Nominal) -> tuple[list[Nominal], core.Estimates, State]:
        """Return the corrected state at each feedback, the estimates of the error, and its state at the end."""
        parts = list(core.feed_back(self.space.prior(), start, self.used, self.propagate, self.correct))
        return [part.nominal for part in parts], core.join([part.estimates for part in parts]), parts[-1].state


def running_product(turns: Array) -> Array:
    """Return the products of the first 1, 2, ..., N matrices (N, 3, 3), by doubling."""
    step = 1
    while step < len(turns):
        turns = np.concatenate([turns[:step], turns[:-step] @ turns[step:]])
        step *= 2
    return turns
