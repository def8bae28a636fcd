"""The family of many light units: processor and memory of driver and workers by stage, and a million on paper.

    python benchmarks/fleet_family.py [--units 2000 10000] [--workers 2] [--folder DIR]

Light units have soaks of forty rows, of which the sums are real: their folders are put into a fleet as a worker puts
them, and `driftlab fleet` finds all of them done. So what is measured is all but the units' own work.
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
from functools import partial
from itertools import pairwise
from pathlib import Path

from common import Row, show
from fleet_units import PER_LOT, config_text, date_of_light, key_of_light, put_lot

from driftlab.config import load_config
from driftlab.production.fleet import fleet
from driftlab.production.manifest import read_manifest
from driftlab.production.store import fleet_folder
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


def driven(config: Path, manifest: Path, out: Path, workers: int) -> None:
    """Do the family of a fleet; print its processor by stage, the driver's and the workers', and peaks of memory."""
    marks, peaks = list[tuple[str, float, float]](), [0.0]

    def note(stage: object) -> None:
        name = str(getattr(stage, "name", ""))
        others = _others()
        peaks[0] = max([peaks[0], *(peak for _, peak in others)])
        if not marks or marks[-1][0] != name:
            marks.append((name, time.process_time(), sum(used for used, _ in others)))

    fleet(load_config(config), str(manifest), out, workers=workers, progress=note)
    marks.append(("end", time.process_time(), marks[-1][2]))
    stages = {name: [later[1] - own, later[2] - theirs] for (name, own, theirs), later in pairwise(marks)}
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


def measured(folder: Path, count: int, workers: int) -> dict[str, object]:
    """Return the result of `driven` of so many units, in a process group of its own."""
    out = folder / f"fleet-{count}"
    config = folder / "family.yaml"
    config.write_text(config_text())
    manifest = put_units(out, count, workers)
    command = [sys.executable, __file__, "--driven", *map(str, (config, manifest, out, workers))]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, start_new_session=True).stdout
    return dict(json.loads(said.splitlines()[-1]))


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("--units", type=int, nargs=2, default=(2_000, 10_000))
    ask.add_argument("--workers", type=int, default=2)
    ask.add_argument("--folder", type=Path)
    ask.add_argument("--driven", nargs=4, help=argparse.SUPPRESS)
    given = ask.parse_args()
    if given.driven:
        config, manifest, out, workers = given.driven
        driven(Path(config), Path(manifest), Path(out), int(workers))
        return
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        few, many = (measured(Path(name), count, given.workers) for count in given.units)
    n, rows = given.units[1], []
    each = {}
    for stage, (own, theirs) in many["stages"].items():  # type: ignore[attr-defined]
        before = few["stages"].get(stage, (0.0, 0.0))  # type: ignore[attr-defined]
        each[stage] = [(b - a) / (n - given.units[0]) for a, b in zip(before, (own, theirs), strict=True)]
        rows.append(Row(f"{stage}, {n:,} units", f"driver {own:.1f} s, workers {theirs:.1f} s of the processor"))
    grows = (many["driver_MB"] - few["driver_MB"]) * 1024 / (n - given.units[0])  # type: ignore[operator]
    rows += [
        Row("driver, peak memory", f"{few['driver_MB']:.0f} and {many['driver_MB']:.0f} MB"),
        Row("driver, a unit more", f"{grows:.2f} kB", f"at most {BUDGET:g} kB", bool(grows <= BUDGET)),
        Row("a worker, peak memory", f"{few['worker_MB']:.0f} and {many['worker_MB']:.0f} MB"),
    ]
    show(f"Fleets: the family of light units, {given.workers} workers", rows)
    total = [sum(column) * 1e6 / 3600 for column in zip(*each.values(), strict=True)]
    base = few["driver_MB"] - grows * given.units[0] / 1024  # type: ignore[operator]
    show("Fleets: the family of a million on paper", [
        Row("driver, processor", f"{total[0]:.1f} h"), Row("workers, processor", f"{total[1]:.1f} h"),
        Row("driver, memory", f"{(base + grows * 1e6 / 1024) / 1024:.1f} GB", "at most 1 GB"),
    ])  # fmt: skip


if __name__ == "__main__":
    main()
