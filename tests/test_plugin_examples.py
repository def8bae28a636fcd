"""The packages under examples/ that bring plugins, really installed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
from command_line import Elsewhere
from command_line import driftlab as here
from units_at_rest import unit_at_rest

EXAMPLES = Path(__file__).parent.parent / "examples"
PIP = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Return a function: the variables under which an example is installed beside driftlab."""

    def install(name):
        folder = tmp_path_factory.mktemp(name)
        subprocess.run(["cp", "-r", EXAMPLES / name, folder / "source"], check=True)  # so that nothing is built in it
        target = ["--disable-pip-version-check", "--target", folder / "site"]
        subprocess.run([*PIP, *target, folder / "source"], check=True)
        return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder / "site"), os.environ.get("PYTHONPATH", "")])}

    return install


def driftlab(*args, cwd, env, **more):
    code = "from driftlab.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *args], cwd=cwd, env=env, capture_output=True, text=True, check=False, **more
    )


def bias(folder):
    with h5py.File(folder / "estimates.h5") as file:
        return file["bias"][:]


CHANNELS = """
    time: {path: t, unit: s}
    gyro: {path: [gx, gy, gz], unit: rad/s}
    accel: {path: [ax, ay, az], unit: m/s^2}
"""


def table(seconds=240):
    unit = unit_at_rest(seconds=seconds)
    gyro, accel = ({f"{name}{axis}": values[:, k] for k, axis in enumerate("xyz")} for name, values in
                   (("g", unit.gyro), ("a", unit.accel)))  # fmt: skip
    return pl.DataFrame({"t": unit.t, **gyro, **accel})


def test_a_source_on_the_public_base(environment, tmp_path):
    env = environment("arrow_source")
    table().write_ipc(tmp_path / "unit.arrow", record_batch_size=1000)
    table().write_csv(tmp_path / "unit.csv")
    for kind in ("arrow", "csv"):
        (tmp_path / f"{kind}.yaml").write_text(f"extends: mems_crs05\nsource:\n  kind: {kind}\n  channels:{CHANNELS}")
    name = "unit.arrow::20:200"
    done = driftlab("run", "arrow.yaml", "--input", name, "--out", "arrow", "--json", cwd=tmp_path, env=env)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["recording"] == name
    done = here("run", "csv.yaml", "--input", "unit.csv::20:200", "--out", "csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(bias(tmp_path / "arrow"), bias(tmp_path / "csv"))

    (tmp_path / "half.arrow").write_bytes((tmp_path / "unit.arrow").read_bytes()[:5000])
    wrong = (
        ("unit.csv", "unit.csv: is a text file, a file of kind arrow was expected; use kind: csv"),
        ("half.arrow", "half.arrow: is cut short or damaged"),
        ("none.arrow", "none.arrow: cannot be read"),
        ("unit.arrow::9000:", "has no row in this range"),
    )
    with Elsewhere(env) as installed:
        for name, message in wrong:
            done = installed.driftlab("run", "arrow.yaml", "--input", name, "--out", "wrong", cwd=tmp_path)
            assert done.returncode == 1
            assert message in done.stderr
            assert "Traceback" not in done.stderr


def test_a_recording_through_a_pipe(tmp_path):
    content = table().write_csv()
    (tmp_path / "unit.csv").write_text(content)
    (tmp_path / "csv.yaml").write_text(f"extends: mems_crs05\nsource:\n  kind: csv\n  channels:{CHANNELS}")
    assert here("run", "csv.yaml", "--input", "unit.csv", "--out", "file", cwd=tmp_path).returncode == 0
    for out, name in (("pipe", "-"), ("part", "-::20:200")):
        args = ("--input", name, "--out", out, "--json")
        done = driftlab("run", "csv.yaml", *args, cwd=tmp_path, env=None, input=content)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["recording"] == name
    np.testing.assert_array_equal(bias(tmp_path / "file"), bias(tmp_path / "pipe"))
    assert len(bias(tmp_path / "part")) < len(bias(tmp_path / "pipe"))

    # what cannot be computed again is not replaced
    args = ("--input", "-", "--out", "pipe")
    refused = driftlab("run", "csv.yaml", *args, cwd=tmp_path, env=None, input=content)
    assert refused.returncode == 2
    assert "give --force to replace it" in refused.stderr


BROKEN = """
from typing import Literal
import numpy as np
from fusion_core.contracts import BiasModel, Prior, Transition
from fusion_core.hookspecs import hookimpl

class Growing(BiasModel):
    \"\"\"Says other things of a recording that is cut.\"\"\"
    kind: Literal["growing"] = "growing"

    def prior(self):
        return Prior(np.zeros(3), np.eye(3))

    def transition(self, chunk, memory):
        return Transition(np.eye(3), np.zeros((3, 3)), np.arange(3.0 * len(chunk)).reshape(-1, 3)), None

@hookimpl
def bias_models():
    return [Growing]
"""


def test_plugins_that_are_installed_are_held_to_the_laws(tmp_path):
    (tmp_path / "growing.py").write_text(BROKEN)
    info = tmp_path / "growing-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: growing\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[fusion_core]\ngrowing = growing\n")
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    done = driftlab("plugins", "--family", "bias_models", "--check", "--json", cwd=tmp_path, env=env)
    assert done.returncode == 1, done.stderr
    rows = json.loads(done.stdout)
    (wrong,) = [row for row in rows if row["error"] is not None]
    assert (wrong["family"], wrong["kind"], wrong["law"]) == (
        "bias_models",
        "growing",
        "any split gives the same steps",
    )
    assert {"constant", "gauss_markov", "random_walk", "thermal_derivative", "growing"} == {row["kind"] for row in rows}
