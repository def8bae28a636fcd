"""Fleets: seconds a unit, what the workers cost beside the work, growth with the units, and a million on paper.

    python benchmarks/fleet.py [--short] [--full 1000]

`--full` does so many real units of 2 h at 1 Hz end to end, and takes the growth from 1,000 to 10,000. That is on light
units: results of a few real ones, renamed and shifted, so that what is timed is all that is not a unit's own work; of
what processes do for the driver then, its own time is not part.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import Row, limit, show
from fleet_units import Light, burn, cluster, config_text, cpu, work, write_units

from driftlab.config import load_config
from driftlab.production.dask import Scheduler
from driftlab.production.fleet import FleetOptions, fleet
from driftlab.production.unit import Task
from driftlab.production.workers import Pool, WorkerLost, Workers

UNIT = 0.25  # s of one core that a unit may take
AGAIN = "nothing left to do"
REAL = "done.pickle"  # results of real units, for the light ones


def one_core(folder: Path, count: int) -> tuple[Row, float]:
    """Do real units in one worker; return the seconds of its processor that one takes, once all is loaded."""
    config, found = config_text(), []
    tasks = [
        Task(path.parent.name, recordings={"calibration": (str(path),)}, config=config)
        for path in write_units(folder, count)
    ]
    with Pool(1) as pool:
        for task, done in pool.map(work, tasks):
            assert not isinstance(done, WorkerLost), done
            assert done.record.state == "done", f"{task.unit}: {done.record.error}"
            found.append(done)
    took = [done.record.seconds for done in found[2:]]
    (folder / REAL).write_bytes(pickle.dumps(found))
    return limit(
        f"a unit of 2 h at 1 Hz, one core (median of {len(took)}, fastest {min(took):.3g} s)",
        float(np.median(took)), "s", UNIT,
    ), float(np.median(took))  # fmt: skip


def beside(workers: Workers, count: int, turns: int) -> tuple[float, float, float]:
    """Return the overhead of workers on `count` items of UNIT s, as a share of the bare loop, fastest of several turns.

    And seconds of this process's processor an item, and seconds an item where nothing is done but to send 100 kB.
    """
    items, bare, theirs, own = [UNIT] * count, np.inf, np.inf, np.inf
    list(workers.map(burn, [0.0] * 4))
    for _ in range(turns):
        begun = time.perf_counter()
        for item in items:
            burn(item)
        bare = min(bare, time.perf_counter() - begun)
        begun, used = time.perf_counter(), time.process_time()
        assert all(isinstance(found, bytes) for _, found in workers.map(burn, items))
        theirs = min(theirs, time.perf_counter() - begun)
        own = min(own, time.process_time() - used)
    empty = np.inf
    for _ in range(turns):
        begun = time.perf_counter()
        assert sum(1 for _ in workers.map(burn, [0.0] * 200)) == 200
        empty = min(empty, (time.perf_counter() - begun) / 200)
    return theirs / bare - 1, own / count, empty


def overheads(folder: Path, count: int, turns: int) -> tuple[list[Row], dict[str, float]]:
    """Return the overheads of the pool and of Dask."""
    with Pool(1) as pool:
        share, own, empty = beside(pool, count, turns)
    rows = [
        limit(f"pool, 1 worker, beside a bare loop over {UNIT:g} s", 100 * share, "%", 5.0),
        limit("pool, an item of no work and 100 kB", 1e3 * empty, "ms"),
        limit("pool, processor of the driver an item", 1e3 * own, "ms"),
    ]
    constants = {"pool_ms": 1e3 * own}
    with cluster(folder, 1) as (address, pid), Scheduler(address) as dask:
        before = cpu(pid)
        share, own, empty = beside(dask, count, turns)
        central = (cpu(pid) - before) / (turns * (count + 200) + 4)
    rows += [
        limit(f"Dask, 1 worker, beside a bare loop over {UNIT:g} s", 100 * share, "%", 15.0),
        limit("Dask, an item of no work and 100 kB", 1e3 * empty, "ms"),
        limit("Dask, processor of the driver an item", 1e3 * own, "ms"),
        limit("Dask, processor of the scheduler an item", 1e3 * central, "ms"),
    ]
    return rows, constants | {"dask_ms": 1e3 * own, "scheduler_ms": 1e3 * central}


@dataclass(frozen=True)
class Lightly(FleetOptions):
    """A fleet whose units are done by `Light`."""

    real: Path = Path()

    def crew(self) -> Workers:
        """Return the pool of workers."""
        return Light(pickle.loads(self.real.read_bytes()))


def light(folder: Path, count: int) -> None:
    """Do a fleet of light units, and again with nothing to do; print its processor by stage, and its peak memory."""
    real = sorted((folder / "real").glob("*/soak.h5"))
    units = folder / "light"
    for k in range(count):
        place = units / f"{k:06d}" / "soak.h5"
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists():
            os.link(real[k % len(real)], place)
    manifest = folder / f"{count}.csv"
    lines = [f"{k:06d},light/{k:06d}/soak.h5,L{k * 10 // count},2026-01-05" for k in range(count)]
    manifest.write_text("\n".join(["unit,path,lot,date", *lines]))
    (folder / "family.yaml").write_text(config_text())
    config, out = load_config(folder / "family.yaml"), folder / f"fleet-{count}"
    marks: dict[str, float] = {}
    fleet(
        config, str(manifest), out, Lightly(real=folder / "real" / REAL),
        lambda stage: marks.setdefault(stage.name, time.process_time()) and None,
    )  # fmt: skip
    ends = [*list(marks.values())[1:], time.process_time()]
    stages = {name: end - begun for (name, begun), end in zip(marks.items(), ends, strict=True)}
    stages["units"] -= Light.spent
    begun = time.process_time()
    fleet(config, str(manifest), out)
    stages[AGAIN] = time.process_time() - begun
    size = sum(path.stat().st_blocks * 512 for path in out.rglob("*") if path.is_file())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    found = {"stages": stages, "peak_MB": peak, "bytes": size}
    print(json.dumps(found))


def growth(folder: Path, sizes: tuple[int, ...]) -> tuple[list[Row], dict[str, float]]:
    """Return the growth of seconds and memory of all but the units' work; each size in a process of its own."""
    found = []
    for count in sizes:
        command = [sys.executable, __file__, "--light", str(count), "--folder", str(folder)]
        said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
        found.append(json.loads(said.splitlines()[-1]))
    stages = list(found[-1]["stages"])
    rows = [slope(f"driver: {name}", sizes, [one["stages"].get(name, 0.0) for one in found]) for name in stages]
    shown = ", ".join(f"{n:,}: {one['peak_MB']:.0f} MB" for n, one in zip(sizes, found, strict=True))
    more = (found[-1]["peak_MB"] - found[0]["peak_MB"]) * 1024 / (sizes[-1] - sizes[0])
    rows.append(Row(f"peak memory of the driver ({shown})", f"{more:.2g} kB a unit more"))
    last, n = found[-1], sizes[-1]
    rows.append(Row("disk", f"{last['bytes'] / n / 1024:.0f} kB a unit"))
    end = sum(s for name, s in last["stages"].items() if name not in ("units", AGAIN))
    constants = {"units_ms": 1e3 * last["stages"]["units"] / n, "end_ms": 1e3 * end / n}
    return rows, constants | {"kB": last["bytes"] / n / 1024, "memory_kB": more}


def slope(what: str, sizes: tuple[int, ...], seconds: list[float]) -> Row:
    """Return the row of a growth: seconds of the processor at each size, and the exponent between the last two."""
    shown = ", ".join(f"{n:,}: {s:.3g} s" for n, s in zip(sizes, seconds, strict=True))
    if len(sizes) < 2 or min(seconds[-2:]) < 0.05 or seconds[-1] < 2 * seconds[-2]:
        return Row(f"{what} ({shown})", "too short to tell")
    grows = float(np.log(seconds[-1] / seconds[-2]) / np.log(sizes[-1] / sizes[-2]))
    return Row(f"{what} ({shown})", f"N^{grows:.2f}", "N^1, at most N^1.1", grows <= 1.1)


def full(folder: Path, count: int) -> list[Row]:
    """Do real units end to end, with as many workers as there are processors."""
    write_units(folder / "full", count)
    (folder / "family.yaml").write_text(config_text())
    begun = time.perf_counter()
    found = fleet(load_config(folder / "family.yaml"), str(folder / "full" / "*" / "soak.h5"), folder / "fleet-full")
    took = time.perf_counter() - begun
    stages = ", ".join(f"{name} {s:.0f} s" for name, s in found.summary["seconds"].items())
    return [limit(f"{count:,} real units end to end ({stages})", took, "s", 0.24 * count)]


def plan(unit: float, constants: dict[str, float], units: int = 1_000_000) -> list[Row]:
    """Return the cost of a million units, by the constants above."""
    rows = [
        Row(f"{units:,} units: processors of workers", f"{units * unit / 3600:,.0f} h"),
        Row("disk of the folders", f"{units * constants['kB'] / 1024**2:,.0f} GB"),
        Row("driver, putting units in place", f"{units * constants['units_ms'] / 3.6e6:,.1f} h"),
        Row("driver, by Dask", f"{units * constants['dask_ms'] / 3.6e6:,.1f} h of its processor"),
        Row("one scheduler keeps busy", f"{unit * 1e3 / constants['scheduler_ms']:,.0f} workers"),
        Row("one driver keeps busy", f"{unit * 1e3 / (constants['units_ms'] + constants['dask_ms']):,.0f} workers"),
    ]
    rows.append(
        Row(
            "driver, family, tables and report at the end",
            f"{units * constants['end_ms'] / 3.6e6:,.1f} h of its processor",
        )
    )
    rows.append(Row("memory of the driver", f"{units * constants['memory_kB'] / 1024**2:,.1f} GB"))
    return rows


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--short", action="store_true")
    ask.add_argument("--full", type=int, default=0)
    ask.add_argument("--light", type=int, default=0, help=argparse.SUPPRESS)
    ask.add_argument("--folder", type=Path)
    given = ask.parse_args()
    if given.light:
        light(given.folder, given.light)
        return
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        folder = Path(name)
        first, unit = one_core(folder / "real", 10 if given.short else 40)
        some, constants = overheads(folder, *((8, 4) if given.short else (8, 15)))
        show("Fleets: a unit, and what its worker costs", [first, *some])
        sizes = (100, 300) if given.short else (100, 1_000, 10_000) if given.full else (100, 1_000)
        rows, more = growth(folder, sizes)
        show("Fleets: all but the units' work, on light units", rows)
        show("Fleets: a million on paper", plan(unit, constants | more))
        if given.full:
            show("Fleets: real units", full(folder, given.full))


if __name__ == "__main__":
    main()
