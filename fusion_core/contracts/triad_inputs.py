"""Inputs of a triad as they are known: rates, the length of gravity, turns between placements.

Known rates, as a turntable turns the unit, axis by axis::

    y = (I + M) u + b + G f                  u: the rate, and the Earth's about an axis that points up

Placements of an accelerometer, whose input is as long as gravity, in a direction that it alone shows::

    g = | (I + M)^-1 (y - b) |

Placements of a gyro, between which it is turned by hand, a_p the direction of gravity in the axes of the accelerometer
at placement p, that rotation R integrated from the readings of the gyro::

    a_(p+1) = R(omega)' a_p,    omega = (I + M)^-1 (y - b - G f),    y = b + G f at rest

Source of the last two: Tedaldi, Pretto and Menegatti, A robust and easy to implement method for IMU calibration without
external equipments, ICRA 2014. f is the specific force, where it is known, G the g-sensitivity. N samples, P
placements, S segments, m equations, q terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array, Integers
from fusion_core.contracts.stimulus import (
    AXES,
    PAIRS,
    TERMS,
    Equations,
    TriadInput,
    input_derivative,
    inverted,
    strain,
)

FACE = 0.8  # of gravity along an axis: a face
TURN = 1.0  # rad, about an axis, all turns together


def _pair(term: int) -> str:
    return PAIRS[(term - 3) % 9] if term >= 3 else 2 * AXES[term]


def _lacking_force(force: Array | None, axis: str, what: str) -> str:
    """Return the reason why a g-sensitivity to the force (P, 3) along an axis is not observable, and the remedy."""
    if force is None:
        return "no specific force is known; record the accelerometers too, or turn about the vertical at a latitude"
    along = force[:, AXES.index(axis)]
    low, high = (round(float(v), 1) + 0.0 for v in (along.min(), along.max()))
    return (
        f"the force along {axis} goes from {low:g} to {high:g} m/s^2; add {what} with {axis} up, and with {axis} down"
    )


@dataclass(frozen=True, eq=False)
class KnownRates(TriadInput):
    """Segments of known input: a turntable at constant rates.

    Attributes
    ----------
    u, y : (S, 3) arrays
        The input, and the mean reading.
    temperatures, times : (S,) arrays
        Of each, in degC and s.
    force : (S, 3) array, optional
        The specific force.
    recordings : (S,) array of int, optional
        Recording of each.
    parts : KnownRates, optional
        First quarter and rest of each.
    """

    u: Array
    y: Array
    temperatures: Array
    times: Array
    force: Array | None = None
    recordings: Integers | None = None
    parts: KnownRates | None = None

    @property
    def T(self) -> Array:
        """Temperatures of the segments."""
        return self.temperatures

    def equations(self, values: Array) -> Equations:
        """Return one equation an axis and segment."""
        S, q, M = *values.shape, values[:, 3:12].reshape(-1, 3, 3)
        left = self.y - self.u - np.einsum("nij,nj->ni", M, self.u) - values[:, :3] - strain(values, self.force)
        J = np.zeros((S, 3, q))
        for i in range(3):
            J[:, i, i], J[:, i, 3 + 3 * i : 6 + 3 * i] = 1.0, self.u
            if q > len(TERMS) and self.force is not None:
                J[:, i, 12 + 3 * i : 15 + 3 * i] = self.force
        each = np.repeat(self.T, 3), np.repeat(self.times, 3)
        own = None if self.recordings is None else np.repeat(self.recordings, 3)
        return Equations(left.ravel(), J.reshape(-1, q), *each, np.zeros(3 * S, dtype=np.int64), own)

    def lacking(self, term: int) -> str:
        """Say which rates are missing."""
        axis = _pair(term)[1]
        if term >= len(TERMS):
            return _lacking_force(self.force, axis, "segments")
        rates = self.u[:, AXES.index(axis)]
        if np.ptp(rates) < 1e-3 * max(float(np.max(np.abs(self.u))), 1e-9):
            return f"no segment turns about {axis}; add segments about {axis}, as fast one way as the other"
        return f"the rates about {axis} do not separate it from the rest; add segments about {axis} at another rate"


@dataclass(frozen=True, eq=False)
class PlacedForces(TriadInput):
    """Placements of an accelerometer at rest: mean readings (P, 3), temperatures, times and recordings (P,), gravity.

    Gravity is unsure by a share, which is one in the scale factors of all axes.

    The frame is the sensor's own: only lengths are known.
    """

    y: Array
    temperatures: Array
    times: Array
    gravity: float
    unsure: float = 0.0
    recordings: Integers | None = None
    parts: PlacedForces | None = None
    sensor_frame = True

    @property
    def T(self) -> Array:
        """Temperatures of the placements."""
        return self.temperatures

    def forces(self, values: Array) -> Array:
        """Return the specific force (P, 3) that terms (P, 12) give."""
        W, bias = inverted(values)
        return np.asarray(np.einsum("nij,nj->ni", W, self.y - bias))

    def equations(self, values: Array) -> Equations:
        """Return one equation a placement, of the length."""
        W, _ = inverted(values)
        f = self.forces(values)
        length = np.linalg.norm(f, axis=1)
        J = np.einsum("ni,nij->nj", f / length[:, None], input_derivative(W, f))
        J = np.pad(J, ((0, 0), (0, values.shape[1] - J.shape[1])))  # an accelerometer is under no other force
        return Equations(
            self.gravity - length, J, self.T, self.times, np.zeros(len(f), dtype=np.int64), self.recordings
        )

    def lacking(self, term: int) -> str:
        """Say which placements are missing."""
        if term >= len(TERMS):
            return "the force is its own input; leave g_sensitivity out, it is a gyro's"
        up = self.y / np.linalg.norm(self.y, axis=1)[:, None]
        i, j = tuple(_pair(term))
        if i != j:
            tilted = np.abs(up[:, AXES.index(i)] * up[:, AXES.index(j)])
            seen = f"the largest product of both parts of gravity is {np.max(tilted):.2f}"
            return f"too few placements lie between {i} and {j} ({seen}); add some tilted by 45 deg between the two"
        part = up[:, AXES.index(i)]
        sides = [f"{s}{i}" for s, most in (("+", part.max()), ("-", -part.min())) if most < FACE]
        if sides:
            return f"no placement has {' or '.join(sides)} up; add {'one each' if len(sides) > 1 else 'one'}"
        if self.unsure:
            return f"gravity is known to {1e6 * self.unsure:.0f} ppm; write latitude, or gravity under stimulus"
        return "the placements are too few for all terms; add some in other directions"


@dataclass(frozen=True, eq=False)
class PlacedRates(TriadInput):
    """Placements of a gyro, and the turns between them.

    Attributes
    ----------
    y : (P, 3) array
        Mean readings at rest.
    up : (P, 3) array
        Unit vectors of gravity's reaction there, in the axes of the accelerometer, which are the frame.
    temperatures, times : (P,) arrays
    turns : sequence of (N, 3) arrays
        Readings from each placement to the next.
    steps : sequence of (N,) arrays
        Time that each of them stands for, s.
    force : (P, 3) array, optional
        The specific force at the placements.
    forces : sequence of (N, 3) arrays
        And during the turns.
    parts : KnownRates, optional
        First quarter and rest of each placement, whose rate is zero.
    """

    y: Array
    up: Array
    temperatures: Array
    times: Array
    turns: Sequence[Array]
    steps: Sequence[Array]
    force: Array | None = None
    forces: Sequence[Array] = ()
    parts: KnownRates | None = None

    @property
    def T(self) -> Array:
        """Temperatures of the placements, then those of the turns."""
        return _with_middles(self.temperatures)

    def equations(self, values: Array) -> Equations:
        """Return three equations a placement, of the bias, and three a turn, of gravity's direction after it."""
        P, q = len(self.y), values.shape[1]
        at_rest = np.zeros((P, 3, q))
        at_rest[:, range(3), range(3)] = 1.0
        if q > len(TERMS) and self.force is not None:
            for i in range(3):
                at_rest[:, i, 12 + 3 * i : 15 + 3 * i] = self.force
        ends, J = self._turned(values[P:])
        rest = self.y - values[:P, :3] - strain(values[:P], self.force)
        return Equations(
            np.concatenate([rest.ravel(), (self.up[1:] - ends).ravel()]),
            np.concatenate([at_rest.reshape(-1, q), J.reshape(-1, q)]),
            np.repeat(self.T, 3),
            np.repeat(_with_middles(self.times), 3),
            np.repeat([0, 1], [3 * P, 3 * P - 3]),
        )

    def _turned(self, values: Array) -> tuple[Array, Array]:
        """Return gravity's direction after each turn (P - 1, 3) and its derivative by the terms (P - 1, 3, q).

        All turns go at once, a shorter one stands still at its end: g' = -omega x g, sample by sample.
        """
        most, (P, q) = max(map(len, self.turns)), values.shape
        y, f, dt = np.zeros((most, P, 3)), np.zeros((most, P, 3)), np.zeros((most, P))
        for k, (turn, step) in enumerate(zip(self.turns, self.steps, strict=True)):
            y[: len(turn), k], dt[: len(step), k] = turn, step
        for k, own in enumerate(self.forces):
            f[: len(own), k] = own
        W, bias = inverted(values)
        g, J = self.up[:-1].copy(), np.zeros((P, 3, q))
        for reading, force, step in zip(y, f, dt, strict=True):
            omega = np.einsum("nij,nj->ni", W, reading - bias - strain(values, force))
            half = _rotation(-omega * step[:, None] / 2)
            g = np.einsum("nij,nj->ni", half, g)
            J = half @ J + step[:, None, None] * (_cross(g) @ input_derivative(W, omega, force)[:, :, :q])
            g, J = np.einsum("nij,nj->ni", half, g), half @ J
        return g, J

    def lacking(self, term: int) -> str:
        """Say which turns are missing."""
        axis = _pair(term)[1]
        if term >= len(TERMS):
            return _lacking_force(self.force, axis, "placements")
        k = AXES.index(axis)
        sums = ((turn[:, k] - self.y[:, k].mean()) @ step for turn, step in zip(self.turns, self.steps, strict=True))
        if sum(map(abs, sums)) < TURN:
            return f"it is hardly turned about {axis}; turn it about {axis} by 90 deg or more between placements"
        return f"{len(self.turns)} turns are too few for all terms; add some about {axis}, and one the other way"


def _with_middles(values: Array) -> Array:
    """Return values (P,) at placements, then those half-way from each to the next."""
    return np.concatenate([values, (values[1:] + values[:-1]) / 2])


def _cross(v: Array) -> Array:
    """Return the matrices (N, 3, 3) of the cross products of v (N, 3)."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _rotation(v: Array) -> Array:
    """Return the rotations (N, 3, 3) by rotation vectors v (N, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(v, axis=1)[:, None, None]
    K = _cross(v)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * (K @ K))
