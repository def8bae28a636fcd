"""The temperature of a soak out of readings that are rounded, and how sure a map is that was fitted on it."""

import h5py
import numpy as np
import pytest
from foreign_soaks import behind
from foreign_thermometers import config, draw, read

from driftlab.config import load_config, with_recording
from driftlab.live.growing_map import GrowingMap
from driftlab.maps.fit import fit_map, map_settings
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read as read_rows
from driftlab.soak.temperature import (
    between_steps,
    of_thermometer,
    soak_temperature,
    soak_temperatures,
    without_noise,
)
from fusion_core.faults import Faults
from fusion_core.thermal.thermometer import NO_STEPS, Steps, steps_of
from fusion_plugins.thermal_maps.polynomial import Polynomial

t = np.arange(21_600.0)
RAMPS = behind(np.interp(t, [0, 10_400, 11_200, 21_600], [-10.0, 50.0, 50.0, -10.0]), 240.0, 1.0)
STAIRS = behind(np.repeat([*range(-10, 51, 5), *range(45, -11, -5)], 864).astype(float), 150.0, 1.0)[: len(t)]


def shown(T, step, noise, averaged=1):
    return read(T, step, noise, np.random.default_rng(0), averaged)


@pytest.mark.parametrize("averaged", [1, 10])
@pytest.mark.parametrize(("step", "noise"), [(0.2, 0.0), (0.5, 0.02), (0.5, 0.2), (1.0, 0.0), (1.0, 0.02), (1.0, 0.2)])
def test_the_temperature_between_the_steps(step, noise, averaged):
    """A temperature moving through the steps is met to a twentieth of one; nowhere is it off by more than a half."""
    T = shown(RAMPS, step, noise, averaged)
    found, _ = soak_temperature(t, T, steps_of(T))
    moving = (np.abs(RAMPS - 20) < 28) & (np.abs(t - 10_800) > 1200)
    assert np.sqrt(np.mean((found - RAMPS)[moving] ** 2)) < 0.05 * max(step, noise)
    assert np.max(np.abs(found - RAMPS)) < 0.6 * max(step, noise)


@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_warming_and_cooling_are_not_apart(noise):
    """A lag of the smoothing would be a memory of the unit; rests at levels are no lag either."""
    for true in (RAMPS, STAIRS):
        T = shown(true, 0.5, noise)
        found, _ = soak_temperature(t, T, steps_of(T))
        half = len(t) // 2
        assert abs(np.mean((found - true)[:half]) - np.mean((found - true)[half:])) < 0.02


def test_noise_before_the_rounding_is_known_through_averages():
    T = shown(RAMPS, 1.0, 0.2, 10)
    assert soak_temperature(t, T, steps_of(T))[1].noise == pytest.approx(0.2, abs=0.02)


def test_a_thermometer_without_steps_is_left_alone():
    T = shown(RAMPS, 0.0, 0.02)
    found, steps = soak_temperature(t, T, NO_STEPS)
    assert found is T
    assert steps == NO_STEPS


@pytest.mark.parametrize(("shift", "gap"), [(0.3, 0.0), (0.0, 3000.0)])
def test_levels_are_where_they_are_and_gaps_are_no_rest(shift, gap):
    """Levels need not be multiples of the step, and what is not recorded may have any course."""
    T = shown(RAMPS, 0.5, 0.02) + shift
    kept = (t < 4000) | (t > 4000 + gap)
    found, _ = soak_temperature(t[kept], T[kept], Steps(0.5, 0.02))
    assert np.sqrt(np.mean((found - shift - RAMPS[kept]) ** 2)) < 0.03


def test_a_coarse_thermometer_does_not_make_a_map_unsure(tmp_path):
    """Steps of 1 K under a slope of 0.5 deg/h/K: the sawtooth of a soak is neither its walk nor a misfit."""
    (tmp_path / "unit.yaml").write_text(config("FOG"))
    sigma = {}
    for step in (0.0, 1.0):
        for unit in (0, 2):
            soak = draw(unit, 0, "FOG", step=step, noise=0.02, profile="soak", rate=1.0, hours=6.0)
            soak.save(tmp_path / "soak.h5")
            fitted = fit_map(load_config(tmp_path / "unit.yaml"), [str(tmp_path / "soak.h5")], None, Faults())
            middle = fitted.sigma(np.linspace(-5, 45, 11), 20.0)
            sigma[step, unit] = np.sqrt(np.mean(middle**2, axis=0))
            assert fitted.record.resolution == pytest.approx(step, abs=1e-3)
            if step:  # of a fiftieth of a step in the middle, of a quarter at the ends
                ends = np.array([fitted.domain[0], fitted.domain[1]])
                assert np.all(fitted.sigma(ends, 20.0) > 0.25 * np.abs(fitted.slope(ends)))
    for unit in (0, 2):
        assert np.all(sigma[1.0, unit] < 4 * sigma[0.0, unit])


def test_a_short_soak_is_fitted_too():
    """A step each minute, a reading a second: what rounding leaves of the matrices breaks no fit."""
    t = np.arange(3960.0)
    true = behind(np.interp(t, [0, 1900, 2060, 3960], [-10.0, 50.0, 50.0, -10.0]), 240.0, 1.0)
    T = read(true, 1.0, 0.02, np.random.default_rng(0))
    found, _ = soak_temperature(t, T, Steps(1.0, 0.02))
    assert np.sqrt(np.mean((found - true)[300:-300] ** 2)) < 0.1


@pytest.mark.parametrize("hours", [1.1, 3.0])
def test_a_soak_that_is_fitted_while_it_goes_on_is_fitted_alike(tmp_path, hours):
    """`live --fit-map` has a few thousand means, and sees between the steps all the same."""
    (tmp_path / "unit.yaml").write_text(config("FOG"))
    draw(0, 0, "FOG", step=1.0, noise=0.02, profile="soak", rate=1.0, hours=hours).save(tmp_path / "soak.h5")
    declared = with_recording(load_config(tmp_path / "unit.yaml"), str(tmp_path / "soak.h5"))
    growing = GrowingMap(declared, map_settings(declared, None), tmp_path / "live.json")
    for _ in growing.through(epochs(read_rows(declared, Faults()), 1.0)):
        pass
    live, whole = growing.finish(), fit_map(declared, [], None, Faults())
    T = np.linspace(-4, 44, 25)
    sigma = whole.sigma(T, 20.0)
    np.testing.assert_allclose(np.sqrt(np.mean(live.sigma(T, 20.0) ** 2)), np.sqrt(np.mean(sigma**2)), rtol=0.1)
    assert np.sqrt(np.mean((live.bias(T) - whole.bias(T)) ** 2)) < 0.2 * np.sqrt(np.mean(sigma**2))
    assert live.record.steps == pytest.approx(whole.record.steps, abs=0.01)
    assert live.domain == pytest.approx(whole.domain, abs=0.02)
    assert live.record.samples == whole.record.samples
    assert growing.status.missing == ()


def test_a_map_of_a_fine_thermometer_keeps_its_ends(tmp_path):
    (tmp_path / "unit.yaml").write_text(config("FOG"))
    draw(0, 0, "FOG", step=0.0, profile="soak", rate=1.0, hours=2.0).save(tmp_path / "soak.h5")
    fitted = fit_map(load_config(tmp_path / "unit.yaml"), [str(tmp_path / "soak.h5")], None, Faults())
    assert of_thermometer(fitted, NO_STEPS).record == fitted.record


@pytest.mark.parametrize("step", [0.125, 1.0])
def test_a_map_ends_where_its_soak_was_read(tmp_path, step):
    """Not a knot beyond, where no sample is: straight on from the last two coefficients is wrong by any amount."""
    (tmp_path / "unit.yaml").write_text(config("MEMS"))
    draw(1, 0, "MEMS", step=step, noise=0.02, profile="soak", rate=1.0, hours=3.0).save(tmp_path / "soak.h5")
    with h5py.File(tmp_path / "soak.h5") as file:
        T = file["temperature"][:]
    fitted = fit_map(load_config(tmp_path / "unit.yaml"), [str(tmp_path / "soak.h5")], None, Faults())
    assert fitted.domain[0] <= T.min() < T.max() <= fitted.domain[1]
    assert fitted.domain == pytest.approx((T.min(), T.max()), abs=0.5 * step + 0.06)
    assert fitted.record.samples <= len(T)


def test_recordings_share_the_steps_of_their_thermometer():
    """One that hardly moves tells nothing of them; another of the same thermometer does."""
    whole, part = shown(RAMPS, 0.5, 0.02), slice(10_600, 11_400)
    assert steps_of(whole[part]).size == 0.0
    (first, second), steps = soak_temperatures([(t, whole), (t[part], whole[part])])
    assert steps.size == pytest.approx(0.5)
    np.testing.assert_array_equal(first, soak_temperature(t, whole, steps_of(whole))[0])
    np.testing.assert_array_equal(second, soak_temperature(t[part], whole[part], steps_of(whole))[0])
    assert soak_temperatures([(t, RAMPS)])[1] == NO_STEPS


@pytest.mark.parametrize("step", [0.5, 1.0, 2.0])
def test_how_far_the_temperature_may_be_off_between_the_steps(step):
    """By next to nothing on a ramp, on holds by as much as it is off; sigma is that of a stay at one reading."""
    for true in (RAMPS, STAIRS):
        T = shown(true, step, 0.0)
        found, steps = soak_temperature(t, T, steps_of(T))
        cuts = np.array([0, *(np.flatnonzero(np.diff(T)) + 1), len(T)])
        stay = np.repeat(np.diff(cuts), np.diff(cuts))
        sigma = np.sqrt(between_steps(t, found, T, steps) / stay)
        assert np.sqrt(np.mean(((found - true) / (sigma + 0.05 * step)) ** 2)) < 1.0
        if true is RAMPS:
            assert np.median(sigma) < 0.02 * step


@pytest.mark.parametrize(("step", "noise"), [(2.0, 0.0), (5.0, 0.02), (0.0, 0.2), (0.0, 1.0)])
def test_what_a_thermometer_hides_is_no_bend_of_the_map(step, noise):
    """A parabola is fitted with one: noise of the readings flattens it at its ends, and steps shift it there."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        T = read(RAMPS, step, noise, rng)
        bias = (8 * RAMPS + 0.1 * RAMPS**2)[:, None] + 10 * rng.normal(size=(len(t), 1))
        bias += np.cumsum(0.03 * rng.normal(size=bias.shape), axis=0)
        found, steps = soak_temperature(t, T, steps_of(T)) if step else (without_noise(t, T), NO_STEPS)
        off = between_steps(t, found, T, steps) if step else None
        fitted = of_thermometer(Polynomial(order=2).fit(found, bias, {}), steps, found, off)
        assert fitted.record.error.misfits == ()
        error = fitted.bias(found)[:, 0] - (8 * RAMPS + 0.1 * RAMPS**2)
        assert np.std(error) < 2 * max(np.sqrt(np.mean(fitted.sigma(found) ** 2)), 1.0)


def test_a_bend_that_is_there_is_told_with_a_coarse_thermometer():
    T = read(RAMPS, 2.0, 0.0, np.random.default_rng(0))
    bias = (20 * np.sin(RAMPS / 5))[:, None] + 10 * np.random.default_rng(1).normal(size=(len(t), 1))
    found, steps = soak_temperature(t, T, steps_of(T))
    off = between_steps(t, found, T, steps)
    assert of_thermometer(Polynomial(order=2).fit(found, bias, {}), steps, found, off).record.error.misfits
