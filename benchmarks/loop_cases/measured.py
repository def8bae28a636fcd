"""Measured recordings with a cause that is known, and controls in which there is nothing to find."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from loop_cases import names
from loop_cases.answer import spread
from loop_cases.case import Case, Columns, Prepared, config_of, follows, write
from loop_cases.oracle import Told, error_told_of_measured
from loop_cases.signatures import late
from loop_cases.sources import PLACEMENTS, RAMPS, cats, data, spans, table

CUBIC = {"kind": "polynomial", "order": 3, "outside": "clamp"}
PPM = 1e-6  # rad/s that stand for 1 ppm
# ppm/sqrt(Hz) and ppm/sqrt(s): Allan deviation at 16 to 64 s, and what a cubic leaves at an hour
OVEN_NOISE = {"lagging": ("2e-7 rad/s/sqrt(Hz)", "2e-9 rad/s/sqrt(s)"),
              "control": ("8e-7 rad/s/sqrt(Hz)", "5e-9 rad/s/sqrt(s)")}  # fmt: skip
CATS_NOISE = ["323 deg/h/sqrt(Hz)", "361 deg/h/sqrt(Hz)", "408 deg/h/sqrt(Hz)"]
CATS_ACCEL = {
    "noise": ["2.1 mg/sqrt(Hz)", "2.2 mg/sqrt(Hz)", "3.4 mg/sqrt(Hz)"],
    "bias": {"kind": "random_walk", "walk": "0.03 mg/sqrt(s)"},
}
CATS_UNITS = {"time": "s", "gyro": "mrad/s", "accel": "m/s^2", "temperature": "degC"}
CATS_PATHS = {"time": "timestamp_utc", "gyro": "angular_velocity", "accel": "acceleration"}
CATS_MORE = {"depth": "1", "magnetic_field": "uT"}
OVEN_UNITS = {"time": "s", "gyro": "rad/s", "temperature": "degC", "ambient": "degC"}
BETTER_MAP = (names.Pattern("curve", "temperature"), names.Pattern("map_misfit", "temperature"))


def cats_config(units: dict[str, str], *, declared: bool = True, paths: dict[str, str] | None = None) -> dict:
    """Return the demonstration's config with these channels; without temperature's map if it is not declared."""
    gyro = follows(CATS_NOISE, "1 deg/h/sqrt(s)", CUBIC if declared else None)
    return config_of(units, gyro, paths=paths, accel=CATS_ACCEL)


def oven_config(which: str, units: dict[str, str]) -> dict:
    """Return the config of an oven: one axis, a cubic map."""
    gyro = follows(*OVEN_NOISE[which], CUBIC, axes=["x"])
    return config_of(units, gyro, align="300 s")


def oven_columns(which: str) -> Columns:
    """Return an oven's recording as that of a gyro of one axis."""
    found = table(data("data", "oven_resistors", f"{which}.csv"))
    return {
        "time": (found["time"], "s"),
        "gyro": (found["ppm"][:, None] * PPM, "rad/s"),
        "temperature": (found["oven"], "degC"),
        "ambient": (found["ambient"], "degC"),
    }


def _oven(which: str, order: Sequence[int], folder: Path) -> Prepared:
    path = write(folder / f"{which}.h5", oven_columns(which))
    parts = [[f"{path}{RAMPS[k - 1]}"] for k in order]
    config = oven_config(which, OVEN_UNITS)
    if which == "control":
        return Prepared(config, *parts)
    told = min(_told_of_lag(path, order, tau) for tau in np.geomspace(300, 10_000, 12))
    return Prepared(config, *parts, truths=(names.memory(1800.0),), tolerated=BETTER_MAP, oracle=told)


def _told_of_lag(path: Path, order: Sequence[int], tau: float) -> float:
    """Return the error of a model that knows the lag, in equilibrium at 25 degC when the oven was switched on."""
    with h5py.File(path) as file:
        t, z, T = (file[name][()] for name in ("time", "gyro", "temperature"))
    told = Told(z, T, (T - late(T, tau))[:, None])
    ramps = [told.where((t >= start) & (t < stop)) for start, stop in spans(RAMPS)]
    first, second, judged = (ramps[k - 1] for k in order)
    return error_told_of_measured([first, second], judged)


def _sweeps(fitted: int, judged: int, folder: Path) -> Prepared:
    """Two heating sweeps of a board, a straight line declared where a cubic is needed; rows taken to be 1 s apart."""
    told = []
    for k in (fitted, judged):
        found = table(data("data", "rtimulib2_teensy", f"measurements{k}.csv"))
        good = found["ok"] == 1
        gyro = np.stack([found[f"g{axis}_rad_s"][good] for axis in "xyz"], axis=1)
        columns = {"time": (np.arange(len(gyro)) * 1.0, "s"), "gyro": (gyro, "rad/s"),
                   "temperature": (found["temp_C"][good], "degC")}  # fmt: skip
        write(folder / f"sweep{k}.h5", columns)
        told.append(Told(gyro, columns["temperature"][0], np.empty((len(gyro), 0))).means())
    straight = {"kind": "polynomial", "order": 1, "outside": "clamp"}
    gyro = follows("4.5e-4 rad/s/sqrt(Hz)", "1e-6 rad/s/sqrt(s)", straight)
    config = config_of({"time": "s", "gyro": "rad/s", "temperature": "degC"}, gyro)
    first, second = ([str(folder / f"sweep{k}.h5")] for k in (fitted, judged))
    T = (told[0].T - 30) / 20, (told[1].T - 30) / 20
    oracle = spread(told[1].z - np.vander(T[1], 4) @ np.linalg.lstsq(np.vander(T[0], 4), told[0].z, rcond=None)[0])
    return Prepared(config, first, first, second, truths=(names.curve(),), oracle=oracle)


def placements(path: Path) -> list[str]:
    """Return the three placements of the CATS recording as parts of its file."""
    return [f"{path}::{start:g}:{'' if np.isinf(stop) else f'{stop:g}'}" for start, stop in PLACEMENTS]


def _cats(holdout: int, declared: bool, folder: Path) -> Prepared:
    parts = placements(cats())
    judged = parts.pop(holdout - 1)
    if not declared:
        config = cats_config(CATS_UNITS, declared=False, paths=CATS_PATHS)
        return Prepared(config, parts, parts, [judged], truths=(names.curve(),))
    paths = {**CATS_PATHS, "magnetic_field": "magnetic_density"}
    return Prepared(cats_config({**CATS_UNITS, **CATS_MORE}, paths=paths), parts, parts, [judged])


BLIND = {"a": (), "b": ("voltage", "pressure"), "c": ("voltage", "pressure", "temperature_case", "magnetic")}
BLIND_UNITS = {"voltage": "V", "pressure": "hPa", "temperature_case": "degC", "magnetic": "uT"}
BLIND_TOLD = 8e-6 * np.sqrt(3)  # rad/s: the error of a model that knows them, as the recordings' README says


def _blind(unit: str, folder: Path) -> Prepared:
    home = data("blind", unit)
    units = {"time": "s", "gyro": "deg/s", "accel": "g", "temperature": "degC"}
    units |= {name: BLIND_UNITS[name] for name in BLIND[unit]}
    walk = {"noise": "0.004 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 m/s^2/sqrt(s)"}}
    gyro = follows("3.1 deg/h/sqrt(Hz)", "0.02 deg/h/sqrt(s)", {"kind": "spline"})
    config = config_of(units, gyro, accel=walk, latitude="40.9 deg", heading="0 deg")
    with h5py.File(home / "holdout.h5") as file:
        bias = file["time"][()], np.load(home / "holdout_bias_truth.npy")
    truths = {"a": (names.play(9.0),), "b": (names.linear("voltage"),), "c": ()}[unit]
    parts = [[str(home / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    return Prepared(config, *parts, truths=truths, bias=bias, oracle=BLIND_TOLD)


def cases() -> Iterator[Case]:
    """Yield the measured cases and the controls; of each recording, one way round is to develop on."""
    for k in (3, 1, 2):
        split = "develop" if k == 3 else "check"
        yield Case(f"cats, holdout {k}", "control", split, partial(_cats, k, True))
        yield Case(f"cats undeclared, holdout {k}", "measured", split, partial(_cats, k, False),
                   bed=f"cats, holdout {k}")  # fmt: skip
    for order in ((1, 2, 3), (2, 1, 3), (2, 3, 1), (3, 1, 2)):
        split, shown = "develop" if order == (1, 2, 3) else "check", "".join(map(str, order))
        yield Case(f"oven control, ramps {shown}", "control", split, partial(_oven, "control", order))
        yield Case(f"oven lagging, ramps {shown}", "measured", split, partial(_oven, "lagging", order))
    yield Case("sweeps, 2 to 3", "measured", "develop", partial(_sweeps, 2, 3))
    yield Case("sweeps, 3 to 2", "measured", "check", partial(_sweeps, 3, 2))
    yield Case("blind c", "control", "develop", partial(_blind, "c"))
    for unit in "ab":
        yield Case(f"blind {unit}", "simulated", "develop", partial(_blind, unit))
