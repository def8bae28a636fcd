"""The loop's joint fit of map and effects against the dense Gaussian; its first look; and what is left."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import Covariance, multivariate_normal

from driftlab.loop import regression as module
from driftlab.loop.evidence import Evidence, Record
from driftlab.loop.regression import SMOOTHING, Fit, Regression, solution
from driftlab.loop.residue import dispersion, structures
from driftlab.loop.scan import SHARES, scan
from driftlab.loop.signals import Kept
from fusion_core.chunk import Chunk
from fusion_core.contracts import Basis
from fusion_core.whitening import ScalarFilter
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.thermal_lag import ThermalLag
from fusion_plugins.effects.turn_on import TurnOn

WHITE, WALK, REST = 1.5e-5, 4e-7, 1e-9  # rad/s/sqrt(Hz), rad/s/sqrt(s), rad
ONE = ("x",)
EFFECTS = (Hysteresis(axes=ONE, width="6 K"), TurnOn(axes=ONE, tau="300 s"), Channel(axes=ONE))
THETA = np.array([6e-6, -8e-5, 2e-5])


def the_filter(dt, fresh, walk=WALK):
    """Return the zero-velocity model of one axis: the integral of the rate, and its bias."""
    N = len(dt)
    F, Q, W = np.tile(np.eye(2), (N, 1, 1)), np.zeros((N, 2, 2)), np.zeros((N, 2, 2))
    F[:, 0, 1] = -dt
    Q[:, 0, 0] = WHITE**2 * dt
    W[:, 0, 0], W[:, 1, 1] = walk**2 * dt**3 / 3, walk**2 * dt
    W[:, 0, 1] = W[:, 1, 0] = -(walk**2) * dt**2 / 2
    b = np.stack([dt, np.zeros(N)], axis=1)
    return ScalarFilter(F, Q, W, b, np.array([1.0, 0.0]), REST**2, np.diag([REST**2, 1e-6]), fresh)


def evidence(sizes=(90, 60), axes=1, seed=0, walk=WALK, known=THETA, noise=None):
    """Return recordings made of a curve, effects, a turn-on offset, a walk and white noise (or the noise given)."""
    rng = np.random.default_rng(seed)
    records, steps = [], []
    for k, N in enumerate(sizes):
        dt = rng.uniform(8.0, 12.0, N)
        t = 100.0 + np.cumsum(dt)
        T = 20 + 15 * np.sin(t / (170 + 60 * k)) + rng.normal(size=N)
        chunk = Chunk(t, {"temperature": T, "voltage": 5 + rng.normal(size=N), "tau": dt})
        rate = np.empty((N, axes))
        for axis in range(axes):
            shown = sum(e.signature(chunk, None)[0][:, 0, 0] * c for e, c in zip(EFFECTS, known, strict=True))
            rough = WHITE / np.sqrt(dt) * rng.normal(size=N) if noise is None else noise(rng, N)
            moved = np.cumsum(walk * np.sqrt(dt) * rng.normal(size=N))
            rate[:, axis] = 1e-5 * np.tanh((T - 22) / 6) + shown + moved + rough + 1e-4 * rng.normal()
        fresh = np.arange(N) == 0
        records.append(Record(f"r{k}", k > 0, chunk.having(gyro=rate), fresh, None))
        steps.append((dt, fresh))
    dt, fresh = (np.concatenate(part) for part in zip(*steps, strict=True))
    return Evidence(tuple(records), (the_filter(dt, fresh),) * axes, ("x", "y", "z")[:axes], 10.0)


def hats(count=12, low=-2.0, high=42.0):
    """Return a map of straight lines, its bends penalised."""
    knots, bends = np.linspace(low, high, count), np.diff(np.eye(count), n=2, axis=0)
    return Basis(lambda T: np.stack([np.interp(T, knots, row) for row in np.eye(count)], axis=1), bends.T @ bends)


def lines():
    """Return a map of straight lines without a penalty."""
    return Basis(lambda T: np.vander((T - 20) / 20, 4), np.zeros((4, 4)))


@cache
def dense(found, log_ratio):
    """Return log det D, of what a rate does to the integrals that are measured, and C (N, N), their noise as rates.

    All states at once: (I - shifted F) x = b s + w; at a restart the state before is drawn anew from P.
    """
    model = found.evidence.filters[0]
    N, n = model.b.shape
    A, noise = np.eye(N * n), []
    for k in range(N):
        Q = model.Q[k] + np.exp(log_ratio) * model.walk[k]
        if model.fresh[k]:
            Q = Q + model.F[k] @ model.P @ model.F[k].T
        else:
            A[k * n : (k + 1) * n, (k - 1) * n : k * n] = -model.F[k]
        noise.append(Q)
    H = np.kron(np.eye(N), model.h) @ np.linalg.inv(A)
    D = H @ block_diag(*model.b[:, :, None])
    rates = np.linalg.solve(D, H)
    from_rest = np.linalg.inv(D)
    return np.linalg.slogdet(D)[1], rates @ block_diag(*noise) @ rates.T + model.r * from_rest @ from_rest.T


def generalised_least_squares(found, effects, smoothing, log_ratio):
    """Return theta, its covariance, the scale and the log-likelihood, the map's curves as part of the covariance."""
    chunks = found.evidence.chunks
    log_det, C = dense(found, log_ratio)
    X = np.concatenate([found.basis.values(chunk["temperature"]) for chunk in chunks])
    columns = [np.concatenate([centred(effect.signature(chunk, None)[0]) for chunk in chunks]) for effect in effects]
    Z, y = np.hstack([np.zeros((len(X), 0)), *columns]), found.evidence.rate[:, 0]
    e, U = np.linalg.eigh(found.penalty)  # the prior K has what the penalty cannot see to machine precision
    along = U.T @ found.prior(smoothing) @ U
    free = e < 1e-9
    assert free.sum() == (2 if found.rough else len(e))
    spread = X @ U[:, ~free] / np.sqrt(np.diag(along)[~free])
    V = C + spread @ spread.T + X @ U[:, free] @ (X @ U[:, free]).T / found.prior(0.0)[0, 0]
    inverse = np.linalg.inv(Z.T @ np.linalg.solve(V, Z))
    theta = inverse @ (Z.T @ np.linalg.solve(V, y))
    left = y - Z @ theta
    scale = np.sqrt(left @ np.linalg.solve(V, left) / len(y))
    gaussian = multivariate_normal(cov=Covariance.from_cholesky(scale * np.linalg.cholesky(V)))
    return theta, scale**2 * inverse, scale, gaussian.logpdf(left) - log_det


def centred(signature):
    return signature[:, 0] - signature[:, 0].mean(axis=0)


@pytest.fixture(scope="module")
def rough():
    return Regression(evidence(), hats())


# -- the fit ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("log_ratio", [-3.0, 0.0, 2.0])
@pytest.mark.parametrize("effects", [(), EFFECTS[:1], EFFECTS])
def test_the_fit_is_the_dense_gaussian_at_its_maximum(rough, effects, log_ratio):
    fit = rough.axis_at(effects, 0, log_ratio)
    theta, covariance, scale, log_likelihood = generalised_least_squares(rough, effects, fit.smoothing, log_ratio)
    assert fit.log_likelihood == pytest.approx(log_likelihood, rel=1e-6)
    assert fit.scale == pytest.approx(scale, rel=1e-6)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(fit.theta / sigma, theta / sigma, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(fit.covariance / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-5)
    on_grid = [generalised_least_squares(rough, effects, s, log_ratio)[3] for s in SMOOTHING[::2]]
    assert fit.log_likelihood > max(on_grid) - 1e-3


@pytest.mark.parametrize("smoothing", SMOOTHING[::6])
def test_any_smoothing_leaves_straight_lines_free(monkeypatch, rough, smoothing):
    """At the greatest too, where rounding in the penalty would count as much as epsilon."""
    monkeypatch.setattr(module, "SMOOTHING", np.array([smoothing]))
    fit = rough.axis_at(EFFECTS, 0, 0.0)
    assert fit.smoothing == smoothing
    *_, log_likelihood = generalised_least_squares(rough, EFFECTS, smoothing, 0.0)
    assert fit.log_likelihood == pytest.approx(log_likelihood, abs=1e-3)


def test_without_a_penalty_there_is_nothing_to_smooth():
    flat = Regression(evidence(), lines())
    fit = flat.axis_at(EFFECTS, 0, 0.0)
    theta, covariance, scale, log_likelihood = generalised_least_squares(flat, EFFECTS, 0.0, 0.0)
    assert fit.smoothing == 0
    assert fit.log_likelihood == pytest.approx(log_likelihood, rel=1e-6)
    np.testing.assert_allclose(fit.theta, theta, atol=1e-5 * np.sqrt(np.diag(covariance)).min())
    assert fit.scale == pytest.approx(scale, rel=1e-6)


def test_axes_share_what_is_alike_and_nothing_else():
    """Two axes with the same filter and one with a larger walk: each is fitted as it is alone."""
    whole = evidence(axes=3)
    own = whole.filters[0]
    filters = (own, own, replace(own, walk=9 * own.walk))
    together = Regression(replace(whole, filters=filters), lines())
    for axis, fit in enumerate(together.fit(()).axes):
        records = tuple(
            replace(record, chunk=record.chunk.having(gyro=record.chunk["gyro"][:, axis : axis + 1]))
            for record in whole.records
        )
        single = Regression(Evidence(records, (filters[axis],), ONE, 10.0), lines())
        single.weight = together.weight  # what epsilon is relative to is that of the first axis
        (alone,) = single.fit(()).axes
        assert fit.log_ratio == pytest.approx(alone.log_ratio, abs=1e-4)
        assert fit.log_likelihood == pytest.approx(alone.log_likelihood, abs=1e-4)
        np.testing.assert_allclose(fit.c, alone.c, rtol=1e-4)


def test_the_same_fit_is_made_once_and_is_of_the_effects_that_were_asked_for():
    found = Regression(evidence(), hats())
    first = found.fit(EFFECTS)
    others = tuple(effect.model_copy() for effect in EFFECTS)
    again = found.fit(others)
    assert again.axes is first.axes
    assert all(one is other for one, other in zip(again.effects, others, strict=True))
    assert found.fit(EFFECTS, near=first).axes is not first.axes


def test_what_is_kept_stays_right_and_little_whoever_asks():
    kept = Kept(4)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda k: kept.get(k % 9, lambda: k % 9 + 100), range(3000)))
    assert found == [k % 9 + 100 for k in range(3000)]
    assert len(kept) == 4


def test_what_the_fit_leaves_has_its_likelihood(rough):
    """Innovations with the coefficients taken out: unit variance, less what the smoothing kept back."""
    fit = rough.fit(EFFECTS)
    white, log_det = rough.innovations(fit, 0)
    own = fit.axes[0]
    N, K = len(white), rough.prior(own.smoothing)
    assert white @ white + own.c @ K @ own.c / own.scale**2 == pytest.approx(N, rel=1e-6)
    X = rough.white_map(EFFECTS, 0, own.log_ratio).X
    dets = np.linalg.slogdet(X.T @ X + K)[1] - np.linalg.slogdet(K)[1]
    expected = -0.5 * (N * np.log(2 * np.pi * own.scale**2) + np.sum(log_det) + dets + N)
    assert own.log_likelihood == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_the_fit_finds_what_was_put_in(seed):
    found = Regression(evidence(sizes=(700, 500), axes=2, seed=seed), hats())
    effects = tuple(e.model_copy(update={"axes": ("x", "y")}) for e in EFFECTS)
    fit = found.fit(effects)
    for axis in fit.axes:
        sigma = np.sqrt(np.diag(axis.covariance))
        assert np.all(np.abs(axis.theta - THETA) < 4 * sigma)
        assert np.all(sigma < 0.35 * np.abs(THETA))
        assert axis.scale == pytest.approx(1, abs=0.08)
    assert fit.log_likelihood > found.fit(()).log_likelihood + 20


def test_an_effect_twice_gets_one_share(rough):
    """What the recordings cannot tell apart gets no coefficient from nothing, and gains nothing."""
    once, twice = rough.axis_at(EFFECTS[2:], 0, 0.0), rough.axis_at((EFFECTS[2], EFFECTS[2]), 0, 0.0)
    assert twice.log_likelihood == pytest.approx(once.log_likelihood, abs=1e-6)
    np.testing.assert_allclose(twice.theta, np.repeat(once.theta, 2) / 2, rtol=1e-6)


# -- the first look --------------------------------------------------------------------------------------------------


def best_of_full_fits(found, base, effect):
    own = base.axes[0]
    full = [found.axis_at((*base.effects, effect), 0, own.log_ratio + share).log_likelihood for share in SHARES]
    return max(0.0, max(full) - own.log_likelihood)


CANDIDATES = [*EFFECTS, Drift(axes=ONE), Hysteresis(axes=ONE, width="2 K"), ThermalLag(axes=ONE, tau="40 s")]


@pytest.mark.parametrize("basis", [hats, lines])
@pytest.mark.parametrize("present", [(), EFFECTS[1:2]])
def test_the_first_look_gains_what_the_fit_gains_with_the_smoothing_kept(monkeypatch, basis, present):
    monkeypatch.setattr(module, "SMOOTHING", np.array([1e-3]))
    found = Regression(evidence(), basis())
    base = found.fit(present)
    scores = scan(found, base, CANDIDATES)
    for effect, score in zip(CANDIDATES, scores, strict=True):
        assert score.effect is effect
        assert score.gain == pytest.approx(best_of_full_fits(found, base, effect), rel=1e-6, abs=1e-5)
    assert max(score.gain for score in scores) > 5


def test_the_first_look_never_promises_too_much(rough):
    base = rough.fit(())
    for score in scan(rough, base, CANDIDATES):
        assert score.gain <= best_of_full_fits(rough, base, score.effect) + 1e-5


def test_solution_bears_any_units():
    rng = np.random.default_rng(1)
    M = rng.normal(size=(40, 6))
    units = 10.0 ** np.array([-12, -6, 0, 5, 9, 14])
    A, x = M.T @ M, rng.normal(size=(6, 3))
    for right in (x, x[:, 0]):
        u = units.reshape(-1, *[1] * (right.ndim - 1))
        found = solution(A * units[:, None] * units, u * (A @ right))
        np.testing.assert_allclose(found * u, right, rtol=1e-9)


def test_solution_of_what_is_not_determined_solves_and_is_small():
    """A column of nothing, and two that are one: the equations hold, and nothing is made of the rest."""
    M = np.random.default_rng(2).normal(size=(40, 3))
    M = np.hstack([M, M[:, :1], np.zeros((40, 1))])
    A, b = M.T @ M, M.T @ np.arange(40.0)
    x = solution(A, b)
    np.testing.assert_allclose(A @ x, b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(x, np.linalg.pinv(A, rcond=1e-10) @ b, rtol=1e-6, atol=1e-9)
    assert x[4] == 0


# -- what is left ----------------------------------------------------------------------------------------------------


def with_rate(made, rate):
    return Regression(
        Evidence(
            tuple(
                Record(r.name, r.train, r.chunk.having(gyro=part), r.fresh, None)
                for r, part in zip(made.records, made.split(rate), strict=True)
            ),
            made.filters, made.axes, made.interval,
        ), hats(),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_noise_leaves_nothing(seed):
    found = Regression(evidence(sizes=(700, 500), axes=2, seed=seed, known=np.zeros(3)), hats())
    fit = found.fit(())
    assert 1 <= dispersion(found, fit) < 1.1
    assert structures(found, fit) == []


def test_correlated_noise_is_dispersed():
    """An oscillation of noise, of some ten blocks: white on no scale, and no walk."""

    def coloured(rng, N):
        out, a = np.zeros(N + 2), 1.9 * np.cos(2 * np.pi / 12)
        for k in range(2, N + 2):
            out[k] = a * out[k - 1] - 0.95**2 * out[k - 2] + rng.normal()
        return out[2:] * 1e-5

    found = Regression(evidence(sizes=(700, 500), known=np.zeros(3), noise=coloured), hats())
    fit = found.fit(())
    assert dispersion(found, fit) > 1.5
    assert any("the innovations vary" in s.description and s.gain > s.threshold for s in structures(found, fit))


def test_a_jump_stands_out():
    made = evidence(sizes=(700, 500), known=np.zeros(3))
    before = Regression(made, hats())
    rate = made.rate.copy()
    rate[400:700] += 12 * WHITE / np.sqrt(10.0)
    found = with_rate(made, rate)
    fit = Fit((), found.fit(()).axes)
    (jump,) = [s for s in structures(found, fit) if s.description.startswith("jumps within")]
    assert jump.gain > jump.threshold
    assert jump.channel == "time"
    assert jump.time_scale in 10.0 * 2.0 ** np.arange(8)
    assert structures(before, before.fit(())) == []
