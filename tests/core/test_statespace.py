"""States made of blocks, and the step from continuous to discrete time, against what they must be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from fusion_core.discretize import van_loan
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, Prior, Transition
from fusion_core.statespace import Block, StateSpace

RNG = np.random.default_rng(0)
POSITION = Block("position", ("x", "y"), "m", Prior(np.array([1.0, 2.0]), np.diag([3.0, 4.0])))
VELOCITY = Block("velocity", ("x", "y"), "m/s", Prior(np.zeros(2), np.eye(2)))
BIAS = Block("bias", ("level", "slope"), ("m", "m/K"), Prior(np.ones(2), np.array([[2.0, 0.5], [0.5, 1.0]])))


def space():
    return StateSpace([POSITION, VELOCITY, BIAS])


def random_part(n=2, lead=()):
    root = RNG.normal(size=(*lead, n, n))
    return Transition(RNG.normal(size=(*lead, n, n)), root @ np.swapaxes(root, -1, -2), RNG.normal(size=(*lead, n)))


# blocks


def test_labels_are_preceded_by_the_block_only_where_another_has_them_too():
    assert space().labels == ["position_x", "position_y", "velocity_x", "velocity_y", "level", "slope"]
    assert space().units == ["m", "m", "m/s", "m/s", "m", "m/K"]
    assert space().places == {"position": slice(0, 2), "velocity": slice(2, 4), "bias": slice(4, 6)}
    assert StateSpace([POSITION]).labels == ["x", "y"]


def test_states_are_selected_by_block_and_by_label():
    np.testing.assert_array_equal(space().select("bias", "velocity_y"), [4, 5, 3])
    np.testing.assert_array_equal(space().flags("velocity"), [False, False, True, True, False, False])
    assert space().select().shape == (0,)


def test_the_prior_is_that_of_independent_blocks():
    state = StateSpace([POSITION, Block("integral", ("z",), "m s"), BIAS]).prior({"bias": VELOCITY.prior})
    np.testing.assert_array_equal(state.x, [1, 2, 0, 0, 0])
    np.testing.assert_array_equal(state.P, np.diag([3.0, 4.0, 0.0, 1.0, 1.0]))


def test_blocks_without_coupling_are_filters_of_their_own():
    parts = {"position": random_part(), "velocity": random_part(lead=(30,)), "bias": random_part()}
    z = RNG.normal(size=(30, 2))
    H, R, used = np.array([[1.0, 0.3], [0.0, 1.0]]), np.diag([0.5, 2.0]), np.ones(30, dtype=bool)
    whole = space()
    H_all = np.vstack([whole.output({name: H}) for name in parts])
    together = estimate(
        whole.prior(), whole.transition(parts), Measurement(np.tile(z, 3), H_all, np.kron(np.eye(3), R), used)
    )
    for name, part in parts.items():
        prior = whole.blocks[name].prior
        alone = estimate(StateSpace([whole.blocks[name]]).prior(), part, Measurement(z, H, R, used))
        assert prior is not None
        np.testing.assert_allclose(together.x[:, whole.places[name]], alone.x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(together.sigma[:, whole.places[name]], alone.sigma, rtol=1e-9)


@given(lead=st.lists(st.booleans(), min_size=5, max_size=5))
def test_a_step_is_what_the_blocks_say_one_by_one(lead):
    """x = F x + u, block by block with einsum, whichever of the arrays are the same for every step."""
    N = [(7,) if yes else () for yes in lead]
    parts = {"position": random_part(lead=N[0]), "bias": random_part(lead=N[1])}
    coupling = {("position", "bias"): RNG.normal(size=(*N[2], 2, 2)), ("velocity", "bias"): RNG.normal(size=(2, 2))}
    cross, own = RNG.normal(size=(*N[3], 2, 2)), np.eye(2) * np.ones((*N[4], 1, 1))
    found = space().transition(parts, coupling, {("position", "bias"): cross, ("velocity", "velocity"): own})
    x = RNG.normal(size=6)
    p, v, b = x[:2], x[2:4], x[4:]
    expected = [
        parts["position"].F @ p + coupling["position", "bias"] @ b + parts["position"].u,
        v + coupling["velocity", "bias"] @ b,
        parts["bias"].F @ b + parts["bias"].u,
    ]
    got = np.broadcast_to(found.F @ x + found.u, (7, 6))
    for k, part in enumerate(expected):
        np.testing.assert_allclose(got[:, 2 * k : 2 * k + 2], np.broadcast_to(part, (7, 2)), rtol=1e-12)
    Q = np.broadcast_to(found.Q, (7, 6, 6))
    np.testing.assert_array_equal(Q, Q.transpose(0, 2, 1))
    np.testing.assert_array_equal(Q[:, :2, 4:], np.broadcast_to(cross, (7, 2, 2)))
    np.testing.assert_array_equal(Q[:, 2:4, 2:4], np.broadcast_to(np.eye(2), (7, 2, 2)))
    assert not Q[:, 2:4, :2].any()
    assert not Q[:, 2:4, 4:].any()
    assert found.F.ndim == 3 if lead[0] or lead[1] or lead[2] else found.F.ndim == 2
    assert found.Q.ndim == 3 if lead[0] or lead[1] or lead[3] or lead[4] else found.Q.ndim == 2
    assert found.u.ndim == 2 if lead[0] or lead[1] else found.u.ndim == 1


def test_a_matrix_composed_of_a_coupled_system_is_the_system():
    """A constant-velocity model discretised as a whole, and put together from its blocks."""
    A, Q_c = np.zeros((4, 4)), np.zeros((4, 4))
    A[:2, 2:], Q_c[2:, 2:] = np.eye(2), np.diag([0.3, 0.7])
    F, Q = van_loan(A, Q_c, 0.4)
    both = StateSpace([POSITION, VELOCITY])
    found = both.transition(
        {
            "position": Transition(np.eye(2), Q[:2, :2], np.zeros(2)),
            "velocity": Transition(np.eye(2), Q[2:, 2:], np.zeros(2)),
        },
        {("position", "velocity"): 0.4 * np.eye(2)},
        {("position", "velocity"): Q[:2, 2:]},
    )
    np.testing.assert_allclose(found.F, F, rtol=1e-14)
    np.testing.assert_allclose(found.Q, Q, rtol=1e-14)


def test_an_output_has_zeros_where_nothing_is_measured():
    H = space().output({"velocity": np.eye(2), "bias": RNG.normal(size=(5, 2, 2))})
    assert H.shape == (5, 2, 6)
    assert not H[..., :2].any()
    np.testing.assert_array_equal(H[3, :, 2:4], np.eye(2))


def part(F=(2, 2), u=(2,)):
    return Transition(np.zeros(F), np.zeros((2, 2)), np.zeros(u))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda s: Block("b", ("x", "x"), "m"), r"block b: two of its labels are the same \(x, x\); rename one"),
        (lambda s: Block("b", ("x",), ("m", "m")), "block b: has 2 units for 1 labels; give one for each, or one"),
        (
            lambda s: Block("b", ("x",), "m", Prior(np.zeros(1), np.zeros(1))),
            r"block b: prior P has the shape \(1,\), \(1, 1\) was expected; ",
        ),
        (lambda s: StateSpace([BIAS, BIAS]), r"two of its blocks have the same name \(bias, bias\); rename one"),
        (
            lambda s: StateSpace([POSITION, VELOCITY, Block("a", ("position_x",), "m")]),
            r"labels are not unique \(.*\); rename one",
        ),
        (lambda s: s.select("speed"), "has no block or label 'speed'; name one of position, velocity, bias, pos"),
        (lambda s: s.prior({"speed": BIAS.prior}), "has no block 'speed'; name one of position, velocity, bias"),
        (lambda s: s.prior({"bias": Prior(np.zeros(3), np.eye(3))}), r"block bias: prior x has the shape \(3,\)"),
        (lambda s: s.transition({"bias": part(F=(3, 3))}), r"F of \(bias, bias\) has the shape \(3, 3\), \(2, 2\) or"),
        (lambda s: s.transition({"bias": part(u=(2, 9, 2))}), r"u of bias has the shape \(2, 9, 2\), \(2,\) or"),
        (lambda s: s.transition({"speed": part()}), "has no block 'speed'"),
        (lambda s: s.transition({}, {("bias", "bias"): np.eye(2)}), "coupling of bias with itself; put it into the F"),
        (
            lambda s: s.transition({"bias": part()}, noise={("bias", "bias"): np.zeros((1, 2))}),
            r"noise of \(bias, bias\) has the shape \(1, 2\)",
        ),
        (
            lambda s: s.transition({}, noise={("bias", "position"): np.eye(2), ("position", "bias"): np.eye(2)}),
            "give one, the other follows",
        ),
        (
            lambda s: s.transition({"bias": part(F=(4, 2, 2)), "position": part(F=(5, 2, 2))}),
            r"steps differ in number \(F of \(bias, bias\) 4, F of \(position, position\) 5\); give each N of them",
        ),
        (lambda s: s.output({}), "no block is measured; name at least one"),
        (lambda s: s.output({"bias": np.ones(2)}), r"H of bias has the shape \(2,\), \(1, 2\) or \(N, 1, 2\) was"),
        (lambda s: s.output({"bias": np.ones((1, 2)), "position": np.eye(2)}), r"H of bias has the shape \(1, 2\)"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused_by_name(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong(space())


# van Loan


def random_system(n, scale=1.0):
    root = RNG.normal(size=(n, n))
    return RNG.normal(size=(n, n)) * scale, root @ root.T


@given(n=st.integers(1, 6), a=st.floats(1e-9, 2.0), b=st.floats(1e-9, 2.0))
@settings(max_examples=40)
def test_two_steps_are_one(n, a, b):
    A, Q_c = random_system(n)
    (F_a, Q_a), (F_b, Q_b), (F, Q) = (van_loan(A, Q_c, dt) for dt in (a, b, a + b))
    scale = np.abs(Q).max()
    np.testing.assert_allclose(F_b @ F_a, F, rtol=1e-9, atol=1e-10 * np.abs(F).max())
    np.testing.assert_allclose(F_b @ Q_a @ F_b.T + Q_b, Q, rtol=1e-9, atol=1e-10 * scale)


def test_it_solves_the_equation_of_lyapunov():
    """dQ/dt = A Q + Q A' + Q_c, integrated numerically."""
    A, Q_c = random_system(4, 0.7)

    def rate(_, q):
        Q = q.reshape(4, 4)
        return (A @ Q + Q @ A.T + Q_c).ravel()

    expected = solve_ivp(rate, (0, 1.7), np.zeros(16), method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1].reshape(4, 4)
    np.testing.assert_allclose(van_loan(A, Q_c, 1.7)[1], expected, rtol=1e-9)


@pytest.mark.parametrize("dt", [0.0, 1e-6, 0.02, 3.0, 5e4])
def test_constant_velocity_random_walk_and_gauss_markov_in_closed_form(dt):
    q, tau = 0.3, 20.0
    F, Q = van_loan([[0.0, 1.0], [0.0, 0.0]], np.diag([0.0, q]), dt)
    np.testing.assert_allclose(F, [[1, dt], [0, 1]], rtol=1e-12)
    np.testing.assert_allclose(Q, q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), rtol=1e-11)
    F, Q = van_loan([[0.0, 1.0, 0], [0.0, 0.0, 1.0], [0, 0, 0]], np.diag([0.0, 0.0, q]), dt)  # twice integrated
    np.testing.assert_allclose(Q[0], q * np.array([dt**5 / 20, dt**4 / 8, dt**3 / 6]), rtol=1e-10)
    F, Q = van_loan([[-1 / tau]], [[2 * q / tau]], dt)
    np.testing.assert_allclose(F, [[np.exp(-dt / tau)]], rtol=1e-10, atol=1e-300)
    np.testing.assert_allclose(Q, [[-q * np.expm1(-2 * dt / tau)]], rtol=1e-10)


def test_a_step_far_longer_than_the_time_constant_ends_in_the_steady_state():
    """A step of 10,000 time constants, over which exp(-A dt) overflows."""
    F, Q = van_loan([[-1.0, 0.5], [0.0, -3.0]], np.eye(2), 1e4)
    np.testing.assert_allclose(F, 0, atol=1e-300)
    A = np.array([[-1.0, 0.5], [0.0, -3.0]])
    np.testing.assert_allclose(A @ Q + Q @ A.T, -np.eye(2), atol=1e-12)


def test_each_step_is_as_it_is_alone():
    dt = RNG.choice([0.01, 0.011, 4.0], size=50)
    A, Q_c = random_system(3, 0.5)
    F, Q = van_loan(A, Q_c, dt)
    assert F.shape == Q.shape == (50, 3, 3)
    vary = A + RNG.normal(size=(50, 3, 3))
    F_v, Q_v = van_loan(vary, Q_c, dt)
    F_w, Q_w = van_loan(A, np.tile(Q_c, (50, 1, 1)), 0.3)
    assert F_w.shape == Q_w.shape == (50, 3, 3)
    for k in range(0, 50, 7):
        for got, alone in (
            ((F[k], Q[k]), van_loan(A, Q_c, dt[k])),
            ((F_v[k], Q_v[k]), van_loan(vary[k], Q_c, dt[k])),
            ((F_w[k], Q_w[k]), van_loan(A, Q_c, 0.3)),
        ):
            for one, other in zip(got, alone, strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-11 * np.abs(other).max())
    assert van_loan(A, Q_c, 0.3)[0].shape == (3, 3)


@pytest.mark.parametrize(
    ("A", "Q_c", "dt", "message"),
    [
        (np.zeros(3), np.eye(3), 1.0, r"van_loan: A has the shape \(3,\), \(n, n\) or \(N, n, n\) was expected; "),
        (np.zeros((3, 2)), np.eye(2), 1.0, r"van_loan: A has the shape \(3, 2\), \(2, 2\) or \(N, 2, 2\) was"),
        (np.eye(2), np.eye(3), 1.0, r"van_loan: Q_c has the shape \(3, 3\), \(2, 2\) or"),
        (np.eye(2), np.eye(2), np.ones((3, 1)), r"van_loan: dt has the shape \(3, 1\)"),
        (np.ones((4, 2, 2)), np.eye(2), np.ones(5), r"van_loan: steps differ in number \(A 4, dt 5\); give each N"),
        (np.eye(2), np.eye(2), -0.1, "van_loan: dt has a value that is negative or not finite; time stamps must not"),
        (np.eye(2), np.eye(2), np.array([0.1, np.nan]), "van_loan: dt has a value that is negative or not finite"),
    ],
)
def test_what_is_not_a_system_is_refused(A, Q_c, dt, message):
    with pytest.raises(ValueError, match=message):
        van_loan(A, Q_c, dt)
