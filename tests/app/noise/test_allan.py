"""Curves against allantools and closed forms; of several stretches, against each stretch by itself."""

import numpy as np
import pytest
from sensors_at_rest import DT, simulated

from driftlab.noise.allan import curve, factors
from driftlab.noise.allan_fit import fit
from driftlab.noise.allan_model import KEYS, design

WHITE, WALK = KEYS.index("white"), KEYS.index("rate_random_walk")


@pytest.mark.parametrize(
    "settings",
    [{"white": 1e-4}, {"white": 1e-4, "walk": 1e-4, "ramp": 1e-6}, {"quantization": 1e-3}],
)
def test_curves_agree_with_allantools(settings):
    allantools = pytest.importorskip("allantools")
    rate = simulated(20_000, 1, **settings) + 5e-3
    found = curve(rate, DT)
    for ours, theirs in ((found.allan, allantools.oadev), (found.hadamard, allantools.ohdev)):
        tau, expected, _, _ = theirs(rate, rate=1 / DT, data_type="freq", taus=found.tau)
        np.testing.assert_allclose(tau, found.tau, rtol=1e-12)
        np.testing.assert_allclose(ours, expected, rtol=1e-9)


def test_an_offset_a_billion_times_the_noise_loses_nothing():
    """The angle of a constant rate must not drown the noise in rounding: 2^30 has no rounding in itself."""
    rate = np.round(np.random.default_rng(0).normal(size=50_000) * 2**20) / 2**20
    np.testing.assert_allclose(curve(rate + 2.0**30, DT).allan, curve(rate, DT).allan, rtol=1e-6)


def test_thinned_overlaps_change_nothing_that_can_be_measured(monkeypatch):
    rate = simulated(200_000, 2, white=1e-4, walk=1e-5)
    full = curve(rate, DT)
    monkeypatch.setattr("driftlab.noise.allan.LONG", 20_000)
    thinned = curve(rate, DT, factors(200_000) // 8 * 8 + 8)
    assert full.stride.max() == 1
    assert thinned.stride.max() == 8
    assert np.all(thinned.tau / DT >= 64 * thinned.stride * (thinned.stride > 1))
    same = np.interp(np.log(thinned.tau), np.log(full.tau), np.log(full.allan))
    # the scatter of the curve itself at the longest averaging time is a hundred times larger
    exact = curve(rate, DT, np.rint(thinned.tau / DT).astype(int))
    np.testing.assert_allclose(np.exp(same), thinned.allan, rtol=0.05)
    monkeypatch.setattr("driftlab.noise.allan.LONG", 2**20)
    exact = curve(rate, DT, np.rint(thinned.tau / DT).astype(int))
    np.testing.assert_allclose(thinned.allan, exact.allan, rtol=2e-3)
    np.testing.assert_allclose(thinned.hadamard, exact.hadamard, rtol=2e-3)


def test_known_power_laws():
    """Closed forms of IEEE Std 952: N^2/tau, 3 Q^2/tau^2, K^2 tau/3 (Hadamard: half of it), R^2 tau^2/2 (and none)."""
    short = slice(0, 12)
    white = curve(simulated(200_000, 3, white=2e-4), DT)
    np.testing.assert_allclose(white.allan[short] * np.sqrt(white.tau[short]), 2e-4, rtol=0.03)
    np.testing.assert_allclose(white.hadamard[short] * np.sqrt(white.tau[short]), 2e-4, rtol=0.03)
    angle = curve(simulated(200_000, 4, quantization=1e-3), DT)
    np.testing.assert_allclose(angle.allan[short] * angle.tau[short], np.sqrt(3) * 1e-3, rtol=0.03)
    np.testing.assert_allclose(angle.hadamard[short] * angle.tau[short], np.sqrt(10 / 3) * 1e-3, rtol=0.03)
    walk = curve(simulated(200_000, 5, walk=1e-4), DT)
    np.testing.assert_allclose(walk.allan[short] / np.sqrt(walk.tau[short] / 3), 1e-4, rtol=0.03)
    np.testing.assert_allclose(walk.hadamard[short] / np.sqrt(walk.tau[short] / 6), 1e-4, rtol=0.03)
    ramp = curve(simulated(20_000, 6, ramp=1e-3), DT)
    np.testing.assert_allclose(ramp.allan, 1e-3 * ramp.tau / np.sqrt(2), rtol=1e-6)
    assert np.all(ramp.hadamard < 1e-6 * ramp.allan)


def rows(lengths, lost=3):
    """Return first row and end (S, 2) of stretches with `lost` rows between them, and how many rows there are."""
    ends = np.cumsum(np.asarray(lengths) + lost) - lost
    return np.stack([ends - lengths, ends], axis=1), int(ends[-1])


def random_gaps(seed, stretches=15, rows=12_000):
    """Return stretches that are cut at random places, a few rows lost at each."""
    rng = np.random.default_rng(1000 + seed)
    cuts = np.sort(rng.choice(np.arange(50, rows - 50), stretches - 1, replace=False))
    found = np.stack([np.append(0, cuts + rng.integers(1, 20, len(cuts))), np.append(cuts, rows)], axis=1)
    return found[np.diff(found, axis=1)[:, 0] >= 3]


def test_several_stretches_are_the_mean_of_allantools_over_their_differences():
    allantools = pytest.importorskip("allantools")
    lengths = [4000, 700, 20, 9000, 701]
    stretches, N = rows(lengths)
    rate = simulated(N, 1, white=1e-4, walk=1e-5)
    found = curve(rate, DT, stretches=stretches)
    for ours, theirs, order in ((found.allan, allantools.oadev, 2), (found.hadamard, allantools.ohdev, 3)):
        for m, value in zip(found.m, ours, strict=True):
            long = [part for part, length in zip(stretches, lengths, strict=True) if length >= 3 * m]
            each = [theirs(rate[a:b], 1 / DT, "freq", [m * DT])[1][0] for a, b in long]
            weights = [b - a - order * m + 1 for a, b in long]
            assert value == pytest.approx(np.sqrt(np.average(np.square(each), weights=weights)), rel=1e-9)
    assert list(found.counts[[0, -1]]) == [5, 1]
    np.testing.assert_allclose(found.used[[0, -1]], [sum(lengths) * DT, 9000 * DT])


def test_the_level_at_which_a_stretch_begins_does_not_matter():
    stretches, N = rows([3000, 500, 2000])
    rate = simulated(N, 2, white=1e-4, walk=1e-5)
    shifted = rate.copy()
    for k, (start, stop) in enumerate(stretches):
        shifted[start:stop] += 2.0 ** (3 * k)
    for one, other in (("allan", "allan"), ("hadamard", "hadamard")):
        expected = getattr(curve(rate, DT, stretches=stretches), one)
        np.testing.assert_allclose(getattr(curve(shifted, DT, stretches=stretches), other), expected, rtol=1e-8)


def test_averaging_times_end_where_less_than_three_of_them_are_left():
    assert factors(1000)[-1] == 200
    assert factors(np.array([1000]))[-1] == 200
    assert factors(np.full(50, 300))[-1] == 100  # a third of each stretch: 50 times a mean
    assert factors(np.array([1000, 300]))[-1] == 200  # the short one is none any more
    assert factors(np.array([1000, 900]))[-1] == 271  # 1900 - 4 m = 3 m


SIZES = {"equal": [600] * 12, "any": [3000, 1500, 1400, 700, 650, 300, 300, 200, 120, 40]}


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("term", ["white", "walk"])
def test_gaps_leave_the_mean_and_the_scatter_is_foretold(sizes, term):
    """Over 300 seeds: the mean is that of the closed form, and a sigma is one (68 % lie within it)."""
    stretches, N = rows(SIZES[sizes])
    theta = np.zeros(5)
    theta[WHITE if term == "white" else WALK] = 1.0
    found = [curve(simulated(N, seed, **{term: 1.0}), DT, stretches=stretches) for seed in range(300)]
    for hadamard, name in ((False, "allan"), (True, "hadamard")):
        model = design(found[0], hadamard)
        own = theta[: model.A.shape[1]]
        variances = np.array([getattr(one, name) ** 2 for one in found])
        far = model.tau > 1.0  # a sample is a mean: at first the walk shows less than its closed form
        ratio = variances[:, far] / (model.A @ own)[far]
        spread = model.spread(own)[far]
        error = spread / np.sqrt(len(found))
        assert np.all(np.abs(np.mean(ratio, axis=0) - 1) < 4 * error)
        np.testing.assert_allclose(np.std(ratio, axis=0) / spread, 1.0, atol=0.25)
        within = np.mean(np.abs(ratio - 1) < spread)
        assert 0.65 < within < 0.78  # 0.68 of a normal, more of a skewed one


def test_limits_cover_the_truth_where_there_are_gaps():
    """95 % limits of white noise and walk over twelve seeds: at most 4 of 24 may miss (probability below 3 %)."""
    found = [
        fit(curve(simulated(12_000, seed, white=1.0, walk=0.05), DT, stretches=random_gaps(seed))) for seed in range(12)
    ]
    truth = np.array([1.0, 0.05])
    each = [(item.low[[WHITE, WALK]], item.high[[WHITE, WALK]]) for item in found]
    missed = sum(int(np.sum((low > truth) | (high < truth))) for low, high in each)
    assert missed <= 4
    np.testing.assert_allclose(np.median([item.value[WHITE] for item in found]), 1.0, rtol=0.04)


def test_a_curve_of_few_points_has_limits():
    """Rows that are missing one after the other leave stretches of a few samples: terms look alike, none is refused."""
    rate = simulated(6000, 1, white=1e-4)
    rows = np.array([(k, k + 6) for k in range(0, 5990, 7)])
    found = fit(curve(rate, DT, stretches=rows))
    assert np.all(np.isfinite(found.high))
