"""An error that is fed back: of a linear system it is the filter itself, of another it beats the filter that is not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_core.discretize import van_loan
from fusion_core.feedback import feed_back
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State, Transition, join

N = 60
RNG = np.random.default_rng(1)
F, Q = van_loan([[0.0, 1.0, 0.0], [-0.4, -0.1, 1.0], [0.0, 0.0, 0.0]], np.diag([0.0, 0.2, 0.05]), 0.3)
U = RNG.normal(size=(N, 3))  # what drives the system; its error does not know it
H, R = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5]]), np.diag([0.3, 0.8])
Z = RNG.normal(size=(N, 2))
USED = RNG.random(N) < 0.4
PRIOR = State(np.array([0.5, -1.0, 0.2]), np.diag([2.0, 1.0, 3.0]))


def propagate(nominal, rows):
    path, x = [], nominal
    for u in U[rows]:
        x = F @ x + u
        path.append(x)
    error = Transition(F, Q, np.zeros(3))
    return np.array(path), error, Measurement(Z[rows] - np.array(path) @ H.T, H, R, USED[rows])


def correct(path, x):
    return path[-1] + x


def fed(ends, **options):
    parts = list(feed_back(State(np.zeros(3), PRIOR.P), PRIOR.x, ends, propagate, correct, **options))
    return parts, join([part.estimates for part in parts])


@given(ends=st.lists(st.booleans(), min_size=N, max_size=N))
@settings(max_examples=20)
def test_of_a_linear_system_it_is_the_filter_wherever_it_is_fed_back(ends):
    direct = estimate(PRIOR, Transition(F, Q, U), Measurement(Z, H, R, USED))
    parts, error = fed(np.array(ends))
    estimates = np.concatenate([part.path + part.estimates.x for part in parts])
    np.testing.assert_allclose(estimates, direct.x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(error.sigma, direct.sigma, rtol=1e-9)
    np.testing.assert_allclose(error.nis[USED], direct.nis[USED], rtol=1e-8)
    assert [part.rows.stop for part in parts] == sorted({*(np.flatnonzero(ends) + 1).tolist(), N})
    np.testing.assert_allclose(parts[-1].nominal, direct.x[-1], rtol=1e-9, atol=1e-9)
    assert not parts[-1].state.x.any()


def test_what_the_gate_refuses_corrects_nothing():
    parts, error = fed(USED, gate=1e-12)
    assert not error.used.any()
    np.testing.assert_allclose(parts[-1].nominal, propagate(PRIOR.x, slice(0, N))[0][-1], rtol=1e-12)


def test_the_covariance_turns_with_the_axes_of_the_error():
    G = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    parts, _ = fed(USED, keep_P=True, jacobian=lambda x: G)
    first = parts[0]
    np.testing.assert_allclose(first.state.P, G @ first.estimates.P[-1] @ G.T, rtol=1e-12)


def test_a_pendulum_swung_far_is_followed_through_its_own_equation():
    """theta'' = -9 sin(theta), the angle measured now and then: NEES within the bounds of chi-square."""
    dt, steps, seeds, every = 0.01, 800, 40, 40
    q, r = 1e-4, 1e-4

    def swing(x, w):
        rate = x[1] - 9 * np.sin(x[0]) * dt + w
        return np.array([x[0] + rate * dt, rate])

    nees = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = [np.array([2.0, 0.0])]
        for w in rng.normal(size=steps) * np.sqrt(q * dt):
            truth.append(swing(truth[-1], w))
        z = np.array(truth)[1:, :1] + rng.normal(size=(steps, 1)) * np.sqrt(r)
        used = (np.arange(steps) + 1) % every == 0

        def along(nominal, rows, z=z, used=used):
            path = [nominal]
            for _ in range(rows.start, rows.stop):
                path.append(swing(path[-1], 0.0))
            before, after = np.array(path[:-1]), np.array(path[1:])
            slope = -9 * np.cos(before[:, 0]) * dt
            step = np.array([[1.0, dt], [0.0, 1.0]]) + slope[:, None, None] * np.array([[dt, 0.0], [1.0, 0.0]])
            noise = q * dt * np.array([[dt**2, dt], [dt, 1.0]])
            measured = Measurement(z[rows] - after[:, :1], np.array([[1.0, 0.0]]), np.array([[r]]), used[rows])
            return after, Transition(step, noise, np.zeros(2)), measured

        P = np.diag([1e-4, 1e-4])
        start = truth[0] + rng.normal(size=2) * 1e-2
        *_, last = feed_back(State(np.zeros(2), P), start, used, along, correct)
        error = last.nominal - truth[-1]
        nees.append(error @ np.linalg.solve(last.state.P, error))
    assert 53.54 < np.sum(nees) < 112.33  # chi-square, 80 degrees of freedom, 1 % on either side


@pytest.mark.parametrize(
    ("ends", "options", "message"),
    [
        (np.ones((N, 1), dtype=bool), {}, r"feed_back: ends is bool \(60, 1\), bool \(N,\) was expected; give"),
        (np.arange(N), {}, r"feed_back: ends is int64 \(60,\), bool \(N,\) was expected"),
        (np.ones(N, dtype=bool), {"jacobian": lambda x: x}, r"feed_back: the jacobian has the shape \(3,\), \(3, 3\)"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(ends, options, message):
    with pytest.raises(ValueError, match=message):
        fed(ends, **options)


def test_no_samples_are_no_segments():
    assert list(feed_back(PRIOR, PRIOR.x, np.zeros(0, dtype=bool), propagate, correct)) == []
