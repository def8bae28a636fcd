"""Whitening against the dense covariance and the textbook filter; play and lag against their definitions and laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.signal import lsim

from fusion_core import reference
from fusion_core.contracts import Transition
from fusion_core.model import Measurement, State
from fusion_core.recursions import lag, play
from fusion_core.whitening import ScalarFilter

N, RESTART = 30, 13


@pytest.fixture(scope="module")
def model():
    """The integral of a rate with white noise and a walking bias, with steps of many lengths and one restart."""
    rng = np.random.default_rng(3)
    dt = rng.uniform(0.2, 3.0, N)
    F = np.zeros((N, 2, 2))
    F[:, 0, 0], F[:, 0, 1], F[:, 1, 1] = 1.0, -dt, rng.uniform(0.8, 1.0, N)
    white, walk = np.zeros((N, 2, 2)), np.zeros((N, 2, 2))
    white[:, 0, 0] = 0.5 * dt
    walk[:, 0, 0], walk[:, 1, 1] = dt**3 / 3, dt
    walk[:, 0, 1] = walk[:, 1, 0] = -(dt**2) / 2
    fresh = np.zeros(N, dtype=bool)
    fresh[RESTART] = True
    b = np.stack([dt, 0.3 * dt], axis=1)
    P = np.array([[0.2, 0.1], [0.1, 4.0]])
    return ScalarFilter(F, white, 0.1 * walk, b, np.array([1.0, -0.2]), 0.05, P, fresh)


def whiten(model, signals, scale):
    whitening = model.at(scale)
    return whitening(signals), whitening.log_S


def dense(model, scale):
    """Return D (N, N), what a signal does to the measurements, and the measurements' covariance C (N, N).

    All states at once: (I - shifted F) x = b s + w; at a restart the state before is drawn anew from P.
    """
    n = len(model.h)
    A = np.eye(N * n)
    noise = []
    for k in range(N):
        Q = model.Q[k] + scale * model.walk[k]
        if k == 0 or model.fresh[k]:
            Q = Q + model.F[k] @ model.P @ model.F[k].T
        else:
            A[k * n : (k + 1) * n, (k - 1) * n : k * n] = -model.F[k]
        noise.append(Q)
    H = np.kron(np.eye(N), model.h) @ np.linalg.inv(A)
    return H @ block_diag(*model.b[:, :, None]), H @ block_diag(*noise) @ H.T + model.r * np.eye(N)


@pytest.mark.parametrize("scale", [0.0, 0.3, 1.0, 50.0])
def test_whitened_signals_have_the_weight_of_the_dense_covariance(model, scale):
    """For any two signals a, b: white_a' white_b = (D a)' C^-1 (D b), and sum log S = log det C."""
    signals = np.random.default_rng(0).normal(size=(N, 5))
    white, log_S = whiten(model, signals, scale)
    D, C = dense(model, scale)
    seen = D @ signals
    np.testing.assert_allclose(white.T @ white, seen.T @ np.linalg.solve(C, seen), rtol=1e-9, atol=1e-9)
    assert np.sum(log_S) == pytest.approx(np.linalg.slogdet(C)[1], rel=1e-9)
    np.testing.assert_allclose(white, np.linalg.solve(np.linalg.cholesky(C), seen), rtol=1e-9, atol=1e-9)


def test_whitened_signals_are_the_textbook_filters_innovations(model):
    """A signal is a known input of the state, and zero is measured: the innovations are those, with the other sign."""
    signal = np.random.default_rng(1).normal(size=N)
    white, log_S = whiten(model, signal[:, None], 0.7)
    found = []
    for part in (slice(0, RESTART), slice(RESTART, N)):
        step = Transition(model.F[part], (model.Q + 0.7 * model.walk)[part], model.b[part] * signal[part, None])
        size = len(step.F)
        measured = Measurement(np.zeros((size, 1)), model.h[None], np.array([[model.r]]), np.ones(size, dtype=bool))
        found.append(reference.estimate(State(np.zeros(2), model.P), step, measured))
    np.testing.assert_allclose(white[:, 0], -np.concatenate([f.white[:, 0] for f in found]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(log_S, np.concatenate([f.log_det for f in found]), rtol=1e-9, atol=1e-12)


def test_whitening_is_linear_and_many_signals_are_as_each_alone(model):
    """More signals than go through the recursion together, and not a multiple of it."""
    signals = np.random.default_rng(2).normal(size=(N, 71))
    white, log_S = whiten(model, signals, 1.0)
    for k in (0, 31, 32, 63, 64, 70):
        alone, log_S_alone = whiten(model, signals[:, k : k + 1], 1.0)
        np.testing.assert_array_equal(alone[:, 0], white[:, k])
        np.testing.assert_array_equal(log_S_alone, log_S)
    mixed = np.random.default_rng(3).normal(size=(71, 2))
    np.testing.assert_allclose(whiten(model, signals @ mixed, 1.0)[0], white @ mixed, atol=1e-11)


def test_a_restart_forgets_what_was_before(model):
    signals = np.random.default_rng(4).normal(size=(N, 2))
    signals[RESTART:, 1] = signals[RESTART:, 0]
    white, _ = whiten(model, signals, 1.0)
    np.testing.assert_array_equal(white[RESTART:, 0], white[RESTART:, 1])
    assert np.all(white[:RESTART, 0] != white[:RESTART, 1])


def test_the_scale_multiplies_the_walk_alone(model):
    signals = np.random.default_rng(5).normal(size=(N, 3))
    given_, log_S = whiten(model, signals, 7.0)
    parts = {name: getattr(model, name) for name in ("F", "Q", "b", "h", "r", "P", "fresh")}
    built_in, same = whiten(ScalarFilter(walk=7.0 * model.walk, **parts), signals, 1.0)
    np.testing.assert_array_equal(given_, built_in)
    np.testing.assert_array_equal(log_S, same)
    still = ScalarFilter(walk=np.zeros_like(model.walk), **parts)
    np.testing.assert_array_equal(whiten(still, signals, 1.0)[0], whiten(still, signals, 1e6)[0])
    np.testing.assert_array_equal(whiten(still, signals, 1.0)[0], whiten(model, signals, 0.0)[0])


# -- play and lag ----------------------------------------------------------------------------------------------------

values = st.lists(st.floats(-50, 50, allow_subnormal=False), min_size=2, max_size=40).map(np.array)
widths = st.floats(0.01, 40)


@given(values, widths, st.floats(-50, 50))
@settings(deadline=None)
def test_play_follows_its_definition(x, width, y):
    """The output is moved only by the edge of the play that the input has reached."""
    out = play(x, width, y)
    for value, moved in zip(x, out, strict=True):
        y = value - width / 2 if value - y > width / 2 else value + width / 2 if y - value > width / 2 else y
        assert moved == pytest.approx(y, abs=1e-12)


@given(values, widths, st.integers(1, 5))
@settings(deadline=None)
def test_play_knows_no_rate(x, width, more):
    """Samples in between, on a straight way, change nothing at the samples that were there."""
    at = np.arange(len(x)) * (more + 1)
    fine = np.interp(np.arange(at[-1] + 1), at, x)
    np.testing.assert_allclose(play(fine, width, x[0])[at], play(x, width, x[0]), atol=1e-12)


@given(values, widths, st.data())
@settings(deadline=None)
def test_play_returns_to_the_point_where_an_inner_loop_began(x, width, data):
    """From the least to the greatest input, any excursion between the two, and back: as if it had not been."""
    low, high = x.min(), x.max()
    after = np.array(data.draw(st.lists(st.floats(-50, 50), min_size=1, max_size=5)))
    with_loop = play(np.concatenate([[low, high], x, [high], after]), width, low)
    without = play(np.concatenate([[low, high], after]), width, low)
    np.testing.assert_allclose(with_loop[-len(after) - 1 :], without[1:], atol=1e-12)


def test_play_between_two_temperatures_is_a_parallelogram():
    up, down = np.linspace(0, 30, 301), np.linspace(30, 0, 301)
    y = play(np.concatenate([up, down, up]), 8.0, 0.0)
    np.testing.assert_allclose(y[:301], np.maximum(up - 4, 0.0), atol=1e-12)
    np.testing.assert_allclose(y[301:602], np.minimum(down + 4, 26.0), atol=1e-12)
    np.testing.assert_allclose(y[602:], np.maximum(up - 4, 4.0), atol=1e-12)


def test_lag_is_the_first_order_system_of_scipy():
    rng = np.random.default_rng(6)
    t = np.arange(200) * 0.7
    x = rng.normal(size=200)
    _, expected, _ = lsim(([1.0], [5.0, 1.0]), x - x[0], t)  # straight between its samples
    dt = np.diff(t, prepend=0.0)
    np.testing.assert_allclose(lag(dt, x, 5.0, x[0], x[0]), expected + x[0], atol=1e-9)


def test_lag_trails_a_ramp_by_its_closed_form():
    dt = np.random.default_rng(7).uniform(0.1, 9.0, 100)
    t = np.cumsum(dt)
    rate, tau = 0.4, 20.0
    np.testing.assert_allclose(
        lag(dt, 3 + rate * t, tau, 3.0, 3.0), 3 + rate * (t - tau * (1 - np.exp(-t / tau))), rtol=1e-12
    )


@given(values, st.floats(0.1, 100), st.data())
@settings(deadline=None)
def test_lag_is_a_semigroup(x, tau, data):
    """Any step may be split in two on the straight way between its samples."""
    size = len(x)
    dt = np.array(data.draw(st.lists(st.floats(0.01, 50), min_size=size, max_size=size)))
    part = np.array(data.draw(st.lists(st.floats(0.01, 0.99), min_size=size, max_size=size)))
    before = np.concatenate([[1.0], x[:-1]])
    fine_dt = np.stack([part * dt, (1 - part) * dt], axis=1).ravel()
    fine_x = np.stack([before + part * (x - before), x], axis=1).ravel()
    np.testing.assert_allclose(lag(fine_dt, fine_x, tau, 1.0, 2.0)[1::2], lag(dt, x, tau, 1.0, 2.0), atol=1e-7)


def test_lag_stays_where_no_time_passes():
    np.testing.assert_array_equal(lag(np.zeros(3), np.array([1.0, 5.0, 9.0]), 2.0, 0.0, 0.5), [0.5, 0.5, 0.5])
