"""`driftlab run` from file to folder: wall, peak memory, where the time goes, and how it grows.

`python end_to_end.py [--short]`: the short form stops at 1 h.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import Row, limit, show
from recording import write_config, write_csv, write_hdf5, write_map

HERE = Path(__file__).parent
STAGES = ("start", "read", "condition", "temperature rate", "map", "filter", "deviations", "write", "report", "digest",
          "rest", "wall")  # fmt: skip


def measured(command: list[str]) -> tuple[float, float]:
    """Run a command; return its wall time in s and its peak memory in GB."""
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - begun
    if status:
        raise SystemExit(f"{command} failed")
    return wall, usage.ru_maxrss / 2**20


def driftlab(*arguments: object) -> list[str]:
    return [str(Path(sys.executable).with_name("driftlab")), *map(str, arguments)]


def run(config: Path, recording: Path, out: Path) -> tuple[float, float]:
    shutil.rmtree(out, ignore_errors=True)
    try:
        return measured(driftlab("run", config, "--input", recording, "--out", out, "--json"))
    finally:
        shutil.rmtree(out, ignore_errors=True)


def stages(config: Path, recording: Path, out: Path) -> dict[str, float]:
    """Return the seconds of each stage of a run."""
    try:
        command = [sys.executable, str(HERE / "stages.py"), str(config), str(recording), str(out)]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    finally:
        shutil.rmtree(out, ignore_errors=True)


def whole_days(folder: Path, fitted: Path, *, short: bool) -> list[Row]:
    """Return the rows of HDF5 recordings, 1 kHz at 10 ms and 100 Hz at every sample."""
    rows: list[Row] = []
    config = write_config(folder / "config.yaml", fitted, "10 ms")
    cases = [(1, 1000, None, None), (6, 1000, None, None), (24, 1000, 30, 10), (24, 100, 8, None)]
    for hours, rate, most, stretch in cases[: 1 if short else None]:
        needed = hours * 3600 * (rate * 36 + 100 * 600)
        if shutil.disk_usage(folder).free < 1.2 * needed:
            rows.append(Row(f"run, {hours} h at {rate} Hz", f"skipped: needs {needed / 1e9:.0f} GB of disk"))
            continue
        recording = write_hdf5(folder / "unit.h5", hours * 3600, rate)
        what = f"run, {hours} h at {rate} Hz, an update every 10 ms"
        wall, memory = min(run(config, recording, folder / "out") for _ in range(1 if hours > 6 else 2))
        rows.append(limit(what, wall, "s", most, stretch))
        rows.append(limit(f"{what}: peak memory", memory, "GB", 1.5))
        found = stages(config, recording, folder / "out")
        total = wall
        rows.append(Row(f"{what}: by stage", ", ".join(f"{k} {found[k]:.2f} s" for k in STAGES if k in found)))
        rows.append(Row(f"{what}: ns a sample", f"{total / (hours * 3600 * rate) * 1e9:.0f}"))
        recording.unlink()
    return rows


def text(folder: Path, fitted: Path, rows: int) -> list[Row]:
    """Return the row of a CSV recording against reading it with polars."""
    config = write_config(folder / "csv.yaml", fitted, "100 ms", kind="csv")
    recording = write_csv(folder / "unit.csv", rows, 100)
    read = f"import polars; polars.read_csv({str(recording)!r})"
    theirs = min(measured([sys.executable, "-c", read])[0] for _ in range(2))
    ours = min(run(config, recording, folder / "out") for _ in range(2))[0]
    recording.unlink()
    return [
        Row(f"polars reads {rows:,} rows of CSV", f"{theirs:.2f} s"),
        limit(f"run on {rows:,} rows of CSV", ours, "s"),
        limit("run / read", ours / theirs, "", 2),
    ]


def start_up(folder: Path, fitted: Path) -> list[Row]:
    config = write_config(folder / "config.yaml", fitted, "100 ms")
    recording = write_hdf5(folder / "short.h5", 600, 100)
    run(config, recording, folder / "out")
    helped = min(measured(driftlab("--help"))[0] for _ in range(5))
    wall = min(run(config, recording, folder / "out") for _ in range(3))[0]
    return [limit("driftlab --help", helped, "s", 0.2), limit("run, 10 min at 100 Hz", wall, "s", 1.5)]


def main() -> None:
    short = "--short" in sys.argv
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fitted = write_map(folder / "map.onnx")
        show("Start-up", start_up(folder, fitted))
        show("End to end", whole_days(folder, fitted, short=short))
        show("CSV", text(folder, fitted, 1_000_000 if short else 10_000_000))


if __name__ == "__main__":
    main()
