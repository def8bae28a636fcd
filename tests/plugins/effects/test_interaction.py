import numpy as np
from effect_recordings import on_one_axis, record

from fusion_core.chunk import Chunk
from fusion_plugins.effects.interaction import Interaction


def test_interaction_is_the_product_with_its_factors():
    rng = np.random.default_rng(6)
    V, T, p = 12 + rng.normal(size=50), 20 + rng.normal(size=50), rng.normal(size=50)
    chunk = Chunk(np.arange(50.0), {"voltage": V, "temperature": T, "pressure": p})
    one = on_one_axis(Interaction(zero=(12.0, 20.0)), chunk)
    np.testing.assert_allclose(one, np.stack([(V - 12) * (T - 20), V - 12], axis=1), rtol=1e-13)
    assert Interaction().labels[:2] == ("x_product", "x_voltage")
    found = {c.channels: c for c in Interaction().proposals([chunk])}
    pairs = {frozenset(pair) for pair in found}
    assert pairs == {frozenset(s) for s in (("voltage", "temperature"), ("pressure", "temperature"),
                                            ("voltage", "pressure"), ("voltage",), ("pressure",))}  # fmt: skip
    square = on_one_axis(found["pressure", "pressure"], chunk)
    np.testing.assert_allclose(square, np.stack([(p - p.mean()) ** 2, p - p.mean()], axis=1), atol=1e-12)


def test_interaction_spans_the_same_wherever_its_zeros_are():
    """Marginality: with the factors and a map linear in T, moving the zeros changes only the coefficients."""
    chunk = record()
    T = np.stack([np.ones(len(chunk)), chunk["temperature"]], axis=1)
    one, other = (np.hstack([on_one_axis(Interaction(zero=z), chunk), T]) for z in ((0.0, 0.0), (19.0, 21.0)))
    np.testing.assert_allclose(other @ np.linalg.lstsq(other, one, rcond=None)[0], one, rtol=1e-9, atol=1e-8)
