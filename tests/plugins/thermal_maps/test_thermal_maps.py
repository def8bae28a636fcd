"""Laws that hold for every kind of map."""

import json

import numpy as np
import pytest
from pydantic import ValidationError
from soaks import NOISE, T_ok, abrupt, b_ok, kinds, rms, smooth, soak

from fusion_core.errors import (
    BadValue,
    EmptyRecording,
    MapError,
    OutsideDomain,
    SwingTooSmall,
)
from fusion_plugins.thermal_maps import common
from fusion_plugins.thermal_maps.onnx_network import OnnxNetwork
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline


@kinds
def test_a_smooth_curve_is_found_far_below_the_noise(maps, fitted):
    T = np.linspace(-19.9, 49.9, 400)
    # 20,000 samples, at most 15 free parameters: noise * sqrt(15 / 20,000) = 0.027 noise
    assert np.all(rms(fitted[maps.kind].bias(T) - smooth(T)) < 0.04 * NOISE)


@kinds
def test_the_residual_is_the_rms_over_all_samples(maps, fitted):
    T, bias = soak(smooth)
    record = fitted[maps.kind].record
    np.testing.assert_allclose(record.residual, rms(bias - fitted[maps.kind].bias(T)), rtol=1e-9)
    np.testing.assert_allclose(record.residual, NOISE, rtol=0.02)
    assert record.samples == len(T)
    assert record.domain == (T.min(), T.max())
    assert record.unit == "rad/s"
    assert record.provenance == {"recording": "soak.csv"}


@pytest.mark.parametrize("maps", [Spline(), OnnxNetwork(starts=6)], ids=lambda maps: maps.kind)
def test_an_abrupt_change_is_followed_where_a_cubic_cannot(maps):
    T, bias = soak(abrupt, N=100_000)
    at = np.linspace(-19.9, 49.9, 700)
    error = rms(maps.fit(T, bias, {}).bias(at) - abrupt(at))
    assert error < 0.05 * NOISE
    assert rms(Polynomial().fit(T, bias, {}).bias(at) - abrupt(at)) > 10 * error


def test_a_long_stay_does_not_outweigh_the_rest():
    """The bias wanders by 2e-5 rad/s between bins: a hundred times more samples make no bin that much better."""
    rng = np.random.default_rng(3)
    count, sigma_b = 100, 2e-5
    centres = np.arange(count) + 0.5
    n = np.where(np.arange(count) % 7 == 0, 20_000, 200)
    wander = sigma_b * rng.normal(size=count)
    T = np.repeat(centres, n)
    T[0], T[-1] = 0.0, float(count)
    bias = np.repeat(wander, n) + NOISE * rng.normal(size=len(T))
    bins = common.bin_samples(T, bias[:, None], count)
    expected = NOISE**2 / n + sigma_b**2
    assert np.all(bins.variance[:, 0] / expected < 2)
    assert np.all(bins.variance[:, 0] / expected > 0.5)


@kinds
def test_a_thermometer_in_whole_degrees_is_enough(maps):
    T, bias = soak(smooth)
    found = maps.fit(np.round(T), bias, {})
    at = np.arange(-18.0, 49.0)
    # within a whole degree the curve bends by less than 1e-6 rad/s
    assert np.all(rms(found.bias(at) - smooth(at)) < 0.05 * NOISE)
    step = 1e-3 / 35 * np.max(np.abs(np.diff(smooth(at), axis=0) / 1e-3 * 35), axis=0)
    slope = (smooth(at + 0.5) - smooth(at - 0.5)) / 1.0
    assert np.all(rms(found.slope(at) - slope) < 0.1 * step)


@kinds
def test_slope_is_the_derivative(maps, fitted):
    low, high = fitted[maps.kind].domain
    T, h = np.linspace(low + 0.1, high - 0.1, 301), 1e-3
    found = fitted[maps.kind]
    difference = (found.bias(T + h) - found.bias(T - h)) / (2 * h)
    np.testing.assert_allclose(found.slope(T), difference, atol=1e-6 * np.max(np.abs(difference)))


@kinds
def test_the_order_of_the_samples_does_not_matter(maps, fitted):
    T, bias = soak(smooth)
    k = np.random.default_rng(9).permutation(len(T))
    found = maps.fit(T[k], bias[k], {})
    at = np.linspace(*found.domain, 200)
    np.testing.assert_allclose(found.bias(at), fitted[maps.kind].bias(at), atol=1e-4 * NOISE)


@kinds
@pytest.mark.parametrize("axes", [[0], [2, 1], [0, 1, 2]])
def test_each_axis_is_fitted_by_itself(maps, axes, fitted):
    T, bias = soak(smooth)
    found = maps.fit(T, bias[:, axes], {})
    at = np.linspace(*found.domain, 100)
    for of_map in (found.bias, found.slope, found.sigma):
        assert of_map(at).shape == (100, len(axes))
    np.testing.assert_allclose(found.bias(at), fitted[maps.kind].bias(at)[:, axes], atol=1e-4 * NOISE)


@kinds
def test_any_split_of_the_samples_gives_the_same(maps, fitted):
    T = np.linspace(-19.9, 49.9, 101)
    for of_map in (fitted[maps.kind].bias, fitted[maps.kind].slope, fitted[maps.kind].sigma):
        whole = of_map(T)
        parts = np.concatenate([of_map(T[:1]), of_map(T[1:1]), of_map(T[1:38]), of_map(T[38:])])
        np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-12 * np.max(np.abs(whole)))


@kinds
def test_beyond_the_domain_a_map_refuses_or_holds(maps, fitted, tmp_path):
    found = fitted[maps.kind]
    low, high = found.domain
    for of_map in (found.bias, found.slope):
        with pytest.raises(OutsideDomain, match=rf"{maps.kind}: T = 60 °C .* set outside: clamp or tangent"):
            of_map(np.array([20.0, 60.0]))
    # how sure the curve is can be told anywhere: less and less
    assert np.all(np.diff(found.sigma(high + np.array([0.0, 1.0, 10.0])), axis=0) > 0)
    found.save(tmp_path / "map")
    held = maps.model_copy(update={"outside": "clamp"}).read(tmp_path / "map")
    np.testing.assert_array_equal(held.bias(np.array([-80.0, 99.0])), found.bias(np.array([low, high])))
    np.testing.assert_array_equal(held.slope(np.array([-80.0, 99.0])), 0)


@kinds
def test_a_saved_map_is_the_same_map(maps, fitted, tmp_path):
    path = tmp_path / f"map{maps.suffix}"
    fitted[maps.kind].save(path)
    found = maps.model_copy(update={"path": path}).load()
    T = np.linspace(*found.domain, 1000)
    for method in ("bias", "slope", "sigma"):
        np.testing.assert_array_equal(getattr(found, method)(T), getattr(fitted[maps.kind], method)(T))
    assert found.record == fitted[maps.kind].record
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@kinds
@pytest.mark.parametrize(
    ("T", "bias", "error", "match"),
    [
        (T_ok[:0], b_ok[:0], EmptyRecording, "has no sample to fit; check"),
        (T_ok, b_ok[:-1], BadValue, r"has T \(400,\) and bias \(399, 2\), expected .*; give one row"),
        (T_ok, b_ok[:, 0], BadValue, r".*bias \(400,\), expected"),
        (np.where(T_ok > 39, np.nan, T_ok), b_ok, BadValue, "T has 10 samples that are not finite.* sample 390 of 400"),
        (T_ok, np.where(b_ok == 0, np.inf, b_ok), BadValue, "bias has 1 samples .* sample 0 of 400.*; leave"),
        (T_ok / 100, b_ok, SwingTooSmall, "T moves by only 0.40 K, .* needs at least 2 K; fit it on a wider soak"),
        (np.full(400, 20.0), b_ok, SwingTooSmall, "T moves by only 0.00 K"),
        (np.round(T_ok / 20) * 20, b_ok, SwingTooSmall, "T takes only 3 distinct values, .* needs at least .*; fit"),
    ],
)
def test_samples_that_cannot_be_fitted_are_refused(maps, T, bias, error, match):
    with pytest.raises(error, match=f"^{maps.kind}: {match}"):
        maps.fit(T, bias, {})


@pytest.mark.parametrize("maps", [Spline(), OnnxNetwork(starts=2)], ids=lambda maps: maps.kind)
def test_a_constant_bias_and_few_temperatures_stay_finite(maps):
    T = np.round(T_ok / 2) * 2
    found = maps.fit(T, np.full((400, 1), 1e-4), {})
    at = np.linspace(0, 40, 77)
    np.testing.assert_allclose(found.bias(at), 1e-4, atol=1e-9)
    np.testing.assert_allclose(found.slope(at), 0, atol=1e-9)
    assert np.all(np.isfinite(found.sigma(at)))


@pytest.mark.parametrize(
    "wrong",
    [{"order": 0}, {"order": 16}, {"min_swing": -2}, {"min_swing": "0 K"}],
)
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValidationError):
        Polynomial(**wrong)


@kinds
def test_a_file_that_is_not_there(maps, tmp_path, fitted):
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*none cannot be read .*; name a file"):
        maps.read(tmp_path / "none")
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*map cannot be written .*; name a file in a folder"):
        fitted[maps.kind].save(tmp_path / "none" / "map")


def _set(data, keys, value):
    for key in keys[:-1]:
        data = data[key]
    data[keys[-1]] = value


@pytest.mark.parametrize("maps", [Polynomial(), Spline()], ids=lambda maps: maps.kind)
@pytest.mark.parametrize(
    ("keys", "value", "match"),
    [
        (["driftlab_map"], 2, "is of version 2, expected version 1; refit it, or use the version that wrote it$"),
        (["record", "kind"], "onnx_network", "kind 'onnx_network', expected '.*'; set kind: onnx_network, or refit"),
        (["record"], None, "is damaged at record"),
        (["record", "domain"], [40.0, -20.0], r"has the domain \(40.0, -20.0\)"),
        (["record", "residual"], [1e-5], r"is damaged at record \(Value error, error is of 3 axes, the map of 1"),
        (["coefficients", 0], [1.0], r"is damaged at content"),
        (["coefficients", 0, 0], "one", "is damaged at coefficients.0.0"),
        (["record", "domain"], [-20.0, 1e308], r"is damaged or not JSON \(the number 1e\+308 is beyond 1e\+30\)"),
        (["record", "residual", 0], -1.0, r"is damaged at record.residual.0"),
        (["coefficients", 0, 0], 1e308, r"is damaged or not JSON \(the number 1e\+308 is beyond 1e\+30\)"),
        (["coefficients", 0, 0], float("nan"), r"is damaged or not JSON \(NaN is not a number\)"),
        (["coefficients"], [], "is damaged"),
        (["colour"], "red", "is damaged at colour"),
    ],
)
def test_a_damaged_json_file_is_refused(maps, keys, value, match, fitted, tmp_path):
    path = tmp_path / "map.json"
    fitted[maps.kind].save(path)
    data = json.loads(path.read_text())
    _set(data, keys, value)
    path.write_text(json.dumps(data))
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*map.json .*{match}"):
        maps.read(path)


@pytest.mark.parametrize("maps", [Polynomial(), Spline()], ids=lambda maps: maps.kind)
@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "is damaged or not JSON"),
        (b"[1, 2]", "has no key 'driftlab_map', expected a map; name a file that holds a fitted map"),
        (b'{"order": 3}', "has no key 'driftlab_map'"),
        (b'{"driftlab_map": 1, "record": {"ki', "is damaged or not JSON"),
        (b"\x08\x80\xff\x12", "is damaged or not JSON"),
    ],
)
def test_a_file_that_is_no_json_map_is_refused(maps, content, match, tmp_path):
    (tmp_path / "map.json").write_bytes(content)
    with pytest.raises(MapError, match=f"^{maps.kind}: map file .*map.json {match}"):
        maps.read(tmp_path / "map.json")
