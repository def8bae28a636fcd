"""The sequence of temperatures, faces and rates of a turntable in a chamber that tells the terms of a gyro best.

The readings are y = (I + M(T)) u + b(T), each term a parabola over the range. S segments of the duration h at a rate
give, of axis i with the white noise n_i and the walk w_i, the covariance of its terms::

    P_i = (A' V^-1 A + diag(usual size)^-2)^-1,    V = n_i^2 / h + w_i^2 min(t, t')

A has the bias and the input of each segment, times the parabola's parts at its temperature. The plan is A-optimal: of a
few numbers of temperatures and rounds through all faces it has the least mean of (sigma / usual size)^2 over terms and
temperatures; of those that are nearly as good the one with the most temperatures, which show a curve that is no
parabola. Each face is turned both ways, as fast as the table can: of a linear sensor no slower rate tells more.
G temperatures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from driftlab.planning.chamber import Chamber, Profile, staircase
from driftlab.planning.unit_model import UnitModel
from driftlab.triad.model import AXES, BIAS, TERMS, polynomial
from fusion_core.chunk import Array
from fusion_core.errors import ConfigError

ORDER = 2  # of the terms over temperature
LEVELS, ROUNDS = (3, 4, 5, 6, 7), (1, 2, 3, 4, 6)  # the catalogue
GAP, SETTLE, SHORTEST = 20.0, 2.0, 10.0  # s: to another face or rate, left out by the stimulus, least of a segment
NEAR = 1.05  # of the best criterion: nearly as good
USUAL = np.array([np.deg2rad(1.0)] * len(BIAS) + [0.01] * (len(TERMS) - len(BIAS)))
GRID = 41


class PlannedSegment(NamedTuple):
    """A part of a recording, s from its first row, and the rate of the unit there about an axis (3,), rad/s."""

    start: float
    stop: float
    axis: tuple[float, ...]
    rate: float


@dataclass(frozen=True, eq=False)
class TurntableDesign:
    """One sequence, and the deviations of the terms that it will give.

    Attributes
    ----------
    profile : Profile
        Set points of the chamber.
    levels, rounds : int
        Number of temperatures, and of rounds through all faces at each.
    segments : list of PlannedSegment
        Seconds from the first row, which is at the beginning of the profile.
    temperature : (G,) array
    sigma : (G, 12) array
        In SI.
    criterion : float
        Mean of (sigma / usual size)^2 of the terms that count.
    """

    profile: Profile
    levels: int
    rounds: int
    segments: Sequence[PlannedSegment]
    temperature: Array
    sigma: Array
    criterion: float

    def table(self) -> str:
        """Return the segments as the file that the stimulus reads."""
        lines = []
        for start, stop, axis, rate in self.segments:
            k = int(np.argmax(np.abs(axis)))
            lines.append(f"{start:.1f},{stop:.1f},{'-' * (axis[k] < 0)}{AXES[k]},{np.rad2deg(rate):.9g}\n")
        return "start [s],stop [s],axis,rate [deg/s]\n" + "".join(lines)


@dataclass(frozen=True, eq=False)
class TurntablePlan:
    """Every sequence that was judged, the best first."""

    subject: UnitModel
    chamber: Chamber
    hours: float
    rate: float  # of the table, rad/s
    tried: Sequence[TurntableDesign]

    @property
    def chosen(self) -> TurntableDesign:
        """The best one, or of those nearly as good the one with the most temperatures."""
        near = [one for one in self.tried if one.criterion <= NEAR * self.tried[0].criterion]
        return max(near, key=lambda one: (one.levels, -one.criterion))


def plan_turntable(
    subject: UnitModel, chamber: Chamber, hours: float, rate: float, wanted: Sequence[int]
) -> TurntablePlan:
    """Return the plan of the gyro's terms `wanted` (places in TERMS) in so many hours, with a table of a rate, rad/s.

    Raises
    ------
    ConfigError
        If the hours are too few for three temperatures with all faces.
    """
    tried, T = [], np.linspace(chamber.low, chamber.high, GRID)
    for levels in LEVELS:
        if (profile := staircase(chamber, hours, chamber.swing / (levels - 1))) is None:
            continue
        for rounds in ROUNDS:
            if segments := _segments(profile, chamber, levels, rounds, rate):
                sigma = _sigma(subject, chamber, profile, segments, T)
                share = float(np.mean((sigma / USUAL)[:, list(wanted)] ** 2))
                tried.append(TurntableDesign(profile, levels, rounds, segments, T, sigma, share))
    if not tried:
        raise ConfigError(
            f"--hours {hours:g}: are too few for {LEVELS[0]} temperatures with {2 * len(AXES)} segments each; give "
            "more, or a faster chamber with --rate"
        )
    return TurntablePlan(subject, chamber, hours, rate, sorted(tried, key=lambda one: one.criterion))


def _segments(profile: Profile, chamber: Chamber, levels: int, rounds: int, rate: float) -> list[PlannedSegment]:
    """Return the segments of a profile; none where they were too short."""
    held = np.flatnonzero(np.diff(profile.temperature) == 0)[-levels:]
    segments = []
    for k in held:
        start, stop = profile.time[k] + chamber.settling(chamber.rate), profile.time[k + 1]
        step = (stop - start) / (2 * len(AXES) * rounds)
        if step < GAP + SETTLE + SHORTEST:
            return []
        for n in range(2 * len(AXES) * rounds):
            axis = np.eye(3)[n // 2 % 3]
            begin = start + n * step + GAP
            segments.append(PlannedSegment(begin, start + (n + 1) * step, tuple(axis.tolist()), (-1) ** n * rate))
    return segments


def _sigma(
    subject: UnitModel, chamber: Chamber, profile: Profile, segments: Sequence[PlannedSegment], T: Array
) -> Array:
    """Return the deviation (G, 12) of the terms at T (G,) that segments give."""
    begin, stop, rate = (np.array([one[k] for one in segments]) for k in (0, 1, 3))
    h, t = stop - begin - SETTLE, (begin + SETTLE + stop) / 2
    u = rate[:, None] * np.array([one.axis for one in segments])
    curve, J = polynomial(ORDER, (chamber.low, chamber.high)), np.column_stack([np.ones(len(t)), u])
    B, at = curve.values(profile.body(t, chamber.lag)), curve.values(T)
    sigma = np.zeros((len(T), len(TERMS)))
    for i in range(len(AXES)):
        own = np.array([i, *range(3 + 3 * i, 6 + 3 * i)])  # bias and row of M
        A = np.hstack([column[:, None] * B for column in J.T])
        V = np.diag(subject.noise[i] ** 2 / h) + subject.walk[i] ** 2 * np.minimum.outer(t, t)
        N = A.T @ np.linalg.solve(V, A) + np.diag(np.repeat(USUAL[own] ** -2.0, curve.q))
        P = np.linalg.inv(N).reshape(len(own), curve.q, len(own), curve.q)
        for k, j in enumerate(own):
            sigma[:, j] = np.sqrt(np.einsum("gq,qr,gr->g", at, P[k, :, k], at))
    return sigma
