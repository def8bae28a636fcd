"""Extremes of numbers, in the core and in the application: right, or refused by name.

Of the core, covariances, measurements and steps of any size, against the same steps in exact fractions. Of the
application, quantities of a config and values of a recording, many powers of ten larger or smaller than any sensor's.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from test_wide_priors import exact

from torture import base
from torture.outcome import Outcome, program

CASES, WORKERS, LIMIT, IN_PROCESS = 2_000, 2, 10.0, True
RNG = np.random.Generator
APPLICATION = 10  # one case in so many
CLOSE = 1e-3  # of sigma
SIZES = ((1, 1), (2, 1), (3, 2))
SETTINGS: dict[tuple[str, ...], str] = {
    ("filter", "gyro", "noise"): "deg/h/sqrt(Hz)", ("filter", "gyro", "bias", "walk"): "deg/h/sqrt(s)",
    ("filter", "gyro", "bias", "sigma_0"): "deg/h", ("filter", "accel", "noise"): "m/s^2/sqrt(Hz)",
    ("filter", "align"): "s", ("filter", "update_interval"): "s", ("latitude",): "deg",
    ("filter", "gyro", "range"): "deg/s", ("filter", "false_alarm"): "",
}  # fmt: skip


def prepare(folder: Path) -> None:
    """Write a recording."""
    base.write_h5(folder / "recording.h5", base.recording(100))


class Bench:
    """The core and the application, tried."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder = folder
        for n, m in SIZES:  # compiled before anything is timed
            core(np.random.default_rng(0), n, m, 1.0)
        program("run", self.config({}), "--out", "out")

    def config(self, content: dict[str, Any]) -> str:
        """Write a config and return its name."""
        source = base.source("hdf5", path=content.pop("path", str(self.folder / "recording.h5")))
        known = base.config(source)
        for at, value in content.items():
            spot = known
            for key in at[:-1]:
                spot = spot[key]
            spot[at[-1]] = value
        base.write_config(Path("config.yaml"), known)
        return "config.yaml"

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """One or the other."""
        if number % APPLICATION:
            n, m = SIZES[rng.integers(len(SIZES))]
            return core(rng, n, m, rng.choice([3.0, 12.0, 40.0, 200.0]))
        return self.settings(rng) if rng.random() < 0.6 else self.values(rng)

    def settings(self, rng: RNG) -> Outcome:
        """Some quantities of a config."""
        spots = list(SETTINGS)
        some = rng.choice(len(spots), size=int(rng.integers(1, 4)), replace=False)
        drawn = {spots[k]: f"{10.0 ** rng.uniform(-40, 40):.6e} {SETTINGS[spots[k]]}".strip() for k in some}
        return judged(program("run", self.config(dict(drawn)), "--out", "out"), Path("out"), str(drawn))

    def values(self, rng: RNG) -> Outcome:
        """A channel, or some of its rows, times a power of ten, or with something added."""
        data = base.recording(100)
        name = str(rng.choice([*data]))
        rows = slice(None) if rng.random() < 0.5 else np.sort(rng.choice(len(data["time"]), 20, replace=False))
        size = 10.0 ** rng.uniform(-40, 200)
        data[name][rows] = data[name][rows] * size if rng.random() < 0.5 else data[name][rows] + size
        if name == "time":
            data[name] = np.sort(data[name])
        base.write_h5(Path("recording.h5"), data)
        said = program("run", self.config({"path": "recording.h5"}), "--out", "out")
        return judged(said, Path("out"), f"{name}, {size:g}")


def judged(said: Any, out: Path, what: str) -> Outcome:
    """Return what a run came to: refused, or every number finite and no sigma zero where something is measured."""
    refused = said.refused()
    if refused is not None:
        return refused
    with h5py.File(out / "estimates.h5") as file:
        for name in ("x", "sigma", "bias", "bias_sigma"):
            if not np.all(np.isfinite(file[name][()])):
                return Outcome("nonsense", f"{name} is not finite", what)
        if np.any(file["bias_sigma"][()] == 0):
            return Outcome("nonsense", "a sigma of 0", what)
    return Outcome("accepted")


def core(rng: RNG, n: int, m: int, span: float) -> Outcome:
    """The filter over three samples, of sizes within `span` powers of ten of one."""
    from fusion_core.contracts import Transition
    from fusion_core.kalman import estimate
    from fusion_core.model import Measurement, State

    def size() -> float:
        return float(10.0 ** rng.uniform(-span, span))

    L = rng.normal(size=(n, n))
    F = np.eye(n) + 0.1 * rng.normal(size=(n, n))
    Q = size() * (L @ L.T) * bool(rng.random() < 0.7)
    P, H, R = size() * np.diag(rng.uniform(0.5, 2, n)), rng.normal(size=(m, n)), np.diag([size() for _ in range(m)])
    z = size() * rng.normal(size=(3, m))
    Q = (Q + Q.T) / 2
    given = Transition(F, Q, np.zeros(n)), Measurement(z, H, R, np.ones(3, dtype=bool))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = estimate(State(np.zeros(n), P), *given)
    except ValueError as error:
        return Outcome("clean", detail=str(error))
    try:
        x, sigma = exact(P, F, Q, H, R, z)
    except OverflowError:
        return Outcome("nonsense", "accepted, and beyond double precision")
    what = f"P {P.max():g}, Q {Q.max():g}, R {R.max():g} {R.min():g}, z {np.abs(z).max():g}"
    if not np.allclose(found.sigma, sigma, rtol=CLOSE, atol=0):
        return Outcome("nonsense", "a sigma of the filter", f"{what}\n{found.sigma}\n{sigma}")
    if np.max(np.abs(found.x - x) / (sigma + 0.1 * np.abs(x).max())) > CLOSE:
        return Outcome("nonsense", "a state of the filter", f"{what}\n{found.x}\n{x}")
    return Outcome("accepted")
