"""A soak in brief: its ways, its cells and its white noise, against what it was made of."""

import numpy as np
import pytest

from driftlab.soak.blocks import CELLS, GrowingSoak, SoakRows, brief, means, runs


def made(turns, N=20_000, noise=1.0, seed=0, start=0.0):
    rng = np.random.default_rng(seed)
    T = np.interp(np.linspace(0, 1, N), np.linspace(0, 1, len(turns)), turns)
    return T, start + noise * rng.normal(size=(N, 2)) * [1.0, 2.0]


def test_ways_follow_the_turns_of_the_temperature():
    T, bias = made([0, 60, 0])
    soak = brief(T, bias, [0], 2.0)
    assert soak.hours(1) == pytest.approx(20_000 / 3600, rel=0.001)
    assert soak.hours(-1) == pytest.approx(20_000 / 3600, rel=0.001)
    np.testing.assert_array_equal(soak.way, np.where(soak.t < 20_000, 1, -1))


def test_a_plateau_belongs_to_the_way_that_led_there_and_a_wiggle_is_no_turn():
    T, bias = made([0, 20, 20, 40, 40, 39, 40, 60, 60])
    assert np.all(brief(T, bias, [0], 1.0).way == 1)


def test_before_the_first_turn_there_is_no_way():
    T, bias = made([10, 10, 10, 60, 10])
    soak = brief(T, bias, [0], 1.0)
    assert np.all(soak.way[soak.t < 9_500] == 0)


def test_the_way_begins_anew_with_each_recording():
    up, down = made([0, 60]), made([60, 0])
    T, bias = (np.concatenate(pair) for pair in zip(up, down, strict=True))
    soak = brief(T, bias, [0, 20_000], 1.0)
    assert set(soak.way[soak.recording == 0]) == {1}
    assert set(soak.way[soak.recording == 1]) == {-1}


def test_samples_in_no_order_of_temperature_go_no_way():
    T, bias = made([0, 60])
    shuffled = np.random.default_rng(1).permutation(len(T))
    assert np.all(brief(T[shuffled], bias, [0], 1.0).way == 0)


def test_cells_hold_every_sample_once_and_their_means():
    T, bias = made([-20, 48, -20], start=5.0)
    soak = brief(T, bias, [0], 1.0)
    assert soak.count.sum() == len(T)
    cell = np.minimum(((T - T.min()) * (CELLS / np.ptp(T))).astype(int), CELLS - 1)
    way = np.repeat(soak.way, soak.span.astype(int))
    inside = (cell == 40) & (way == -1)
    count, at, mean = soak.cells(-1)
    assert count[40] == inside.sum()
    assert at[40] == pytest.approx(T[inside].mean(), rel=1e-9)
    np.testing.assert_allclose(mean[40], bias[inside].mean(axis=0), rtol=1e-9)


def test_white_noise_is_told_from_a_curve_and_a_walk():
    T, bias = made([0, 60], N=200_000)
    curve = np.sin(T / 9)[:, None] * 30
    walk = np.cumsum(0.01 * np.random.default_rng(2).normal(size=bias.shape), axis=0)
    assert brief(T, bias + curve + walk, [0], 1.0).white == pytest.approx([1.0, 2.0], rel=0.01)


def test_a_run_is_of_one_recording_and_what_is_over_belongs_to_the_last():
    assert runs([0, 7, 9], 16, 3).tolist() == [0, 3, 7, 9, 12]
    assert runs([0], 5, 10).tolist() == [0]
    lengths = np.diff(runs([0], 1000, 7), append=1000)
    assert lengths.tolist() == [7] * 141 + [13]


def test_rows_of_rows_are_the_means_of_the_samples():
    rng = np.random.default_rng(3)
    t, span = np.arange(50.0), rng.uniform(0.5, 2, 50)
    fine = SoakRows(t, rng.normal(size=50), rng.normal(size=(50, 2)), span, {"force": rng.normal(size=(50, 3))})
    once, twice = runs([0], 50, 10), runs([0], 10, 2)
    found, whole = fine.coarsened(runs([0], 50, 5)).coarsened(twice), fine.coarsened(once)
    for name in ("t", "T", "bias", "span"):
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name), rtol=1e-12)
    np.testing.assert_allclose(whole.bias[1], np.average(fine.bias[10:20], axis=0, weights=span[10:20]), rtol=1e-12)
    np.testing.assert_allclose(found.channels["force"], means(fine.channels["force"], once, span), rtol=1e-12)


@pytest.mark.parametrize("N", [5, 64, 1000, 4097])
def test_rows_of_a_soak_that_goes_on_are_means_of_all_samples_in_equal_numbers(N):
    rng = np.random.default_rng(0)
    T, bias = rng.normal(size=N), 5 + rng.normal(size=(N, 2))
    growing = GrowingSoak(most=64)
    at = 0
    while at < N:
        size = int(rng.integers(1, 90))
        growing.add(np.arange(at, at + size)[: N - at] * 1.0, T[at : at + size], bias[at : at + size])
        at += size
    found = growing.rows(0.5)
    assert growing.samples == N
    assert len(found.T) <= 64
    n = growing.n
    np.testing.assert_array_equal(found.span, 0.5 * n)
    whole = N // n
    assert len(found.T) in (whole, whole + 1)
    np.testing.assert_allclose(found.bias[:whole], bias[: whole * n].reshape(whole, n, 2).mean(axis=1), rtol=1e-12)
    assert (found.T.min(), found.T.max()) == (T.min(), T.max())
    # the spread about a straight line through the means is what the samples have about it in their blocks
    slope = np.full((len(found.T), 2), 0.3)
    left = (bias - 0.3 * T[:, None])[: whole * n].reshape(whole, n, 2)
    np.testing.assert_allclose(growing.within(slope)[0], left.var(axis=1).mean(axis=0)[0], rtol=0.1, atol=1e-12)
