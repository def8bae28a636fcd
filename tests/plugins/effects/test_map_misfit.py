import numpy as np
import pytest
from effect_recordings import at_temperature, on_one_axis

from fusion_plugins.effects.map_misfit import MapMisfit


def test_map_misfit_sums_to_one_and_is_constant_beyond():
    T = np.linspace(-60, 120, 700)
    effect = MapMisfit(intervals=7, low="-20 degC", high="60 degC")
    B = on_one_axis(effect, at_temperature(np.arange(700.0), T))
    assert B.shape[1] == 10
    np.testing.assert_allclose(B.sum(axis=1), 1.0, rtol=1e-12)
    assert np.all(B >= 0)
    assert np.ptp(B[T <= -20], axis=0).max() == 0
    assert np.ptp(B[T >= 60], axis=0).max() == 0
    inside = (T > -20) & (T < 60)
    cubic = np.polynomial.Polynomial([1.0, -0.3, 0.02, 1e-4])(T[inside])
    left = cubic - B[inside] @ np.linalg.lstsq(B[inside], cubic, rcond=None)[0]
    assert np.max(np.abs(left)) < 1e-9 * np.max(np.abs(cubic))  # cubic splines contain the cubics


def test_map_misfit_is_proposed_where_temperature_moved():
    warm, still = (at_temperature(np.arange(50.0), T) for T in (np.linspace(3, 44, 50), np.full(50, 20.0)))
    assert {(c.low, c.high) for c in MapMisfit().proposals([warm, still])} == {(3.0, 44.0)}
    assert list(MapMisfit().proposals([still])) == []
    with pytest.raises(ValueError, match="low 50 degC is not below high 10 degC; write the colder one as low"):
        MapMisfit(low="50 degC", high="10 degC")
