"""A fleet that is killed at any moment: the same command goes on, to what an undisturbed one comes to."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import fleets
import polars as pl
import pytest

COUNT = 6
COMMAND = [
    sys.executable,
    "-c",
    "from driftlab.cli import main; main()",
    "fleet",
    "family.yaml",
    "--units",
    "units.csv",
]


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    folder = tmp_path_factory.mktemp("line")
    fleets.write_fleet(folder, COUNT, broken=[4])
    return folder


def begun(folder, out):
    return subprocess.Popen(
        [*COMMAND, "--out", out, "--workers", "2"], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


def wait_for(process, there):
    deadline = time.monotonic() + 120
    while not there():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_killed_on_the_way_it_goes_on_to_the_same_end(line):
    undisturbed = begun(line, "whole")
    said, errors = undisturbed.communicate()
    assert undisturbed.returncode == 0, errors

    units = line / "killed" / "units"
    process = begun(line, "killed")
    wait_for(process, lambda: len(list(units.glob("0*/unit.json"))) >= 2)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    done = {path.parent.name: path.stat().st_mtime_ns for path in units.glob("0*/unit.json")}
    assert 2 <= len(done) < COUNT
    assert not (line / "killed" / "units.parquet").exists()

    again = begun(line, "killed")
    told, errors = again.communicate()
    assert again.returncode == 0, errors
    assert {name: (units / name / "unit.json").stat().st_mtime_ns for name in done} == done
    assert fleets.contents(line / "killed") == fleets.contents(line / "whole")
    tables = [pl.read_parquet(line / out / "units.parquet").drop("seconds") for out in ("killed", "whole")]
    assert tables[0].equals(tables[1])
    assert f"{COUNT} units: 5 done, 1 failed ({COUNT - len(done)} of them now, {len(done)} before)" in told
    assert told.splitlines()[1:-1] == said.splitlines()[1:-1]  # the last one names the folder
    leftovers = [path.name for path in (line / "killed").rglob(".*")]
    assert leftovers == []


def test_ctrl_c_says_that_the_same_command_goes_on(line):
    process = begun(line, "stopped")
    units = line / "stopped" / "units"
    wait_for(process, lambda: any(units.glob("0*/unit.json")))
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 130, said
    assert said.splitlines()[-1] == (
        "driftlab: interrupted; what is done is in stopped, and the same command goes on from there"
    )
    assert "Traceback" not in said
    assert not Path(line / "stopped" / "driftlab.lock").exists()
    assert os.listdir(units)
