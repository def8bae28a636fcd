"""A third party's plugin, built and installed beside the wheel; and one that is broken."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import Elsewhere
from units_at_rest import unit_at_rest
from units_with_effects import make_unit

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


@pytest.fixture(scope="module")
def installed(environment):
    """The process in which both are installed."""
    with Elsewhere(environment) as found:
        yield found


def test_both_are_listed_and_the_broken_one_stops_nothing(environment, installed, tmp_path):
    done = subprocess.run([DRIFTLAB, "plugins", "--json"], env=environment, capture_output=True, text=True, check=True)
    rows = {row["module"]: row for row in json.loads(done.stdout)}
    mine = rows["driftlab_warm_up.warm_up"]
    assert (mine["family"], mine["kind"]) == ("bias_models", "warm_up")
    assert (mine["distribution"], mine["version"], mine["error"]) == ("driftlab-warm-up", "0.1.0", None)
    effect = rows["driftlab_warm_up.fan"]
    assert (effect["family"], effect["kind"], effect["error"]) == ("effects", "chamber_fan", None)
    broken = rows["driftlab_broken"]
    assert broken["error"] == "RuntimeError: the licence server does not answer"
    assert (broken["distribution"], broken["version"]) == ("driftlab-broken", "6.6.6")
    assert rows["fusion_plugins.bias_models.random_walk"]["error"] is None
    table = installed.driftlab("plugins", cwd=tmp_path).stdout
    assert "warm_up" in table
    assert "broken" in table


def test_the_template_keeps_the_laws_and_is_typed(environment, tmp_path):
    tests = ["-q", "-p", "no:cacheprovider", "--rootdir", tmp_path, TEMPLATE / "tests"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *tests], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout
    assert (Path(environment["PYTHONPATH"]) / "driftlab_warm_up" / "py.typed").is_file()
    assert (TEMPLATE / ".github" / "workflows" / "ci.yml").is_file()


def test_a_config_that_uses_it_runs(installed, tmp_path):
    unit = unit_at_rest(seconds=900, walk=1e-8)
    transient = np.array([2e-3, -1e-3, 5e-4]) * np.exp(-unit.t / 600)[:, None]
    with h5py.File(tmp_path / "recording.h5", "w") as file:
        file["time"], file["gyro"] = unit.t, np.rad2deg(unit.gyro + transient)
        file["accel"] = unit.accel / 9.80665
    config = TEMPLATE / "warm_up.yaml"
    done = installed.driftlab("run", config, "--input", "recording.h5", "--out", "out", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert "gyro_bias_x_transient" in summary["states"]
    with h5py.File(tmp_path / "out" / "estimates.h5") as file:
        truth = unit.bias + transient
        # neither latitude nor heading are given: Earth rate is part of the bias
        error = file["bias"][-1] - (truth[-1] + [5.51177e-5, 0, 4.77445e-5])
        assert np.all(np.abs(error) < 6 * file["bias_sigma"][-1])


def chamber_with_a_fan(path, rng, size):
    """Let a fan start and stop in a recording, and the gyro answer by `size` (3,) in rad/s, over 400 s."""
    with h5py.File(path, "r+") as file:
        t = file["time"][:]
        fan, part, since, runs, left = np.zeros(len(t)), np.zeros((len(t), 3)), np.inf, False, 300.0
        for k in range(len(t)):
            if left <= 0:
                runs, left = not runs, rng.uniform(60.0, 700.0)
                since = 0.0 if runs else since
            fan[k] = runs
            part[k] = size * np.exp(-since / 400.0)
            since, left = since + 1.0, left - 1.0
        file["gyro"][:] += np.rad2deg(part)
        file.create_dataset("fan", data=fan).attrs["unit"] = "1"


def test_explain_finds_a_third_partys_effect(installed, tmp_path):
    rng, size = np.random.default_rng(8), np.array([6e-5, -5e-5, 4e-5])
    make_unit(tmp_path, 3, hours=(1.5, 1.2, 1.0))
    for name in ("soak", "train", "holdout"):
        chamber_with_a_fan(tmp_path / f"{name}.h5", rng, size)
    declared = tmp_path / "declared.yaml"
    line = "    temperature: {path: temperature, unit: degC}\n"
    text = declared.read_text().replace(line, line + '    fan: {path: fan, unit: "1"}\n')
    declared.write_text(text)

    files = ["--calibration", "soak.h5", "--train", "train.h5", "--holdout", "holdout.h5", "--out", "closed"]
    done = installed.driftlab("explain", "declared.yaml", *files, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    loop = json.loads(done.stdout)
    (effect,) = loop["effects"]
    assert (effect["kind"], effect["channel"], effect["indistinguishable_from"]) == ("chamber_fan", "fan", [])
    found, sigma = (np.array([effect[name][axis] for axis in "xyz"]) for name in ("coefficients", "sigma"))
    assert np.all(np.abs(found - size) < 5 * sigma)
    assert np.all(sigma < 0.2 * np.abs(size))
    assert float(effect["parameters"]["tau"].split()[0]) == pytest.approx(400.0, rel=0.1)
    before, after = (np.linalg.norm(loop[when]["coast_rmse_rad_s"]) for when in ("before", "after"))
    assert after < 0.3 * before
    # the new config needs the plugin, and finds it
    again = ("run", "closed/explained.yaml", "--input", "holdout.h5", "--out", "out", "--json")
    done = installed.driftlab(*again, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
