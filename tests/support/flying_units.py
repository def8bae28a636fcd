"""Calibrated units that fly, and the formulas of firmware written in C, from their documentation, as an oracle."""

import subprocess
from dataclasses import replace
from functools import cache

import numpy as np

from fusion_core.contracts import Calibrated, Export
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

DEG_H = np.degrees(1) * 3600


def curve(T):
    """A MEMS gyro's bias in rad/s on three axes: on x a cubic, on y a wave, on z a line."""
    x = (T - 20) / 30
    return 1e-3 * np.stack([2 + x - 0.7 * x**2 + 0.3 * x**3, 0.4 * np.sin(T / 8), 0.5 * x - 1], axis=1)


@cache
def _fitted(kind, low, high, axes):
    T = np.linspace(low, high, 2001)
    return {"spline": Spline(), "cubic": Polynomial(order=3), "fifth": Polynomial(order=5)}[kind].fit(
        T, curve(T)[:, :axes], {}
    )


def fitted(kind="spline", low=-10.0, high=50.0, axes=3, **record):
    """A map of a kind, whose record says more."""
    found = _fitted(kind, low, high, axes)
    return replace(found, record=found.record.model_copy(update=record))


def cubic(low=-10.0, high=50.0):
    return fitted("cubic", low, high)


def unit(fitted, axes=("x", "y", "z"), **more):
    return Export((sensor(fitted, axes, **more),))


def sensor(fitted, axes=("x", "y", "z"), channel="gyro", unit="rad/s", shown="deg/h", **more):
    return Calibrated(channel, unit, shown, axes, fitted, **more)


def in_c(folder, body, numbers, T):
    """Run a function `float f(const float *c, float T)` on temperatures (N,), with single precision numbers c.

    Products and sums are rounded one by one (-ffp-contract=off), as the standard has it without contraction.
    """
    source = folder / "formula.c"
    source.write_text(
        "#include <stdio.h>\n" + body + "int main(void) {\n"
        f"  float c[{len(numbers)}], T, y;\n"
        f"  if (fread(c, sizeof T, {len(numbers)}, stdin) != {len(numbers)}) return 1;\n"
        "  while (fread(&T, sizeof T, 1, stdin) == 1) { y = f(c, T); fwrite(&y, sizeof y, 1, stdout); }\n"
        "  return 0;\n}\n"
    )
    flags = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Werror"]
    subprocess.run(["gcc", *flags, "-o", folder / "formula", source, "-lm"], check=True)
    data = np.concatenate([numbers, T]).astype(np.float32).tobytes()
    done = subprocess.run([folder / "formula"], input=data, capture_output=True, check=True)
    return np.frombuffer(done.stdout, dtype=np.float32)
