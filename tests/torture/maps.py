"""Hostile maps, JSON and ONNX, through `driftlab check` and a short run, against an evaluation of our own.

A map that was used must be of gyro biases in rad/s, over a finite range that holds the recording's temperatures, and
what was subtracted must be what NumPy (Chebyshev), SciPy (B-splines) or the reference evaluator of ONNX gives.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.polynomial import chebyshev
from onnx.reference import ReferenceEvaluator
from scipy.interpolate import BSpline

from torture import base
from torture.map_mutations import KEY, mutate
from torture.outcome import Outcome, program
from torture.truth import Results, not_finite

CASES, WORKERS, LIMIT, IN_PROCESS = 300, 2, 5.0, True
FILES = {
    "polynomial": "polynomial.json",
    "spline": "spline.json",
    "onnx_network": "network.onnx",
    "slope": "slope.onnx",
}
RNG = np.random.Generator


def prepare(folder: Path) -> None:
    """Fit one of each kind."""
    base.write_h5(folder / "recording.h5", base.recording(100))
    base.fit_map(folder / FILES["polynomial"], kind="polynomial", order=4)
    base.fit_map(folder / FILES["spline"], kind="spline", interval="5 K")
    for name, target in (("onnx_network", "bias"), ("slope", "slope")):
        base.fit_map(folder / FILES[name], kind="onnx_network", neurons=2, starts=1, target=target)


def record_of(name: str, raw: bytes) -> dict[str, Any]:
    """Return what the file says of itself; raises whatever a damaged one does."""
    if name in ("polynomial", "spline"):
        content = json.loads(raw)
    else:
        found = {entry.key: entry.value for entry in onnx.load_from_string(raw).metadata_props}
        content = json.loads(found[KEY])
    return dict(content)


def evaluate(name: str, raw: bytes, T: np.ndarray) -> np.ndarray | None:
    """Return the bias (N, 3) at T, None for a slope's network."""
    content = record_of(name, raw)
    low, high = content["record"]["domain"]
    if name == "polynomial":
        return chebyshev.chebval((2 * T - low - high) / (high - low), np.array(content["coefficients"], dtype=float)).T
    if name == "spline":
        c = np.array(content["coefficients"], dtype=float)
        h = (high - low) / (len(c) - 3)
        return np.asarray(BSpline(low + h * np.arange(-3, len(c) + 1), c, 3)(T))
    if name == "slope":
        return None
    with np.errstate(all="ignore"):
        model = onnx.load_from_string(raw)
        (result,) = ReferenceEvaluator(model).run(None, {model.graph.input[0].name: T[:, None]})
    return np.asarray(result).reshape(len(T), -1)


def complaint(name: str, raw: bytes, found: Results) -> str | None:
    """Say why this map should not have been used."""
    try:
        record = record_of(name, raw)["record"]
    except Exception:  # whatever a damaged file makes of it
        return "a map that an independent reader cannot read"
    kind = "onnx_network" if name == "slope" else name
    if record["kind"] != kind:
        return "a map of another kind"
    if record.get("unit", "rad/s") != "rad/s":
        return "a map of another unit"
    if record.get("channel", "gyro") != "gyro":
        return "a map of another channel"
    low, high = map(float, record["domain"])
    T = found.columns["temperature"].astype(np.float64)
    if not (np.isfinite([low, high]).all() and low < high and high - low < 1e6):
        return "a map over an infinite range"
    if T.min() < low - 1e-3 or T.max() > high + 1e-3:
        return "temperatures outside the map's range"
    try:
        expected = evaluate(name, raw, T)
    except Exception:
        return "a map that an independent evaluation cannot run"
    used = found.columns["calibration"]
    scale = 1e-5 * (1e-3 + np.abs(used).max())  # temperatures are kept in single precision
    if expected is not None and not np.allclose(expected, used, rtol=0, atol=scale):
        return "not the bias that an independent evaluation gives"
    return None


class Bench:
    """Each map, tried."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder = folder
        self.files = {name: (folder / file).read_bytes() for name, file in FILES.items()}
        self.clean: dict[str, Results] = {}
        for name, raw in self.files.items():
            outcome = self._used(name, raw, case)
            if outcome is not None:
                raise RuntimeError(f"the map {name} was refused: {outcome}")
            self.clean[name] = self.found
            if problem := complaint(name, raw, self.found):
                raise RuntimeError(f"the map {name}: {problem}")

    def _used(self, name: str, raw: bytes, case: Path) -> Outcome | None:
        """Run with a map; the outcome where it was refused."""
        kind = "onnx_network" if name == "slope" else name
        path = case / FILES[name]
        path.write_bytes(raw)
        target = {"target": "slope"} if name == "slope" else {}
        settings = {"kind": kind, "path": str(path), **target}
        content = base.config(base.source("hdf5", path=str(self.folder / "recording.h5")), calibration=settings)
        base.write_config(case / "config.yaml", content)
        checked = program("check", "config.yaml")
        if checked.trace:
            return checked.refused()
        said = program("run", "config.yaml", "--out", f"out-{name}")
        if said.status == 0 and not said.trace:
            self.found = Results.of(case / f"out-{name}", said)
        return said.refused()

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """Mutate, run and judge."""
        name = list(FILES)[int(rng.integers(len(FILES)))]
        raw = mutate(name, self.files[name], rng)
        refused = self._used(name, raw, folder)
        if refused is not None:
            return refused
        if problem := complaint(name, raw, self.found) or not_finite(self.found, self.clean[name]):
            return Outcome("nonsense", problem)
        return Outcome("accepted" if self.found.same(self.clean[name]) or self.found.notes else "undetectable")
