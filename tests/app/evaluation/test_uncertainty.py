"""The budget of the bias over temperature, against what its sources are by other roads."""

import certificate_coverage
import numpy as np
import pytest
from scipy import stats

from driftlab.evaluation.limits import Measured
from driftlab.evaluation.uncertainty import bias_budget, expanded, power_ups, temperatures
from driftlab.maps.assessment import MapVerdict
from driftlab.soak.blocks import brief
from driftlab.soak.placements import placed
from fusion_plugins.thermal_maps.polynomial import Polynomial

DEG_H = np.deg2rad(1) / 3600
RNG = np.random.default_rng


def soak(rng, *, shape=(-20, 50, -20), N=4000, level=0.0, noise=3.0):
    """Temperature (N,) and bias (N, 3) of a soak of 4000 s and white noise."""
    T = np.interp(np.linspace(0, 1, N), np.linspace(0, 1, len(shape)), shape)
    return T, DEG_H * (np.outer(T, [0.5, -1, 0.2]) + level + noise * rng.normal(size=(N, 3)))


def verdict_on(T, bias, starts=(0,), placements=None):
    settings = Polynomial(order=2)
    return MapVerdict(settings.fit(T, bias, {}), settings, brief(T, bias, list(starts), 1.0), placements)


@pytest.fixture(scope="module")
def verdict():
    return verdict_on(*soak(RNG(1)))


def test_the_sources_add_up_by_their_squares_and_u_is_twice_that(verdict):
    budget = bias_budget(verdict.map, thermometer=0.3)
    assert [source.name for source in budget.sources] == ["curve", "mean", "memory", "thermometer"]
    total = np.zeros_like(budget.values)
    for source in budget.sources:
        total += source.u * source.u
    assert np.allclose(budget.U, 2 * np.sqrt(total), rtol=1e-12)
    assert np.array_equal(budget.values, verdict.map.bias(budget.T))


def test_no_row_stands_where_nothing_was_recorded():
    """What a curve does in a hole nobody can tell: a peak there is not seen."""
    T, bias = soak(RNG(3))
    keep = (T < 3) | (T > 22)
    budget = bias_budget(verdict_on(T[keep], bias[keep]).map)
    assert not np.any((budget.T > 3.1) & (budget.T < 21.9))
    assert {3.0, 22.0} <= set(np.round(budget.T, 1))
    assert any(text.endswith("°C: there is no sample") for text in budget.missing)
    assert not any("no sample" in text for text in bias_budget(verdict_on(T, bias).map).missing)


def test_a_thermometer_counts_by_the_slope(verdict):
    budget = bias_budget(verdict.map, thermometer=0.3)
    (thermometer,) = (source for source in budget.sources if source.name == "thermometer")
    inside = budget.T[1:-1]
    off = (verdict.map.bias(inside + 0.15) - verdict.map.bias(inside - 0.15)) / 2
    assert np.allclose(thermometer.u[1:-1], np.abs(off), rtol=1e-6)
    assert thermometer.kind == "B"
    assert any("thermometer" in text for text in bias_budget(verdict.map).missing)
    assert not any("thermometer" in text for text in budget.missing)


def test_the_noise_of_the_mean_is_that_of_so_many_samples(verdict):
    (mean,) = (source for source in bias_budget(verdict.map).sources if source.name == "mean")
    levels = [np.mean(soak(RNG(seed))[1], axis=0) for seed in range(200)]
    assert np.allclose(mean.u[0], np.std(levels, axis=0), rtol=0.15)


def test_a_memory_that_cannot_be_seen_is_not_covered():
    once = verdict_on(*soak(RNG(2), shape=(-20, 50)))
    budget = bias_budget(once.map)
    assert "memory" not in [source.name for source in budget.sources]
    assert any(text.startswith("a hysteresis or lag, of which nothing is known: ") for text in budget.missing)
    assert any("file does not say what its soak tells" in text for text in bias_budget(once.fitted).missing)


def test_a_memory_that_is_seen_covers_both_ways():
    T, bias = soak(RNG(3), shape=(-20, 50, -20, 50, -20), N=8000)
    way = np.sign(np.gradient(T))[:, None] * DEG_H * np.array([20, 10, 0])
    budget = bias_budget(verdict_on(T, bias + way).map)
    for sign in (1, -1):
        truth = DEG_H * np.outer(budget.T, [0.5, -1, 0.2]) + sign * DEG_H * np.array([20, 10, 0])
        assert np.all(np.abs(budget.values - truth)[:, :2] <= budget.U[:, :2])
    assert np.all(budget.U[:, 0] < 2 * DEG_H * 40)


def test_a_map_that_does_not_say_how_sure_it_is_has_no_uncertainty(verdict):
    budget = bias_budget(verdict.map.noting(error=None), thermometer=0.3)
    assert (budget.u, budget.U, budget.sources) == (None, None, [])
    assert budget.missing[0].startswith("anything")


def test_the_level_of_one_more_power_up_is_covered_as_often_as_student_says():
    fitted, inside, sizes = verdict_on(*soak(RNG(4))).map, 0, []
    T = np.linspace(-19, 49, 40)
    for seed in range(400):
        rng = RNG(seed)
        levels = 5 * DEG_H * rng.normal(size=(5, 3))
        bias = np.concatenate([fitted.bias(T) + level for level in levels[:4]])
        found = power_ups(fitted, brief(np.tile(T, 4), bias, [0, 40, 80, 120], 1.0))
        inside += int(np.sum(np.abs(levels[4] - np.mean(levels[:4], axis=0)) <= 2 * found))
        sizes.append(found / np.std(levels[:4], axis=0, ddof=1))
    low, high = stats.binom.interval(0.999, 1200, 0.9545)
    assert low <= inside <= high
    assert np.allclose(sizes, stats.t.ppf(0.97725, 3) / 2 * np.sqrt(1.25), rtol=1e-3)


def test_of_two_recordings_nothing_is_said_of_power_ups(verdict):
    T, bias = soak(RNG(5), N=200)
    two = brief(np.tile(T, 2), np.tile(bias, (2, 1)), [0, 200], 1.0)
    assert power_ups(verdict.map, two) is None
    assert any("power-up" in text for text in bias_budget(verdict.map, soak=two).missing)
    three = brief(np.tile(T, 3), np.tile(bias, (3, 1)), [0, 200, 400], 1.0)
    budget = bias_budget(verdict.map, soak=three)
    assert budget.sources[-1].name == "power-ups"
    assert not any("power-up" in text for text in budget.missing)


@pytest.mark.parametrize(("ups", "missing"), [(6, ""), (1, "one with the tilt")])
def test_the_level_of_a_triad_is_as_sure_as_its_placements_say(ups, missing):
    rng, g = RNG(6), 9.8
    up = np.concatenate([np.eye(3), -np.eye(3)])[:ups]
    placement = np.repeat(np.arange(ups), 600)
    T = np.tile(np.interp(np.arange(600), [0, 300, 599], [0, 40, 0]), ups)
    reading = g * up[placement] + 1e-3 * T[:, None] + 1e-3 * rng.normal(size=(len(T), 3))
    bias, placements = placed(T, reading, placement, g, 1e-5)
    own = verdict_on(T, bias, np.flatnonzero(np.diff(placement, prepend=-1)), placements)
    budget = bias_budget(own.map, placements=placements)
    (level,) = (source for source in budget.sources if source.name == "placements")
    assert bool(missing) == any("tilt" in text for text in budget.missing)
    if not missing:
        assert np.all(np.abs(budget.values - (1e-3 * budget.T)[:, None]) <= 1.5 * budget.U)
        assert np.array_equal(level.u[0], placements.levels.sigma)


@pytest.mark.parametrize(("low", "high"), [(-20.02, 50.01), (21.3, 24.9), (-55, 125), (0, 1200), (20.0, 20.4)])
def test_temperatures_are_the_ends_and_round_ones_between(low, high):
    T = temperatures(low, high)
    assert (T[0], T[-1]) == (low, high)
    assert np.all(np.diff(T) > 0)
    assert len(T) <= 9
    between = T[1:-1]
    assert np.allclose(np.round(2 * between), 2 * between)
    assert not np.any(np.signbit(between[between == 0]))


def test_a_quantity_is_expanded_by_its_wider_side():
    one = Measured(np.array([2.0, 3.0]), "xy", np.array([1.9, 3.0]), np.array([2.3, np.inf]))
    found = expanded(one)
    assert found[0] == pytest.approx(2 / 1.645 * 0.3)
    assert np.isnan(found[1])
    assert expanded(Measured(np.array([2.0]), "x")) is None


def test_true_biases_are_within_u_as_often_as_it_says(monkeypatch):
    """A small dose of `benchmarks/certificate_coverage.py`; 60 soaks of each cell are in docs/how-to."""
    cells = [("cubic", "white", 0.0), ("spline", "walk 0.03", certificate_coverage.THERMOMETER)]
    monkeypatch.setattr(certificate_coverage, "CELLS", cells)
    found = list(certificate_coverage.coverages(4, seed=3))
    assert all(0.9 <= share <= 1 and 0.6 <= rms <= 1.3 for _, share, rms in found), found
