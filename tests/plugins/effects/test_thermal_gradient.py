import numpy as np
from effect_recordings import at_temperature, on_one_axis, record

from fusion_plugins.effects.relaxation import Relaxation
from fusion_plugins.effects.thermal_gradient import ThermalGradient


def test_thermal_gradient_has_a_difference_and_its_rate():
    t = np.cumsum(np.random.default_rng(8).uniform(0.5, 3.0, 600))
    T = 20 + 0.01 * t
    chunk = at_temperature(t, T, temperature_case=T + 2 + 0.004 * (t - t[0]), temperature_raw=T, temperature_rate=T)
    both = on_one_axis(ThermalGradient(), chunk)
    np.testing.assert_allclose(both[:, 0], 2 + 0.004 * (t - t[0]), atol=1e-12)
    np.testing.assert_allclose(both[:, 1], 0.004 * (1 - np.exp(-(t - t[0]) / 30)), atol=1e-12)  # window 60 s
    for k, form in enumerate(("difference", "rate")):
        np.testing.assert_array_equal(on_one_axis(ThermalGradient(form=form), chunk)[:, 0], both[:, k])
        assert ThermalGradient(form=form).labels == tuple(f"{axis}_{form}" for axis in "xyz")
    proposed = list(ThermalGradient().proposals([chunk]))
    assert {c.channel for c in proposed} == {"temperature_case"}
    assert {c.form for c in proposed} == {"difference", "rate", "both"}
    for form in ("rate", "both"):
        assert [c.window for c in proposed if c.form == form] == [5, 10, 20, 40, 80, 160, 320]


def test_the_rate_of_a_difference_is_its_relaxation():
    chunk = record()
    difference = chunk["temperature_case"] - chunk["temperature"]
    rate = on_one_axis(ThermalGradient(form="rate", window="80 s"), chunk)
    late = on_one_axis(Relaxation(tau="40 s"), chunk.having(temperature=difference))
    np.testing.assert_allclose(rate, late / 40, rtol=1e-12, atol=1e-14)
