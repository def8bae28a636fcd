"""The noise of what is left, against a state-space likelihood and laws."""

import numpy as np
import pytest

from driftlab.noise.local_level import effective, fit_local_level


@pytest.mark.parametrize(("walk", "white"), [(0.05, 1.0), (0.3, 1.0), (2.0, 1.0)])
def test_the_noise_is_that_of_a_local_level(walk, white):
    """statsmodels' maximum likelihood of a local level: the same steady gain and one-step variance."""
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    rng = np.random.default_rng(5)
    x = np.cumsum(walk * rng.normal(size=2000)) + white * rng.normal(size=2000)
    likelier = structural.UnobservedComponents(x, level="local level").fit(disp=False)
    r, q = likelier.params
    P = (q + np.sqrt(q**2 + 4 * q * r)) / 2  # steady prediction of the level
    found = fit_local_level([x])
    assert found.gain == pytest.approx(P / (P + r), rel=0.1)
    assert found.variance == pytest.approx(P + r, rel=0.01)
    assert found.white == pytest.approx(r, rel=0.1)
    assert found.walk == pytest.approx(q, rel=0.25)


@pytest.mark.parametrize("walking", [False, True])
def test_white_noise_has_as_many_independent_rows_as_rows(walking):
    rng, n = np.random.default_rng(6), 4000
    ratios = [effective(rng.normal(size=n), np.sin(np.arange(n) / tau), walking=walking) / n for tau in (5, 20, 80) * 4]
    assert np.mean(ratios) == pytest.approx(1, abs=0.15)


def test_a_walk_has_few_independent_rows_for_what_is_slow():
    rng, n = np.random.default_rng(7), 4000
    walk = np.cumsum(rng.normal(size=n))
    assert effective(walk, np.sin(2 * np.pi * np.arange(n) / n), walking=False) < 10
    assert effective(walk, rng.normal(size=n), walking=False) > n / 3
