"""ArduPilot's thermal correction of its first barometer: one parameter, an exponent.

::

    P <- P + max(T - 25, 0)^TCAL_BARO_EXP,    Pa and degC, in single precision

So it holds a bias that falls from 25 degC on, by a power of the temperature of 0 to 2, and none that rises. The
altitude is from a ground pressure that is taken at each start: a constant counts neither in the fit nor in the loss.
powf is the compiler's, whose last bit differs from one to another. Source: ArduPilot, AP_TempCalibration.cpp and .h.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, ReadBack, SensorLoss, beyond_a_map
from fusion_core.contracts.calibration import TEMPERATURES
from fusion_core.errors import ConfigError
from fusion_plugins.exporters import autopilot
from fusion_plugins.exporters.autopilot import Corrections, FirmwareSensor, Parameter, Single

KIND = FirmwareSensor("BARO", "baro", "Pa", axes=("",))
T_ZERO = np.float32(25.0)  # degC
EXPONENTS = (0.0, 2.0)
WORTH = 0.9  # of what the barometer is off by without it: more must not be left


@dataclass(frozen=True)
class BarometerExponent(autopilot.Firmware):
    """The exponent as the firmware holds it, and the range in which it was found."""

    exponent: np.float32
    T_min: np.float32
    T_max: np.float32

    def bias(self, temperature: ArrayLike) -> Single:
        """Return the bias (N, 1) at temperatures (N,) in degC, Pa."""
        above = np.maximum(np.asarray(temperature, dtype=np.float32) - T_ZERO, np.float32(0))
        return np.asarray(-np.power(above, self.exponent)[:, None], dtype=np.float32)


def corrections(sensor: Calibrated) -> Corrections:
    """Return the exponent that follows a barometer's map best.

    Raises
    ------
    ConfigError
        If no exponent makes it better than none.
    """
    low, high = sensor.fitted.domain
    T = np.linspace(low, high, TEMPERATURES)
    curve = sensor.fitted.bias(T)[:, 0]

    def hold(exponent: float) -> BarometerExponent:
        return BarometerExponent(np.float32(exponent), np.float32(low), np.float32(high))

    def left(exponent: float) -> float:
        return float(np.std(curve - hold(exponent).bias(T)[:, 0]))

    best = min(np.linspace(*EXPONENTS, 81), key=left)  # it may have several minima
    near = np.clip([best - 0.025, best + 0.025], *EXPONENTS)
    held = hold(float(minimize_scalar(left, bounds=near, method="bounded", options={"xatol": 1e-5}).x))
    if left(float(held.exponent)) > WORTH * np.std(curve):
        raise ConfigError(
            f"export ardupilot: the bias of the {sensor.channel} does not fall by a power of the temperature above "
            f"{T_ZERO:g} °C, and ArduPilot holds nothing else of a barometer; leave it out"
        )
    constant = float(np.mean(curve - held.bias(T)[:, 0]))

    def target(T: Array) -> Array:
        return np.asarray(held.bias(T).astype(np.float64) + constant)

    modelled, left_out = beyond_a_map(sensor)
    loss = SensorLoss.measured(modelled, target)
    parameters = [Parameter("TCAL_ENABLED", 1.0), Parameter("TCAL_BARO_EXP", float(held.exponent))]
    note = f"{sensor.channel}: the first barometer alone is corrected; its constant is in the ground pressure"
    return Corrections(parameters, loss, left_out, [note])


def calibration(values: Mapping[str, float]) -> ReadBack | None:
    """Return the calibration of the first barometer that parameters have; None where there is none in use."""
    exponent = np.float32(values.get("TCAL_BARO_EXP", 0.0))
    if not autopilot.integer(values, "TCAL_ENABLED") or not exponent:
        return None
    low, high = (np.float32(values.get(f"TCAL_TEMP_{end}", 0.0)) for end in ("MIN", "MAX"))
    if not low < high:  # which it learns only by itself
        low, high = T_ZERO, T_ZERO + np.float32(40)
    held = BarometerExponent(exponent, low, high)
    first = f"baro: the first, corrected above {T_ZERO:g} °C without a limit"
    return ReadBack("baro", "Pa", ("x",), (float(low), float(high)), lambda T: held.bias(T).astype(float), 5, (first,))
