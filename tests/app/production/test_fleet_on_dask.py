"""A fleet on a real scheduler and its workers: a worker is killed, or the driver, and the files are the same."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from threading import Thread

import fleets
import polars as pl
import pytest
from clusters import said, scheduler, wait_until, worker

from driftlab.config import load_config
from driftlab.production import fleet as job
from driftlab.production import units_pass
from driftlab.production.fleet_folder import fleet_folder
from driftlab.production.unit import Task, UnitResult
from driftlab.production.unit_folders import SCRATCH, UnitPlace
from driftlab.production.units_pass import work_in_place

COUNT = 5
COMMAND = "import driftlab.production.fleet as job; job.ALONE = 0; from driftlab.cli import main; main()"


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    return fleets.made_once(tmp_path_factory.mktemp("line"), COUNT)


@pytest.fixture
def cluster(tmp_path):
    """A scheduler's address, and its two workers."""
    with scheduler(tmp_path) as (_, log):
        address = said(log, "Scheduler at:").split()[-1]
        with worker(tmp_path, address) as (first, _), worker(tmp_path, address) as (second, _):
            yield address, (first, second)


def assert_same(line, out):
    assert fleets.contents(line / out) == fleets.contents(line / "made")
    tables = [pl.read_parquet(line / name / "units.parquet").drop("seconds") for name in (out, "made")]
    assert tables[0].equals(tables[1])
    assert [path.name for path in (line / out).rglob(".*")] == []


def a_unit(out):
    return lambda: any((out / "units").glob("0*/unit.json"))


def the_family(out):
    return lambda: any((out / SCRATCH).glob("stacked-*"))


@pytest.mark.parametrize("part", [a_unit, the_family])
def test_a_worker_is_killed(part, line, cluster, monkeypatch):
    address, workers = cluster
    monkeypatch.chdir(line)
    monkeypatch.setattr(job, "ALONE", 0)
    monkeypatch.setattr(units_pass, "Pool", None)  # nobody else works
    out = f"worker-{part.__name__}"

    def kill():
        wait_until(part(line / out), 600.0)
        os.kill(workers[0].pid, signal.SIGKILL)

    thread = Thread(target=kill)
    thread.start()
    result = job.fleet(load_config(Path("family.yaml")), "units.csv", Path(out), scheduler=address)
    thread.join()
    assert workers[0].wait(30) == -signal.SIGKILL
    assert result.summary["counts"]["failed"] == 1
    assert_same(line, out)


def test_the_driver_is_killed_and_started_again(line, cluster):
    address, _ = cluster
    command = [sys.executable, "-c", COMMAND, "fleet", "family.yaml", "--units", "units.csv", "--scheduler", address]
    units = line / "driver" / "units"
    times = {}
    for part in (a_unit, the_family, None):
        process = subprocess.Popen(
            [*command, "--out", "driver"], cwd=line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        if part is not None:
            wait_until(lambda part=part, process=process: part(line / "driver")() or process.poll() is not None, 600.0)
            process.send_signal(signal.SIGKILL)
        _, errors = process.communicate()
        assert process.returncode == (0 if part is None else -signal.SIGKILL), errors
        known = {path.parent.name: path.stat().st_mtime_ns for path in units.glob("0*/unit.json")}
        assert times.items() <= known.items()  # none is done twice
        times = {name: when for name, when in known.items() if part is not None}
    assert_same(line, "driver")


def test_a_worker_that_does_not_see_the_folder_gives_the_unit_back(line, tmp_path):
    task = Task("0000", recordings={"calibration": (str(line / "units/0000/soak.h5"),)},
                config=(line / "family.yaml").read_text())  # fmt: skip
    with fleet_folder(tmp_path / "fleet") as folder:
        for place in (UnitPlace(tmp_path / "elsewhere", folder.place.signed), UnitPlace(folder.path, b"another's")):
            result = work_in_place(place, task)
            assert isinstance(result, UnitResult)
            assert set(result.files) == {"unit.npz", "map.json"}
            assert os.listdir(folder.path / "units") == []
        record = work_in_place(folder.place, task)
        assert record.key == folder.units.record("0000").key
        assert set(record.written) == {"unit.npz", "map.json"}
