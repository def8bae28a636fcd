"""What PX4 makes of thermal parameters, to the bit: single precision, in the firmware's order of operations.

::

    d = clip(T, TMIN, TMAX) - TREF
    gyro, accelerometer:  X0 + X1 d + X2 d2 + X3 d3,    d2 = d d,  d3 = d2 d
    barometer:            the same to X5, the power multiplied up as it goes

What is subtracted from the sensor is not this, but what was last *published*: a module looks once a second, and
publishes when the temperature has moved by more than 1 K since it last did. So the correction runs in stairs. (When it
publishes another sensor's, this one's goes with it: with `TC_A_ENABLE` the stairs may be finer than here.)

Products and sums are rounded one by one, as C without contraction does; a compiler that fuses them differs in the last
bit. Source: PX4-Autopilot, src/modules/temperature_compensation: TemperatureCompensation.cpp,
TemperatureCompensationModule.cpp. N samples, n coefficients, d axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

Single = NDArray[np.float32]

PERIOD = 1.0  # s from one look to the next
STEP = np.float32(1.0)  # K that the temperature must have moved, and more
NEVER = np.float32(-100.0)  # degC: the temperature of what was published last, where nothing was


@dataclass(frozen=True)
class Calibration:
    """One sensor's thermal parameters as the firmware holds them: coefficients X (n, d), lowest power first."""

    X: Single
    T_ref: np.float32
    T_min: np.float32
    T_max: np.float32

    def offset(self, temperature: ArrayLike) -> Single:
        """Return the thermal offset (N, d) at temperatures (N,) in degC, as if each were published."""
        T = np.asarray(temperature, dtype=np.float32)
        ends = self.T_max - self.T_ref, self.T_min - self.T_ref
        d = np.where(self.T_max < T, ends[0], np.where(self.T_min > T, ends[1], T - self.T_ref))[:, None]
        found, power = self.X[0] + self.X[1] * d, d
        for X in self.X[2:]:
            power = power * d
            found = found + X * power
        return np.asarray(found, dtype=np.float32)


def published(t: ArrayLike, temperature: ArrayLike) -> Single:
    """Return the temperature (N,) whose offset is in use at times t (N,) in s, from a start at the first of them.

    Before anything is published nothing is subtracted; that is before the first look only, and left out here.
    """
    times, T = np.asarray(t, dtype=np.float64), np.asarray(temperature, dtype=np.float32)
    count = int((times[-1] - times[0]) / PERIOD + 1e-9) + 1
    looks = np.searchsorted(times, times[0] + PERIOD * np.arange(count) + 1e-9, side="right") - 1
    used, last = np.empty_like(T), NEVER
    for look, after in pairwise([*looks.tolist(), len(T)]):
        if abs(T[look] - last) > STEP:
            last = T[look]
        used[look:after] = last
    return used
