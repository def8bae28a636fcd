"""A small dose of the campaign; `make torture` has all of it."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).with_name("campaign.py")
DOSES = {
    "disks": 0.125,
    "kills": 0.067,
    "configs": 0.04,
    "recordings": 0.03,
    "tables": 0.03,
    "maps": 0.1,
    "streams": 0.033,
    "surroundings": 0.0875,
    "extremes": 0.1,
    "injections": 0.1,
    "bombs": 0.023,
}


def campaign(name, failures):
    """Run one with a single worker, so that three can run beside one another."""
    command = [sys.executable, CAMPAIGN, "--only", name, "--dose", str(DOSES[name]), "--workers", "1"]
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    return subprocess.run(
        [*command, "--failures", failures],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        timeout=1000,
    )


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """All of them, begun."""
    folder = tmp_path_factory.mktemp("torture")
    with ThreadPoolExecutor(3) as pool:
        yield {name: pool.submit(campaign, name, folder / name) for name in DOSES}


@pytest.mark.parametrize("name", DOSES)
def test_a_dose_of_torture(campaigns, name):
    done = campaigns[name].result()
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
