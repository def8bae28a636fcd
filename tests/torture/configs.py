"""Mutated configs, loaded as `driftlab check` does; one in ten that names a recording is run too.

Where a config is accepted, PyYAML must read it, every quantity in it must be one by the grammar here and have the value
that is computed here, every number must be the one that is written, finite and no truth value, and no key be unknown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torture import base, grammar
from torture.config_mutations import get, leaves, mutate
from torture.outcome import Outcome, program
from torture.truth import Results, not_finite

CASES, WORKERS, LIMIT, IN_PROCESS = 5_000, 2, 5.0, True
RUN_EVERY = 10
QUANTITIES = {
    "latitude", "heading", "update_interval", "align", "noise", "range", "walk", "sigma_0", "tau", "attitude",
    "velocity",
    "realign_after", "window", "interval", "start", "stop", "min_swing", "width", "low", "high", "silent_after",
    "tick", "period",
}  # fmt: skip
NUMBERS = {"false_alarm", "order", "neurons", "starts", "seed", "coefficients", "smoothing", "baudrate", "buffer",
"scale",
           "offset", "modulo", "count", "equals", "zero", "intervals"}  # fmt: skip


def bases(folder: Path) -> list[dict[str, Any]]:
    """Return valid configs; the first four can be run."""
    h5 = base.source("hdf5", path=str(folder / "recording.h5"))
    csv = base.source("csv", path=str(folder / "recording.csv"), start="0 s", stop="170 s")
    polynomial = {
        "kind": "polynomial",
        "order": 3,
        "path": str(folder / "map.json"),
        "outside": "clamp",
        "min_swing": "2 K",
    }
    effects = [
        {"kind": "hysteresis", "width": "9 K", "coefficients": [2.4e-5, -3.0e-5, 1.8e-5]},
        {"kind": "turn_on", "tau": "600 s", "coefficients": [0, 0, 0], "sigma": [1e-5, 1e-5, 1e-5], "estimate": True},
    ]
    derivative = {
        "kind": "thermal_derivative",
        "walk": base.WALK,
        "sigma_0": "10 deg/h",
        "map": polynomial,
        "effects": effects,
    }
    markov = {"kind": "gauss_markov", "sigma": "10 deg/h", "tau": "5 min", "sigma_0": "1 deg/s"}
    binary = {
        "kind": "binary", "sync": "A5 5A",
        "fields": [{"name": "sequence", "type": "uint16"}, {"name": "gyro", "type": "float32", "count": 3,
        "unit": "deg/s", "scale": 0.5},
                   {"name": "accel", "type": "int16", "count": 3, "unit": "g", "offset": 0.0}],
        "checksum": {"kind": "CRC-32/ISO-HDLC"}, "counter": {"field": "sequence", "modulo": 65536, "tick": "10 ms"},
    }  # fmt: skip
    text = {
        "kind": "text",
        "channels": {n: {"path": p, "unit": base.UNITS[n]} for n, p in base.PATHS.items() if n != "time"},
    }
    kvh = {"kind": "kvh_1775", "interval": "10 ms"}
    serial = {
        "kind": "serial",
        "port": "/dev/ttyUSB0",
        "baudrate": 115200,
        "interval": "10 ms",
        "buffer": 65536,
        "window": "60 s",
    }
    spline = {"kind": "spline", "interval": "1 K", "smoothing": 1.0}
    full = base.config(h5, derivative, range="300 deg/s")
    full["filter"] |= {
        "update_interval": "0.1 s", "temperature_rate": {"kind": "regression", "window": "60 s"},
        "rest": {"attitude": "1e-6 rad", "velocity": "1e-5 m/s", "false_alarm": 1e-7, "realign_after": "60 s"},
    }  # fmt: skip
    kalman = base.config(csv, markov, calibration=polynomial)
    kalman["filter"]["temperature_rate"] = {"kind": "kalman", "noise": "0.1 K", "walk": "2e-4 K/s/sqrt(s)"}
    kalman["heading"] = "10 deg"
    return [
        base.config(h5), base.config(csv), full, kalman,
        base.config(serial | {"framing": binary}), base.config(serial | {"framing": text}),
        base.config(serial | {"framing": kvh}),
        base.config(h5, {"kind": "constant", "sigma_0": "1 deg/s"}, calibration=spline),
    ]  # fmt: skip


def prepare(folder: Path) -> None:
    """Write the recordings and the map that the configs name."""
    data = base.recording()
    base.write_h5(folder / "recording.h5", data)
    (folder / "recording.csv").write_text(base.csv_text(data))
    base.fit_map(folder / "map.json", kind="polynomial", order=3)


class Bench:
    """The valid configs, tried."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.bases = bases(folder)
        self.clean = []
        for k, content in enumerate(self.bases):
            base.write_config(case / "config.yaml", content)
            said = program("check", "config.yaml")
            if k < 4 and said.status == 0:
                said = program("run", "config.yaml", "--out", f"out{k}")
                self.clean.append(Results.of(case / f"out{k}", said))
            if said.status != 0:
                raise RuntimeError(f"valid config {k} was refused: {said}")

    def case(self, number: int, rng: np.random.Generator, folder: Path) -> Outcome:
        """Mutate and load."""
        runs = number % RUN_EVERY == 0
        k = int(rng.integers(4 if runs else len(self.bases)))
        (folder / "config.yaml").write_bytes(mutate(self.bases[k], rng, folder))
        said = program("check", "config.yaml")
        refused = said.refused()
        if refused is not None:
            return refused
        if problem := nonsense(folder / "config.yaml"):
            return Outcome("nonsense", problem, (folder / "config.yaml").read_text(errors="replace"))
        if (again := self._again(folder, said.out)) is not None:
            return again
        if not runs:
            return Outcome("accepted")
        said = program("run", "config.yaml", "--out", "out")
        refused = said.refused()
        if refused is not None:
            return refused
        problem = not_finite(Results.of(folder / "out", said), self.clean[k], same_config=False)
        return Outcome("nonsense", f"run: not finite: {problem}") if problem else Outcome("accepted")

    @staticmethod
    def _again(folder: Path, printed: str) -> Outcome | None:
        """Check what `check` has printed: the output is a config again."""
        (folder / "printed.yaml").write_text(printed)
        said = program("check", "printed.yaml")
        if said.trace:
            return said.refused()
        if said.status != 0:
            return Outcome("nonsense", "what `check` prints is no config", said.err)
        return None


def nonsense(path: Path) -> str | None:
    """Say what should not have been accepted in a config that was."""
    from driftlab.config import load_config

    try:
        tree = yaml.safe_load(path.read_bytes().decode("utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, TypeError, RecursionError) as error:
        return f"PyYAML cannot read it ({type(error).__name__})"
    loaded = load_config(path)
    for at, value in leaves(tree):
        try:
            found = _loaded(loaded, at)
        except (AttributeError, KeyError, IndexError, TypeError):
            if value is None or at[0] == "extends" or (value in ([], {})):
                continue
            return f"key that the config does not know: {at[-1]}"
        if problem := _wrong(at, value, found, tree):
            return problem
    return None


def _loaded(loaded: Any, at: tuple[Any, ...]) -> Any:
    for key in at:
        loaded = loaded[key] if isinstance(loaded, Mapping | tuple | list) else getattr(loaded, str(key))
    return loaded


def _wrong(at: tuple[Any, ...], value: Any, found: Any, tree: Any) -> str | None:
    """Say what is wrong with a leaf as it was understood."""
    key = next(str(k) for k in reversed(at) if not isinstance(k, int))
    parent = get(tree, at[:-1]) if isinstance(at[-1], str) else {}
    if value is None:
        return None
    if key in QUANTITIES or (key == "sigma" and isinstance(parent, dict) and parent.get("kind") == "gauss_markov"):
        return _wrong_quantity(key, value, found)
    if key == "unit":
        try:
            grammar.unit_with_factor(str(value))
        except grammar.NotAQuantity:
            return "unit that is none"
        except grammar.NotKnown:
            return None
    if key in NUMBERS or isinstance(found, float | int):
        if isinstance(value, bool) is not isinstance(found, bool) and isinstance(value, bool):
            return f"truth value for a number: {key}"
        if isinstance(found, float | int) and not isinstance(found, bool) and not math.isfinite(found):
            return f"number that is not finite: {key}"
        if isinstance(value, int | float) and not isinstance(value, bool) and value != found:
            return f"other number than written: {key}"
    return None


def _wrong_quantity(key: str, value: Any, found: Any) -> str | None:
    if not isinstance(value, str):
        return f"quantity without a unit: {key}"
    try:
        size, powers = grammar.quantity(value)
    except grammar.NotAQuantity:
        return "text that is not `number unit`"
    except grammar.NotKnown:
        return None
    if not powers:
        return "number without a unit in a text"
    if not isinstance(found, float) or not math.isfinite(found):
        return f"quantity that is not finite: {key}"
    if not math.isclose(size, found, rel_tol=1e-9, abs_tol=1e-300):
        return f"quantity with another value than written: {key}"
    return None
