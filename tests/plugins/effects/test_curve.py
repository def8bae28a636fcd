import numpy as np
import pytest
from effect_recordings import on_one_axis

from fusion_core.chunk import Chunk
from fusion_plugins.effects.curve import Curve


def test_curve_is_a_power_series_and_goes_straight_on_beyond():
    u = np.linspace(-2, 12, 141)
    effect = Curve(channel="voltage", powers=3, low=0.0, high=10.0)
    B = on_one_axis(effect, Chunk(np.arange(141.0), {"voltage": u}))
    x = (u - 5) / 5
    inside = np.abs(x) <= 1
    np.testing.assert_allclose(B[inside], np.stack([x, x**2, x**3], axis=1)[inside], atol=1e-14)
    for side in (x < -1, x > 1):
        np.testing.assert_allclose(np.diff(B[side], n=2, axis=0), 0, atol=1e-13)
    slope = np.gradient(B, x, axis=0)
    np.testing.assert_allclose(slope[-1], [1, 2, 3], rtol=1e-9)
    np.testing.assert_allclose(slope[0], [1, -2, 3], rtol=1e-9)
    assert effect.labels[:3] == ("x_c1", "x_c2", "x_c3")
    assert Curve(powers=2, above=3).terms == ("c4", "c5")
    higher = Curve(channel="voltage", powers=2, above=1, low=0.0, high=10.0)
    np.testing.assert_array_equal(on_one_axis(higher, Chunk(np.arange(141.0), {"voltage": u})), B[:, 1:])
    with pytest.raises(ValueError, match="low 50 is not below high 10; write the lower end as low"):
        Curve(low=50, high=10)


def test_curve_is_proposed_over_the_range_of_what_moves():
    rng = np.random.default_rng(9)
    chunk = Chunk(
        np.arange(50.0),
        {"temperature": np.linspace(3, 44, 50), "voltage": 5 + rng.normal(size=50), "still": np.ones(50),
         "field": rng.normal(size=(50, 3)), "residual": rng.normal(size=(50, 3))},
    )  # fmt: skip
    found = [(c.channel, c.powers, c.above) for c in Curve().proposals([chunk])]
    assert found == [("temperature", k, 0) for k in (1, 2, 3)] + [("voltage", 3, 0)]
    assert {(c.low, c.high) for c in Curve().proposals([chunk]) if c.channel == "temperature"} == {(3.0, 44.0)}
