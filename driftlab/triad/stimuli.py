"""Stimuli of a triad: its input, as far as it is known, as equations in its terms.

Known rates, as a turntable turns the unit, axis by axis::

    y = (I + M) u + b                                    u: the rate, and the Earth's about an axis that points up

Placements of an accelerometer, whose input is as long as gravity, in a direction that it alone shows::

    g = | (I + M)^-1 (y - b) |

Placements of a gyro, between which it is turned by hand, a_p the direction of gravity in the axes of the accelerometer
at placement p, that rotation R integrated from the readings of the gyro::

    a_(p+1) = R(omega)' a_p,    omega = (I + M)^-1 (y - b),    y = b at rest

Source of the last two: Tedaldi, Pretto and Menegatti, A robust and easy to implement method for IMU calibration without
external equipments, ICRA 2014. N samples, P placements, S segments, m equations.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from driftlab.triad.model import AXES, BELOW, PAIRS, TERMS, input_derivative, inverted
from fusion_core.chunk import Array
from fusion_core.errors import NotAtRest

WINDOW = 0.5  # s, over which the scatter of a triad is looked at
QUIET = 4.0  # times the scatter of the quietest tenth of the windows: more is motion
EDGE = 0.25  # s, left out at both ends of a rest
FACE = 0.8  # of gravity along an axis: a face
TILTED = 0.35  # product of the parts of gravity along two axes: a placement between them
TURN = 1.0  # rad, about an axis, all turns together


@dataclass(frozen=True, eq=False)
class Equations:
    """The linearised equations of a stimulus about some terms: left = J (change of the terms at T) + noise.

    Attributes
    ----------
    left : (m,) array
        Measured less modelled.
    J : (m, 12) array
    T, t : (m,) arrays
        Temperatures, degC, and times, s, by which the bias walks from one equation to another.
    group : (m,) array of int
        Equations of one kind of noise, whose size is found from them. Within it all count alike: after seconds at rest
        it is the instability and the mounting that are left, and no longer white noise.
    """

    left: Array
    J: Array
    T: Array
    t: Array
    group: NDArray[np.int64]


class Stimulus(ABC):
    """The input of a triad, as far as it is known; another one is a class with these three methods."""

    sensor_frame: bool = False
    """True where the frame is the sensor's own: M then has 6 terms."""
    unsure: float = 0.0
    """Deviation of the size of the input, as a share of it, the same in all equations."""

    @property
    @abstractmethod
    def T(self) -> Array:
        """Temperatures of the equations."""

    @abstractmethod
    def equations(self, values: Array) -> Equations:
        """Return the equations about terms (len(T), 12), the values at each of `T`."""

    @abstractmethod
    def lacking(self, term: int) -> str:
        """Return the reason why a term of `TERMS` is not told, and after `; ` the remedy."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """True for the terms (12,) that are looked for."""
        free = np.ones(len(TERMS), dtype=bool)
        free[list(BELOW)] = not self.sensor_frame
        return free


def _pair(term: int) -> str:
    return PAIRS[term - 3] if term >= 3 else 2 * AXES[term]


@dataclass(frozen=True, eq=False)
class KnownRates(Stimulus):
    """Segments of known input: a turntable at constant rates.

    Attributes
    ----------
    u, y : (S, 3) arrays
        The input, and the mean reading.
    temperatures, times : (S,) arrays
        Of each, in degC and s.
    """

    u: Array
    y: Array
    temperatures: Array
    times: Array

    @property
    def T(self) -> Array:
        """Temperatures of the segments."""
        return self.temperatures

    def equations(self, values: Array) -> Equations:
        """Return one equation an axis and segment."""
        S, M = len(self.u), values[:, 3:].reshape(-1, 3, 3)
        left = self.y - self.u - np.einsum("nij,nj->ni", M, self.u) - values[:, :3]
        J = np.zeros((S, 3, len(TERMS)))
        for i in range(3):
            J[:, i, i], J[:, i, 3 + 3 * i : 6 + 3 * i] = 1.0, self.u
        each = np.repeat(self.T, 3), np.repeat(self.times, 3)
        return Equations(left.ravel(), J.reshape(-1, 12), *each, np.zeros(3 * S, dtype=np.int64))

    def lacking(self, term: int) -> str:
        """Say which rates are missing."""
        axis = _pair(term)[1]
        rates = self.u[:, AXES.index(axis)]
        if np.ptp(rates) < 1e-3 * max(float(np.max(np.abs(self.u))), 1e-9):
            return f"no segment turns about {axis}; add segments about {axis}, as fast one way as the other"
        return f"the rates about {axis} do not separate it from the rest; add segments about {axis} at another rate"


@dataclass(frozen=True, eq=False)
class PlacedForces(Stimulus):
    """Placements of an accelerometer at rest: mean readings (P, 3), temperatures and times (P,), gravity.

    Gravity is unsure by a share, which is one in the scale factors of all axes.

    The frame is the sensor's own: only lengths are known.
    """

    y: Array
    temperatures: Array
    times: Array
    gravity: float
    unsure: float = 0.0
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
        return Equations(self.gravity - length, J, self.T, self.times, np.zeros(len(f), dtype=np.int64))

    def lacking(self, term: int) -> str:
        """Say which placements are missing."""
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
        return f"{len(up)} placements are too few for all terms; add some in other directions"


@dataclass(frozen=True, eq=False)
class PlacedRates(Stimulus):
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
    """

    y: Array
    up: Array
    temperatures: Array
    times: Array
    turns: Sequence[Array]
    steps: Sequence[Array]

    @property
    def T(self) -> Array:
        """Temperatures of the placements, then those of the turns."""
        return _with_middles(self.temperatures)

    def equations(self, values: Array) -> Equations:
        """Return three equations a placement, of the bias, and three a turn, of gravity's direction after it."""
        P = len(self.y)
        at_rest = np.zeros((P, 3, len(TERMS)))
        at_rest[:, range(3), range(3)] = 1.0
        ends, J = self._turned(values[P:])
        return Equations(
            np.concatenate([(self.y - values[:P, :3]).ravel(), (self.up[1:] - ends).ravel()]),
            np.concatenate([at_rest.reshape(-1, 12), J.reshape(-1, 12)]),
            np.repeat(self.T, 3),
            np.repeat(_with_middles(self.times), 3),
            np.repeat([0, 1], [3 * P, 3 * P - 3]),
        )

    def _turned(self, values: Array) -> tuple[Array, Array]:
        """Return gravity's direction after each turn (P - 1, 3) and its derivative by the terms (P - 1, 3, 12).

        All turns go at once, a shorter one stands still at its end: g' = -omega x g, sample by sample.
        """
        most, P = max(map(len, self.turns)), len(self.turns)
        y, dt = np.zeros((most, P, 3)), np.zeros((most, P))
        for k, (turn, step) in enumerate(zip(self.turns, self.steps, strict=True)):
            y[: len(turn), k], dt[: len(step), k] = turn, step
        W, bias = inverted(values)
        g, J = self.up[:-1].copy(), np.zeros((P, 3, len(TERMS)))
        for reading, step in zip(y, dt, strict=True):
            omega = np.einsum("nij,nj->ni", W, reading - bias)
            half = _rotation(-omega * step[:, None] / 2)
            g = np.einsum("nij,nj->ni", half, g)
            J = half @ J + step[:, None, None] * (_cross(g) @ input_derivative(W, omega))
            g, J = np.einsum("nij,nj->ni", half, g), half @ J
        return g, J

    def lacking(self, term: int) -> str:
        """Say which turns are missing."""
        axis = _pair(term)[1]
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


def rests(t: Array, *triads: Array, least: float) -> list[tuple[int, int]]:
    """Return start and stop of the rests in samples t (N,) of triads (N, 3), each at least `least` s long.

    Raises
    ------
    NotAtRest
        If there are fewer than two.
    """
    per = max(round(WINDOW / float(np.median(np.diff(t)))), 2)
    count = len(t) // per
    quiet = np.ones(count, dtype=bool)
    for values in triads:
        cut = values[: count * per].reshape(count, per, 3)
        scatter, level = np.sqrt(cut.var(axis=1).sum(axis=1)), cut.mean(axis=1)
        usual = np.median(np.sort(scatter)[: max(count // 10, 3)])
        move = np.linalg.norm(np.diff(level, axis=0, prepend=level[:1]), axis=1)  # a slow turn scatters little
        quiet &= (scatter < QUIET * usual) & (move < QUIET * usual)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(np.int8)))
    margin = max(int(EDGE / WINDOW * per), 1)
    pairs = [(a * per + margin, b * per - margin) for a, b in edges.reshape(-1, 2)]
    whole = [(a, b) for a, b in pairs if b > a and t[b - 1] - t[a] >= least]
    if len(whole) < 2:
        raise NotAtRest(
            f"{len(whole)} placements at rest for {least:g} s were found, two at least were expected; leave the unit "
            "alone for longer at each, or set stimulus.rest lower"
        )
    return whole


def placed_rates(t: Array, y: Array, T: Array, places: Sequence[tuple[int, int]], up: Array) -> PlacedRates:
    """Return the stimulus of a gyro's samples t (N,), y (N, 3), T (N,) at rest in `places`, `up` (P, 3) there."""
    step = np.diff(t, prepend=2 * t[0] - t[1])
    between = [slice(a[1], b[0]) for a, b in pairwise(places)]
    # between the mean of one rest and that of the next it stands still but for the turn: the bias alone would add up
    return PlacedRates(
        np.stack([y[a:b].mean(axis=0) for a, b in places]), up, np.array([T[a:b].mean() for a, b in places]),
        np.array([t[a:b].mean() for a, b in places]), [y[part] for part in between], [step[part] for part in between],
    )  # fmt: skip
