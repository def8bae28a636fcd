"""A thermal map that is fitted while the device still measures: `driftlab live --fit-map`."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from bench import FRAMING, Device, frame, paced
from units_at_rest import unit_at_rest

DRIFTLAB = Path(sys.executable).with_name("driftlab")
RATE = 1  # of the device's own time; it sends 400 times as fast
LOW, HIGH = 0.0, 40.0
DEG_H = np.degrees(1) * 3600


@pytest.fixture
def bench(tmp_path):
    """A folder with a config without a map, and the device that it names."""
    device = Device(tmp_path)
    walk = {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}
    source = {"kind": "serial", "port": str(device.path), "interval": f"{1 / RATE} s", "framing": FRAMING}
    gyro = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": walk}
    content = {
        "latitude": "40.9 deg",
        "heading": "0 deg",
        "source": source,
        "filter": {"update_interval": "1 s", "align": "60 s", "accel": None, "gyro": gyro},
    }
    (tmp_path / "live.yaml").write_text(yaml.safe_dump(content))
    yield tmp_path, device
    device.close()


def soak_frames(seconds):
    """Frames of a soak up and down again."""
    unit = unit_at_rest(
        seconds=seconds, rate=RATE, walk=1e-8, temperature=lambda t: HIGH - (HIGH - LOW) * np.abs(2 * t / seconds - 1)
    )
    return [frame(k, unit.gyro[k], unit.accel[k], unit.temperature[k]) for k in range(len(unit.t))]


def begin(folder, *args):
    command = [DRIFTLAB, "live", "live.yaml", "--record", "raw.h5", "--out", "out", "--json", *args]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def listening(run):
    """The lines until the device is listened to."""
    lines = []
    while not lines or lines[-1]["state"] == "getting ready":
        line = run.stdout.readline()
        assert line, run.stderr.read()
        lines.append(json.loads(line))
    return lines


def driftlab(folder, *args):
    done = subprocess.run([DRIFTLAB, *args], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def curve(path, T):
    from fusion_core.contracts import ThermalMap
    from fusion_core.host.registry import registry

    kind = registry().classes(ThermalMap)["spline"]
    fitted = kind.model_validate({"path": str(path)}).load()
    return fitted, fitted.bias(T)


def test_the_run_ends_when_sigma_is_reached_and_its_map_is_that_of_the_recording(bench):
    folder, device = bench
    wanted = ["--sigma", "3 deg/h", "--range", "5..35 degC", "--until-reached"]
    run = begin(folder, "--fit-map", "live.json", "--kind", "spline", *wanted)
    lines = listening(run)
    paced(device, soak_frames(6000), 400)
    out, errors = run.communicate(timeout=120)
    assert run.returncode == 0, errors
    lines += [json.loads(line) for line in out.splitlines()]
    maps = [line["map"] for line in lines if "map" in line]
    missing = [found["missing_degC"] for found in maps if found["curve"] and not found["reached"]]
    assert missing[0][-1][1] == 35.0, "the soak begins cold: what is missing is the warm end"
    not_yet = [found for found in maps if found["curve"] and not found["reached"]]
    assert all(found["sigma_worst_rad_s"] > 3 / DEG_H or found["samples"] < 2626 for found in not_yet)
    assert maps[-1]["samples"] > 1500, "35 degC is reached after 2,625 s"
    driftlab(folder, "fit-map", "live.yaml", "--input", "raw.h5", "--kind", "spline", "--out", "again.json")
    T = np.linspace(5, 35, 100)
    (live, b), (again, b_again) = (curve(folder / name, T) for name in ("live.json", "again.json"))
    assert live.record.samples == again.record.samples
    assert live.domain == again.domain
    assert np.max(live.sigma(T)) <= 3.3 / DEG_H
    np.testing.assert_allclose(b, b_again, atol=0.05 * np.min(again.sigma(T)), rtol=0)
    np.testing.assert_allclose(live.record.residual, again.record.residual, rtol=1e-3)
    np.testing.assert_allclose(live.sigma(T), again.sigma(T), rtol=0.2)
