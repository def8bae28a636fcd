"""Reading a PX4 log: the source beside pyulog for the same topics, on a log with three units; time and memory.

python benchmarks/ulog.py [--short]
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from common import Row, best, largest_memory, show

from fusion_core.faults import Faults
from fusion_plugins.sources.ulog import Ulog

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "05_autopilot"))
from ulog_writer import sensor, write_ulog

TOPICS = ["sensor_gyro", "sensor_accel"]
CHANNELS = {
    "time": {"path": "sensor_gyro.time"},
    "gyro": {"path": [f"sensor_gyro.{a}" for a in "xyz"]},
    "accel": {"path": [f"sensor_accel.{a}" for a in "xyz"]},
    "temperature": {"path": "sensor_gyro.temperature"},
}


def write(path: Path, N: int, units: int) -> None:
    """Write N rows of each sensor at 1 kHz."""
    rng, found = np.random.default_rng(0), []
    t = np.arange(N) / 1000
    for k in range(units):
        for name in TOPICS:
            found.append(sensor(name, k, t + 1e-5 * k, rng.normal(size=(N, 3)), 20 + t / 60, 0x26000A + 256 * k))
    write_ulog(path, found)


def ours(path: Path) -> int:
    return sum(len(chunk) for chunk in Ulog(path=path, channels=CHANNELS).chunks(65536, Faults()))


def theirs(path: Path) -> int:
    from pyulog import ULog

    log = ULog(str(path), TOPICS)
    return len(log.get_dataset("sensor_gyro", 0).data["x"])


def grown(code: str, path: Path) -> float:
    """Return the largest memory of a process that reads the file, less that of one that imports alone, MB."""
    start = "import sys; sys.path[:0] = sys.argv[2:]; import ulog; from pathlib import Path; import pyulog;"
    small = "from fusion_plugins.sources.ulog import file as ulog_file; p = Path(sys.argv[1]);"
    peak = "print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    sizes = []
    for work in ("", code):
        call = [sys.executable, "-c", start + small + work + peak, str(path), *sys.path]
        done = subprocess.run(call, capture_output=True, text=True, check=True)
        sizes.append(int(done.stdout) / 1024)
    return sizes[1] - sizes[0]


def main() -> None:
    N = 20_000 if "--short" in sys.argv else 200_000
    rows = []
    for units in (1, 3):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.ulg"
            write(path, N, units)
            assert ours(path) == theirs(path) == N
            mine, other = best(lambda path=path: ours(path), lambda path=path: theirs(path), turns=3)
            size, what = path.stat().st_size / 1e6, f"{units} unit{'s' * (units > 1)}, {N:,} rows of each sensor"
            rows.append(Row(f"{what}: time a row", f"{mine / N * 1e6:.2f} us", "", None))
            rows.append(Row(f"{what}: pyulog's", f"{other / N * 1e6:.2f} us", "", None))
            rows.append(Row(f"{what}: ratio", f"{mine / other:.2f}", "≤ 2", mine / other <= 2))
            rows.append(Row(f"{what}: memory for {size:.0f} MB", f"{grown('ulog.ours(p);', path):.0f} MB", "", None))
            rows.append(Row(f"{what}: pyulog's memory", f"{grown('ulog.theirs(p);', path):.0f} MB", "", None))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.ulg"
        write(path, 660_000 if N > 20_000 else N, 3)
        rows.append(largest_memory(CHANNELS, path, 320))
    show("PX4 logs", rows)


if __name__ == "__main__":
    main()
