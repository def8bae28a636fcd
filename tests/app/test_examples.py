"""The example that closes the loop on a measured recording, with its control; and the one of autopilots, in small."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from ways import binned

FOLDER = Path(__file__).parent.parent.parent / "examples" / "02_oven_resistor"


def asked(which, out):
    code = f"import run; answer = run.ask({which!r}, 3, run.Path({str(out)!r})); import json; " + (
        "print(json.dumps([answer.verdict, answer.effects, {k: v[1][0] for k, v in answer.errors.items()}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=FOLDER, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_the_lag_of_a_measured_resistor_is_named_and_its_error_at_least_halved(tmp_path):
    verdict, effects, error = asked("lagging", tmp_path / "out")
    assert verdict == "explained"
    assert [(e["kind"], e["channel"]) for e in effects] in (
        [("relaxation", "temperature")],
        [("thermal_lag", "temperature")],
    )
    assert error["before"] == pytest.approx(0.59e-6, rel=0.02)  # of the declared model, the constant removed: 0.59 ppm
    assert error["after"] < error["before"] / 2


def test_to_the_control_nothing_is_added_and_its_map_stays_byte_for_byte(tmp_path):
    _, effects, error = asked("control", tmp_path / "out")
    assert effects == []
    assert error["after"] == error["before"]
    assert (tmp_path / "out" / "explained.json").read_bytes() == (tmp_path / "out" / "declared.json").read_bytes()


SPANS = ((0.0, 3999.0), (5000.0, 8999.0), (10_000.0, None))
PROOF = """
import json
import run
from rich.console import Console
rows = run.prove(run.Path({out!r}), run.Path({source!r}), Console(stderr=True), {spans!r}, search=False)
print(json.dumps({{name: float(run.np.linalg.norm(found["to the end"])) for name, found in rows.items()}}))
"""


def warm_ups(path):
    """Write three warm-ups from 5 to 30 degC, of which a bias of 5000 deg/h is a cubic, as the recording is kept."""
    rng, rows = np.random.default_rng(6), []
    for start in (0, 5000, 10_000):
        t = np.arange(4000.0)
        T = 30 - 25 * np.exp(-t / 900)
        x = (T - 17) / 13
        bias = np.stack([x**3 - x**2, 2 * x, x**2 - x**3], axis=1) * 2500 * np.pi / 180 / 3600
        rows.append((t + start, bias + rng.normal(size=3) * 1e-3 + rng.normal(size=(4000, 3)) * 1e-4, T))
    t, gyro, T = (np.concatenate(column) for column in zip(*rows, strict=True))
    with h5py.File(path, "w") as file:
        accel = np.array([0.0, 0.0, 9.80665]) + 0.02 * rng.normal(size=gyro.shape)
        columns = {"timestamp_utc": t, "angular_velocity": gyro * 1e3, "acceleration": accel, "temperature": T}
        for name, values in columns.items():
            file[name] = values


def test_an_autopilots_logs_become_parameters_that_take_its_bias_off(tmp_path):
    """Cubics hold a cubic: only PX4's stairs leave more than the level, and what noise leaves of the reference."""
    warm_ups(tmp_path / "three.h5")
    out = tmp_path / "out"
    code = PROOF.format(out=str(out), source=str(tmp_path / "three.h5"), spans=SPANS)
    folder = FOLDER.parent / "05_autopilot"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    left = json.loads(done.stdout.splitlines()[-1])
    for firmware in ("PX4", "ArduPilot"):
        assert left[f"own cubic in {firmware}"] < left["none"] / 15
    assert left["ours in ArduPilot"] < left["none"] / 50
    assert left["ours in C"] < left["none"] / 50
    assert left["ours in PX4"] < left["none"] / 15
    assert left["ours in PX4"] > 2 * left["ours in ArduPilot"]
    assert left["ours in driftlab"] < left["none"] / 50
    assert {"vehicle.params", "vehicle.parm", "loss.json", "soak1.bin", "soak1.ulg"} <= {p.name for p in out.iterdir()}


def test_the_cubic_of_px4s_script_is_fitted_to_means_over_temperature():
    """Tools/process_sensor_caldata.py: each sample in its interval, one at a time; an outlier is gone by the median."""
    rng = np.random.default_rng(4)
    T = np.sort(rng.uniform(5, 20, 9000))
    gyro = np.stack([T, T**2, -T], axis=1) * 1e-3
    gyro[500] = 7.0
    bins = {}
    for k in range(len(T)):
        near = np.concatenate([np.zeros((15, 3)), gyro, np.zeros((15, 3))])[k : k + 31]
        place = min(int((T[k] - T[0]) / ((T[-1] - T[0]) / 2000)), 1999)
        bins.setdefault(place, []).append([T[k], *np.median(near, axis=0)])
    expected = np.array([np.mean(bins[place], axis=0) for place in sorted(bins)])
    found_T, found = binned(T, gyro)
    np.testing.assert_allclose(np.column_stack([found_T, found]), expected, rtol=1e-9)
