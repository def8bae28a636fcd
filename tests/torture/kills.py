"""`run` and `live` killed at random moments: what was flushed is readable, and `--resume` goes on to the same end."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from bench import FRAMING, Device, paced, unit_frames

from torture import base
from torture.commands import begin, call, ended, kill
from torture.outcome import Outcome, program

CASES, WORKERS, LIMIT, IN_PROCESS = 60, 5, 45.0, False
RNG = np.random.Generator
LIVE_RATE = 200
ESTIMATES = ("t", "bias", "bias_sigma", "x", "sigma")
RAW = ("time", "gyro", "accel", "temperature")


def prepare(folder: Path) -> None:
    """Write a longer recording and its config."""
    base.write_h5(folder / "recording.h5", base.recording(300, 100))
    base.write_config(folder / "run.yaml", base.config(base.source("hdf5", path=str(folder / "recording.h5"))))


def live_config(folder: Path, device: Device) -> None:
    """Write the config of a device."""
    source = {"kind": "serial", "port": str(device.path), "interval": f"{1 / LIVE_RATE} s", "framing": FRAMING}
    content = base.config(source)
    content["filter"]["align"] = "2 s"
    base.write_config(folder / "live.yaml", content)


def rows(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray] | None:
    """Return the whole rows of a file, closed or not by its writer; None where it cannot be opened."""
    for swmr in (False, True):
        try:
            with h5py.File(path, "r", swmr=swmr) as file:
                N = min((len(file[name]) for name in names if name in file), default=0)
                return {name: file[name][:N] for name in names if name in file}
        except OSError:
            continue
    return None


def count(data: dict[str, np.ndarray] | None) -> int:
    """Return how many rows there are."""
    return len(next(iter(data.values()))) if data else 0


def begins_with(long: dict[str, np.ndarray], short: dict[str, np.ndarray], N: int) -> bool:
    """Tell if the first N rows are the same, within rounding."""
    for name, values in short.items():
        scale = np.nanmax(np.abs(long[name][:N]), axis=0, initial=0.0)
        if not np.all(np.abs(long[name][:N] - values[:N]) <= 1e-9 * scale + 1e-15):
            return False
    return True


class Bench:
    """The undisturbed run."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder = folder
        since = time.monotonic()
        said = ended(begin(folder, "run", "run.yaml", "--out", case / "out", slowly=True))
        self.seconds = time.monotonic() - since
        if isinstance(said, Outcome) or said.status:
            raise RuntimeError(f"the undisturbed run ended with {said}")
        self.reference = rows(case / "out" / "estimates.h5", ESTIMATES)
        self.summary = json.loads((case / "out" / "summary.json").read_text())

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """Kill the one or the other, and go on."""
        if number % 2 == 0:
            return self._run(rng, folder)
        device = Device(folder)
        stop = threading.Event()
        try:
            live_config(folder, device)
            sender = paced(device, unit_frames(90, LIVE_RATE, int(rng.integers(100))), LIVE_RATE, stop)
            return self._live(rng, folder)
        finally:
            stop.set()
            sender.join()
            device.close()

    def _run(self, rng: RNG, folder: Path) -> Outcome:
        args: list[Any] = ["run", self.folder / "run.yaml", "--out", folder / "out"]
        for k in range(int(rng.choice([1, 1, 2, 3]))):
            process = begin(folder, *args, *(["--resume"] if k else []), slowly=True)
            time.sleep(rng.uniform(0, self.seconds))
            alive = process.poll() is None
            kill(process)
            if not alive and process.returncode:
                return Outcome("traceback", "ended before it was killed", str(process.returncode))
            if problem := self._flushed(folder):
                return problem
        said = ended(begin(folder, *args, "--resume"))
        refused = said if isinstance(said, Outcome) else said.refused()
        if refused is not None:
            return (
                refused if refused.kind != "clean" else Outcome("lost", "`run --resume` does not go on", refused.detail)
            )
        found = rows(folder / "out" / "estimates.h5", ESTIMATES)
        if found is None or self.reference is None or count(found) != count(self.reference):
            return Outcome("lost", "`run --resume` ends with other rows", f"{count(found)}")
        if not begins_with(self.reference, found, count(found)):
            return Outcome("nonsense", "`run --resume` ends with other estimates")
        summary = json.loads((folder / "out" / "summary.json").read_text())
        if any(summary[key] != self.summary[key] for key in ("faults", "motion_s", "updates")):
            return Outcome("nonsense", "`run --resume` ends with other notes", str(summary["faults"]))
        return Outcome("accepted")

    def _flushed(self, folder: Path) -> Outcome | None:
        """Check what a killed run has left."""
        checkpoint = next(folder.glob("out.partial/checkpoint*.npz"), None)
        if checkpoint is None:
            return None
        from driftlab.filtering.checkpoint import read_checkpoint

        safe = read_checkpoint(checkpoint)["rows"]
        found = rows(checkpoint.with_name("estimates.h5"), ESTIMATES)
        if count(found) < safe:
            return Outcome("lost", "estimates that a checkpoint stands on", f"{count(found)} of {safe} rows")
        assert found is not None, "there are rows"
        assert self.reference is not None, "there are rows"
        if not begins_with(self.reference, found, safe):
            return Outcome("lost", "estimates that were flushed are others", f"of {safe} rows")
        return None

    def _live(self, rng: RNG, folder: Path) -> Outcome:
        args = ["live", "live.yaml", "--record", "raw.h5", "--out", "out", "--json"]
        kept: dict[str, np.ndarray] = {}
        for k in range(int(rng.choice([1, 1, 2]))):
            process = begin(folder, *args, *(["--resume"] if k else []))
            time.sleep(rng.uniform(0, 7))
            printed = kill(process)
            if process.returncode != -9:
                return Outcome("lost", "`live` ended before it was killed", printed)
            told = [json.loads(line)["recorded"] for line in printed.splitlines() if line.endswith("}")]
            found = rows(folder / "raw.h5", RAW) if (folder / "raw.h5").exists() else {}
            if problem := _kept(kept, found, max(told, default=0)):
                return problem
            kept = found or {}
        said = call(folder, *args, "--resume", "--duration", "3 s")
        refused = said if isinstance(said, Outcome) else said.refused()
        if refused is not None:
            return (
                refused
                if refused.kind != "clean"
                else Outcome("lost", "`live --resume` does not go on", refused.detail)
            )
        if problem := _kept(kept, rows(folder / "raw.h5", RAW), count(kept) + 1):
            return problem
        return self._again(folder)

    @staticmethod
    def _again(folder: Path) -> Outcome:
        """Compare with a run on what was recorded."""
        refused = program(
            "run", folder / "live.yaml", "--input", folder / "raw.h5", "--out", folder / "again"
        ).refused()
        if refused is not None:
            return refused
        live, again = (rows(folder / name / "estimates.h5", ESTIMATES) for name in ("out", "again"))
        if live is None or again is None or count(live) != count(again) or not begins_with(live, again, count(live)):
            return Outcome(
                "nonsense", "a run on the recording ends with other estimates", f"{count(live)} {count(again)}"
            )
        return Outcome("accepted")


def _kept(before: dict[str, np.ndarray], now: dict[str, np.ndarray] | None, least: int) -> Outcome | None:
    """Check that what was recorded is there, in order."""
    if now is None:
        return Outcome("lost", "the recording cannot be opened") if least or before else None
    if count(now) < max(least, count(before)):
        return Outcome("lost", "rows of the recording", f"{count(now)} rows, {max(least, count(before))} were safe")
    if count(now) and np.any(np.diff(now["time"]) <= 0):
        return Outcome("nonsense", "the recording's time runs backwards")
    if any(not np.array_equal(now[name][: count(before)], values) for name, values in before.items()):
        return Outcome("lost", "rows of the recording are others than before")
    return None
