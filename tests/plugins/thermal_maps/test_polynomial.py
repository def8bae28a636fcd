import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from soaks import NOISE, T_ok, b_ok, smooth, soak

from fusion_core.errors import (
    SingularFit,
    SwingTooSmall,
)
from fusion_plugins.thermal_maps.polynomial import Polynomial


@pytest.mark.parametrize("order", [1, 2, 3, 7, 15])
def test_a_polynomial_is_recovered(order):
    rng = np.random.default_rng(order)
    truth = np.polynomial.Chebyshev(rng.normal(size=order + 1), domain=[-25, 60])
    T = np.linspace(-20, 50, 500)
    found = Polynomial(order=order).fit(T, truth(T)[:, None], {})
    np.testing.assert_allclose(found.bias(T)[:, 0], truth(T), atol=1e-10 * np.ptp(truth(T)))
    np.testing.assert_allclose(found.slope(T)[:, 0], truth.deriv()(T), atol=1e-9 * np.ptp(truth.deriv()(T)))


def test_least_squares_and_its_deviation_are_those_of_numpy():
    T, bias = soak(smooth, N=150_000)  # more than one slab
    found = Polynomial(order=3).fit(T, bias, {})
    at, T_0 = np.linspace(*found.domain, 50), 15.0
    for axis in range(3):
        c, covariance = np.polyfit(T, bias[:, axis], 3, cov=True)
        np.testing.assert_allclose(found.bias(at)[:, axis], np.polyval(c, at), atol=1e-12)
        V = np.vander(at, 4) - np.vander([T_0], 4)
        spread = np.einsum("Nm,mn,Nn->N", V, covariance, V)
        # estimated from blocks of samples, beside a walk that is not there
        np.testing.assert_allclose(found.sigma(at, T_0)[:, axis], np.sqrt(spread), rtol=0.2, atol=1e-9)


@settings(max_examples=30)
@given(
    order=st.integers(1, 15),
    low=st.floats(-60, 20),
    swing=st.floats(3, 150),
    seed=st.integers(0, 1000),
)
def test_slope_is_the_derivative_of_any_polynomial(order, low, swing, seed):
    rng = np.random.default_rng(seed)
    T = np.linspace(low, low + swing, 200)
    found = Polynomial(order=order).fit(T, rng.normal(size=(200, 2)), {})
    h = swing * 1e-5
    at = T[5:-5]
    difference = (found.bias(at + h) - found.bias(at - h)) / (2 * h)
    np.testing.assert_allclose(found.slope(at), difference, atol=1e-5 * np.max(np.abs(difference)))


def test_the_numbers_in_a_polynomials_file_are_si(fitted, tmp_path):
    fitted["polynomial"].save(tmp_path / "map.json")
    data = json.loads((tmp_path / "map.json").read_text())
    T = np.linspace(-19, 49, 30)
    assert data["record"]["unit"] == "rad/s"
    for axis, c in enumerate(np.transpose(data["coefficients"])):
        curve = np.polynomial.Chebyshev(c, domain=data["record"]["domain"])
        np.testing.assert_allclose(curve(T), smooth(T)[:, axis], atol=0.1 * NOISE)


def test_the_polynomial_says_what_it_needs():
    with pytest.raises(SwingTooSmall, match="a cubic needs at least 5 K; fit it on a wider soak or lower min_swing"):
        Polynomial(min_swing="5 K").fit(T_ok / 10, b_ok, {})
    with pytest.raises(SwingTooSmall, match=r"only 11 distinct .* order 15 needs at least 16; .* lower order"):
        Polynomial(order=15).fit(np.round(T_ok / 4), b_ok, {})


def test_two_temperatures_and_their_rounding_do_not_determine_a_cubic():
    T = np.where(np.arange(400) % 2, 40.0, 0.0) + 1e-10 * np.arange(400)
    with pytest.raises(SingularFit, match=r"determine only 2 of 4 coefficients, a cubic needs all .* lower order"):
        Polynomial().fit(T, b_ok, {})
