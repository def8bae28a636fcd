"""Whether up and down differ: never by chance, always where it was planted, and by as much."""

import numpy as np
import pytest

from driftlab.maps.branches import CHANCE, differences
from driftlab.maps.soak import brief

WHITE = 3.0  # deg/h of a sample, one every 4 s
DT = 4.0
PROFILES = {"once": [-20, 48, -20], "twice": [-20, 48, -20, 48, -20], "from the middle": [20, 48, -20, 20]}


def soak(seed, walk=0.05, hours=8.0, profile="once", planted=0.0, drift=0.0):
    """Return T (N,) and what a map leaves (N, 3), deg/h: a walk in deg/h/sqrt(s), noise, and what is planted."""
    rng = np.random.default_rng(seed)
    N = int(hours * 3600 / DT)
    turns = PROFILES[profile]
    T = np.interp(np.linspace(0, 1, N), np.linspace(0, 1, len(turns)), turns)
    way = np.sign(np.gradient(T))
    left = np.cumsum(walk * np.sqrt(DT) * rng.normal(size=(N, 3)), axis=0) + WHITE * rng.normal(size=(N, 3))
    left += (planted * arch(T) * way / 2)[:, None] * [1, 0, -1]
    return T, left + drift * np.linspace(0, 1, N)[:, None]


def arch(T):
    return np.sin(np.pi * (T + 20) / 68)


def judged(T, left, starts=(0,)):
    found = brief(T, left, list(starts), DT)
    return differences(found, found.bias)


def test_a_bias_that_wanders_is_not_taken_for_a_difference():
    """54 soaks of different length, profile and walk, 3 axes each: chance is as rare as it says."""
    chances = []
    for seed, (profile, hours, walk) in enumerate(
        (profile, hours, walk)
        for profile in PROFILES
        for hours in (2, 8, 30)
        for walk in (0, 0.01, 0.05, 0.1, 0.3, 1.0)
    ):
        found = judged(*soak(seed, walk, hours, profile))
        chances.append(min(one.chance for one in found))
    chances = np.array(chances)
    assert np.sum(chances < CHANCE) <= 1  # 0.05 expected; more than 1 once in 700
    assert np.sum(chances < 0.05) <= 8  # 2.7 expected; more than 8 once in 500
    assert np.sum(chances < 0.01) <= 4


@pytest.mark.parametrize("profile", PROFILES)
def test_a_planted_difference_is_found_on_its_axes_with_its_size(profile):
    z = []
    for seed in range(4):
        x, y, z_axis = judged(*soak(seed, 0.02, profile=profile, planted=30.0))
        assert x.seen
        assert z_axis.seen
        assert not y.seen
        assert x.value[x.peak] == pytest.approx(30, abs=6)
        assert z_axis.value[z_axis.peak] == pytest.approx(-30, abs=6)
        assert x.rms == pytest.approx(np.sqrt(np.mean((30 * arch(x.T)) ** 2)), rel=0.25)
        z.append((y.value / y.sigma)[::15])
    assert np.sqrt(np.mean(np.square(z))) < 2.0


def test_a_steady_drift_is_none():
    assert not any(found.seen for found in judged(*soak(3, 0.0, drift=200.0)))


def test_a_level_that_jumps_between_recordings_is_none():
    """Up in one recording, down in another, and a turn-on between them: who could say."""
    T, left = soak(4, 0.0)
    left[len(T) // 2 :] += 100.0
    assert judged(T, left, (0, len(T) // 2)) == "levels", "its size is anything: it is not said to be small"
    assert all(found.seen for found in judged(T, left)), "in one recording it is not to be overlooked"


def test_a_difference_over_temperature_is_seen_between_recordings_less_its_level():
    """Up in one recording, down in the other: the level is theirs, the bend of the difference is not."""
    T, left = soak(4, 0.0, planted=40.0)
    found = judged(T, left, (0, len(T) // 2))
    assert [axis.seen for axis in found] == [True, False, True]
    swing = np.ptp(40 * arch(found[0].T))
    assert np.ptp(found[0].value) == pytest.approx(swing, rel=0.15)
    assert np.max(found[0].sigma) < 0.1 * swing


@pytest.mark.parametrize(
    ("turns", "why"),
    [([0, 60], "warms"), ([60, 0], "cools"), ([0, 60, 55], "apart"), ([0, 0.0, 60, 0], None)],
)
def test_where_nothing_can_be_seen_that_is_said(turns, why):
    rng = np.random.default_rng(0)
    T = np.interp(np.linspace(0, 1, 5000), np.linspace(0, 1, len(turns)), turns)
    found = judged(T, rng.normal(size=(5000, 2)))
    assert found == why if why else isinstance(found, tuple)


def test_a_soak_without_noise_is_not_divided_by_zero():
    T = np.interp(np.linspace(0, 1, 5000), [0, 0.5, 1], [0, 60, 0])
    assert not any(found.seen for found in judged(T, np.zeros((5000, 1))))
