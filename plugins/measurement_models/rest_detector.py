"""Whether the unit stands still, told from what its sensors show and from nothing else.

No map, no bias model and no filter has a say, so that a score cannot be made better by a filter that refuses what it
does not like. A bias moves slowly; what moves a unit shows within a second. With the white-noise density s of an axis,
its level m over the seconds before (weight w_m in s), and the latest epoch, or the mean over about a second, x (w_x)::

    stands out:  |x - m| > OUTLIER s sqrt(1 / w_x + 1 / w_m)

From the first epoch that stands out the unit moves, until its rates have been back at the level for HOLD s, or have
stayed for `rest.realign_after` at another one: it was turned over, and stands still again. The level is forgotten
over a gap longer than FORGET, in which a bias may have gone anywhere. N epochs, D axes of all triads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Alignment, Detector, Sensor
from fusion_core.model import Flags
from fusion_plugins.measurement_models.alignment import OUTLIER

LEVEL = 3.0  # s over which the level is averaged: a bias that drifts by 5 deg/h a second lags by 15 deg/h
FAST = 1.0  # s over which a slow motion is averaged
HOLD = 1.0  # s without standing out that end a motion
FORGET = 30.0  # s of a gap after which the level says nothing


@dataclass(frozen=True)
class RestDetector(Detector):
    """What is looked for: density (D,) of the white noise of each axis, names of the axes, and the patience in s."""

    density: Array
    axes: tuple[tuple[str, str], ...]  # channel and axis
    patience: float

    @classmethod
    def of(cls, sensors: Sequence[Sensor], alignment: Alignment, patience: float) -> RestDetector:
        """Return the detector of a run: declared noise, or what the alignment has measured where that is more."""
        density = [s.noise * np.maximum(alignment.noise_ratio[s.channel], 1.0) for s in sensors]
        return cls(np.concatenate(density), tuple((s.channel, axis) for s in sensors for axis in s.axes), patience)

    def start(self) -> Array:
        """Return the memory before the first epoch: mean and weight of level, fast mean and other level, 3 counters."""
        memory = np.zeros(6 * len(self.axes) + 4)
        memory[-1] = -np.inf
        return memory

    def look(self, chunk: Chunk, memory: Array) -> tuple[Flags, Flags, Array]:
        """Return which epochs are still (N,), which axes stand out in each (N, D), and the memory."""
        triads = dict.fromkeys(channel for channel, _ in self.axes)
        x = np.hstack([chunk[channel] for channel in triads])
        memory = memory.copy()
        limit = (OUTLIER * self.density) ** 2
        still, out = _look(chunk.t, chunk["tau"], np.ascontiguousarray(x), limit, self.patience, memory)
        return still, out, memory


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _look(t: Array, tau: Array, x: Array, limit: Array, patience: float, memory: Array) -> tuple[Flags, Flags]:
    N, D = x.shape
    level, fast, other = memory[:D], memory[D : 2 * D], memory[2 * D : 3 * D]
    w_level, w_fast, w_other = memory[3 * D : 4 * D], memory[4 * D : 5 * D], memory[5 * D : 6 * D]
    still, out = np.empty(N, dtype=np.bool_), np.zeros((N, D), dtype=np.bool_)
    moving = memory[-4] > 0.0
    quiet, settled, last = memory[-3], memory[-2], memory[-1]
    for k in range(N):
        if t[k] - last > FORGET:
            w_level[:], w_fast[:], w_other[:] = 0.0, 0.0, 0.0
            moving, quiet, settled = False, 0.0, 0.0
        last = t[k]
        _average(fast, w_fast, x[k], tau[k], FAST)
        stands = _stands_out(x[k], tau[k], limit, level, w_level, fast, w_fast, out[k])
        if stands and not moving:
            moving, settled, w_other[:] = True, 0.0, 0.0
        quiet = 0.0 if stands else quiet + tau[k]
        if moving:
            settled += tau[k]
            if _leaves(x[k], tau[k], limit, other, w_other):
                settled, w_other[:] = 0.0, 0.0
            _average(other, w_other, x[k], tau[k], LEVEL)
            if settled >= patience:
                moving = False
                level[:], w_level[:], fast[:], w_fast[:] = other, w_other, other, w_other
            elif quiet >= HOLD:
                moving = False
        if not moving:
            _average(level, w_level, x[k], tau[k], LEVEL)
        still[k] = not moving
    memory[-4], memory[-3], memory[-2], memory[-1] = 1.0 if moving else 0.0, quiet, settled, last
    return still, out


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _average(mean: Array, weight: Array, x: Array, tau: float, window: float) -> None:
    """Take x (D,), which lasted tau s, into means (D,) of weight (D,) over about `window` s."""
    for j in range(len(x)):
        weight[j] = min(weight[j], window) + tau
        mean[j] += tau / weight[j] * (x[j] - mean[j])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _stands_out(
    x: Array, tau: float, limit: Array, level: Array, w_level: Array, fast: Array, w_fast: Array, out: Flags
) -> bool:
    """Return whether an axis is off its level, by itself or in the mean of the last second, and which are: out (D,)."""
    for j in range(len(x)):
        if w_level[j] == 0:
            continue
        alone = (x[j] - level[j]) ** 2 > limit[j] * (1 / tau + 1 / w_level[j])
        out[j] = alone or (fast[j] - level[j]) ** 2 > limit[j] * (1 / w_fast[j] + 1 / w_level[j])
        if alone:
            w_fast[j] = 0.0  # begun anew: a large motion would stay in the mean long after its end
    return bool(np.any(out))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _leaves(x: Array, tau: float, limit: Array, other: Array, w_other: Array) -> bool:
    """Return whether an axis leaves the level at which it has settled."""
    left = False
    for j in range(len(x)):
        left |= w_other[j] > 0 and (x[j] - other[j]) ** 2 > limit[j] * (1 / tau + 1 / w_other[j])
    return left
