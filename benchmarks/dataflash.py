"""An ArduPilot log read by the source and by pymavlink's DFReader: the same rows, side by side."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import Row, best, largest_memory, limit, ratio, show
from pymavlink import DFReader

from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash import DataFlash

sys.path.append(str(Path(__file__).parents[1] / "examples" / "05_autopilot"))
from dataflash_writer import write_log

CHANNELS = {
    "time": {"path": "IMU.TimeUS"},
    "gyro": {"path": ["IMU.GyrX", "IMU.GyrY", "IMU.GyrZ"]},
    "accel": {"path": ["IMU.AccX", "IMU.AccY", "IMU.AccZ"]},
    "temperature": {"path": "IMU.T"},
}
TCAL = {"INS_TCAL1_ENABLE": 1, "INS_TCAL1_TMAX": 70, "INS_TCAL1_GYR1_X": 200, "INS_TCAL1_ACC1_X": 900}


def pymavlink(path: Path) -> list[tuple[float, ...]]:
    reader, found = DFReader.DFReader_binary(str(path)), []
    while (m := reader.recv_match(type="IMU")) is not None:
        if m.I == 0:
            found.append((m.TimeUS, m.GyrX, m.GyrY, m.GyrZ, m.AccX, m.AccY, m.AccZ, m.T))
    reader.data_map.close()
    reader.filehandle.close()
    return found


def source(path: Path, compensated: str) -> Callable[[], object]:
    reader = DataFlash.model_validate({"path": path, "channels": CHANNELS, "compensated": compensated})
    return lambda: [len(chunk) for chunk in reader.chunks(65_536, Faults())]


def written(path: Path, N: int) -> Path:
    """Write a log of two units with N rows each."""
    rng = np.random.default_rng(1)
    t = 10 + np.arange(N) / 400
    unit = (rng.normal(size=(N, 3)), rng.normal(size=(N, 3)), 20 + t / 10)
    return write_log(path, t, [unit, unit], {"AHRS_ORIENTATION": 6, **TCAL})


def rows(N: int = 20_000) -> list[Row]:
    """Return the rows of the table for a log of two units with N rows each."""
    with tempfile.TemporaryDirectory() as name:
        path = written(Path(name) / "log.bin", N)
        kept, undone, theirs = best(source(path, "keep"), source(path, "undo"), lambda: pymavlink(path), turns=3)
        memory = largest_memory(CHANNELS, written(Path(name) / "long.bin", 50 * N), 200)
    return [
        ratio("DataFlash, rows as logged, against pymavlink", kept, theirs, 30),
        limit("DataFlash, a row as logged", kept / N * 1e6, "µs", 3),
        limit("DataFlash, a row with the autopilot's corrections undone", undone / N * 1e6, "µs", 3),
        limit("pymavlink's DFReader, a row", theirs / N * 1e6, "µs"),
        memory,
    ]


def main() -> None:
    show("ArduPilot logs", rows())


if __name__ == "__main__":
    main()
