"""Short gaps are bridged: against windows of a grid with holes, closed forms, and what the fit foretells."""

import numpy as np
import pytest
from sensors_at_rest import DT, simulated

from driftlab.noise.allan import curve, places, spans
from driftlab.noise.allan_fit import fit
from driftlab.noise.allan_model import KEYS, design
from driftlab.noise.recording import NEVER, pieces

WHITE, WALK = KEYS.index("white"), KEYS.index("rate_random_walk")


def single(N, rng):
    """One sample lost every 40 s."""
    return np.arange(N) % 400 != 399


def bursts(N, rng):
    """1 s lost every 60 s."""
    return np.arange(N) % 600 < 590


def scattered(N, rng):
    """5 % of the samples lost, any."""
    return rng.uniform(size=N) > 0.05


LOSSES = {"single": single, "bursts": bursts, "scattered": scattered}


def lossy(loss, N, seed, m=None, **terms):
    kept = LOSSES[loss](N, np.random.default_rng(2000 + seed))
    cut = pieces(np.flatnonzero(kept) * DT)
    rate = simulated(N, seed, **terms)
    return curve(rate[kept], cut.dt, m, stretches=cut.rows, missing=cut.missing), rate, kept


@pytest.mark.parametrize("loss", LOSSES)
def test_averages_are_the_means_of_what_is_there(loss):
    """Each window by itself, as numpy averages a grid with holes in it."""
    found, rate, kept = lossy(loss, 3000, 1, white=1e-4, walk=1e-5)
    rate[~kept] = np.nan
    rate = rate[: np.flatnonzero(kept)[-1] + 1]
    for m, allan, hadamard in zip(found.m, found.allan, found.hadamard, strict=True):
        windows = np.lib.stride_tricks.sliding_window_view(rate, m)
        there = np.mean(np.isfinite(windows), axis=1)
        mean = np.where(there >= 0.9 - 1e-12, np.nansum(windows, axis=1) / np.maximum(1, there * m), np.nan)
        second = mean[m:] - mean[:-m]
        third = second[m:] - second[:-m]
        assert allan == pytest.approx(np.sqrt(np.nanmean(second**2) / 2), rel=1e-9)
        assert hadamard == pytest.approx(np.sqrt(np.nanmean(third**2) / 6), rel=1e-9)


@pytest.mark.parametrize("loss", LOSSES)
def test_averaging_times_go_as_far_as_without_gaps(loss):
    found, rate, _ = lossy(loss, 20_000, 2, white=1.0)
    assert found.tau[-1] == pytest.approx(curve(rate, DT).tau[-1], rel=2e-3)
    assert found.counts[0] > 10
    assert found.counts[-1] == 1


def test_without_lost_samples_nothing_changes():
    rate = simulated(5000, 3, white=1.0, walk=0.1)
    rows = np.array([[0, 2000], [2000, 5000]])
    for missing, stretches in ((0, [[0, 5000]]), (NEVER, rows), (30_000, rows)):
        one = curve(rate, DT, stretches=np.array(stretches))
        other = curve(rate, DT, stretches=rows, missing=np.array([missing]))
        for name in ("tau", "allan", "hadamard", "lengths", "counts"):
            assert np.array_equal(getattr(one, name), getattr(other, name))


def test_thinned_overlaps_change_nothing_that_can_be_measured(monkeypatch):
    m = np.array([512, 1024, 2048])
    exact = lossy("scattered", 40_000, 4, m, white=1.0, walk=0.1)[0]
    monkeypatch.setattr("driftlab.noise.allan.LONG", 5_000)
    thinned = lossy("scattered", 40_000, 4, m, white=1.0, walk=0.1)[0]
    assert thinned.stride.tolist() == [8, 8, 8]
    np.testing.assert_allclose(thinned.allan, exact.allan, rtol=2e-3)
    np.testing.assert_allclose(thinned.hadamard, exact.hadamard, rtol=2e-3)
    np.testing.assert_allclose(thinned.bridge.angle, exact.bridge.angle, rtol=1e-2)


def test_a_gap_is_in_a_span_where_some_window_bridges_it():
    def joined(lengths, missing):
        return spans(np.array(lengths), np.array(missing, dtype=np.int64)).tolist()

    assert joined([100], []) == [[0, 1]]
    assert joined([45, 45], [10]) == [[0, 2]]
    assert joined([45, 44], [10]) == [[0, 1], [1, 2]]
    assert joined([45, 45, 45], [10, NEVER]) == [[0, 2], [2, 3]]
    assert joined([250] * 25, [15_000] * 24) == [[k, k + 1] for k in range(25)]
    # the short piece in the middle belongs to a window that reaches over both gaps
    assert joined([500, 1, 500], [40, 40]) == [[0, 3]]
    lengths, missing = np.array([45, 45, 7]), np.array([10, NEVER])
    assert places(lengths, missing, spans(lengths, missing)).tolist() == [100, 7]


def test_lost_samples_are_counted_by_the_clock_of_each_gap():
    """A clock that gains 200 ppm over a day gains 170 samples, and none of them is a lost one."""
    kept = scattered(864_000, np.random.default_rng(5))
    t = np.flatnonzero(kept) * DT
    cut = pieces(t * (1 + 2e-4 * t / t[-1]) + np.random.default_rng(6).uniform(-0.2, 0.2, len(t)) * DT)
    np.testing.assert_array_equal(cut.missing, np.diff(np.flatnonzero(kept))[np.diff(np.flatnonzero(kept)) > 1] - 1)
    assert cut.places.tolist() == [864_000]
    assert cut.dt == pytest.approx(DT * (1 + 2e-4), rel=1e-6)


def test_a_late_sample_is_no_lost_one():
    t = np.arange(1000) * DT
    t[500] += 0.7 * DT
    cut = pieces(t)
    assert cut.rows.tolist() == [[0, 500], [500, 1000]]
    assert cut.missing.tolist() == [0]
    assert cut.places.tolist() == [1000]
    assert cut.dt == pytest.approx(DT)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("term", ["white", "walk", "quantization"])
def test_the_mean_and_the_scatter_are_foretold(loss, term):
    """Over 150 seeds: the mean is that of the closed form with what lost samples add, and a sigma is one."""
    theta = np.full(5, 1e-12)
    theta[KEYS.index({"walk": "rate_random_walk"}.get(term, term))] = 1.0
    m = np.array([3, 8, 12, 20, 45, 80, 150, 300, 700])
    found = [lossy(loss, 6000, seed, m, **{term: 1.0})[0] for seed in range(150)]
    for hadamard, name in ((False, "allan"), (True, "hadamard")):
        models = [design(one, hadamard) for one in found]
        own = theta[: models[0].A.shape[1]]
        ratio = np.array([getattr(one, name) ** 2 / (d.A @ own) for one, d in zip(found, models, strict=True)])
        spread = np.mean([d.spread(own) for d in models], axis=0)
        far = (m > 8) | (term != "walk")  # a sample is a mean: at first the walk shows less than its closed form
        error = np.std(ratio, axis=0) / np.sqrt(len(found))
        assert np.all(np.abs(np.mean(ratio, axis=0) - 1)[far] < 4 * error[far] + 0.01)
        if term != "quantization":  # its scatter is foretold to 50 % without gaps too; white noise covers it
            np.testing.assert_allclose((np.std(ratio, axis=0) / spread)[far], 1.0, atol=0.25)


@pytest.mark.parametrize("loss", LOSSES)
def test_limits_cover_the_truth_where_samples_are_lost(loss):
    """95 % limits of white noise and walk over eight seeds: at most 3 of 16 may miss (probability below 1 %)."""
    found = [fit(lossy(loss, 12_000, seed, white=1.0, walk=0.05)[0]) for seed in range(8)]
    truth = np.array([1.0, 0.05])
    each = [(item.low[[WHITE, WALK]], item.high[[WHITE, WALK]]) for item in found]
    assert sum(int(np.sum((low > truth) | (high < truth))) for low, high in each) <= 3
    np.testing.assert_allclose(np.median([item.value[WHITE] for item in found]), 1.0, rtol=0.04)
    assert np.median([item.high[WALK] for item in found]) < 0.15  # stretches of 40 s show nothing below 0.4
