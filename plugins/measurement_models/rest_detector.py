"""The detector of rest: a unit stands still or moves, judged by the readings of its sensors alone.

No map, no bias model and no filter takes part, so that no filter can make its score better by refusing samples. A bias
moves slowly, or as the temperature does; a motion of the unit shows within a second. With the
white-noise density s of an axis, its level p over the seconds before (weight w_p in s), and the latest epoch, or the
mean over about a second, x (w_x)::

    stands out:  |x - p| > OUTLIER s sqrt(1 / w_x + 1 / w_p) + B dT

B is the steepest that a bias may be over temperature. The level goes on by its own trend, no farther than B times the
change of the temperature; dT is what the temperature departs from its own trend, beyond the thermometer's noise, and
what a bend of the curve makes of the trend. Where the temperature stands still, or none is recorded, the level is the
mean alone.

From the first epoch that stands out the unit moves, until its rates have been back at the level for HOLD s, or have
stayed for `rest.realign_after` at another one: it was turned over, and stands still again. The level is forgotten
over a gap longer than FORGET, in which a bias may have gone anywhere. N epochs, D axes of all triads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.contracts import Alignment, Detector, Sensor
from fusion_core.fast import compiled, inlined
from fusion_plugins.measurement_models import alignment
from fusion_plugins.measurement_models.alignment import steepest

OUTLIER, BEND = alignment.OUTLIER, alignment.BEND
LEVEL = 3.0  # s over which the level is averaged
LONG = 10.0  # s over which it is averaged beside that: both together show its trend
FAST = 1.0  # s over which a slow motion is averaged
HOLD = 1.0  # s without standing out that end a motion
FORGET = 30.0  # s of a gap after which the level says nothing


@dataclass(frozen=True)
class RestDetector(Detector):
    """The detector of motion: density (D,) of the white noise of each axis, names of the axes, and the patience in s.

    `steepest` (D,) is how much a bias may change a kelvin, in the unit of its axis.
    """

    density: Array
    axes: tuple[tuple[str, str], ...]  # channel and axis
    patience: float
    steepest: Array

    @classmethod
    def of(cls, sensors: Sequence[Sensor], alignment: Alignment, patience: float) -> RestDetector:
        """Return the detector of a run: declared noise, or what the alignment has measured where that is more."""
        density = [s.noise * np.maximum(alignment.noise_ratio[s.channel], 1.0) for s in sensors]
        axes = tuple((s.channel, axis) for s in sensors for axis in s.axes)
        return cls(np.concatenate(density), axes, patience, np.concatenate([steepest(s) for s in sensors]))

    def start(self) -> Array:
        """Return the memory before the first epoch: means of D axes (`_look`), and numbers that they share."""
        memory = np.zeros(7 * len(self.axes) + 20)
        memory[-1] = -np.inf
        return memory

    def look(self, chunk: Chunk, memory: Array) -> tuple[Flags, Flags, Array]:
        """Return the epochs that are still (N,), the axes that stand out in each (N, D), and the memory."""
        triads, limit = self._constant
        x = np.ascontiguousarray(np.concatenate([chunk[channel] for channel in triads], axis=1))
        (N, D), memory = x.shape, memory.copy()
        T = rate = np.zeros(N)
        if "temperature" in chunk.channels:
            T = chunk.channels.get("temperature_raw", chunk["temperature"])
            rate = chunk.channels.get("temperature_rate", rate)
        means, rest = memory[: 7 * D].reshape(7, D), memory[7 * D :]
        still, out = np.empty(N, dtype=np.bool_), np.zeros((N, D), dtype=np.bool_)
        _look(chunk.t, chunk["tau"], x, T, rate, limit, self.steepest, self.patience, means, rest, still, out)
        return still, out, memory

    @cached_property
    def _constant(self) -> tuple[tuple[str, ...], Array]:
        """The channels, and the square (D,) of what stands out in a second."""
        return tuple(dict.fromkeys(channel for channel, _ in self.axes)), (OUTLIER * self.density) ** 2


@compiled
def _look(
    t: Array, tau: Array, x: Array, T: Array, rate: Array, limit: Array, steep: Array, patience: float,
    means: Array, rest: Array, still: Flags, out: Flags,
) -> None:  # fmt: skip
    """Run the detector, which writes what is still (N,) and where what stands out (N, D); the memory goes on in place.

    That is means (7, D) and the rest (20,).

    For each axis the level's means over LEVEL and LONG, the same of another level, the mean over FAST, its weight and
    its age; then of the two levels what `_average` keeps, the temperature over FAST with its weight, what the
    thermometer scatters (variance, last reading), whether it moves, two counters in s, and the last time.
    """
    N = len(x)
    level, other, fast = means[:2], means[2:4], means[4:]
    of_level, of_other, warm, counters = rest[:6], rest[6:12], rest[12:16], rest[16:]
    moving, quiet, settled, last = counters[0] > 0.0, counters[1], counters[2], counters[3]
    for k in range(N):
        dt = t[k] - last
        if dt > FORGET:
            means[:], rest[:16] = 0.0, 0.0
            moving, quiet, settled, dt = False, 0.0, 0.0, tau[k]
            warm[3] = T[k]
        last = t[k]
        _warm(warm, T[k], tau[k])
        far = _fast(fast, x, k, tau[k], dt, limit, level, of_level[0])
        of_level[2], of_level[3] = of_level[2] + dt, of_level[3] + dt
        stands = far and _stands_out(x, k, tau[k], limit, steep, level, of_level, fast, warm, rate[k], out)
        if stands and not moving:
            moving, settled, of_other[:] = True, 0.0, 0.0
        quiet = 0.0 if stands else quiet + tau[k]
        if moving:
            of_other[2], of_other[3] = of_other[2] + dt, of_other[3] + dt
            leaves = _leaves(x, k, tau[k], limit, steep, other, of_other, warm, rate[k])
            settled = 0.0 if leaves else settled + tau[k]
            _average(other, of_other, x, k, warm[0], tau[k])
            moving = settled < patience and quiet < HOLD
            if settled >= patience:
                _settle(level, of_level, fast, other, of_other)
        if not moving:
            _average(level, of_level, x, k, warm[0], tau[k])
        still[k] = not moving
    counters[0], counters[1], counters[2], counters[3] = 1.0 if moving else 0.0, quiet, settled, last


@inlined
def _settle(level: Array, of_level: Array, fast: Array, other: Array, of_other: Array) -> None:
    """Take another level for the level; one by one, as to copy arrays would take seconds more to compile."""
    for i in range(len(of_level)):
        of_level[i] = of_other[i]
    for j in range(level.shape[1]):
        level[0, j], level[1, j] = other[0, j], other[1, j]
        fast[0, j], fast[1, j], fast[2, j] = other[0, j], of_other[0], of_other[2]


@inlined
def _warm(warm: Array, T: float, tau: float) -> None:
    """Take a temperature into its mean over FAST (`warm`: mean, weight, variance of a reading, last reading)."""
    warm[1] = min(warm[1], FAST) + tau
    warm[0] += tau / warm[1] * (T - warm[0])
    warm[2] += min(tau / FORGET, 1.0) * ((T - warm[3]) ** 2 / 2 - warm[2])
    warm[3] = T


@inlined
def _fast(fast: Array, x: Array, k: int, tau: float, dt: float, limit: Array, level: Array, weight: float) -> bool:
    """Take row k of x (N, D), which lasted tau s, into means over FAST, with weights and ages (3, D).

    Return True if an axis is farther off its level, of that weight, than noise alone takes it: seldom. Without a branch
    the axes stand side by side in the processor: a fifth of the time.
    """
    far, known = False, 1 / weight  # infinite where there is no level yet: nothing is far off it
    for j in range(x.shape[1]):
        w = min(fast[1, j], FAST) + tau
        share = tau / w
        mean = fast[0, j] + share * (x[k, j] - fast[0, j])
        fast[0, j], fast[1, j], fast[2, j] = mean, w, (fast[2, j] + dt) * (1.0 - share)
        off, slow = x[k, j] - level[0, j], mean - level[0, j]
        far |= (off * off > limit[j] * (1 / tau + known)) | (slow * slow > limit[j] * (1 / w + known))
    return far


@inlined
def _average(means: Array, of: Array, x: Array, k: int, T: float, tau: float) -> None:
    """Take row k of x (N, D) into means (2, D) over LEVEL and LONG; `of` has their weights, ages and temperatures."""
    of[0], of[1] = min(of[0], LEVEL) + tau, min(of[1], LONG) + tau
    share, less = tau / of[0], tau / of[1]
    of[2], of[3] = of[2] * (1.0 - share), of[3] * (1.0 - less)
    of[4], of[5] = of[4] + share * (T - of[4]), of[5] + less * (T - of[5])
    for j in range(x.shape[1]):
        means[0, j] += share * (x[k, j] - means[0, j])
        means[1, j] += less * (x[k, j] - means[1, j])


@inlined
def _departs(
    x: float, w: float, age: float, j: int, limit: float, steep: float, means: Array, of: Array, warm: Array,
    rate: float, tau: float,
) -> bool:  # fmt: skip
    """Return True if x, of weight w and so old, is farther off a level than noise and temperature take it."""
    variance, level, lead, span = 1 / w + 1 / of[0], means[0, j], of[2] - age, of[3] - of[2]
    off = x - level
    if off * off <= limit * variance:
        return False
    warmer, g = warm[0] - of[4], 0.0
    if span > FAST:
        reach = max(abs(rate) * lead, abs(of[4] - of[5]) * lead / span) * steep
        if reach * reach * of[0] > limit / OUTLIER**2:
            g = lead / span
            off -= min(max((level - means[1, j]) * g, -reach), reach)
            variance += ((1 + g) ** 2 - 1) / of[0] + g * g / of[1]
    apart = abs(warmer - (of[4] - of[5]) * g)
    scatter = 3 * np.sqrt(warm[2] * tau * (1 / warm[1] + (1 + g) ** 2 / of[0] + g * g / of[1]))
    allowed = steep * max(apart - scatter, 0.0)
    if g > 0:  # the curve bends by about its own slope, and a little where it has none
        trend = abs(level - means[1, j])
        slope = min(trend / max(abs(of[4] - of[5]), 1e-9) + steep / 8, steep)
        allowed += slope * abs(warmer * (warm[0] - of[5])) / BEND
        # that the temperature stops, within its scatter the thermometer does not show
        allowed += trend * g * min(1.0, scatter / max(abs(rate) * lead, 1e-9))
    return bool(max(abs(off) - allowed, 0.0) ** 2 > limit * variance)


@inlined
def _stands_out(
    x: Array, k: int, tau: float, limit: Array, steep: Array, level: Array, of: Array, fast: Array, warm: Array,
    rate: float, out: Flags,
) -> bool:  # fmt: skip
    """Return True if an axis is off its level, by itself or in the mean of the last second; `out` (N, D) has which."""
    stands = False
    for j in range(x.shape[1]):
        w = fast[1, j]
        alone = _departs(x[k, j], tau, 0.0, j, limit[j], steep[j], level, of, warm, rate, tau)
        out[k, j] = alone or _departs(fast[0, j], w, fast[2, j], j, limit[j], steep[j], level, of, warm, rate, tau)
        stands |= out[k, j]
        if alone:
            fast[1, j] = 0.0  # begun anew: a large motion would stay in the mean long after its end
    return stands


@inlined
def _leaves(
    x: Array, k: int, tau: float, limit: Array, steep: Array, other: Array, of: Array, warm: Array, rate: float
) -> bool:
    """Return True if an axis leaves the level at which it has settled; that begins anew then."""
    if of[0] == 0:
        return False
    left = False
    for j in range(x.shape[1]):
        left |= _departs(x[k, j], tau, 0.0, j, limit[j], steep[j], other, of, warm, rate, tau)
    if left:
        of[:] = 0.0
    return left
