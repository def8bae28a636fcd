"""A run that is killed goes on from its last checkpoint, to the same result."""

import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
import yaml
from units_at_rest import thermal_bias, unit_at_rest

from driftlab.commands.run import run
from driftlab.config import load_config
from driftlab.filtering.checkpoint import read_checkpoint, write_checkpoint
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from fusion_core.chunk import Chunk
from fusion_core.contracts import Alignment, ThermalMap
from fusion_core.errors import ConfigError, PluginError, UnreadableFile
from fusion_core.faults import Fault
from fusion_core.host.registry import registry
from fusion_core.model import State

# a checkpoint after every chunk, and chunks so small that there are many
CHILD = """
import sys
from pathlib import Path
from driftlab.commands import estimates as estimating, run as filtering
from driftlab.recordings import screening as intake
from driftlab.filtering import run
from driftlab.config import load_config
estimating.PERIOD = 0.0
run.read = lambda config, faults: intake.read(config, faults, 500)
write = estimating.write_checkpoint
def say(*args):
    write(*args)
    print("goes on", flush=True)
    estimating.write_checkpoint = write
estimating.write_checkpoint = say
config = load_config(Path("unit.yaml"), "recording.h5")
print("begun", flush=True)
filtering.run(config, out=Path("killed"), resume=True)
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A unit that is warmed, moved, turned to another bias, and not recorded for a while."""
    tmp_path = tmp_path_factory.mktemp("recording")
    unit = unit_at_rest(seconds=1500, rate=100, temperature=lambda t: 20 + t / 60, seed=3)
    unit.gyro[30_000:30_200] += 0.02
    unit.gyro[60_000:] += 4e-3
    unit.t[90_000:] += 33.3
    unit.write(tmp_path / "recording.h5")
    T = np.linspace(0, 60, 500)
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 5})
    settings.fit(T, thermal_bias(T), {}).save(tmp_path / "map.json")
    units = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
    bias = {"kind": "thermal_derivative", "walk": "1e-5 deg/s/sqrt(s)", "repeatability": "0.1 deg/s"}
    begun = {"coefficients": [1e-5, -1e-5, 0.0], "initial": [1e-4, 1e-4, 1e-5]}  # memories that began before
    bias["effects"] = [
        {"kind": "relaxation", "tau": "10 min", **begun},
        {"kind": "hysteresis", "width": "9 K", **begun},
    ]
    content = {
        "latitude": "40.9 deg",
        "source": {"kind": "hdf5", "channels": {name: {"path": name, "unit": unit} for name, unit in units.items()}},
        "filter": {
            "align": "20 s",
            "gyro": {
                "noise": "3.18 deg/h/sqrt(Hz)",
                "bias": bias | {"map": {"kind": "polynomial", "path": "map.json"}},
            },
            "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}},
            "rest": {"realign_after": "30 s"},
        },
    }
    (tmp_path / "unit.yaml").write_text(yaml.safe_dump(content))
    return tmp_path


@pytest.fixture(scope="module")
def checkpoint(recording):
    """The last checkpoint of a run."""
    kept = []
    config = load_config(recording / "unit.yaml", str(recording / "recording.h5"))
    list(Run(config, RunLog(), settled=lambda snapshot: kept.append(snapshot())))
    write_checkpoint(recording / "checkpoint.npz", kept[-1])
    return recording / "checkpoint.npz"


def test_kills_change_nothing(recording):
    """Five kills; the campaign `kills` of `make torture` has more, on another recording."""
    rng = np.random.default_rng(time.time_ns())
    reached = []
    for k in range(5):
        child = subprocess.Popen([sys.executable, "-c", CHILD], cwd=recording, stdout=subprocess.PIPE, text=True)
        child.stdout.readline()
        if k % 4:
            child.stdout.readline()  # it has gone on by one checkpoint at least
        time.sleep(rng.uniform(0, 0.1))
        child.kill()
        child.communicate()
        checkpoint = recording / "killed.partial" / "checkpoint.npz"
        reached.append(read_checkpoint(checkpoint)["run"]["t"] if checkpoint.exists() else 0.0)
        if (recording / "killed").exists():
            break
    assert reached == sorted(reached)
    assert len(set(reached)) >= 3, "the kills came at moments that differ"
    subprocess.run([sys.executable, "-c", CHILD], cwd=recording, check=True, capture_output=True)
    config = load_config(recording / "unit.yaml", str(recording / "recording.h5"))
    result = run(config, out=recording / "whole")
    assert len(result.summary["aligned_again_s"]) >= 1
    assert result.summary["motion_s"]
    assert {path.name for path in (recording / "killed").iterdir()} == {"estimates.h5", "summary.json", "report.html"}
    with (
        h5py.File(recording / "killed" / "estimates.h5") as killed,
        h5py.File(recording / "whole/estimates.h5") as whole,
    ):
        for name, values in whole.items():
            scale = 1e-12 * np.nanmax(np.abs(values[:].astype(float)))
            if name in ("x", "sigma", "bias", "coast"):
                scale = 1e-12 * (np.nanmax(np.abs(values[:])) + np.nanmax(whole["bias_sigma"][:]))
            tolerance = 1e-6 if name in ("innovations", "white", "nis") else scale
            np.testing.assert_allclose(killed[name][:], values[:], rtol=0, atol=tolerance, err_msg=name)
    killed, whole = (yaml.safe_load((recording / name / "summary.json").read_text()) for name in ("killed", "whole"))
    for name in ("faults", "motion_s", "aligned_again_s", "updates"):
        assert killed[name] == whole[name]
    np.testing.assert_allclose(killed["whiteness_p"], whole["whiteness_p"], rtol=1e-6)


def test_another_config_is_not_continued(recording):
    (recording / "out.partial").mkdir()
    (recording / "out.partial" / "driftlab.lock").touch()  # as a run that was killed leaves it
    config = load_config(recording / "unit.yaml", str(recording / "recording.h5"))
    content = {"driftlab": "0", "config": config.as_yaml(), "rows": 0, "run": {}}
    write_checkpoint(recording / "out.partial" / "checkpoint.npz", content)
    with pytest.raises(ConfigError, match="was begun with another config, recording or version of driftlab; use the"):
        run(config, out=recording / "out", resume=True)
    (recording / "out.partial" / "checkpoint.npz").write_bytes(b"PK\x03\x04 cut short")
    with pytest.raises(UnreadableFile, match=r"is not a checkpoint .*; begin anew without --resume"):
        run(config, out=recording / "out", resume=True)


@pytest.mark.parametrize("broken", [
    lambda found: found["tracker"].pop("refused"),
    lambda found: found["segments"].pop("prediction"),
    lambda found: _shortened(found["segments"]["prediction"], "thermometer"),
    lambda found: _shortened(found["segments"]["prediction"], "uncertainty"),
])  # fmt: skip
def test_a_checkpoint_of_another_layout_is_not_continued(recording, checkpoint, broken):
    config = load_config(recording / "unit.yaml", str(recording / "recording.h5"))
    found = read_checkpoint(checkpoint)
    broken(found)
    with pytest.raises(ConfigError, match="the checkpoint is not laid out as this version of driftlab writes it"):
        list(Run(config, RunLog(), resume=found))


def _shortened(prediction, name):
    prediction[name] = tuple(values[:-1] for values in prediction[name])


def test_what_a_checkpoint_holds_comes_back(tmp_path):
    chunk = Chunk(np.arange(3.0), {"gyro": np.ones((3, 3))}, Chunk(np.array([-1.0]), {"gyro": np.zeros((1, 3))}))
    alignment = Alignment(1.0, 0.1, {"gyro": np.zeros(3)}, {"gyro": np.ones(3)}, np.full(3, 1e-8))
    content = {
        "memory": (None, [1, 2.5, "T", True], {"a": np.arange(4), 3: (np.float64(0.1), float("nan"))}),
        "chunk": chunk,
        "records": [alignment, State(np.zeros(2), np.eye(2)), Fault(3, "at t = 1 s")],
    }
    write_checkpoint(tmp_path / "c.npz", content)
    back = read_checkpoint(tmp_path / "c.npz")
    assert back["memory"][0] is None
    assert back["memory"][1] == [1, 2.5, "T", True]
    np.testing.assert_array_equal(back["memory"][2]["a"], np.arange(4))
    assert back["memory"][2][3][0] == 0.1
    assert np.isnan(back["memory"][2][3][1])
    assert isinstance(back["memory"], tuple)
    np.testing.assert_array_equal(back["chunk"].previous["gyro"], np.zeros((1, 3)))
    assert back["records"][0].up is None
    assert back["records"][2] == content["records"][2]


def test_a_memory_that_no_checkpoint_can_keep(tmp_path):
    with pytest.raises(
        PluginError, match=r"a memory holds a builtins.object, which a checkpoint cannot keep; numbers, text"
    ):
        write_checkpoint(tmp_path / "c.npz", {"memory": (1, [object()])})
    assert list(tmp_path.iterdir()) == []
