"""Tones in time: as likely as dense matrices say, and no memories of temperature. Made in plain NumPy."""

import numpy as np
import pytest
from loop_cases.signatures import dragged
from scipy.stats import multivariate_normal

from driftlab.maps.hysteresis.contrasts import RATIOS, THIN, SoakContrasts, log_mean
from driftlab.maps.hysteresis.memory import memory_of
from driftlab.maps.hysteresis.rivals import STRENGTHS, evidence_of, lines_of, tone_of
from driftlab.soak.blocks import brief

N = 10_800  # samples, of 1 s
t = np.arange(N)
T = np.interp(t, [0, N / 2, N], [-20, 60, -20])
CURVES = np.stack([60 * np.cos(T / 30), 0.03 * (T - 10) ** 2, 20 * np.exp(T / 50)], axis=1)


def sine(period, rng, wander=0.0):
    """A tone of 1 on three axes, each of its own phase, whose frequency walks by so much over the soak."""
    turns = np.cumsum(1 + wander * np.cumsum(rng.normal(size=N)) / np.sqrt(N)) / period
    return np.sin(2 * np.pi * turns[:, None] + rng.uniform(0, 2 * np.pi, 3))


def judged(added, rng):
    """Judge a soak of 3 h, up and down once: white noise of 2 and a walk of 0.01 beside what is added, in deg/h."""
    noise = np.cumsum(0.01 * rng.normal(size=(N, 3)), axis=0) + 2 * rng.normal(size=(N, 3))
    return memory_of(brief(T + 0.01 * rng.normal(size=N), CURVES + added + noise, [0], 1.0))


@pytest.mark.parametrize("n", [1, 2])
def test_a_tone_is_as_likely_as_by_dense_matrices(n):
    rng = np.random.default_rng(1)
    soak = brief(T, CURVES[:, :1] + sine(900, rng)[:, :1] + 2 * rng.normal(size=(N, 1)), [0], 1.0)
    contrasts = SoakContrasts(soak)
    u, m, z = contrasts.u[:, 0], len(contrasts.u), contrasts.of(lines_of(soak, np.array([12.0]), n))[:, 0]
    with_it, without = [], []
    for (own, _), C in zip(contrasts.laws, contrasts.covariances, strict=True):
        for ratio in RATIOS[::THIN]:
            V = np.eye(m) + ratio / np.mean(own) * contrasts.Z.T @ C @ contrasts.Z
            spread = z @ np.linalg.solve(z.T @ np.linalg.solve(V, z), z.T)
            each = [V, *(V + g * spread for g in STRENGTHS)]
            logs = []
            for W in each:  # s^2 by the inverse gamma
                squares = u @ np.linalg.solve(W, u)
                logs.append(multivariate_normal(cov=W).logpdf(u) + squares / 2 - m / 2 * np.log(squares))
            without.append(logs[0])
            with_it.append(log_mean(np.array(logs[1:])))
    factor = log_mean(np.array(with_it)) - log_mean(np.array(without))
    assert evidence_of(contrasts, np.array([12.0]), n)[0] == pytest.approx(
        np.logaddexp(0, factor) - np.log(2), abs=1e-3
    )


@pytest.mark.parametrize("period", [900.0, 743.0, 3000.0])
def test_the_period_of_a_tone_is_found_and_none_is_where_there_is_none(period):
    rng = np.random.default_rng(2)
    soaks = [CURVES + size * sine(period, rng) + 2 * rng.normal(size=(N, 3)) for size in (1.0, 0.0)]
    (evidence, found, lines), (without, _, _) = (tone_of(SoakContrasts(brief(T, y, [0], 1.0))) for y in soaks)
    assert evidence > 20 > 0 > without
    assert found == pytest.approx(period, rel=0.02)
    assert lines.shape[0] == len(brief(T, CURVES, [0], 1.0).T)


@pytest.mark.parametrize(("size", "period", "wander"), [(6, 900, 0.0), (1, 900, 0.0), (6, 3600, 0.0), (6, 900, 0.1)])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_tone_in_time_is_no_memory_and_no_limit_passes_on_it(size, period, wander, seed):
    rng = np.random.default_rng(seed)
    found = judged(size * sine(period, rng, wander), rng)
    assert found.answer != "seen"
    if found.answer == "undecided":
        assert np.all(np.isinf(found.none_larger_than))
    known = np.isfinite(found.size)
    assert np.all((np.abs(found.size) - 3 * found.sigma)[known] < 2 * size)


def test_where_a_period_explains_as_much_it_is_named():
    rng = np.random.default_rng(3)
    found = judged(6 * sine(900, rng), rng)
    assert found.answer == "undecided"
    assert found.why.startswith("a period of 15 min in time explains as much")
    assert not found.kinds
    assert np.nanmax(np.abs(found.difference)) < 6  # beside the tone


def test_a_memory_beside_a_tone_is_seen_with_its_size():
    rng = np.random.default_rng(4)
    play = (T - dragged(T, 8.0))[:, None] / 8 * [24.0, -16.0, 0.0]
    found = judged(play + 6 * sine(900, rng), rng)
    assert found.answer == "seen"
    np.testing.assert_allclose(found.size[:2], [24, -16], atol=4 * found.sigma[:2].max())
    assert found.sigma.max() < 4
