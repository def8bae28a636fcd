"""Chamber profiles: what they are asked to be, and the body behind them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from driftlab.planning.chamber import Chamber, Profile, mixed, quickest, ramps, staircase
from driftlab.planning.search import MIN_COVERAGE, candidates

CHAMBER = Chamber(-20.0, 50.0, 25.0, 2 / 60, 600.0)


@pytest.mark.parametrize("lag", [1.0, 300.0, 5000.0])
def test_a_body_follows_as_its_differential_equation_has_it(lag):
    profile = mixed(CHAMBER, 12.0, 2, 10.0)
    t = np.linspace(0, profile.duration, 400)
    solved = solve_ivp(
        lambda t, T: (profile.chamber(t) - T) / lag, (0, t[-1]), [25.0], "LSODA", t, rtol=1e-8, max_step=60.0
    )
    np.testing.assert_allclose(profile.body(t, lag), solved.y[0], atol=2e-3)


def test_a_body_without_lag_is_the_chamber():
    profile = staircase(CHAMBER, 8.0, 5.0)
    t = np.linspace(0, profile.duration, 1000)
    np.testing.assert_array_equal(profile.body(t, 0.0), profile.chamber(t))
    np.testing.assert_allclose(profile.body(t, 1e-3), profile.chamber(t), atol=1e-4)


@pytest.mark.parametrize("lag", [0.0, 60.0, 600.0, 5000.0])
@pytest.mark.parametrize("cycles", [1, 3, 24])
def test_below_the_quickest_hours_there_are_no_ramps(lag, cycles):
    chamber = Chamber(-20.0, 50.0, 25.0, 2 / 60, lag)
    hours = quickest(chamber, cycles)
    assert ramps(chamber, hours, cycles).hours == pytest.approx(hours)
    assert ramps(chamber, 0.9999 * hours, cycles) is None


@given(
    hours=st.floats(0.2, 200), low=st.floats(-60, 10), swing=st.floats(3, 150), start=st.floats(-60, 100),
    rate=st.floats(0.002, 0.5), lag=st.floats(0, 3600),
)  # fmt: skip
def test_every_candidate_is_what_the_chamber_can(hours, low, swing, start, rate, lag):
    chamber = Chamber(low, low + swing, start, rate, lag)
    for profile in candidates(chamber, hours):
        assert profile.hours == pytest.approx(hours, rel=1e-6)
        assert profile.time[0] == 0
        assert np.all(np.diff(profile.time) > 0)
        assert np.max(np.abs(profile.rates)) <= rate * (1 + 1e-6)
        assert profile.temperature[0] == start
        assert min(profile.temperature) == pytest.approx(min(low, start))
        assert max(profile.temperature) == pytest.approx(max(low + swing, start))


@pytest.mark.parametrize("cycles", [1, 2, 3])
def test_the_ends_of_ramps_are_held_until_the_body_is_there(cycles):
    profile = ramps(CHAMBER, 8.0, cycles)
    assert np.ptp(profile.samples(CHAMBER.lag, 20_000)[1]) / CHAMBER.swing > MIN_COVERAGE
    assert profile.reversals == 2 * cycles


def test_ramps_are_found_where_only_slower_ones_fit():
    """A fast ramp leaves the body behind: it is held at the ends for longer than a slower one takes."""
    chamber = Chamber(20.0, 30.0, 20.0, 10 / 60, 600.0)
    profile = ramps(chamber, 3.0, 1)
    assert 2 * chamber.swing / chamber.rate + 3 * chamber.settling(chamber.rate) > 3.0 * 3600
    assert profile.hours == pytest.approx(3.0)
    assert np.ptp(profile.samples(chamber.lag, 20_000)[1]) / chamber.swing > MIN_COVERAGE


def test_a_profile_that_does_not_fit_the_hours_is_none():
    assert ramps(CHAMBER, 8.0, 12) is None
    assert staircase(CHAMBER, 0.5, 5.0) is None
    assert mixed(CHAMBER, 2.0, 1, 10.0) is None


def test_levels_are_those_of_the_paper():
    """Fontanella et al. 2018, sec. 4: plateaus each 5 K, 2.5 h each, here from the first to the last in equal steps."""
    profile = staircase(Chamber(-20.53, 48.08, -20.53, 2 / 60, 0.0), 36.0, 5.0)
    held = profile.temperature[:-1][profile.rates == 0]
    assert len(held) == 15
    np.testing.assert_allclose(np.diff(held), 68.61 / 14)
    assert profile.reversals == 0


def test_what_is_said_of_samples():
    profile = Profile("up", "ramps", np.array([0.0, 3600.0]), np.array([10.0, 46.0]))
    t, T = profile.samples(0.0, 36)
    np.testing.assert_allclose(T, 10 + 36 * t / 3600)
    assert len(t) == 36
    assert t[0] == 50.0
