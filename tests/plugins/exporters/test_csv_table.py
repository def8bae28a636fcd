"""Exporters: what is written is what the map says, and what is lost is no more than they own up to."""

import numpy as np
import pytest

from fusion_core.contracts import Calibrated, Export, Exporter, ThermalMap
from fusion_core.host.registry import registry


@pytest.fixture
def fitted():
    rng, T = np.random.default_rng(3), np.linspace(-10, 45, 4000)
    bias = np.stack([1e-5 * T**2, np.sin(T / 9) * 1e-3, 1e-4 * T], axis=1) + rng.normal(size=(4000, 3)) * 1e-6
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 4})
    return settings.fit(T, bias, {})


def table(step):
    return registry().classes(Exporter)["csv_table"].model_validate({"kind": "csv_table", "step": step})


def of(fitted):
    return Export((Calibrated("gyro", "rad/s", "deg/h", ("x", "y", "z"), fitted),))


def lost(step, fitted, path):
    """The largest error (3,) over the domain as the exporter says it, in rad/s."""
    (sensor,) = table(step).export(of(fitted), path).sensors
    return sensor.domain.largest


def test_a_table_gives_the_map_back_within_what_it_says(fitted, tmp_path):
    largest = lost("2 K", fitted, tmp_path / "map.csv")
    lines = [line for line in (tmp_path / "map.csv").read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == "temperature,bias_x,bias_y,bias_z,sigma_x,sigma_y,sigma_z"
    rows = np.loadtxt(lines[1:], delimiter=",")
    assert (rows[0, 0], rows[-1, 0]) == pytest.approx(fitted.domain, rel=1e-8)
    np.testing.assert_allclose(rows[:, 4:], fitted.sigma(rows[:, 0]), rtol=1e-6)
    T = np.linspace(*fitted.domain, 5003)  # other places than those at which the loss was measured
    read = np.stack([np.interp(T, rows[:, 0], column) for column in rows[:, 1:4].T], axis=1)
    found = np.max(np.abs(read - fitted.bias(T)), axis=0)
    assert np.all(found <= 1.02 * largest)
    assert np.all(found >= 0.9 * largest)
    # straight lines: step^2 / 8 times the largest second derivative, here by differences of the slope
    bend = np.max(np.abs(np.gradient(fitted.slope(T), T, axis=0)), axis=0)
    assert np.all(largest <= (rows[1, 0] - rows[0, 0]) ** 2 / 8 * bend * 1.01)


def test_half_the_step_loses_a_quarter(fitted, tmp_path):
    coarse, fine = (lost(step, fitted, tmp_path / "map.csv") for step in ("5.5 K", "2.75 K"))
    np.testing.assert_allclose(coarse / fine, 4, rtol=0.15)
