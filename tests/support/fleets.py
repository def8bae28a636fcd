"""Small fleets on disk, of the made-up family of examples/06_family, and workers that are this process."""

import csv
import json
import re
from pathlib import Path

import family
import pytest

from driftlab.config import load_config
from driftlab.production import fleet as job
from driftlab.production import units_pass
from driftlab.production.unit import Task
from driftlab.production.workers import WorkerLost, Workers

EXAMPLE = Path(family.__file__).parent / "family.yaml"
HOURS = 1 / 3  # of a soak: in less the chamber is too fast for a map


class Here(Workers):
    """Workers that are this process; notes which units and pages they were asked for; loses those in `lost`."""

    def __init__(self, lost=()):
        self.asked, self.pages, self.lost = [], [], dict(lost)

    def close(self):
        return None

    def map(self, function, items):
        for item in items:
            if not isinstance(item, Task):
                yield item, function(item)
                continue
            (self.pages if item.page else self.asked).append(item.unit)
            yield item, WorkerLost(self.lost[item.unit]) if item.unit in self.lost else function(item)


def write_fleet(folder, count, *, seed=1, broken=(), lots=2):
    """Write soaks, units.csv and family.yaml of a fleet; of the numbers in `broken` the files hold nothing."""
    units = family.deal(count, seed, lots=lots)
    rows = []
    for k, unit in enumerate(units):
        path = folder / "units" / unit.name / "soak.h5"
        if k in broken:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"no HDF5")
        else:
            family.write(path, family.soak(unit, HOURS))
        rows.append([unit.name, f"units/{unit.name}/soak.h5", unit.lot, unit.date, f"K{k % 2}"])
    with (folder / "units.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["unit", "path", "lot", "date", "chamber"], *rows])
    (folder / "family.yaml").write_text(EXAMPLE.read_text())
    return units


def contents(fleet):
    """Return what is in a fleet's folder by path, but for what says how long it took, or when; of pages the names."""
    found = {}
    for path in sorted(fleet.rglob("*")):
        name = path.relative_to(fleet).as_posix()
        if path.is_dir() or name in ("fleet.json", "inputs.ndjson", "units.parquet"):
            continue
        if path.suffix == ".html":
            found[name] = b""
            continue
        content = re.sub(rb'"fitted_at": ?"[^"]*"|sha256:[0-9a-f]{64}', b"", path.read_bytes())
        if path.name == "unit.json":
            content = json.loads(content)
            del content["seconds"], content["written"]
        found[name] = content
    return found


def made_once(folder, count):
    """Write a fleet's recordings, of which the last cannot be read, and in `made` what one process makes of them."""
    write_fleet(folder, count, broken=[count - 1])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(units_pass, "Pool", lambda workers: Here())
        job.fleet(load_config(Path("family.yaml")), "units.csv", Path("made"))
    return folder
