"""Coasting's variance against the plain recursion, its thermometer, its vertical."""

from itertools import pairwise

import numpy as np
import pytest
from days_at_rest import DEG_H, config, day, fitted, run_over
from hypothesis import given, settings
from hypothesis import strategies as st

from driftlab.config import Config
from driftlab.filtering.coasting import Coast, spread
from fusion_core.contracts import Transition
from fusion_plugins.earth import earth_rate

# the recursion


def plain(P, F, Q, C, N):
    """Return the variance (N, d) of C x by the recursion as it is written."""
    out = []
    for k in range(N):
        F_k, Q_k, C_k = (a[k] if a.ndim == 3 else a for a in (F, Q, C))
        P = F_k @ P @ F_k.T + Q_k
        out.append(np.diag(C_k @ P @ C_k.T))
    return np.array(out), P


def drawn(seed, diagonal, varying):
    """Return P, F, Q and C (or None) of 3 or 4 states over 40 steps."""
    rng = np.random.default_rng(seed)
    n, N = (3, 40) if diagonal else (4, 40)
    steps = (N,) if varying else ()

    def covariance(*shape):
        root = rng.normal(size=(*shape, n, n))
        return root @ root.swapaxes(-1, -2)

    F = np.eye(n) + 0.1 * rng.normal(size=(*steps, n, n))
    P, Q, C = covariance(), 0.01 * covariance(*steps), rng.normal(size=(*(steps if seed % 2 else ()), 3, n))
    if diagonal:
        return P * np.eye(n), F * np.eye(n), Q * np.eye(n), None
    return P, F, Q, C


def part(step, start, stop):
    F, Q, C, u = (
        a if a is None or a.ndim == ndim else a[start:stop]
        for a, ndim in ((step.F, 2), (step.Q, 2), (step.C, 2), (step.u, 1))
    )
    return Transition(F, Q, u, C)


@given(st.integers(0, 10_000), st.booleans(), st.booleans(), st.lists(st.integers(0, 40), max_size=5))
@settings(max_examples=40)
def test_spread_is_the_plain_recursion_and_can_be_cut_anywhere(seed, diagonal, varying, cuts):
    P, F, Q, C = drawn(seed, diagonal, varying)
    step = Transition(F, Q, np.zeros(len(P)), C)
    expected, P_after = plain(P, F, Q, np.eye(len(P)) if C is None else C, 40)
    before = P.copy()
    variance, after = spread(P, step, 40)
    np.testing.assert_array_equal(P, before)
    np.testing.assert_allclose(variance, expected, rtol=1e-12)
    np.testing.assert_allclose(after, P_after, rtol=1e-12, atol=1e-15)
    found = []
    for start, stop in pairwise(sorted({0, 40, *cuts})):
        rows, P = spread(P, part(step, start, stop), stop - start)
        found.append(rows)
    np.testing.assert_array_equal(np.concatenate(found), variance)
    np.testing.assert_array_equal(P, after)


def test_a_coupled_prior_takes_the_dense_road():
    """F and Q are diagonal, but P is not: its cross terms must not be lost."""
    P = np.array([[2.0, 1.0], [1.0, 3.0]])
    step = Transition(np.diag([1.0, 0.9]), 0.1 * np.eye(2), np.zeros(2))
    _, after = spread(P, step, 10)
    np.testing.assert_allclose(after, plain(P, step.F, step.Q, np.eye(2), 10)[1], rtol=1e-12)
    assert after[0, 1] == pytest.approx(0.9**10)


def test_the_mean_goes_on_with_its_drift():
    rng = np.random.default_rng(0)
    P, F, Q, C = drawn(3, False, True)
    u, x = rng.normal(size=(40, 4)), rng.normal(size=4)
    coast = Coast(x, P, 20.0)
    step = Transition(F, Q, u, C)
    found = np.concatenate(
        [coast.advance(stop - start, part(step, start, stop))[0] for start, stop in ((0, 7), (7, 40))]
    )
    for k in range(40):
        x = F[k] @ x + u[k]
        np.testing.assert_allclose(found[k], C[k] @ x, rtol=1e-9)


# the vertical


MINUTES, _ = day(0, seconds=100)


def levelled(bias, **accel):
    """Return the alignment of a level unit whose accelerometers have a bias (3,) in m/s^2."""
    rng = np.random.default_rng(0)
    true = np.array([0.0, 0.0, 9.80206])
    chunk = MINUTES.having(accel=true + bias + 1e-4 * rng.normal(size=(100, 3)))
    content = {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)", **accel}}
    settings = config(accel=content)
    return settings.filter.aligned(chunk, settings.site)


def test_the_tilt_of_a_biased_accelerometer_is_in_the_sigma_of_the_earth_rate():
    """Over directions of a 5 mg bias the removed Earth rate errs as `tilt` says, with a deviation of 5 mg an axis."""
    rng = np.random.default_rng(2)
    true = earth_rate(np.array([0, 0, 1.0]), np.deg2rad(40.9), 0.0)
    sigma = 5e-3 * 9.80206
    errors = [levelled(sigma * rng.normal(size=3), sigma_0="5 mg") for _ in range(200)]
    rms = np.sqrt(np.mean([(one.inputs["gyro"] - true) ** 2 for one in errors], axis=0))
    tilt = np.mean([one.unsure for one in errors], axis=0)
    np.testing.assert_allclose(tilt, rms, rtol=0.15, atol=1e-3 * DEG_H)
    assert 0.03 * DEG_H < tilt[2] < 0.08 * DEG_H  # 0.052 deg/h of a level unit, with x to the north


def test_the_length_of_gravity_tells_of_a_bias_that_nothing_is_said_of():
    small, large = levelled(np.zeros(3)), levelled(np.array([0, 0, 0.2]))
    assert np.all(large.unsure >= small.unsure)
    assert large.unsure[2] > 5 * small.unsure[2] > 0


def test_without_latitude_or_accelerometers_there_is_no_tilt():
    nowhere = Config.model_validate({"filter": config().filter.model_dump(mode="json")})
    for one in (config(accel=None), nowhere):
        np.testing.assert_array_equal(one.filter.aligned(MINUTES, one.site).unsure, 0.0)


# a run


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    return {kind: fitted(folder, kind) for kind in ("polynomial", "spline")}


@pytest.mark.parametrize("kind", [None, "polynomial", "spline"])
def test_the_sigma_of_a_run_is_finite_and_never_below_the_departures(kind, maps):
    chunk, _ = day(0)
    run, columns = run_over(config(of_map=maps.get(kind)), chunk)
    aligned = columns["t"] > run.journal.alignments[0].t
    coast, running = columns["coast_sigma"], columns["bias_sigma"]
    assert np.all(np.isfinite(coast[aligned]))
    assert np.all(np.isnan(coast[~aligned]))
    assert np.all(np.isfinite(running))
    k = int(np.argmax(aligned))
    assert np.all(coast[aligned] >= 0.99 * running[k - 1])
    t = columns["t"][aligned] - columns["t"][k - 1]
    walk = 0.05 * DEG_H
    tilt = run.journal.alignments[0].unsure
    assert np.all(coast[aligned] ** 2 >= 0.999 * (walk**2 * t[:, None] + tilt**2))
    if kind is None:  # nothing else is known of: departure, walk and vertical are all of it
        P = running[k - 1] ** 2 - tilt**2
        np.testing.assert_allclose(coast[aligned] ** 2, P + walk**2 * t[:, None] + tilt**2, rtol=1e-6)
    rms = np.sqrt(np.mean(coast[aligned] ** 2, axis=0))
    np.testing.assert_allclose(run.yardsticks.coast_sigma["to the end"], rms, rtol=1e-6)


def test_any_split_of_a_run_gives_the_same_sigma(maps):
    from driftlab.filtering.run import Run
    from driftlab.filtering.segment import RunLog, joined

    chunk, _ = day(0, seconds=2400)
    chunk = chunk.having(temperature=np.round(chunk["temperature"]))
    settings = config(of_map=maps["spline"])
    whole = joined(Run(settings, RunLog()).over([chunk]))
    for size in (997, 130):
        parts = (chunk.part(k, min(k + size, len(chunk))) for k in range(0, len(chunk), size))
        split = joined(Run(settings, RunLog()).over(parts))
        for name in ("coast_sigma", "bias_sigma"):
            np.testing.assert_allclose(split[name], whole[name], rtol=1e-9)
        np.testing.assert_array_equal(split["still"], whole["still"])


def test_a_coarse_thermometer_makes_a_map_less_sure(maps):
    """In steps of 1 K on a slope of up to 40 deg/h/K."""
    chunk, _ = day(0)
    fine = run_over(config(of_map=maps["spline"]), chunk)[1]
    coarse = run_over(config(of_map=maps["spline"]), chunk.having(temperature=np.round(chunk["temperature"])))[1]
    steep = np.abs(chunk["temperature"] - 27) < 1
    level = chunk["temperature"] > 38
    assert np.mean(coarse["bias_sigma"][steep, 0]) > 2 * np.mean(fine["bias_sigma"][steep, 0])
    np.testing.assert_allclose(coarse["bias_sigma"][level], fine["bias_sigma"][level], rtol=0.02)
    # half of slope q / sqrt(12) at the steepest, 40 deg/h/K over 1 K: smoothing takes the rest of a step a minute
    assert np.max(coarse["coast_sigma"][steep, 0]) > 0.45 * 40 * DEG_H / np.sqrt(12)
