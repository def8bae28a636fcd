"""The smoother against the joint posterior of all states, and against itself cut anywhere."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fusion_core.smoother as module
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State, Transition
from fusion_core.smoother import Smoother, smooth

n, m = 3, 2


def problem(N, varying, seed=0):
    rng = np.random.default_rng(seed)
    lead = (N,) if varying else ()
    L = rng.normal(size=(*lead, n, n))
    F = np.eye(n) + 0.2 * rng.normal(size=(*lead, n, n))
    F /= np.maximum(1.0, np.abs(np.linalg.eigvals(F)).max(axis=-1))[..., None, None]
    R = np.array([[1.0, 0.4], [0.4, 0.7]])
    step = Transition(F, L @ np.swapaxes(L, -1, -2) + 0.1 * np.eye(n), rng.normal(size=(N, n)))
    used = rng.random((N, m)) < 0.6
    measurement = Measurement(3 * rng.normal(size=(N, m)), rng.normal(size=(*lead, m, n)), R, used)
    return State(rng.normal(size=n), np.eye(n)), step, measurement


def least_squares(state, step, measurement, taken, reset):
    """All states at once: noise and measurements as rows of one whitened system (N n unknowns and the start)."""
    N = len(measurement.z)
    F, Q = (np.broadcast_to(a, (N, n, n)) for a in (step.F, step.Q))
    H = np.broadcast_to(measurement.H, (N, m, n))
    A, b = [], []

    def row(blocks, value, covariance):
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        wide = np.zeros((len(value), (N + 1) * n))
        for k, block in blocks:
            wide[:, k * n : (k + 1) * n] = block
        A.append(white @ wide)
        b.append(white @ value)

    row([(0, np.eye(n))], state.x, state.P)
    for k in range(N):
        keep = np.diag(np.where(reset & ~taken[k].any(), 0.0, 1.0))
        tiny = 1e-12 * (np.eye(n) - keep)  # known exactly, but for what the solver needs
        row([(k, -keep @ F[k]), (k + 1, np.eye(n))], keep @ step.u[k], keep @ Q[k] @ keep + tiny)
        some = taken[k]
        if some.any():
            row([(k + 1, H[k][some])], measurement.z[k, some], measurement.R[np.ix_(some, some)])
    A, b = np.concatenate(A), np.concatenate(b)
    covariance = np.linalg.inv(A.T @ A)
    x = (covariance @ A.T @ b).reshape(N + 1, n)[1:]
    return x, np.sqrt(np.diag(covariance)).reshape(N + 1, n)[1:]


@pytest.mark.parametrize("varying", [True, False])
@pytest.mark.parametrize("gate", [np.inf, 4.0])
@pytest.mark.parametrize("reset", [False, True])
def test_smoothed_states_are_the_joint_least_squares_solution(varying, gate, reset):
    given = problem(40, varying)
    reset = np.array([reset, False, False])
    found = estimate(*given, gate=gate, reset=reset)
    taken = given[2].used & found.used[:, None]
    assert 0 < taken.sum() < taken.size
    assert np.any(given[2].used.any(axis=1) & ~found.used) == np.isfinite(gate)
    x, sigma = smooth(*given, found, reset=reset)
    expected_x, expected_sigma = least_squares(*given, taken, reset)
    np.testing.assert_allclose(x, expected_x, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(sigma, expected_sigma, rtol=1e-5, atol=2e-6)


@given(cuts=st.lists(st.integers(1, 199), max_size=5), block=st.sampled_from([1, 7, 64, 8192]))
@settings(max_examples=20)
def test_stretch_by_stretch_it_is_the_same(cuts, block):
    state, step, measurement = problem(200, varying=True)
    whole = estimate(state, step, measurement)
    expected_x, expected_sigma = smooth(state, step, measurement, whole)
    edges = sorted({0, 200, *cuts})
    parts = [slice(a, b) for a, b in pairwise(edges)]
    states, used = [state], []
    for rows in parts:
        found = estimate(states[-1], step.part(rows), measurement.part(rows))
        states.append(found.state)
        used.append(found.used)
    smoother, x, sigma = Smoother(n), [], []
    usual, module.BLOCK = module.BLOCK, block
    try:
        for k in reversed(range(len(parts))):
            some = smoother.back(states[k], step.part(parts[k]), measurement.part(parts[k]), used[k])
            x.insert(0, some[0])
            sigma.insert(0, some[1])
    finally:
        module.BLOCK = usual
    np.testing.assert_allclose(np.concatenate(x), expected_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.concatenate(sigma), expected_sigma, rtol=1e-9)


def test_nothing_to_smooth_is_nothing():
    state, step, measurement = problem(5, varying=False)
    none = slice(0, 0)
    given = state, step.part(none), measurement.part(none)
    x, sigma = smooth(*given, estimate(*given))
    assert x.shape == sigma.shape == (0, n)
