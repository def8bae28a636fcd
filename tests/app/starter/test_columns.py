"""Units by values: what a unit at rest on the Earth shows, written in any unit."""

import numpy as np
import pytest

from driftlab.noise.quick import noise_of
from driftlab.starter import columns
from fusion_core.units import convert

RNG = np.random.default_rng(4)
REST = np.array([0.1, -0.2, 0.97]) + 1e-3 * RNG.standard_normal((500, 3))  # g


@pytest.mark.parametrize("unit", ["g", "m/s^2", "mg", "Gal"])
def test_an_accelerometer_at_rest_shows_its_unit(unit):
    assert columns.of_accel(convert(REST, "g", unit)).unit == unit


def test_raw_counts_of_an_accelerometer_are_parts_of_g():
    guess = columns.of_accel(np.rint(REST * 16384))
    assert guess.unit == "6.10352e-05 g"
    assert columns.of_accel(REST * 40).unit is None
    assert columns.of_accel(REST[:, :1]).unit is None


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("rate", [10.0, 50.0, 200.0, 400.0])
@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_a_clock_shows_its_unit(unit, rate, begin):
    t = convert(begin + np.arange(300) / rate, "s", unit)
    assert columns.of_time(t).unit == unit


@pytest.mark.parametrize("first", [45658.5, 739617.5])  # of noon on 1 January 2025, in Excel and in MATLAB
def test_days_of_a_spreadsheet_are_a_date(first):
    for step in (0.05, 1.0, 2.0):  # s
        assert columns.of_time(first + np.arange(300) / 86_400 * step).unit == "day"
    assert columns.of_time(first + np.arange(300) / 20).unit == "s"


def test_slow_samples_are_not_fast_ones_where_the_temperature_moves():
    t = 5.0 * np.arange(6000)
    assert columns.of_time(t).unit == "ms"
    assert columns.of_time(t, swing=10.0).unit == "s"


@pytest.mark.parametrize(("unit", "expected"), [("degC", "degC"), ("K", "K")])
def test_a_thermometer_shows_its_unit(unit, expected):
    T = np.linspace(-10, 60, 400)
    assert columns.of_temperature(convert(T, "degC", unit)).unit == expected


def test_other_temperatures():
    assert columns.of_temperature(np.linspace(2100, 4500, 100)).unit == "0.01 degC"
    assert columns.of_temperature(np.linspace(65000, 65236, 100)).unit is None


@pytest.mark.parametrize(("level", "density", "accel", "unit"), [
    (0.8, 5e-3, None, "deg/s"),  # of a MEMS part
    (0.01, 6e-5, None, "rad/s"),
    (0.01, 5e-4, "m/s^2", "rad/s"),  # may be of either, were it not for the accelerometers
    (0.01, 5e-4, "g", "deg/s"),
    (0.01, 5e-4, None, None),
    (300.0, 5.0, "g", None),  # counts
])  # fmt: skip
def test_a_gyro_at_rest_shows_its_unit_or_none(level, density, accel, unit):
    values = level * np.ones((10, 3))
    assert columns.of_gyro(values, np.full(3, density), accel).unit == unit


def test_noise_is_that_of_the_quietest_stretch():
    """White noise of 0.01/sqrt(Hz) at 100 Hz has a deviation of 0.01 sqrt(100); motion before and after is left out."""
    t = np.arange(60_000) / 100
    values = 0.5 + 0.1 * RNG.standard_normal((60_000, 2))
    values[:9000] += 5 * np.sin(t[:9000])[:, None]
    values[40_000:] += 2 * RNG.standard_normal((20_000, 2))
    noise = noise_of(t, values)
    np.testing.assert_allclose(noise.white, 0.01, rtol=0.05)
    assert noise.start >= 60
    assert 200 < noise.seconds <= 310
    assert noise_of(t, np.zeros((60_000, 1))) is None
    assert noise_of(t[:50], values[:50]) is None


def test_single_readings_far_off_are_no_noise():
    """0.2 % of 200 deviations would make the noise 13 times as large, and the walk at most as much larger."""
    t = np.arange(60_000) / 100
    values = RNG.standard_normal((60_000, 2))
    spoilt = values.copy()
    spoilt[RNG.choice(60_000, 120, replace=False), 0] += 200
    clean, noise = noise_of(t, values), noise_of(t, spoilt)
    np.testing.assert_allclose(noise.white, 0.1, rtol=0.05)
    np.testing.assert_allclose(noise.walk, clean.walk, rtol=0.2)


def test_the_walk_is_that_whose_allan_curve_has_this_floor():
    """The curve of white noise N and a walk K is lowest at K = sqrt(3) / 2 B^2 / N: what is drawn comes back."""
    t = np.arange(200_000) / 10
    walk = 1e-3 * np.sqrt(0.1) * np.cumsum(RNG.standard_normal(200_000))
    noise = noise_of(t, (walk + 0.01 * np.sqrt(10) * RNG.standard_normal(200_000))[:, None])
    np.testing.assert_allclose(noise.white, 0.01, rtol=0.1)
    np.testing.assert_allclose(noise.walk, 1e-3, rtol=0.4)


def test_a_step_of_the_bias_within_a_kelvin_is_not_taken_for_a_walk():
    """Of 100 deg/h at 30 degC, on a staircase: a curve with knots 4 K apart leaves some of it, as a walk would be."""
    t = np.arange(40_000) / 4
    T = 20 + 5 * np.floor(t / 2000) + 5 * np.clip(np.mod(t, 2000) / 300, 0, 1) + 0.02 * RNG.standard_normal(len(t))
    white = 10 * np.sqrt(4) * RNG.standard_normal(len(t))
    bend = 100 / (1 + np.exp(-4.4 * (T - 30.5)))
    noise = noise_of(t, np.column_stack([white, white + bend]), T)
    assert not noise.known[1]
