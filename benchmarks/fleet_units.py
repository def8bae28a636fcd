"""Functions of workers in the benchmark of fleets, and a cluster on this machine: importable, as they must be."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

import numpy as np

from driftlab.family.basis import STEP
from driftlab.family.record import Figure, UnitRecord
from driftlab.family.unit_information import UnitInformation
from driftlab.production.unit_folders import UnitPlace
from driftlab.soak.blocks import SoakRows

RESULT = os.urandom(100_000)


AXES = ("x", "y", "z")
DEG_H = np.pi / 180 / 3600
FIGURES = {"residual": 1.0, "noise": 2.0, "walk": 0.02, "swing": 30.0, "coast": 4.0, "hysteresis": 0.5}
PER_LOT = 500  # units


def burn(seconds: float) -> bytes:
    """Use the processor for so long, and return as much as a unit's files hold."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass
    return RESULT


def cpu(pid: int) -> float:
    """Return the seconds of the processor that a process has used."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, int]]:
    """Start a scheduler and its workers, each a process; give the address, and the scheduler's process id."""
    own = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(os.path.abspath(p) for p in sys.path if p),
        "OMP_NUM_THREADS": "1",
    }
    log = folder / "scheduler.log"

    def part(name: str, *args: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{name}", "--no-dashboard", *args]
        with log.open("ab") as file:
            return subprocess.Popen(command, stdout=file, stderr=file, cwd=folder, env=own)

    parts = [part("scheduler", "--port", "0", "--host", "127.0.0.1")]
    try:
        while "Scheduler at:" not in log.read_text():
            time.sleep(0.05)
        address = log.read_text().partition("Scheduler at:")[2].split()[0]
        parts += [part("worker", address, "--no-nanny", "--nthreads", "1") for _ in range(workers)]
        yield address, parts[0].pid
    finally:
        for one in parts:
            one.kill()
            one.wait()


def write_units(folder: Path, count: int, hours: float = 2.0) -> list[Path]:
    """Write soaks of the made-up family of the examples, those that are not there yet."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "06_family"))
    import family

    paths = []
    for unit in family.deal(count):
        paths.append(folder / unit.name / "soak.h5")
        if not paths[-1].exists():
            family.write(paths[-1], family.soak(unit, hours))
    return paths


def config_text() -> str:
    """Return the config of that family."""
    return (Path(__file__).parents[1] / "examples" / "06_family" / "family.yaml").read_text()


def put_lot(place: UnitPlace, soaks: Path, units: range) -> None:
    """Put the light units of a lot into the place of a fleet's, as a worker puts them."""
    rng, rows = np.random.default_rng(units.start), 40
    t = np.arange(rows) * 90.0
    T = 20.0 - 20.0 * np.cos(2 * np.pi * t / t[-1])
    shapes = np.cos(np.outer(np.arange(4), np.pi * T / 40.0))
    white, walk, span = np.full(3, 2.0 * DEG_H), np.full(3, 0.02 * DEG_H), np.full(rows, 90.0)
    for k in units:
        name = f"{k:07d}"
        (soaks / f"{name}.h5").touch()
        curve = DEG_H * (np.array([20.0, 10.0, 5.0, 2.0]) * rng.normal(size=(3, 4))) @ shapes
        noise = np.cumsum(walk[:, None] * np.sqrt(90.0) * rng.normal(size=(3, rows)), axis=1)
        bias = curve + noise + white[:, None] / np.sqrt(90.0) * rng.normal(size=(3, rows))
        soaked = UnitInformation.of(name, AXES, [SoakRows(t, T, bias.T, span, {})], white, walk, STEP)
        record = UnitRecord(
            key=key_of_light(k), unit=name, lot=f"L{k // PER_LOT}", date=date_of_light(k), state="done", channel="gyro",
            bias_unit="rad/s", axes=AXES, domain=(0.0, 40.0), hours=1.0, samples=rows, map_file="map.json",
            figures={name: _figure(size * DEG_H, rng) for name, size in FIGURES.items()}, seconds=0.3,
            limits=[{"name": "noise", "verdict": "pass"}],
        )  # fmt: skip
        place.put(record, {"unit.npz": soaked.to_bytes()})


def key_of_light(k: int) -> str:
    return sha256(str(k).encode()).hexdigest()


def date_of_light(k: int) -> str:
    return f"2026-01-{1 + k % 28:02d}"


def _figure(size: float, rng: np.random.Generator) -> Figure:
    return Figure(value=tuple((size * np.exp(0.1 * rng.normal(size=3))).tolist()), sigma=(0.05 * size,) * 3)
