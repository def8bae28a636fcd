"""The filter against independent derivations: the textbook twin, filterpy, the joint posterior, extended precision."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_core.contracts import Transition
from fusion_core.fast.groups import find_groups
from fusion_core.fast.steady import invariant, steady_state
from fusion_core.kalman import correct, estimate, expected, predict
from fusion_core.model import Measurement, State, join
from fusion_core.smoother import smooth


def triad(dt=0.1, white=1.54e-5, walk=8.7e-6, rest=1e-6, d=3):
    """An integral of white noise and a walking bias: the shape of the zero-velocity model."""
    one, none = np.eye(d), np.zeros((d, d))
    F = np.block([[one, -dt * one], [none, one]])
    Q = np.block(
        [
            [(white**2 * dt + walk**2 * dt**3 / 3) * one, -(walk**2) * dt**2 / 2 * one],
            [-(walk**2) * dt**2 / 2 * one, walk**2 * dt * one],
        ]
    )
    return F, Q, np.hstack([one, none]), rest**2 * one


def twelve(dt=0.1):
    """Two triads: gyro and accelerometer, n = 12, m = 6."""
    parts = [triad(dt), triad(dt, white=8.3e-4, walk=5.6e-4, rest=1e-5)]
    return tuple(scipy.linalg.block_diag(*(part[k] for part in parts)) for k in range(4))


def simulate(F, Q, H, R, P, N, rng):
    """Draw states, a drift and measurements from the model; return the drift and the measurements."""
    n, m = len(F), len(H)
    u = rng.normal(size=(N, n)) * np.sqrt(np.diag(Q) + 1e-30)
    x = rng.multivariate_normal(np.zeros(n), P)
    z = np.empty((N, m))
    for k in range(N):
        x = F @ x + u[k] + rng.multivariate_normal(np.zeros(n), Q, method="eigh")
        z[k] = H @ x + rng.multivariate_normal(np.zeros(m), R)
    return u, z


def random_model(rng, N, n, m):
    """A time-varying model with full Q and R."""
    F = np.eye(n) + 0.1 * rng.normal(size=(N, n, n))
    F /= np.maximum(1.0, np.abs(np.linalg.eigvals(F)).max(axis=1))[:, None, None]
    L, M = rng.normal(size=(N, n, n)), rng.normal(size=(N, m, m))
    Q, R = L @ L.transpose(0, 2, 1), M @ M.transpose(0, 2, 1) + 0.1 * np.eye(m)
    H = rng.normal(size=(N, m, n))
    return Transition(F, Q, rng.normal(size=(N, n))), Measurement(rng.normal(size=(N, m)), H, R, np.ones(N, dtype=bool))


def assert_same(a, b, tolerance):
    sigma = np.sqrt(np.einsum("kii->ki", b.P))
    scale = sigma[:, :, None] * sigma[:, None, :] + 1e-300
    assert np.max(np.abs(a.x - b.x) / (sigma + 1e-300)) < tolerance
    assert np.max(np.abs(a.P - b.P) / scale) < tolerance
    for name in ("white", "nis", "log_det"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(a.y, b.y, rtol=tolerance, atol=tolerance * np.nanmax(np.abs(b.y)))
    np.testing.assert_array_equal(a.used, b.used)


def test_the_recursion_equals_its_readable_twin():
    transition, measurement = random_model(np.random.default_rng(1), N=60, n=5, m=3)
    measurement.used[::7] = False
    start = State(np.arange(5.0), np.diag([1.0, 2.0, 0.0, 3.0, 4.0]))
    reset = np.array([True, False, False, False, True])
    kwargs = {"gate": 12.0, "reset": reset}
    fast = estimate(start, transition, measurement, keep_P=True, **kwargs)
    plain = estimate(start, transition, measurement, method="plain", keep_P=True, **kwargs)
    assert 0 < np.sum(~plain.used) < 60
    assert_same(fast, plain, 1e-9)


@pytest.mark.parametrize("which", ["ordinary", "not quite symmetric", "correlated", "missing", "refused"])
def test_one_sample_at_a_time_equals_the_readable_twin(which):
    """Each in a call of its own, as a live run and an error state ask: most by one compiled call, the others by all."""
    transition, measured = random_model(np.random.default_rng(1), N=60, n=5, m=3)
    state, gate = State(np.arange(5.0), np.diag([1.0, 2.0, 0.0, 3.0, 4.0])), 4.0 if which == "refused" else np.inf
    R = measured.R if which == "correlated" else measured.R * np.eye(3)
    used = np.random.default_rng(2).random((60, 3)) > (0.3 if which == "missing" else -1)
    measured, reset = Measurement(measured.z, measured.H, R, used), np.array([True, False, False, False, True])
    plain = estimate(state, transition, measured, method="plain", keep_P=True, gate=gate, reset=reset)
    parts = []
    for k in range(60):
        rows = slice(k, k + 1)
        if which == "not quite symmetric":
            state.P[0, 1] *= 1 + 1e-12
        given = transition.part(rows), measured.part(rows)
        parts.append(estimate(state, *given, keep_P=True, gate=gate, reset=reset))
        state = parts[-1].state
    found = join(parts)
    assert_same(found, plain, 1e-9)
    np.testing.assert_array_equal(found.dof, plain.dof)
    np.testing.assert_allclose(found.sigma, plain.sigma, rtol=1e-9)


@pytest.mark.parametrize("of", ["z", "H", "u", "F", "P", "Q"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_one_sample_that_is_not_finite_is_refused(of, value):
    F, P, Q, z, H, u = np.eye(2), np.eye(2), np.eye(2), np.zeros((1, 1)), np.eye(1, 2), np.zeros(2)
    {"F": F, "P": P, "Q": Q, "z": z, "H": H, "u": u}[of][0] = value
    with pytest.raises(ValueError, match=r"finite|NaN"):
        estimate(State(np.zeros(2), P), Transition(F, Q, u), Measurement(z, H, np.eye(1), np.ones(1, dtype=bool)))


@pytest.mark.parametrize("C", [np.eye(2), np.ones((1, 1, 2))])
def test_one_sample_of_a_model_whose_bias_is_a_function_of_states(C):
    state, F, u = State(np.zeros(2), np.eye(2)), np.eye(2), np.array([1.0, 2.0])
    measured = Measurement(np.ones((1, 2)), np.eye(2), np.eye(2), np.ones(1, dtype=bool))
    plain, found = (estimate(state, Transition(F, F, u, of), measured, keep_P=True) for of in (None, C))
    assert_same(found, plain, 1e-12)


def assert_is_filterpys(F, Q, H, R, P, u, z, method):
    (N, n), m = u.shape, len(H)
    ours = estimate(State(np.zeros(n), P), Transition(F, Q, u), Measurement(z, H, R, np.ones(N, bool)), method=method)
    theirs = KalmanFilter(dim_x=n, dim_z=m, dim_u=n)
    theirs.x, theirs.P, theirs.F, theirs.Q, theirs.H, theirs.R = np.zeros((n, 1)), P, F, Q, H, R
    for k in range(N):
        theirs.predict(u=u[k][:, None], B=np.eye(n))
        theirs.update(z[k][:, None])
        sigma = np.sqrt(np.diag(theirs.P))
        assert np.max(np.abs(ours.x[k] - theirs.x[:, 0]) / sigma) < 1e-9
        assert np.max(np.abs(ours.sigma[k] / sigma - 1)) < 1e-9


def test_the_recursion_equals_filterpy():
    F, Q, H, R = twelve()
    rng = np.random.default_rng(2)
    P0 = np.diag([1e-10] * 3 + [1e-6] * 3 + [1e-8] * 3 + [1e-4] * 3)
    u, z = simulate(F, Q, H, R, P0, 500, rng)
    assert_is_filterpys(F, Q, H, R, P0, u, z, "recursive")


@pytest.mark.parametrize("method", ["recursive", "steady"])
@pytest.mark.parametrize(("n", "m"), [(5, 2), (13, 6)])
def test_states_that_are_all_coupled_equal_filterpy(n, m, method):
    """Fours of sums and what is left of them; gains that change, and those that stay."""
    rng, N = np.random.default_rng(n), 1200
    F, H = 0.97 * np.linalg.qr(rng.normal(size=(n, n)))[0], rng.normal(size=(m, n))
    Q, R = 0.01 * np.eye(n), np.diag(rng.uniform(0.5, 2.0, m))
    u, z = simulate(F, Q, H, R, np.eye(n), N, rng)
    assert_is_filterpys(F, Q, H, R, np.eye(n), u, z, method)


@pytest.mark.parametrize("rate_variance", [1e-12, 1e-8, 1e-4])
def test_steady_gains_equal_the_recursion(rate_variance):
    F, Q, H, R = twelve()
    P0 = np.diag([0.0] * 3 + [rate_variance] * 3 + [0.0] * 3 + [rate_variance] * 3)
    u, z = simulate(F, Q, H, R, P0, 4000, np.random.default_rng(3))
    args = State(np.zeros(12), P0), Transition(F, Q, u), Measurement(z, H, R, np.ones(4000, bool))
    long, short = (estimate(*args, method=method, keep_P=True) for method in ("recursive", "steady"))
    sigma = np.sqrt(np.einsum("kii->ki", long.P))
    assert np.max(np.abs(short.x - long.x) / sigma) < 1e-7
    assert np.max(np.abs(short.P - long.P) / (sigma[:, :, None] * sigma[:, None, :])) < 1e-10
    assert np.max(np.abs(short.white - long.white)) < 1e-7


def test_both_methods_against_extended_precision():
    """The textbook recursion in 80-bit arithmetic, over a stretch with the prior's transient in it."""
    F, Q, H, R = triad(d=1)
    P0 = np.diag([0.0, 1e-6])
    u, z = simulate(F, Q, H, R, P0, 20_000, np.random.default_rng(4))
    F_, Q_, R_ = (a.astype(np.longdouble) for a in (F, Q, R))
    x, P = np.zeros(2, dtype=np.longdouble), P0.astype(np.longdouble)
    exact_x, exact_P = np.empty((len(z), 2)), np.empty((len(z), 2, 2))
    for k in range(len(z)):
        x, P = F_ @ x + u[k], F_ @ P @ F_.T + Q_
        s = P[0, 0] + R_[0, 0]
        K = P[:, 0] / s
        x, P = x + K * (z[k, 0] - x[0]), P - np.outer(K, P[0])
        exact_x[k], exact_P[k] = x, P
    sigma = np.sqrt(np.einsum("kii->ki", exact_P))
    for method in ("recursive", "steady"):
        ours = estimate(
            State(np.zeros(2), P0),
            Transition(F, Q, u),
            Measurement(z, H, R, np.ones(len(z), bool)),
            method=method,
            keep_P=True,
        )
        assert np.max(np.abs(ours.x - exact_x) / sigma) < 1e-7
        assert np.max(np.abs(ours.P - exact_P) / (sigma[:, :, None] * sigma[:, None, :])) < 1e-10


def test_filter_and_smoother_equal_the_joint_posterior():
    """All states at once by one linear solve of the Gaussian's information form."""
    rng = np.random.default_rng(5)
    N, n, m = 12, 3, 2
    transition, measurement = random_model(rng, N, n, m)
    P0 = np.eye(n) * 2.0
    x0 = rng.normal(size=n)

    def joint(used_until):
        """Mean and covariance of x_0 .. x_N given the first measurements."""
        size = (N + 1) * n
        information, vector = np.zeros((size, size)), np.zeros(size)
        information[:n, :n] += np.linalg.inv(P0)
        vector[:n] += np.linalg.solve(P0, x0)
        for k in range(N):
            W = np.linalg.inv(transition.Q[k])
            D = np.zeros((n, size))
            D[:, k * n : (k + 1) * n], D[:, (k + 1) * n : (k + 2) * n] = -transition.F[k], np.eye(n)
            information += D.T @ W @ D
            vector += D.T @ W @ transition.u[k]
            if k < used_until:
                M = np.zeros((m, size))
                M[:, (k + 1) * n : (k + 2) * n] = measurement.H[k]
                V = np.linalg.inv(measurement.R[k])
                information += M.T @ V @ M
                vector += M.T @ V @ measurement.z[k]
        return np.linalg.solve(information, vector).reshape(N + 1, n)[1:], np.linalg.inv(information)

    found = estimate(State(x0, P0), transition, measurement, keep_P=True)
    for k in range(N):
        mean, covariance = joint(k + 1)
        np.testing.assert_allclose(found.x[k], mean[k], rtol=1e-8, atol=1e-8)
        block = slice((k + 1) * n, (k + 2) * n)
        np.testing.assert_allclose(found.P[k], covariance[block, block], rtol=1e-8, atol=1e-8)
    x, sigma = smooth(State(x0, P0), transition, measurement, found)
    mean, covariance = joint(N)
    np.testing.assert_allclose(x, mean, rtol=1e-7, atol=1e-7)
    for k in range(N):
        block = slice((k + 1) * n, (k + 2) * n)
        np.testing.assert_allclose(sigma[k] ** 2, np.diag(covariance)[block], rtol=1e-7, atol=1e-7)


def test_likelihood_equals_the_joint_density():
    """The innovations' likelihood is the density of all measurements as one Gaussian vector."""
    F, Q, H, R = triad(d=1, white=1e-2, walk=1e-2, rest=1e-2)
    P0 = np.diag([0.3, 0.7])
    N = 30
    u, z = simulate(F, Q, H, R, P0, N, np.random.default_rng(6))
    powers = [np.eye(2)]
    for _ in range(N):
        powers.append(F @ powers[-1])
    mean = np.array([H @ sum((powers[k - j] @ u[j] for j in range(k + 1)), np.zeros(2)) for k in range(N)]).ravel()
    covariance = np.empty((N, N))
    for i in range(N):
        for j in range(i, N):
            state = powers[i + 1] @ P0 @ powers[j + 1].T
            state = state + sum(powers[i - k] @ Q @ powers[j - k].T for k in range(i + 1))
            covariance[i, j] = covariance[j, i] = (H @ state @ H.T)[0, 0] + (R[0, 0] if i == j else 0.0)
    residual = z.ravel() - mean
    expected = -0.5 * (
        residual @ np.linalg.solve(covariance, residual) + np.linalg.slogdet(covariance)[1] + N * np.log(2 * np.pi)
    )
    found = estimate(State(np.zeros(2), P0), Transition(F, Q, u), Measurement(z, H, R, np.ones(N, bool)))
    assert found.log_likelihood() == pytest.approx(expected, rel=1e-9)


@given(cuts=st.lists(st.integers(1, 399), max_size=5), missing=st.integers(0, 399))
@settings(max_examples=25)
def test_any_split_gives_the_same_estimates(cuts, missing):
    F, Q, H, R = twelve()
    P0 = np.diag([0.0] * 3 + [1e-6] * 3 + [0.0] * 3 + [1e-4] * 3)
    u, z = simulate(F, Q, H, R, P0, 400, np.random.default_rng(7))
    used = np.ones(400, bool)
    used[missing] = False
    whole = estimate(State(np.zeros(12), P0), Transition(F, Q, u), Measurement(z, H, R, used))
    state, parts = State(np.zeros(12), P0), []
    edges = sorted({0, 400, *cuts})
    for a, b in pairwise(edges):
        part = estimate(state, Transition(F, Q, u[a:b]), Measurement(z[a:b], H, R, used[a:b]))
        state = part.state
        parts.append(part.x)
    assert np.max(np.abs(np.concatenate(parts) - whole.x) / whole.sigma.max(axis=0)) < 1e-7


@pytest.mark.parametrize("driven", [True, False])
def test_gate_takes_the_same_samples_with_both_methods(driven):
    F, Q, H, R = twelve()
    P0 = np.diag([0.0] * 3 + [1e-6] * 3 + [0.0] * 3 + [1e-4] * 3)
    u, z = simulate(F, Q, H, R, P0, 3000, np.random.default_rng(8))
    if driven:
        u[1000:1040, :3] += 1e-3
        u[2500, 7] += 1.0
    args = State(np.zeros(12), P0), Transition(F, Q, u), Measurement(z, H, R, np.ones(3000, bool))
    reset = np.array([True] * 3 + [False] * 3 + [True] * 3 + [False] * 3)
    auto, long = (estimate(*args, gate=50.0, reset=reset, method=method) for method in ("auto", "recursive"))
    np.testing.assert_array_equal(auto.used, long.used)
    assert bool(np.all(auto.used)) is not driven
    assert np.max(np.abs(auto.x - long.x) / long.sigma.max(axis=0)) < 1e-7


def test_steady_state_solves_the_riccati_equation():
    F, Q, H, R = twelve()
    found = steady_state(F, Q, H, R)
    expected = scipy.linalg.solve_discrete_are(F.T, H.T, Q, R)
    sigma = np.sqrt(np.diag(expected))
    assert np.max(np.abs(found[1] - expected) / np.outer(sigma, sigma)) < 1e-9


def test_gains_ahead_of_the_data_are_those_of_the_textbook():
    F, Q, H, R = uneven()
    P = np.diag([0.0, 1e-6, 0.0, 1e-6, 1e-6, 1e-4])
    model = invariant(F, Q, H, np.diag(R), P)
    gains, N = model.gains_from(model.groups.blocks(P, model.groups.states, model.groups.states), 500)
    assert N == 500
    state = State(np.zeros(6), P)
    for k in range(N):
        state, _, S = correct(predict(state, F, Q, np.zeros(6)), np.zeros(2), H, R)
        sigma = np.sqrt(np.diag(state.P)) + 1e-300
        np.testing.assert_allclose(gains.sigma(model.groups)[k], sigma, rtol=1e-9)
        found = model.groups.whole(gains.P[k, gains.kind])
        assert np.max(np.abs(found - state.P) / np.outer(sigma, sigma)) < 1e-9
        assert gains.log_det[k] == pytest.approx(np.linalg.slogdet(S)[1], abs=1e-9)


def test_groups_that_are_alike_share_their_gains():
    F, Q, H, R = twelve()
    P = np.diag([0.0] * 3 + [1e-6] * 3 + [0.0] * 3 + [1e-4] * 3)
    model = invariant(F, Q, H, np.diag(R), P)
    gains, _ = model.gains_from(model.groups.blocks(P, model.groups.states, model.groups.states), 10)
    assert gains.kind.tolist() == [0, 0, 0, 1, 1, 1]
    assert gains.P.shape == (10, 2, 2, 2)


def test_no_steady_state_without_driving_noise():
    """The gains never stay the same; they are known before the data all the same."""
    F, Q, H, R = triad(walk=0.0)
    assert steady_state(F, Q, H, R) is None
    P0 = np.diag([0.0] * 3 + [1e-6] * 3)
    u, z = simulate(F, Q, H, R, P0, 5000, np.random.default_rng(11))
    args = State(np.zeros(6), P0), Transition(F, Q, u), Measurement(z, H, R, np.ones(5000, bool))
    short, long = (estimate(*args, method=method, keep_P=True) for method in ("steady", "recursive"))
    assert_same(short, long, 1e-9)


def test_covariance_stays_positive_over_ten_million_steps():
    """Realistic parameters, hardest where the reference is far stiller than the white noise (r << h P h')."""
    F, Q, H, R = twelve(dt=0.01)
    N = 100_000
    z, u, used = np.zeros((N, 6)), np.zeros(12), np.ones(N, bool)
    state = State(np.zeros(12), np.diag([0.0] * 3 + [1.0] * 3 + [0.0] * 3 + [1.0] * 3))
    for _ in range(100):
        state = estimate(state, Transition(F, Q, u), Measurement(z, H, R, used), method="recursive").state
    np.testing.assert_array_equal(state.P, state.P.T)
    assert np.linalg.eigvalsh(state.P).min() > 0
    expected = steady_state(F, Q, H, R)[0]
    sigma = np.sqrt(np.diag(expected))
    assert np.max(np.abs(state.P - expected) / np.outer(sigma, sigma)) < 1e-8


def uneven(dt=0.1):
    """Groups of different size: an integral and its bias, one with two biases, and a state that nothing sees."""
    F, Q, H, R = triad(dt, d=1)
    F = scipy.linalg.block_diag(F, F, [[0.9]], [[0.99]])
    F[2, 4] = -0.09
    Q = scipy.linalg.block_diag(Q, Q, [[1e-12]], [[1e-10]])
    H = np.hstack([scipy.linalg.block_diag(H, H), np.zeros((2, 2))])
    return F, Q, H, scipy.linalg.block_diag(R, R)


def test_independent_states_are_found_and_nothing_more():
    F, Q, H, _ = uneven()
    order = np.array([3, 0, 5, 1, 4, 2])  # mixed up: groups need not be neighbours
    F, Q, H = F[np.ix_(order, order)], Q[np.ix_(order, order)], H[:, order]
    found = find_groups(F[None], Q[None], H[None], np.eye(6))
    names = [{int(order[i]) for i in states if i < 6} for states in found.states]
    assert sorted(map(sorted, names)) == [[0, 1], [2, 3, 4], [5]]
    assert not found.ordered
    coupled = np.eye(6)
    coupled[2, 0] = coupled[0, 2] = 0.1
    assert len(find_groups(F[None], Q[None], H[None], coupled).states) == 2
    late = np.stack([F, F])
    late[1, 2, 0] = -1e-300  # once is enough, however small; a negative zero is none
    late[0, 1, 0] = -0.0
    assert len(find_groups(late, Q[None], H[None], np.eye(6)).states) == 2


@pytest.mark.parametrize("method", ["recursive", "auto"])
def test_groups_of_different_size_equal_the_textbook(method):
    F, Q, H, R = uneven()
    P0 = np.diag([0.0, 1e-6, 0.0, 1e-6, 1e-6, 1e-4])
    u, z = simulate(F, Q, H, R, P0, 3000, np.random.default_rng(9))
    args = State(np.zeros(6), P0), Transition(F, Q, u), Measurement(z, H, R, np.ones(3000, bool))
    ours, plain = estimate(*args, method=method, keep_P=True), estimate(*args, method="plain", keep_P=True)
    assert_same(ours, plain, 1e-8)


@pytest.mark.parametrize(("s", "m", "G"), [(1, 1, 13), (2, 2, 12), (3, 2, 9), (6, 3, 2), (8, 2, 3)])
def test_groups_side_by_side_equal_the_textbook(s, m, G):
    """More groups than one instruction has, more states than its registers, and two kinds of groups among them."""
    rng, N = np.random.default_rng(s), 300
    kinds = [0.97 * np.linalg.qr(rng.normal(size=(s, s)))[0] for _ in range(2)]
    F = scipy.linalg.block_diag(*(kinds[g % 2] for g in range(G)))
    H = scipy.linalg.block_diag(*[rng.normal(size=(m, s))] * G)
    P0, Q, R = np.eye(s * G), 0.01 * np.eye(s * G), np.diag(np.tile(rng.uniform(0.5, 2.0, m), G))
    u, z = simulate(F, Q, H, R, P0, N, rng)
    args = State(np.zeros(s * G), P0), Transition(F, Q, u), Measurement(z, H, R, np.ones(N, bool))
    ours, plain = (estimate(*args, method=method, keep_P=True) for method in ("steady", "plain"))
    assert_same(ours, plain, 1e-8)


def test_expected_states_are_the_recursion_without_measurements():
    transition, _ = random_model(np.random.default_rng(10), N=50, n=3, m=1)
    x = np.ones(3)
    found = expected(x, transition, 50)
    for k in range(50):
        x = transition.F[k] @ x + transition.u[k]
        np.testing.assert_allclose(found[k], x, rtol=1e-9, atol=1e-12)
