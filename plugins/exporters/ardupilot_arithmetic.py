"""What ArduPilot makes of thermal parameters, to the bit: single precision, in the firmware's order of operations.

::

    p(t) = (c1 + (c2 + c3 t) t) t 1e-6
    v <- v - p(clip(T) - 35) + p(clip(T_cal) - 35) - offset

clip is to TMIN and TMAX; T_cal is the temperature at which the offset was taken (-300 where none was: that is clipped
to TMIN). So the parameters hold no constant: it is in the offset, together with its temperature.

Products and sums are rounded one by one, as C without contraction does; a compiler that fuses them differs in the last
bit. Source: ArduPilot, AP_InertialSensor_tempcal.cpp, AP_InertialSensor_Backend.cpp. (The simulator takes the middle of
the range in place of 35 degC, and does not clip: it proves nothing here.) N samples, d axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Single = NDArray[np.float32]

T_REF = np.float32(35.0)  # degC
SCALE = np.float32(1e-6)  # of a stored coefficient
UNCALIBRATED = np.float32(-300.0)  # degC: T_cal before the first calibration


@dataclass(frozen=True)
class Calibration:
    """One sensor's thermal parameters as the firmware holds them: coefficients c (3, d) in 1e-6 unit/K^i."""

    c: Single
    T_min: np.float32
    T_max: np.float32
    offset: Single  # (d,)
    T_cal: np.float32

    def corrected(self, value: ArrayLike, temperature: ArrayLike) -> Single:
        """Return sensor values (N, d) at temperatures (N,) in degC after the firmware's correction."""
        v, T = np.asarray(value, dtype=np.float32), np.asarray(temperature, dtype=np.float32)
        v = v - self._polynomial(self._clipped(T)[:, None] - T_REF)
        v = v + self._polynomial(self._clipped(self.T_cal) - T_REF)
        return np.asarray(v - self.offset, dtype=np.float32)

    def bias(self, temperature: ArrayLike) -> Single:
        """Return what is taken off a sensor in all (N, d), as far as single precision can tell it at zero."""
        T = np.asarray(temperature, dtype=np.float32)
        return np.asarray(-self.corrected(np.zeros((len(T), len(self.offset)), dtype=np.float32), T), dtype=np.float32)

    def _polynomial(self, t: Single | np.float32) -> Single:
        c1, c2, c3 = self.c
        return np.asarray((c1 + (c2 + c3 * t) * t) * t * SCALE, dtype=np.float32)

    def _clipped(self, T: Single | np.float32) -> Single:
        return np.asarray(np.clip(T, self.T_min, self.T_max), dtype=np.float32)
