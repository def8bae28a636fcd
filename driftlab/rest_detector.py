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

from dataclasses import dataclass

import numpy as np
from numba import njit

from driftlab.alignment import OUTLIER, Alignment
from driftlab.config import Filter
from fusion_core.chunk import Array, Chunk
from fusion_core.model import Flags
from fusion_core.units import along_axes

LEVEL = 3.0  # s over which the level is averaged: a bias that drifts by 5 deg/h a second lags by 15 deg/h
FAST = 1.0  # s over which a slow motion is averaged
HOLD = 1.0  # s without standing out that end a motion
FORGET = 30.0  # s of a gap after which the level says nothing


@dataclass(frozen=True)
class RestDetector:
    """What is looked for: density (D,) of the white noise of each axis, names of the axes, and the patience in s."""

    density: Array
    axes: tuple[tuple[str, str], ...]  # channel and axis
    patience: float

    @classmethod
    def of(cls, settings: Filter, alignment: Alignment) -> RestDetector:
        """Return the detector of a run: declared noise, or what the alignment has measured where that is more."""
        density, axes = [], []
        for channel, section in (("gyro", settings.gyro), ("accel", settings.accel)):
            if section is None:
                continue
            names = section.bias.axes
            measured = np.maximum(alignment.noise_ratio[channel], 1.0)
            density.append(along_axes(section.noise, len(names)) * measured)
            axes += [(channel, name) for name in names]
        return cls(np.concatenate(density), tuple(axes), settings.rest.realign_after)

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
        still, out = _look(chunk.t, chunk["tau"], np.ascontiguousarray(x), self.density, self.patience, memory)
        return still, out, memory


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _look(t: Array, tau: Array, x: Array, density: Array, patience: float, memory: Array) -> tuple[Flags, Flags]:
    N, D = x.shape
    level, fast, other = memory[:D], memory[D : 2 * D], memory[2 * D : 3 * D]
    w_level, w_fast, w_other = memory[3 * D : 4 * D], memory[4 * D : 5 * D], memory[5 * D : 6 * D]
    still, out = np.empty(N, dtype=np.bool_), np.zeros((N, D), dtype=np.bool_)
    moving = memory[-4] > 0.0
    quiet, settled, last = memory[-3], memory[-2], memory[-1]
    limit = OUTLIER**2
    for k in range(N):
        if t[k] - last > FORGET:
            w_level[:], w_fast[:], w_other[:] = 0.0, 0.0, 0.0
            moving, quiet, settled = False, 0.0, 0.0
        last = t[k]
        stands, unsettled = False, False
        for j in range(D):
            s = limit * density[j] ** 2
            w_fast[j] = min(w_fast[j], FAST) + tau[k]
            fast[j] += tau[k] / w_fast[j] * (x[k, j] - fast[j])
            if w_level[j] > 0:
                away, far = x[k, j] - level[j], fast[j] - level[j]
                alone = away**2 > s * (1 / tau[k] + 1 / w_level[j])
                if alone or far**2 > s * (1 / w_fast[j] + 1 / w_level[j]):
                    stands = out[k, j] = True
                if alone:
                    w_fast[j] = 0.0  # begun anew: a large motion would stay in the mean long after its end
            if moving and w_other[j] > 0:
                away = x[k, j] - other[j]
                unsettled |= away**2 > s * (1 / tau[k] + 1 / w_other[j])
        if stands and not moving:
            moving, settled, w_other[:] = True, 0.0, 0.0
        quiet = 0.0 if stands else quiet + tau[k]
        if moving:
            settled = 0.0 if unsettled else settled + tau[k]
            for j in range(D):
                w_other[j] = tau[k] if unsettled else min(w_other[j], LEVEL) + tau[k]
                other[j] += tau[k] / w_other[j] * (x[k, j] - other[j])
            if settled >= patience:
                moving = False
                level[:], w_level[:], fast[:], w_fast[:] = other, w_other, other, w_other
            elif quiet >= HOLD:
                moving = False
        if not moving:
            for j in range(D):
                w_level[j] = min(w_level[j], LEVEL) + tau[k]
                level[j] += tau[k] / w_level[j] * (x[k, j] - level[j])
        still[k] = not moving
    memory[-4], memory[-3], memory[-2], memory[-1] = 1.0 if moving else 0.0, quiet, settled, last
    return still, out
