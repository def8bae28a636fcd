"""The result of a run on three minutes of samples, worked out from the samples by NumPy alone.

The samples are read by an independent reader (h5py, or text cell by cell). A run that ended with 0 must have read the
same numbers, have no NaN or infinity where the undisturbed run has none, have said what it left out and how many rows,
and agree with the undisturbed run where the samples do.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torture.outcome import Outcome, Said

GAP = 600.0  # s without a sample, in a recording of 180 s, of which nobody is told
STUCK = 100
ABSURD = 1e30
UNUSABLE = r"not a (finite )?number|beyond"
COAST = ("coast", "coast_sigma")  # NaN before the end of the alignment, also in the undisturbed run


@dataclass
class Results:
    """The summary, columns and notes that a run has left."""

    summary: dict[str, Any]
    columns: dict[str, np.ndarray]
    notes: list[str]

    @classmethod
    def of(cls, folder: Path, said: Said) -> Results:
        """Read them."""
        with h5py.File(folder / "estimates.h5") as file:
            columns = {name: data[()] for name, data in file.items()}
        return cls(json.loads((folder / "summary.json").read_text()), columns, said.notes)

    def same(self, other: Results) -> bool:
        """Tell if both have the same estimates, within rounding."""
        if self.columns["t"].shape != other.columns["t"].shape:
            return False
        names = ("t", "x", "sigma", "bias", "bias_sigma")
        scales = {name: np.abs(other.columns[name]).max(axis=0) for name in names}
        return all(
            np.all(np.abs(self.columns[name] - other.columns[name]) <= 1e-9 * scales[name] + 1e-15) for name in names
        )


def not_finite(found: Results, clean: Results, *, same_config: bool = True) -> str | None:
    """Say where a number is not finite that is so in the undisturbed run; other configs may leave a score undefined."""
    aligned = found.summary["t"]["aligned_s"]
    if aligned is None:
        return "summary.json: t.aligned_s"
    for name, values in found.columns.items():
        rows = found.columns["t"] > aligned if name in COAST else slice(None)
        if name in clean.columns and not np.all(np.isfinite(values[rows].astype(np.float64))):
            return f"estimates.h5: {name}"
    told = bool(found.notes) or not same_config
    for path, value in _leaves(found.summary):
        if isinstance(value, float) and not np.isfinite(value):
            return f"summary.json: {path}"
        needed = path.startswith(("t.", "bias_rad_s", "noise_ratio", "updates"))
        if value is None and (needed or not told) and _leaf(clean.summary, path) is not None:
            return f"summary.json: {path} is null"
    return None


def _leaves(value: Any, path: str = "") -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in _leaves(item, f"{path}.{key}".lstrip("."))]
    if isinstance(value, list):
        return [leaf for k, item in enumerate(value) for leaf in _leaves(item, f"{path}.{k}")]
    return [(path, value)]


def _leaf(summary: dict[str, Any], path: str) -> Any:
    return dict(_leaves(summary)).get(path)


@dataclass
class Truth:
    """Samples as an independent reader has them; `demands` say what a run on them must tell."""

    data: dict[str, np.ndarray]  # SI; time (N,), gyro and accel (N, d), temperature (N,)
    torn: int = 0  # lines at the end of a text that must be reported as torn

    def usable(self) -> np.ndarray:
        """Return which rows (N,) are finite in every channel."""
        good = np.ones(len(self.data["time"]), dtype=bool)
        for values in self.data.values():
            good &= np.isfinite(values).reshape(len(values), -1).all(axis=1)
        return good

    def sane(self) -> np.ndarray:
        """Return which rows (N,) have no value that no sensor of this world gives."""
        good = np.ones(len(self.data["time"]), dtype=bool)
        for values in self.data.values():
            with np.errstate(invalid="ignore"):
                good &= (np.abs(values) < ABSURD).reshape(len(values), -1).all(axis=1)
        if "temperature" in self.data:
            T = self.data["temperature"].reshape(len(good), -1)
            good &= ~np.any((T < -273.15) | (T > 5000), axis=1)  # degC, as robustness.md says
        return good

    def complaint(self, found: Results, clean: Results) -> str | None:
        """Say what the run should have refused or told, and did not."""
        if not len(self.data["time"]):
            return "a recording without rows was used"
        good, told = self.usable(), "\n".join(found.notes)
        counted = sum(v["count"] for k, v in found.summary["faults"].items() if re.search(UNUSABLE, k))
        if counted and counted == np.sum(~(good & self.sane())):
            good &= self.sane()  # so large that they were left out too, and told
        if counted != np.sum(~good):
            return f"rows with NaN: {'not' if not counted else 'wrongly'} counted"
        t = self.data["time"][good]
        if not len(t):
            return "a recording without a usable row was used"
        steps = np.diff(t)
        if np.any(steps < 0):
            return "time runs backwards"
        if np.any(steps == 0) and "repeat a time stamp" not in told:
            return "repeated time stamps, no note"
        if self.torn and "torn" not in told:
            return "torn last line, no note"
        if len(t) > 1 and steps.max() > GAP and set(found.notes) <= set(clean.notes):
            return "a gap longer than the recording, no note"
        if self._stuck(good) and "stuck" not in told:
            return "a stuck sensor, no note"
        return None

    def _stuck(self, good: np.ndarray) -> bool:
        for name in ("gyro", "accel"):
            for column in self.data[name][good].T:
                ends = np.flatnonzero(np.diff(column) != 0)
                runs = np.diff(np.concatenate([[-1], ends, [len(column) - 1]]))
                if runs.max() > STUCK:
                    return True
        return False

    def differs(self, read: dict[str, np.ndarray]) -> str | None:
        """Say where the numbers that the program has read are others."""
        for name, values in self.data.items():
            mine = np.asarray(values, dtype=np.float64)
            theirs = read[name]
            if mine.size != theirs.size:
                return f"{name}: {theirs.shape} values were read, {mine.shape} are there"
            scale = np.abs(mine, where=np.isfinite(mine), out=np.zeros_like(mine)) * 1e-9
            close = np.abs(mine.ravel() - theirs.ravel()) <= scale.ravel() + 1e-300
            equal = (mine.ravel() == theirs.ravel()) | (np.isnan(mine.ravel()) & np.isnan(theirs.ravel()))
            if not np.all(close | equal):
                return f"{name}: other numbers were read than are there"
        return None


def plausible(found: Results) -> bool:
    """Tell if the last bias is what the rate was, seconds before: within ten deviations of both."""
    rate, bias, sigma = (found.columns[name] for name in ("rate", "bias", "bias_sigma"))
    last = found.columns["t"] > found.columns["t"][-1] - 20
    if np.sum(last) < 50 or not np.all(found.columns["used"][last]):
        return True
    spread = np.std(rate[last], axis=0) / np.sqrt(np.sum(last))
    return bool(np.all(np.abs(bias[-1] - rate[last].mean(axis=0)) <= 10 * (sigma[-1] + spread) + 1e-12))


def judge(found: Results, truth: Truth | None, read: dict[str, np.ndarray], clean: Results, same: bool) -> Outcome:
    """Return the outcome of a run that ended with 0; `same`: whether the samples are those of the undisturbed run."""
    if problem := not_finite(found, clean):
        return Outcome("nonsense", f"not finite: {problem}", "\n".join(found.notes))
    if truth is None:
        return Outcome("nonsense", "used, though an independent reader cannot read it", "\n".join(found.notes))
    if problem := truth.complaint(found, clean) or truth.differs(read):
        return Outcome("nonsense", problem, "\n".join(found.notes))
    if same and not found.same(clean):
        return Outcome("nonsense", "the same samples, other results")
    silent = set(found.notes) <= set(clean.notes)
    if silent and not plausible(found):
        return Outcome("nonsense", "bias is not what was measured, and nothing is said")
    return Outcome("undetectable" if silent and not same else "accepted")
