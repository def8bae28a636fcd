"""The soaks that share no code with the project: sizes, noises and the likelihood that is told the truth."""

import numpy as np
import pytest
from foreign_curves import FAMILIES, draw_curves
from foreign_soaks import (
    DEG_H,
    MEMORIES,
    PROFILES,
    Noise,
    _slow,
    behind,
    block_covariance,
    cells,
    draw,
    opening,
    play,
    truth_gain,
)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_soak_has_the_size_that_was_asked_for(profile):
    for k, memory in enumerate(MEMORIES):
        soak = draw(k, profile, 3.0, "walk", memory, (24 * DEG_H, 0.0, -8 * DEG_H), interval=2.0)
        assert soak.t.shape == soak.T.shape == (5400,)
        assert soak.bias.shape == soak.memory.shape == soak.curve.shape == (5400, 3)
        # of the rows' own means too, but for what a row of 2 s smooths
        assert soak.size / DEG_H == pytest.approx([24.0, 0.0, 8.0], rel=1e-6)
        assert opening(soak.T_true, soak.memory) / DEG_H == pytest.approx([24.0, 0.0, 8.0], rel=0.05)
        assert np.ptp(soak.T_true) > 40
        assert np.abs(soak.T - soak.T_true).max() < 0.1


def test_a_seed_is_a_soak():
    one, two, other = (draw(k, "ramps", 2.0, "flicker", "play+lag", 24 * DEG_H) for k in (5, 5, 6))
    assert (one.bias == two.bias).all()
    assert not np.allclose(one.bias, other.bias)
    with pytest.raises(ValueError, match="memory"):
        draw(1, memory="paly")
    with pytest.raises(ValueError, match="profile"):
        draw(1, "up")


def test_play_and_lag_by_their_definitions():
    T = np.concatenate([np.linspace(0, 30, 301), np.linspace(30, 5, 251), np.linspace(5, 12, 71)])
    p = [T[0]]
    for x in T[1:]:
        p.append(min(max(p[-1], x - 4.0), x + 4.0))
    assert play(T, 4.0) == pytest.approx(p, abs=1e-12)
    assert opening(T, 3.0 * (play(T, 4.0) - T)[:, None]) == pytest.approx([24.0], rel=1e-3)
    late = behind(np.where(np.arange(2001) < 1, 0.0, 1.0), 100.0, 1.0)
    assert late[101] == pytest.approx(1 - np.exp(-1), rel=1e-6)


@pytest.mark.parametrize("slow", ["walk", "gauss_markov", "flicker"])
def test_the_covariance_is_that_of_the_noise(slow):
    noise = Noise(slow, white=0.0, walk=0.1, flicker=1.0, tau=300.0)
    rng = np.random.default_rng(2)
    drawn = np.concatenate([_slow(noise, 1200, 1.0, rng) for _ in range(700)], axis=1)
    means = drawn.reshape(20, 60, -1).mean(axis=1)
    C = block_covariance(noise, 20, 60, 1.0)
    # to a level, which no soak knows
    M = np.eye(20) - 1 / 20
    estimated, true = M @ np.cov(means) @ M, M @ C @ M
    assert np.abs(estimated - true).max() < 0.1 * np.diag(true).max()
    assert np.trace(estimated) == pytest.approx(np.trace(true), rel=0.06)


def test_the_likelihood_that_is_told_the_truth():
    assert truth_gain(draw(1)) == 0
    known = [truth_gain(draw(k, "sines", 5.0, "walk", "play", s * DEG_H, value=4.0)) for k in range(3) for s in (4, 24)]
    assert min(known[1::2]) > 10 * max(known[::2]) > 0
    # a noise that is not known says less of a large memory, and of none at all little
    soak = draw(0, "sines", 5.0, "walk", "play", 24 * DEG_H, value=4.0)
    assert 50 < truth_gain(soak, fitted=True) < truth_gain(soak)
    assert abs(truth_gain(draw(0, "sines", 5.0, "walk", "play", 1e-6 * DEG_H), fitted=True)) < 10
    # a shape that is not in the soak has half a nat an axis on average
    gains = []
    for k in range(40):
        soak = draw(k, "sines", 2.0, "walk", "play", (1e-3 * DEG_H,) * 3, value=4.0, interval=60.0)
        gains.append(truth_gain(soak))
    assert np.mean(gains) == pytest.approx(1.5, abs=0.6)


def test_the_design_has_its_own_seeds():
    design = list(cells(memories=("play", "lag"), profiles=("once",), hours=(2.0,), sizes=(24 * DEG_H,)))
    assert len(design) == 6
    assert len({c.seed for c in design}) == 6
    assert [s.name for s in design[0].soaks(2, interval=10.0)] == ["play, once, 2 h, walk"] * 2


@pytest.mark.parametrize("family", FAMILIES)
def test_curves_are_smooth_and_as_large_as_asked_for(family):
    T = np.linspace(-30, 50, 2001)
    for seed in range(10):
        for curve in draw_curves(seed, 200.0, low=-30.0, high=50.0, family=family):
            bias = curve(T)
            assert np.ptp(bias) == pytest.approx(200.0, rel=1e-3)
            assert (curve(T) == bias).all()
            # a cubic spline with knots 2.5 K apart, through the curve itself, leaves nothing
            from scipy.interpolate import make_interp_spline

            knots = slice(None, None, 62)
            through = make_interp_spline(T[knots], bias[knots])(T[: 62 * 32 + 1])
            assert np.abs(through - bias[: 62 * 32 + 1]).max() < 0.2
