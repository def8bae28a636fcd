import numpy as np
import pytest
from effect_recordings import at_temperature, on_one_axis
from scipy.signal import lsim

from fusion_plugins.effects.thermal_rate import ThermalRate


def test_thermal_rate_is_its_transfer_function():
    """s (1 + 3 tau s) / (1 + tau s)^3 by scipy, on a temperature that bends every minute."""
    t = np.arange(0, 1200, 0.25)
    T = np.interp(t, np.arange(0, 1201, 60), 20 + np.random.default_rng(2).normal(size=21))
    tau = 20.0
    _, expected, _ = lsim(([3 * tau, 1.0, 0.0], [tau**3, 3 * tau**2, 3 * tau, 1.0]), T - T[0], t)
    found = on_one_axis(ThermalRate(tau="20 s"), at_temperature(t, T))[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.max(np.abs(expected)))


def test_thermal_rate_settles_on_a_ramp_and_on_a_bend():
    """A steady rate is met exactly, and a steadily growing one without delay."""
    t = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, 1000))
    effect = ThermalRate(tau="20 s")
    assert on_one_axis(effect, at_temperature(t, 5 + 0.03 * t))[-1, 0] == pytest.approx(0.03, rel=1e-9)
    bend = on_one_axis(effect, at_temperature(t, 5 + 0.5 * 1e-4 * t**2))[:, 0]
    np.testing.assert_allclose(bend[500:], 1e-4 * t[500:], atol=1e-4 * 0.05)  # 0.05 s late at most
