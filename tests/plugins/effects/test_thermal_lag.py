import numpy as np
import pytest
from effect_recordings import at_temperature

from fusion_plugins.effects.thermal_lag import ThermalLag


def test_thermal_lag_trails_a_ramp_by_tau_times_its_rate():
    t = np.cumsum(np.random.default_rng(1).uniform(0.5, 8.0, 400))
    rate, tau = -0.02, 90.0
    effect = ThermalLag(tau="90 s")
    seen, _ = effect.input(at_temperature(t, 30 + rate * t), None)
    behind = 30 + rate * t - seen
    np.testing.assert_allclose(behind, rate * tau * (1 - np.exp(-(t - t[0]) / tau)), atol=1e-10)
    assert behind[-1] == pytest.approx(rate * tau, rel=1e-6)
    assert effect.labels == ()
    assert effect.coefficients == ()
