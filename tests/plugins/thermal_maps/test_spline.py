import json

import numpy as np
from soaks import NOISE, abrupt, rms, smooth, soak

from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline


def test_a_spline_without_noise_follows_the_change_closely():
    T, bias = soak(abrupt, noise=0.0)
    at = np.linspace(-19.9, 49.9, 700)
    assert rms(Spline().fit(T, bias, {}).bias(at) - abrupt(at)) < 0.01 * np.ptp(bias)


def test_a_spline_passes_a_hole_in_the_soak_smoothly_and_says_so():
    T, bias = soak(smooth)
    keep = (T < 10) | (T > 25)
    found = Spline().fit(T[keep], bias[keep], {})
    inside, beside = np.linspace(12, 23, 50), np.linspace(-15, 8, 50)
    assert np.all(rms(found.bias(inside) - smooth(inside)) < NOISE)
    assert np.all(found.sigma(inside).mean(axis=0) > 2 * found.sigma(beside).mean(axis=0))
    ((low, high),) = found.record.error.holes
    assert (low, high) == (T[T < 10].max(), T[T > 25].min())


def test_a_spline_smoothed_without_end_is_the_weighted_straight_line():
    T, bias = soak(smooth)
    found = Spline(smoothing=1e9).fit(T, bias, {})
    at = np.linspace(*found.domain, 50)
    assert np.all(np.ptp(found.slope(at), axis=0) < 2e-3 * np.ptp(np.gradient(smooth(at), at, axis=0), axis=0))
    line = Polynomial(order=1).fit(T, bias, {})
    np.testing.assert_allclose(found.bias(T), line.bias(T), atol=0.05 * NOISE)


def test_the_numbers_in_a_splines_file_are_si(fitted, tmp_path):
    from scipy.interpolate import splev

    fitted["spline"].save(tmp_path / "map.json")
    data = json.loads((tmp_path / "map.json").read_text())
    T = np.linspace(-19, 49, 30)
    low, high = data["record"]["domain"]
    n = len(data["coefficients"])
    knots = low + (high - low) / (n - 3) * np.arange(-3, n + 1)
    for axis, c in enumerate(np.transpose(data["coefficients"])):
        np.testing.assert_allclose(splev(T, (knots, c, 3)), smooth(T)[:, axis], atol=0.1 * NOISE)
