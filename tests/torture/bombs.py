"""Small files that declare much, inflate to much, or have no end: what it costs the program to read or to refuse them.

Each case is a process of its own, whose memory (its peak, over that of an ordinary run) and time of the processor are
measured. A file that costs more than the budget and its rows is a hang, whatever was said of it.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torture import base, bombs_of_logs, bombs_of_pipes
from torture.commands import MAIN
from torture.outcome import Outcome, Said

CASES, WORKERS, LIMIT, IN_PROCESS = 90, 2, 240.0, False
RNG = np.random.Generator
MEMORY, SECONDS = 1_500_000_000, 60.0  # the budget, over an ordinary run and what the rows cost
ROW, ROW_SECONDS = 100, 2e-5  # bytes and s of the processor that a row may cost
MOST, LONGEST = 12 << 30, 200  # bytes of addresses that a process may have, and s of the processor
NAMES = ["torture.bombs_of_logs", "torture.bombs_of_columns", "torture.bombs_of_arrays", "torture.bombs_of_pipes"]
MODULES = [import_module(name) for name in NAMES if find_spec(name)]
FORMATS: dict[str, Callable[[RNG, Path], None]] = {k: make for m in MODULES for k, make in m.FORMATS.items()}
SUFFIXES: dict[str, str] = {k: suffix for m in MODULES for k, suffix in m.SUFFIXES.items()}
MAPS = ("onnx_network", "polynomial")
FRAMING = {
    "kind": "binary", "sync": "A5 5A", "checksum": {"kind": "sum8", "start": 2},
    "fields": [{"name": name, "type": "int16", "count": 3, "unit": unit}
               for name, unit in (("gyro", "0.01 deg/s"), ("accel", "0.001 m/s^2"))],
}  # fmt: skip


class Cost(NamedTuple):
    """The cost of a process: bytes at its peak, s of the processor, and by the clock."""

    memory: int
    seconds: float
    wall: float


def prepare(folder: Path) -> None:
    """Write an ordinary recording."""
    (folder / "recording.csv").write_text(base.csv_text(base.recording(100)))


def measured(folder: Path, *args: object, feeder: subprocess.Popen[bytes] | None = None) -> tuple[Said, Cost]:
    """Run the program, on what `feeder` writes where there is one, and measure it."""

    def limits() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MOST, MOST))
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST + 5))

    temporary = folder / "tmp"
    temporary.mkdir(exist_ok=True)
    environment = {**os.environ, "TMPDIR": str(temporary), "MPLBACKEND": "Agg", "OPENBLAS_NUM_THREADS": "1"}
    since = time.monotonic()
    with (folder / "out.txt").open("wb") as out, (folder / "err.txt").open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-c", MAIN, *map(str, args)], cwd=folder, stdout=out, stderr=err,
            stdin=feeder.stdout if feeder else subprocess.DEVNULL, env=environment, preexec_fn=limits,
        )  # fmt: skip
        if feeder and feeder.stdout:
            feeder.stdout.close()
        _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    said = [(folder / name).read_text(errors="replace") for name in ("out.txt", "err.txt")]
    cost = Cost(1024 * used.ru_maxrss, used.ru_utime + used.ru_stime, time.monotonic() - since)
    return Said(process.returncode, *said), cost


def config(kind: str, path: Path, ordinary: Path) -> dict[str, Any]:
    """Return a config that reads a file: a recording, or a map."""
    if kind in MAPS:
        return base.config(base.source("csv", path=str(ordinary)), calibration={"kind": kind, "path": str(path)})
    if kind == "hdf5":
        return base.config(base.source(kind, path=str(path)))
    if kind == "mat":
        return base.config({**base.source("hdf5", path=str(path)), "kind": kind, "channels": {
            name: {"path": name, "unit": unit} for name, unit in base.UNITS.items()
        }})  # fmt: skip
    if kind == "binary_log":
        channels = {name: {"path": name} for name in ("gyro", "accel")}
        return base.config(
            {"kind": kind, "path": str(path), "framing": FRAMING, "interval": "10 ms", "channels": channels}
        )
    channels = bombs_of_logs.CHANNELS.get(kind)
    more = {"channels": channels} if channels else {}
    return base.config({**base.source(kind, path=str(path)), **more})


class Bench:
    """The cost of an ordinary run."""

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder = folder
        base.write_config(case / "config.yaml", config("csv", folder / "recording.csv", folder))
        measured(case, "run", "config.yaml", "--out", "first")  # compiles what is not compiled
        said, self.ordinary = measured(case, "run", "config.yaml", "--out", "out")
        if said.status:
            raise RuntimeError(f"the ordinary run: {said}")

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """Make a file of each format in turn, and have it read by `run`, or by `init`."""
        name = list(FORMATS)[number % len(FORMATS)]
        kind = name.partition(" ")[0]
        path = folder / f"bomb{SUFFIXES.get(name) or SUFFIXES[kind]}"
        FORMATS[name](rng, path)
        feeder = bombs_of_pipes.feed(path) if path.suffix == ".pipe" else None
        if kind == "config":
            command: list[object] = ["check", path]
        elif feeder is None and kind not in MAPS and rng.integers(4) == 0:
            command = ["init", path, "--out", "made.yaml"]
        else:
            base.write_config(folder / "config.yaml", config(kind, path, self.folder / "recording.csv"))
            command = ["run", "config.yaml", "--out", "out", *(["--input", "-"] if feeder else [])]
        said, cost = measured(folder, *command, feeder=feeder)
        if feeder:
            feeder.wait()
        return self.judged(name, said, cost, folder)

    def judged(self, name: str, said: Said, cost: Cost, folder: Path) -> Outcome:
        """Return what it came to."""
        rows = 0
        if said.status == 0 and (folder / "out" / "summary.json").is_file():
            rows = json.loads((folder / "out" / "summary.json").read_text()).get("faults", {}).get("rows", 0)
        memory = cost.memory - self.ordinary.memory - ROW * rows
        seconds = cost.seconds - self.ordinary.seconds - ROW_SECONDS * rows
        about = (
            f"{name}: {memory / 1e6:.0f} MB and {seconds:.1f} s over an ordinary run, {rows} rows\n{said.err[-2000:]}"
        )
        if memory > MEMORY:
            return Outcome("hang", f"memory over budget, {name}", about)
        if seconds > SECONDS:
            return Outcome("hang", f"time over budget, {name}", about)
        if any(folder.glob("tmp/driftlab-*")):
            return Outcome("lost", f"room in TMPDIR, {name}", about)
        if said.status == 0 and rows == 0 and (folder / "out").exists():
            rows = -1
        refused = said.refused()
        if refused is None:
            return Outcome("accepted", detail=about)
        return Outcome(refused.kind, refused.cause and f"{refused.cause}, {name}", about + refused.detail)
