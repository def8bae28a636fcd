"""The map of an ArduPilot log is the one that ArduPilot's own script finds in it, for gyros and accelerometers.

The script is `tempcal_imu.py` of the package ardupilot_methodic_configurator (GPL-3): it is fetched, run as a program,
and is no part of this project. Its cubic is in T - 35 degC, in 1e-6 of the SI unit.
"""

import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from dataflash_writer import write_log

import driftlab
from driftlab.commands.inputs import config_of

ROOT = Path(__file__).parents[3]
PACKAGE, MEMBER = "ardupilot-methodic-configurator==5.0.1", "ardupilot_methodic_configurator/tempcal_imu.py"
REFERENCE = 35.0  # degC, of the script's polynomials
RATE, LENGTH = 5.0, 2400.0  # Hz, s

CONFIG = """
extends: ardupilot_log
filter:
  update_interval: 1 s
  align: 10 s
  gyro: {calibration: {kind: polynomial, order: 3}}
  accel: {calibration: {kind: polynomial, order: 3}}
"""


@pytest.fixture(scope="session")
def script():
    """Return the script, fetched once from the index that pip is set up for."""
    path = ROOT / ".cache" / Path(MEMBER).name
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        done = subprocess.run([*pip, "--dest", str(path.parent), PACKAGE], capture_output=True, text=True, timeout=120)
        if done.returncode:
            pytest.skip(f"{PACKAGE} cannot be fetched here")
        wheel = next(path.parent.glob("ardupilot_methodic*.whl"))
        with zipfile.ZipFile(wheel) as archive:
            path.write_bytes(archive.read(MEMBER))
        wheel.unlink()
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A vehicle that stands, level but for some degrees, and warms up by itself; both triads bend with temperature."""
    rng = np.random.default_rng(5)
    t = np.arange(round(RATE * LENGTH)) / RATE
    T = 15 + 45 * (1 - np.exp(-t / 900)) / (1 - np.exp(-LENGTH / 900))
    x = ((T - REFERENCE) / 20)[:, None]
    gyro = [2e-3, -1e-3, 3e-3] + x * [4e-3, -6e-3, 2e-3] + x**2 * [1e-3, 2e-3, -2e-3] + x**3 * [5e-4, 0, -1e-3]
    accel = [0.4, -0.3, -9.78] + x * [0.2, -0.1, 0.3] + x**2 * [0.05, 0.02, -0.06] + x**3 * [0.02, -0.03, 0.01]
    gyro = gyro + rng.normal(size=gyro.shape) * np.deg2rad(0.01) * np.sqrt(RATE)
    accel = accel + rng.normal(size=accel.shape) * 150e-6 * 9.80665 * np.sqrt(RATE)
    path = tmp_path_factory.mktemp("log") / "warm_up.bin"
    return write_log(path, t, [(gyro, accel, T)], {"INS_TCAL1_ENABLE": 0.0, "AHRS_ORIENTATION": 0.0})


@pytest.fixture(scope="module")
def theirs(script, log):
    """Return the coefficients (3 orders, 3 axes) that the script finds, in SI, by sensor."""
    out = log.with_name("tcal.parm")
    command = [sys.executable, str(script), "--no-graph", "--outfile", str(out), str(log)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    values = dict(line.split() for line in out.read_text().splitlines() if line)
    return {
        sensor: np.array([[float(values[f"INS_TCAL1_{name}{k}_{axis}"]) for axis in "XYZ"] for k in (1, 2, 3)]) * 1e-6
        for sensor, name in (("gyro", "GYR"), ("accel", "ACC"))
    }


@pytest.mark.parametrize("channel", ["gyro", "accel"])
def test_the_coefficients_are_those_of_the_script_to_a_hundredth_of_the_swing(theirs, log, channel):
    config = config_of(CONFIG)
    fitted = driftlab.fit_map(config.tracking(channel), str(log)).map
    assert fitted.record.channel == channel
    low, high = fitted.domain
    T = np.linspace(low, high, 200)
    ours = np.polynomial.polynomial.polyfit(T - REFERENCE, fitted.bias(T), 3)
    found = theirs[channel]
    swing = np.ptp(fitted.bias(T), axis=0)
    half = (high - low) / 2
    for order in (1, 2, 3):  # what a coefficient is worth over the range
        worth = np.abs(ours[order] - found[order - 1]) * half**order
        assert np.all(worth < 0.01 * swing), (order, worth / swing)
    powers = np.stack([(T - REFERENCE) ** k for k in (1, 2, 3)], axis=1)
    apart = fitted.bias(T) - powers @ found
    assert np.all(np.ptp(apart, axis=0) < 0.01 * swing)
