"""Exporters: what is written is what the map says, and what is lost is no more than they own up to."""

import numpy as np
import pytest

from fusion_core.contracts import Exporter, ThermalMap
from fusion_core.host.registry import registry


@pytest.fixture
def fitted():
    rng, T = np.random.default_rng(3), np.linspace(-10, 45, 4000)
    bias = np.stack([1e-5 * T**2, np.sin(T / 9) * 1e-3, 1e-4 * T], axis=1) + rng.normal(size=(4000, 3)) * 1e-6
    settings = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 4})
    return settings.fit(T, bias, {})


def table(step):
    return registry().classes(Exporter)["csv_table"].model_validate({"kind": "csv_table", "step": step})


def test_a_table_gives_the_map_back_within_what_it_says(fitted, tmp_path):
    loss = table("2 K").export(fitted, tmp_path / "map.csv")
    lines = (tmp_path / "map.csv").read_text().splitlines()
    assert lines[2] == "temperature,bias_x,bias_y,bias_z,sigma_x,sigma_y,sigma_z"
    rows = np.loadtxt(tmp_path / "map.csv", delimiter=",", skiprows=3)
    assert (rows[0, 0], rows[-1, 0]) == pytest.approx(fitted.domain, rel=1e-8)
    np.testing.assert_allclose(rows[:, 4:], fitted.sigma(rows[:, 0]), rtol=1e-6)
    T = np.linspace(*fitted.domain, 5003)  # other places than those at which the loss was measured
    read = np.stack([np.interp(T, rows[:, 0], column) for column in rows[:, 1:4].T], axis=1)
    lost = np.max(np.abs(read - fitted.bias(T)), axis=0)
    assert np.all(lost <= 1.02 * loss.largest)
    assert np.all(lost >= 0.9 * loss.largest)
    # straight lines: step^2 / 8 times the largest second derivative, here by differences of the slope
    bend = np.max(np.abs(np.gradient(fitted.slope(T), T, axis=0)), axis=0)
    assert np.all(loss.largest <= (rows[1, 0] - rows[0, 0]) ** 2 / 8 * bend * 1.01)


def test_half_the_step_loses_a_quarter(fitted, tmp_path):
    coarse, fine = (table(step).export(fitted, tmp_path / "map.csv").largest for step in ("5.5 K", "2.75 K"))
    np.testing.assert_allclose(coarse / fine, 4, rtol=0.15)
