"""The filter where P is far wider than R, against the same steps in exact fractions: right, or refused by name."""

from fractions import Fraction

import numpy as np
import pytest

from fusion_core.checks import TooWide
from fusion_core.contracts import Transition
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State
from fusion_core.smoother import smooth


def exact(P, F, Q, H, R, z):
    """Return x and sigma (N, n) of the filter in fractions, one scalar measurement after the other; R diagonal."""
    n = len(F)
    F, Q, H, P = ([[Fraction(float(v)) for v in row] for row in a] for a in (F, Q, H, P))
    x, found = [Fraction(0)] * n, []
    for sample in z:
        x = [sum(F[i][j] * x[j] for j in range(n)) for i in range(n)]
        FP = [[sum(F[i][k] * P[k][j] for k in range(n)) for j in range(n)] for i in range(n)]
        P = [[sum(FP[i][k] * F[j][k] for k in range(n)) + Q[i][j] for j in range(n)] for i in range(n)]
        for h, r, value in zip(H, np.diag(R), sample, strict=True):
            p = [sum(P[i][j] * h[j] for j in range(n)) for i in range(n)]
            S = sum(h[i] * p[i] for i in range(n)) + Fraction(float(r))
            y = Fraction(float(value)) - sum(h[i] * x[i] for i in range(n))
            x = [x[i] + p[i] * y / S for i in range(n)]
            P = [[P[i][j] - p[i] * p[j] / S for j in range(n)] for i in range(n)]
        found.append([[float(v) for v in x], [float(P[i][i]) ** 0.5 for i in range(n)]])
    return np.moveaxis(np.array(found), 1, 0)


def model(n, m, q, N, seed=0):
    rng = np.random.default_rng(seed)
    L = np.round(rng.normal(size=(n, n)), 2)
    F = np.eye(n) + (0 if n == 1 else 0.1) * np.round(rng.normal(size=(n, n)), 1)
    H, z = np.round(rng.normal(size=(m, n)), 2), np.round(rng.normal(size=(N, m)), 3)
    return F, q * (L @ L.T + L.T @ L) / 2, H, np.eye(m), z


@pytest.mark.parametrize("q", [0.0, 1.0, 1e20])
@pytest.mark.parametrize("P0", [1e10, 1e13, 1e16, 1e24])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (3, 2)])
@pytest.mark.parametrize("method", ["recursive", "auto"])
def test_a_prior_of_any_width_is_right(n, m, P0, q, method):
    F, Q, H, R, z = model(n, m, q, N=300)
    Q = (Q + Q.T) / 2
    found = estimate(
        State(np.zeros(n), P0 * np.eye(n)), Transition(F, Q, np.zeros(n)),
        Measurement(z, H, R, np.ones(len(z), dtype=bool)), method=method, keep_P=True,
    )  # fmt: skip
    x, sigma = exact(P0 * np.eye(n), F, Q, H, R, z[:6])
    np.testing.assert_allclose(found.sigma[:6], sigma, rtol=1e-4)
    assert np.max(np.abs(found.x[:6] - x) / sigma) < 1e-3
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.P, axis1=1, axis2=2)), found.sigma, rtol=1e-6)


def test_a_wide_prior_takes_gates_gaps_and_resets_as_another_does():
    """Samples after P has become narrow again give the plain filter's result; before, that of exact fractions."""
    F, Q, H, R, z = model(3, 2, 0.01, N=40)
    Q, used = (Q + Q.T) / 2, np.ones((40, 2), dtype=bool)
    used[0, 1] = used[1] = used[7] = False
    z[20] += 100
    reset = np.array([False, True, False])
    found = estimate(
        State(np.zeros(3), 1e16 * np.eye(3)), Transition(F, Q, np.zeros(3)), Measurement(z, H, R, used), gate=30.0,
        reset=reset, keep_P=True,
    )  # fmt: skip
    assert not found.used[[1, 7, 20]].any()
    assert found.sigma[1, 1] == found.sigma[7, 1] == found.x[20, 1] == 0
    again = estimate(
        State(found.x[9], found.P[9]), Transition(F, Q, np.zeros(3)), Measurement(z[10:], H, R, used[10:]), gate=30.0,
        reset=reset, method="plain",
    )  # fmt: skip
    np.testing.assert_allclose(found.x[10:], again.x, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.sigma[10:], again.sigma, rtol=1e-6)


@pytest.mark.parametrize("P0", [1e30, 1e200, 1e308])
def test_what_double_precision_cannot_hold_is_refused_by_name(P0):
    F, Q, H, R, z = model(2, 1, 1.0, N=10)
    with pytest.raises(TooWide, match="P at sample 0 of the stretch is too wide"):
        estimate(
            State(np.zeros(2), P0 * np.eye(2)), Transition(F, (Q + Q.T) / 2, np.zeros(2)),
            Measurement(z, 10 * H, R, np.ones(10, dtype=bool)),
        )  # fmt: skip


def test_sample_by_sample_a_wide_prior_is_right_or_refused():
    """P as a matrix does not hold what one of two directions was measured to, where the other is 1e16 wide."""
    state, H = State(np.zeros(2), 1e16 * np.eye(2)), np.array([[1.0, 1.0]])
    step, used = Transition(np.eye(2), np.zeros((2, 2)), np.zeros(2)), np.ones(1, dtype=bool)
    state = estimate(state, step, Measurement(np.array([[1.0]]), H, np.eye(1), used)).state
    with pytest.raises(TooWide, match="run more samples in one call"):
        estimate(state, step, Measurement(np.array([[1.0]]), H, np.eye(1), used))


def test_the_plain_steps_refuse_what_they_would_get_wrong():
    F, Q, H, R, z = model(2, 1, 1.0, N=10)
    with pytest.raises(TooWide):
        estimate(
            State(np.zeros(2), 1e16 * np.eye(2)), Transition(F, (Q + Q.T) / 2, np.zeros(2)),
            Measurement(z, H, R, np.ones(10, dtype=bool)), method="plain",
        )  # fmt: skip


def test_what_is_smoothed_from_a_wide_prior_agrees_with_a_line_through_all_samples():
    z = np.random.default_rng(3).normal(size=(200, 1))
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    given = Measurement(z, np.array([[1.0, 0.0]]), np.eye(1), np.ones(200, dtype=bool))
    state, steps = State(np.zeros(2), 1e16 * np.eye(2)), Transition(F, np.zeros((2, 2)), np.zeros(2))
    x, sigma = smooth(state, steps, given, estimate(state, steps, given))
    t = np.arange(200.0)
    (b, a), C = np.polyfit(t, z[:, 0], 1, cov="unscaled")
    np.testing.assert_allclose(x[-1], [a + b * t[-1], b], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(sigma[-1, 1], np.sqrt(C[0, 0]), rtol=1e-5)
