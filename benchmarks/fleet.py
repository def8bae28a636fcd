"""Fleets of real units: seconds a unit, what the workers cost beside the work, and the family beside the units' work.

    python benchmarks/fleet.py [--short] [--real 50 200 1000] [--workers 2] [--folder DIR]

What grows with the units, the family and the driver's memory, is measured on light ones: `benchmarks/fleet_family.py`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from common import Row, limit, show
from fleet_family import measured
from fleet_units import burn, cluster, config_text, cpu, write_units

from driftlab.production.dask import Scheduler
from driftlab.production.unit import Task, work
from driftlab.production.workers import Pool, WorkerLost, Workers

UNIT = 0.25  # s of one core that a unit may take


def one_core(folder: Path, count: int) -> tuple[Row, float]:
    """Do real units in one worker; return the seconds of its processor that one takes, once all is loaded."""
    config, took = config_text(), list[float]()
    tasks = [
        Task(path.parent.name, recordings={"calibration": (str(path),)}, config=config)
        for path in write_units(folder, count)
    ]
    with Pool(1) as pool:
        for task, done in pool.map(work, tasks):
            assert not isinstance(done, WorkerLost), done
            assert done.record.state == "done", f"{task.unit}: {done.record.error}"
            took.append(done.record.seconds)
    took = took[2:]
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


def real(folder: Path, count: int, workers: int) -> list[Row]:
    """Return the time of real units end to end, and of their family beside their own work: of all workers, and of one.

    Another command with run rules does the family again and no unit.
    """
    write_units(folder / "full", count)
    paths = sorted((folder / "full").glob("*/soak.h5"))[:count]
    manifest, out = folder / f"{count}.csv", folder / f"fleet-{count}"
    lines = [f"{k:04d},{path},L{k // 40},2026-01-05" for k, path in enumerate(paths)]
    manifest.write_text("\n".join(["unit,path,lot,date", *lines]))
    (folder / "family.yaml").write_text(config_text())
    done, alone = measured(manifest, out, workers), measured(manifest, out, 1, "nelson")
    units, family = (np.sum([took for name, took in done["stages"].items() if (name == "units") == own], axis=0)
                     for own in (True, False))  # fmt: skip
    of_one = np.sum([took for name, took in alone["stages"].items() if name != "units"], axis=0)

    def shown(took: Any) -> str:
        return f"{took[0]:.1f} s, {took[1] + took[2]:.1f} s of the processor ({took[1]:.1f} the driver's)"

    own, share = f"{count:,} units", float(100 * sum(family[1:]) / sum(units[1:]))
    return [
        limit(f"{own} end to end, {workers} workers", float(units[0] + family[0]), "s", 0.12 * count),
        Row(f"{own}, their own work", shown(units)), Row(f"{own}, all that follows", shown(family)),
        limit(f"{own}, what follows of their own work, processor", share, "%", 10.0),
        Row(f"{own}, all that follows, one worker", shown(of_one)),
        limit(f"{own}, what follows, {workers} workers of one", float(100 * family[0] / of_one[0]), "%", 60.0),
    ]  # fmt: skip


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--short", action="store_true")
    ask.add_argument("--real", type=int, nargs="*", default=[50], help="numbers of units")
    ask.add_argument("--workers", type=int, default=2)
    ask.add_argument("--folder", type=Path)
    given = ask.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        folder = Path(name)
        first, unit = one_core(folder / "real", 10 if given.short else 40)
        some, constants = overheads(folder, *((8, 4) if given.short else (8, 15)))
        show("Fleets: a unit, and what its worker costs", [first, *some])
        for count in given.real:
            show(f"Fleets: {count:,} real units", real(folder, count, given.workers))
        show("Fleets: a million on paper", [
            Row("processors of workers", f"{1e6 * unit / 3600:,.0f} h"),
            Row("driver, by Dask", f"{1e6 * constants['dask_ms'] / 3.6e6:,.1f} h of its processor"),
            Row("one scheduler keeps busy", f"{unit * 1e3 / constants['scheduler_ms']:,.0f} workers"),
        ])  # fmt: skip


if __name__ == "__main__":
    main()
