"""A small dose of the campaign; `make torture` has all of it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).with_name("campaign.py")
# known failures would hide new ones: a dose has none
DOSES = {
    "configs": 0.03,
    "recordings": 0.03,
    "tables": 0.03,
    "maps": 0.08,
    "streams": 0.02,
    "kills": 0.04,
    "disks": 0.09,
}


@pytest.mark.parametrize("name", DOSES)
def test_a_dose_of_torture(tmp_path, name):
    command = [
        sys.executable,
        CAMPAIGN,
        "--only",
        name,
        "--dose",
        str(DOSES[name]),
        "--failures",
        tmp_path / "failures",
    ]
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
