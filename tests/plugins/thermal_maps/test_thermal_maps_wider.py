"""A map over a wider domain is the same inside, and less sure beyond."""

import numpy as np
import pytest

from fusion_core.contracts import ThermalMap
from fusion_core.host.registry import registry

RNG = np.random.default_rng(3)
T = np.linspace(-10, 30, 4000)
BIAS = np.stack([1e-5 * np.tanh((T - 5) / 8), 2e-6 * T], axis=1) + RNG.normal(size=(4000, 2)) * 1e-7


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("spline", {}),
        ("polynomial", {"order": 3}),
        ("onnx_network", {"starts": 1, "neurons": 2}),
        ("onnx_network", {"starts": 1, "neurons": 2, "target": "slope"}),
    ],
)
def test_inside_nothing_changes_and_beyond_sigma_grows(kind, settings, tmp_path):
    made = registry().classes(ThermalMap)[kind].model_validate(settings)
    fitted = made.fit(T, BIAS, {})
    wider = made.over(fitted, (-14.3, 30.001))
    assert wider.domain[0] <= -14.3
    assert wider.domain[0] >= -15.4
    assert wider.domain[1] >= 30.001
    np.testing.assert_allclose(wider.bias(T), fitted.bias(T), atol=1e-9 * np.ptp(BIAS) + 1e-13 + 1e-5 * 1e-5)
    np.testing.assert_allclose(wider.slope(T[1:-1]), fitted.slope(T[1:-1]), atol=1e-9)
    assert np.all(wider.sigma(np.array([-14.0])) > wider.sigma(np.array([-10.0])))
    assert wider.record.error.holes[0][1] == pytest.approx(-10.0)
    assert made.over(fitted, (-9.0, 29.0)) is fitted
    path = tmp_path / f"map{made.suffix}"
    wider.save(path)
    np.testing.assert_allclose(made.read(path).bias(T), wider.bias(T), rtol=1e-6, atol=1e-12)
