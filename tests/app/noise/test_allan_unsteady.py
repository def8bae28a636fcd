"""Noise that is not Gaussian of one strength: what its limits cover, and the laws that they stand on."""

import numpy as np
import pytest
from scipy.stats import t as student
from sensors_at_rest import DT, simulated

from driftlab.noise.allan import curve
from driftlab.noise.allan_fit import fit
from driftlab.noise.allan_model import KEYS
from driftlab.noise.allan_unsteady import BATCHES, PARTS, Unsteady, tail

N = KEYS.index("white")
WHOLE = np.array([[0, 2]])


def heavy(rng, samples):
    return rng.standard_t(3, samples) / np.sqrt(3)


def bursts(rng, samples):
    """Sigma is 1 or 5, each for 10 to 60 s."""
    lasting = rng.integers(100, 600, samples // 100)
    sigma = np.repeat(np.where(np.arange(len(lasting)) % 2 == rng.integers(2), 1.0, 5.0), lasting)[:samples]
    return sigma * rng.normal(size=samples) / np.sqrt(13)


@pytest.mark.parametrize("law", [heavy, bursts])
def test_limits_of_unsteady_noise_cover_the_root_of_the_mean_variance(law):
    """Of eight recordings at most 2 may miss (probability of more below 1 %); Gaussian limits miss in 5 or so."""
    rates = [law(np.random.default_rng(seed), 20_000) / np.sqrt(DT) for seed in range(8)]
    found = [fit(curve(rate, DT)) for rate in rates]
    assert sum(not item.low[N] <= 1.0 <= item.high[N] for item in found) <= 2
    assert all(any("stronger at some times" in note for note in item.notes) for item in found)
    assert np.median([item.high[N] / item.low[N] for item in found]) < 1.6


def test_steady_noise_is_not_said_to_be_unsteady():
    """Slow noise has squares that are alike in neighbouring samples, and so has a filter's."""
    for seed in range(4):
        white = simulated(20_000, seed, white=1.0)
        smooth = np.convolve(white, np.ones(5) / 5, mode="valid")
        for rate in (white, smooth, simulated(20_000, seed, white=0.1, walk=1.0), simulated(20_000, seed, walk=1.0)):
            assert not any("stronger at some times" in note for note in fit(curve(rate, DT)).notes)


def test_parts_are_the_mean_squares_of_the_curve_with_gaps_and_without():
    rate = simulated(9_000, 1, white=1.0)
    stretches = np.array([[0, 4_000], [4_010, 9_000]])
    for missing in (None, np.array([10]), np.array([5_000])):
        found = curve(rate, DT, stretches=stretches, missing=missing)
        squares, number = np.sum(found.parts, axis=1).T
        factor = 2.0 if found.bridge is not None else 2 * found.tau**2
        np.testing.assert_allclose(squares / number, factor * found.allan**2, rtol=1e-9)
    alone = curve(rate, DT).parts[0]
    first = np.diff(rate[: int(alone[0, 1]) + 1]) * DT
    assert alone.shape == (PARTS, 2)
    assert alone[0, 0] == pytest.approx(np.sum(first**2))


def test_squares_that_have_a_variance_have_students_limits():
    """Of the mean x of parts, 95 % limits are x (1 + t s) above; below, x exp(-t s): alike to first order."""
    s = 0.1
    factors = Unsteady(s, 2.0, np.ones(4), np.zeros(1), 2.0).factors
    low, high = np.quantile(factors, [0.025, 0.975])
    bound = student.ppf(0.975, BATCHES - 1) * s
    assert 1 / low == pytest.approx(1 + bound, rel=0.02)
    assert np.log(high) == pytest.approx(bound, rel=0.06)


def test_a_heavy_tail_opens_the_upper_limit_alone():
    """Of stable variates that are skewed to the right the mean is mostly too low."""
    light, heavy = (Unsteady(0.1, 2.0, np.ones(4), np.zeros(1), index).factors for index in (2.0, 1.5))
    assert np.quantile(heavy, 0.025) < 0.9 * np.quantile(light, 0.025)
    assert np.quantile(heavy, 0.975) == pytest.approx(np.quantile(light, 0.975), rel=0.01)


def test_the_index_of_a_tail():
    """Squares of Student's t with nu degrees of freedom fall as x^(-nu / 2); those of Gaussian noise faster."""
    rng = np.random.default_rng(1)
    assert tail(rng.standard_t(3, 400_000), WHOLE) == pytest.approx(1.5, abs=0.12)
    assert tail(rng.normal(size=400_000), WHOLE) == 2.0
    assert tail(np.round(rng.normal(size=10_000) * 0.3), WHOLE) == 2.0
    assert tail(np.zeros(100), WHOLE) == 2.0


def test_a_step_between_stretches_is_no_sample_that_stands_out():
    rate = np.random.default_rng(2).normal(size=1000)
    stepped = rate + 1e6 * (np.arange(1000) >= 500)
    stretches = np.array([[0, 500], [500, 1000]])
    assert tail(stepped, stretches) == pytest.approx(tail(rate, stretches), rel=1e-6)
