"""A third party's plugin, built and installed beside the wheel; and one that is broken."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from units_at_rest import unit_at_rest

ROOT = Path(__file__).parent.parent
TEMPLATE = ROOT / "examples" / "plugin_template"
DRIFTLAB = Path(sys.executable).with_name("driftlab")

BROKEN = """
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"
[project]
name = "driftlab-broken"
version = "6.6.6"
[project.entry-points.fusion_core]
broken = "driftlab_broken"
[tool.setuptools]
py-modules = ["driftlab_broken"]
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Environment variables under which both plugins are installed beside driftlab."""
    folder = tmp_path_factory.mktemp("third_party")
    broken = folder / "broken"
    broken.mkdir()
    (broken / "pyproject.toml").write_text(BROKEN)
    (broken / "driftlab_broken.py").write_text('raise RuntimeError("the licence server does not answer")\n')
    template = folder / "template"
    subprocess.run(["cp", "-r", TEMPLATE, template], check=True)
    site = folder / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--disable-pip-version-check", "--target", site, template, broken], check=True)
    return {**os.environ, "PYTHONPATH": str(site)}


def test_both_are_listed_and_the_broken_one_stops_nothing(environment):
    done = subprocess.run([DRIFTLAB, "plugins", "--json"], env=environment, capture_output=True, text=True, check=True)
    rows = {row["module"]: row for row in json.loads(done.stdout)}
    mine = rows["driftlab_warm_up.warm_up"]
    assert (mine["family"], mine["kind"]) == ("bias_models", "warm_up")
    assert (mine["distribution"], mine["version"], mine["error"]) == ("driftlab-warm-up", "0.1.0", None)
    broken = rows["driftlab_broken"]
    assert broken["error"] == "RuntimeError: the licence server does not answer"
    assert (broken["distribution"], broken["version"]) == ("driftlab-broken", "6.6.6")
    assert rows["fusion_plugins.bias_models.random_walk"]["error"] is None
    table = subprocess.run([DRIFTLAB, "plugins"], env=environment, capture_output=True, text=True, check=True).stdout
    assert "warm_up" in table
    assert "broken" in table


def test_a_config_that_uses_it_runs(environment, tmp_path):
    unit = unit_at_rest(seconds=900, walk=1e-8)
    transient = np.array([2e-3, -1e-3, 5e-4]) * np.exp(-unit.t / 600)[:, None]
    with h5py.File(tmp_path / "recording.h5", "w") as file:
        file["time"], file["gyro"] = unit.t, np.rad2deg(unit.gyro + transient)
        file["accel"] = unit.accel / 9.80665
    config = TEMPLATE / "warm_up.yaml"
    args = [DRIFTLAB, "run", config, "--input", "recording.h5", "--out", "out", "--json"]
    done = subprocess.run(args, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert "gyro_bias_x_transient" in summary["states"]
    with h5py.File(tmp_path / "out" / "estimates.h5") as file:
        truth = unit.bias + transient
        # neither latitude nor heading are given: Earth rate is part of the bias
        error = file["bias"][-1] - (truth[-1] + [5.51177e-5, 0, 4.77445e-5])
        assert np.all(np.abs(error) < 6 * file["bias_sigma"][-1])
