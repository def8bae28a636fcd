"""The family of many light units: processor and memory of driver and workers by stage, and a million on paper.

    python benchmarks/fleet_family.py [--units 10000 100000] [--workers 2] [--folder DIR]

Light units have soaks of forty rows, of which the sums are real: their folders are put into a fleet as a worker puts
them, and `driftlab fleet` finds all of them done. So what is measured is all but the units' own work. Fleets in DIR
stay there, and are taken by the next call. From 5,000 units on the page has as many rows and points, whatever the
fleet: what a unit more takes is seen above that.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from common import Row, show
from fleet_units import PER_LOT, config_text, date_of_light, key_of_light, put_lot

from driftlab.config import load_config
from driftlab.production.fleet import fleet
from driftlab.production.fleet_folder import TABLE, fleet_folder
from driftlab.production.manifest import read_manifest
from driftlab.production.unit import Task
from driftlab.production.units_pass import stamp_of, versions_of
from driftlab.production.workers import Pool

BUDGET = 1.0  # kB a unit in the driver


def put_units(out: Path, count: int, workers: int) -> Path:
    """Put light units into a fleet's folder, with recordings that are empty; return their manifest."""
    config, manifest = load_config(out.parent / "family.yaml"), out.with_suffix(".csv")
    lots = [range(first, min(first + PER_LOT, count)) for first in range(0, count, PER_LOT)]
    lines = [f"{k:07d},{out.name}-soaks/{k:07d}.h5,L{k // PER_LOT},{date_of_light(k)}" for of in lots for k in of]
    manifest.write_text("\n".join(["unit,path,lot,date", *lines]))
    soaks = out.with_name(f"{out.name}-soaks")
    soaks.mkdir()
    with fleet_folder(out) as folder, Pool(workers) as pool:
        for _ in pool.ordered(partial(put_lot, folder.place, soaks), lots):
            pass
        versions, yaml = versions_of(config), config.as_yaml()
        for k, entry in enumerate(read_manifest(str(manifest)).units):
            task = Task(**vars(entry), config=yaml, folder=os.getcwd())
            folder.stamp(entry.unit, key_of_light(k), stamp_of(task, versions))
    return manifest


def driven(config: Path, manifest: Path, out: Path, workers: int, rules: str) -> None:
    """Do a fleet; print by stage its time and its processor, the driver's and the workers', and peaks of memory, MB."""
    marks, peaks = list[tuple[str, float, float, float]](), [0.0]

    def note(stage: object) -> None:
        name = str(getattr(stage, "name", ""))
        if marks and marks[-1][0] == name:
            return
        others = _others()
        peaks[0] = max([peaks[0], *(peak for _, peak in others)])
        marks.append((name, time.perf_counter(), time.process_time(), sum(used for used, _ in others)))

    fleet(load_config(config), str(manifest), out, workers=workers, rules=rules or None, progress=note)
    marks.append(("end", time.perf_counter(), time.process_time(), marks[-1][3]))
    stages = {
        name: [after - before for before, after in zip(began, ended, strict=True)]
        for (name, *began), (_, *ended) in pairwise(marks)
    }
    driver = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"stages": stages, "driver_MB": driver, "worker_MB": peaks[0]}))


def _others() -> list[tuple[float, float]]:
    """Return processor, s, and peak memory, MB, of the other processes of this one's group: its workers."""
    found, ticks = [], os.sysconf("SC_CLK_TCK")
    for path in Path("/proc").glob("[0-9]*"):
        try:
            fields = (path / "stat").read_text().rpartition(")")[2].split()
            status = (path / "status").read_text()
        except OSError:
            continue
        if int(fields[2]) == os.getpgrp() and int(path.name) != os.getpid() and "VmHWM:" in status:
            peak = float(status.partition("VmHWM:")[2].split()[0]) / 1024
            found.append(((int(fields[11]) + int(fields[12])) / ticks, peak))
    return found


def measured(manifest: Path, out: Path, workers: int, rules: str = "") -> dict[str, Any]:
    """Return the result of `driven` in a process group of its own; the config is beside the manifest."""
    given = (manifest.with_name("family.yaml"), manifest, out, workers, rules)
    command = [sys.executable, str(Path(__file__)), "--driven", *map(str, given)]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, start_new_session=True).stdout
    return dict(json.loads(said.splitlines()[-1]))


def light(folder: Path, count: int, workers: int) -> dict[str, Any]:
    """Return time and memory of the family of so many light units; a fleet of them that is in the folder is taken."""
    (folder / "family.yaml").write_text(config_text())
    out = folder / f"fleet-{count}"
    manifest = out.with_suffix(".csv") if out.exists() else put_units(out, count, workers)
    (out / TABLE).unlink(missing_ok=True)  # or nothing would be left to do
    return measured(manifest, out, workers)


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--units", type=int, nargs=2, default=(10_000, 100_000))
    ask.add_argument("--workers", type=int, default=2)
    ask.add_argument("--folder", type=Path)
    ask.add_argument("--driven", nargs=5, help=argparse.SUPPRESS)
    given = ask.parse_args()
    if given.driven:
        config, manifest, out, workers, rules = given.driven
        driven(Path(config), Path(manifest), Path(out), int(workers), rules)
        return
    with ExitStack() as held:
        folder = given.folder or Path(held.enter_context(tempfile.TemporaryDirectory()))
        few, many = (light(folder, count, given.workers) for count in given.units)
    n, rows, each = given.units[1], list[Row](), list[list[float]]()
    for stage, (took, own, theirs) in many["stages"].items():
        before = few["stages"].get(stage, (0.0, 0.0, 0.0))
        each.append([(b - a) / (n - given.units[0]) for a, b in zip(before[1:], (own, theirs), strict=True)])
        used = f"driver {own:.1f} s, workers {theirs:.1f} s of the processor, {took:.0f} s in all"
        rows.append(Row(f"{stage}, {n:,} units", used))
    grows = (many["driver_MB"] - few["driver_MB"]) * 1024 / (n - given.units[0])
    rows += [
        Row("driver, peak memory", f"{few['driver_MB']:.0f} and {many['driver_MB']:.0f} MB"),
        Row("driver, a unit more", f"{grows:.2f} kB", f"at most {BUDGET:g} kB", bool(grows <= BUDGET)),
        Row("a worker, peak memory", f"{few['worker_MB']:.0f} and {many['worker_MB']:.0f} MB"),
    ]
    show(f"Fleets: the family of light units, {given.workers} workers", rows)
    total = [sum(column) * 1e6 / 3600 for column in zip(*each, strict=True)]
    base = few["driver_MB"] - grows * given.units[0] / 1024
    show("Fleets: the family of a million on paper", [
        Row("driver, processor", f"{total[0]:.1f} h"), Row("workers, processor", f"{total[1]:.1f} h"),
        Row("driver, memory", f"{(base + grows * 1e6 / 1024) / 1024:.1f} GB", "at most 1 GB"),
    ])  # fmt: skip


if __name__ == "__main__":
    main()
