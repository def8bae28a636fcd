"""In which unit values are, by their size: what a unit at rest on the Earth can show.

An accelerometer shows 1 g whatever else it shows; a thermometer what people can stand, or a chamber reaches; a clock
rises. A gyroscope at rest shows its bias and its noise, of which a size is only probable: where they may be of either
unit, the accelerometers tell whether the file is in SI.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array

EPOCHS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of time stamps since 1970
YEARS = (8e8, 4e9)  # s since 1970: 1995 to 2096
RATES = {"s": (1e-4, 1.0), "ms": (2.0, 499.0), "us": (500.0, 499_999.0), "ns": (500_000.0, 1e9)}  # steps that are usual
G = {"g": 1.0, "m/s^2": 9.80665, "mg": 1000.0, "Gal": 980.665}
NEAR = 0.15  # of g: bias and scale of accelerometers without calibration
QUIET_DEG, QUIET_RAD = 1.5e-3, 1e-4  # noise densities that only gyros in deg/s have, and only those in rad/s
LARGE = 0.3  # mean rate: 17 deg/s of bias has no gyro
FASTEST = 0.1  # K/s over a whole recording: faster is no chamber
COUNTS = 30.0  # and beyond, no unit is probable


class Guess(NamedTuple):
    """A unit, and why; None where the values do not tell it."""

    unit: str | None
    why: str


def of_time(t: Array, swing: float = 0.0) -> Guess:
    """Guess the unit of time stamps (N,), while which the temperature moved by `swing` K."""
    finite = t[np.isfinite(t)]
    steps = np.diff(finite)
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    for unit, factor in EPOCHS.items():
        if len(finite) and YEARS[0] < finite[0] * factor < YEARS[1]:
            return Guess(unit, f"{finite[0]:.4g} is a date in {unit} since 1970")
    for unit, (low, high) in RATES.items():
        if low <= step <= high:
            lasts = float(finite[-1] - finite[0])
            larger = [name for name in EPOCHS if EPOCHS[name] >= EPOCHS[unit]][::-1]
            likely = next((name for name in larger if swing <= FASTEST * lasts * EPOCHS[name]), unit)
            why = f"steps of {step:.6g} {likely} are {1 / (step * EPOCHS[likely]):.4g} Hz"
            return Guess(likely, why if likely == unit else f"{why}; in {unit} the temperature would jump")
    return Guess(None, f"steps of {step:.6g}: s, ms, us or ns?")


def of_accel(values: Array) -> Guess:
    """Guess the unit of an accelerometer (N, d): at rest a triad shows 1 g."""
    if values.shape[1] < 3:
        size = float(np.nanmax(np.abs(np.nanmedian(values, axis=0))))
        return Guess(None, f"of {values.shape[1]} axes, up to {size:.4g}: g, m/s^2 or mg?")
    norm = float(np.nanmedian(np.linalg.norm(values, axis=1)))
    unit = min(G, key=lambda unit: abs(np.log(max(norm, 1e-9) / G[unit])))
    if abs(norm / G[unit] - 1) < NEAR:
        return Guess(unit, f"the norm is {norm:.4g}")
    if norm > 1500:
        bits = round(np.log2(norm))
        count = 2.0**bits if abs(norm / 2.0**bits - 1) < NEAR else norm
        return Guess(f"{1 / count:.6g} g", f"the norm is {norm:.5g} counts: 1 g is {count:.6g}")
    return Guess(None, f"the norm is {norm:.4g}, neither 1 g, 9.8 m/s^2 nor 1000 mg")


def of_temperature(T: Array) -> Guess:
    """Guess the unit of a temperature (N,)."""
    low, high = (float(np.nanpercentile(T, q)) for q in (1, 99))
    seen = f"{low:.4g} to {high:.4g}"
    if low >= -60 and high <= 130:
        return Guess("degC", seen)
    if low >= 200 and high <= 420:
        return Guess("K", seen)
    if low >= -6000 and high <= 13000:
        return Guess("0.01 degC", seen)
    return Guess(None, f"{seen}: raw counts? value = number * scale + offset has no unit; convert it first")


def of_gyro(values: Array, density: Array, accel: str | None) -> Guess:
    """Guess the unit of a gyroscope (N, d) at rest.

    `density` (d,) is its white noise in the file's unit/sqrt(Hz), `accel` the unit of the accelerometers.
    """
    level, noise = float(np.nanmax(np.abs(np.nanmedian(values, axis=0)))), float(np.max(density))
    seen = f"mean {level:.2g} and noise {noise:.2g}/sqrt(Hz)"
    if level > COUNTS or noise > COUNTS / 100:
        return Guess(None, f"{seen}: deg/h, mrad/s, or raw counts? Write their size, as in 0.0305 deg/s")
    if level > LARGE or noise > QUIET_DEG:
        return Guess("deg/s", f"{seen} are too large for rad/s")
    if 0 < noise < QUIET_RAD:
        return Guess("rad/s", f"{seen} are small for deg/s")
    if accel == "m/s^2":
        return Guess("rad/s", "the accelerometers are in SI")
    if accel in ("g", "mg"):
        return Guess("deg/s", f"the accelerometers are in {accel}")
    return Guess(None, f"{seen}: rad/s or deg/s?")
