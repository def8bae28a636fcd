"""Compensation of a gyro over a day by each firmware: its own arithmetic, with its own script's cubic and with ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import CDLL, POINTER, c_float
from pathlib import Path
from shutil import which
from subprocess import run
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.signal import medfilt

from fusion_plugins.exporters import ardupilot as ardupilot_arithmetic
from fusion_plugins.exporters import px4 as px4_arithmetic
from fusion_plugins.exporters.ardupilot import Ardupilot
from fusion_plugins.exporters.px4 import Px4

if TYPE_CHECKING:
    from days import Placement
    from rich.console import Console

Array = NDArray[np.float64]
MEDIAN, INTERVALS = 31, 2000  # of PX4's script
FORMS = (("px4", "vehicle.params"), ("ardupilot", "vehicle.parm"), ("c", "c"))  # kind, and what is written


def firmware(
    soaks: Sequence[Placement], flown: Placement, files: Mapping[str, Path], console: Console
) -> dict[str, Array]:
    """Return the compensation of the gyro (N, 3) on the day that is flown, by its name."""
    t, T = flown.t, flown.temperature
    own_px4, own_ardupilot = own_cubic(soaks)
    stairs = px4_arithmetic.published(t, T).astype(np.float64)
    (ours_px4,) = Px4().read(files["px4"])
    (ours_ardupilot,) = Ardupilot().read(files["ardupilot"])
    rows = {
        "none": np.zeros((len(t), 3)),
        "own cubic in PX4": own_px4.bias(stairs).astype(np.float64),
        "own cubic in ArduPilot": own_ardupilot.bias(T).astype(np.float64),
        "ours in PX4": ours_px4.bias(np.clip(stairs, *ours_px4.domain)),
        "ours in ArduPilot": ours_ardupilot.bias(np.clip(T, *ours_ardupilot.domain)),
    }
    if which("gcc") is None:
        console.print("   no gcc: the C code is left out")
        return rows
    return {**rows, "ours in C": compiled(files["c"], T)}


def own_cubic(
    soaks: Sequence[Placement],
) -> tuple[px4_arithmetic.Px4Parameters, ardupilot_arithmetic.ArduPilotParameters]:
    """Return the cubics that the firmwares' own scripts fit to the soaks as one log, as each holds it.

    Sources: PX4-Autopilot, Tools/process_sensor_caldata.py; ArduPilot, Tools/scripts/tempcal_IMU.py.
    """
    T = np.concatenate([day.temperature for day in soaks])
    gyro = np.concatenate([day.gyro for day in soaks])
    low, high = float(T.min()), float(T.max())
    middle = (low + high) / 2
    px4 = px4_arithmetic.Px4Parameters(
        np.polynomial.polynomial.polyfit(*binned(T - middle, gyro), 3).astype(np.float32),
        *(np.float32(temperature) for temperature in (middle, low, high)),
    )
    # the script's moving average over two seconds is nothing at 1 Hz
    reference, scale = float(ardupilot_arithmetic.T_REF), float(ardupilot_arithmetic.SCALE)
    c = np.polynomial.polynomial.polyfit(T - reference, gyro, 3)
    low, high = round(low, 1), round(high, 1)
    T_cal = min(max(reference, low), high)
    level = np.polynomial.polynomial.polyval(T_cal - reference, c)
    ardupilot = ardupilot_arithmetic.ArduPilotParameters(
        (c[1:] / scale).astype(np.float32),
        np.float32(low),
        np.float32(high),
        level.astype(np.float32),
        np.float32(T_cal),
    )
    return px4, ardupilot


def binned(T: Array, gyro: Array) -> tuple[Array, Array]:
    """Return the points of PX4's fit: medians of 31 samples (N, 3), averaged in 2000 equal intervals of T (N,)."""
    filtered = np.stack([medfilt(column, MEDIAN) for column in gyro.T], axis=1)
    place = np.minimum((INTERVALS * (T - T.min()) / np.ptp(T)).astype(np.int64), INTERVALS - 1)
    count = np.bincount(place)
    filled = count > 0
    sums = [np.bincount(place, column)[filled] / count[filled] for column in (T, *filtered.T)]
    return sums[0], np.stack(sums[1:], axis=1)


def compiled(folder: Path, T: Array) -> Array:
    """Return the output of the compiled C code (N, 3)."""
    library = folder / "gyro_bias.so"
    run(["gcc", "-std=c99", "-O2", "-shared", "-fPIC", str(folder / "gyro_bias.c"), "-o", str(library)], check=True)
    function = CDLL(str(library.resolve())).gyro_bias
    function.argtypes, function.restype = [c_float, POINTER(c_float)], None
    found, values = np.empty((len(T), 3)), (c_float * 3)()
    for k, temperature in enumerate(T):
        function(temperature, values)
        found[k] = values
    return found
