"""Many units with shared gains, beside each of them alone and beside filterpy."""

import numpy as np
import pytest
import scipy.linalg
from filterpy.kalman import KalmanFilter

from fusion_core.fast import loop
from fusion_core.fast.fleet import run_fleet
from fusion_core.fast.steady import invariant
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State, Transition


def triad(dt, white, walk, rest):
    one, none = np.eye(3), np.zeros((3, 3))
    F = np.block([[one, -dt * one], [none, one]])
    Q = np.kron(
        [[white**2 * dt + walk**2 * dt**3 / 3, -(walk**2) * dt**2 / 2], [-(walk**2) * dt**2 / 2, walk**2 * dt]], one
    )
    return F, Q, np.hstack([one, none]), rest**2 * one


def two_triads():
    """Two triads of different noise, n = 12 and m = 6, states sensor by sensor."""
    parts = [triad(0.1, 1.54e-5, 8.7e-6, 1e-6), triad(0.1, 8.3e-4, 5.6e-4, 1e-5)]
    return tuple(scipy.linalg.block_diag(*(part[k] for part in parts)) for k in range(4))


def uneven():
    """Groups of three states, two, and one, the last of which sees two components; in no order."""
    F = np.eye(6)
    F[0, 2], F[2, 4], F[1, 5] = 0.1, -0.2, 0.3
    F[4, 4] = F[5, 5] = 0.9
    Q = np.diag([1.0, 2.0, 0.5, 0.3, 0.2, 1.5])
    H = np.zeros((4, 6))
    H[0, 1], H[1, 0], H[2, 3], H[3, 3] = 1.0, 1.0, 2.0, -1.0
    return F, Q, H, np.diag([0.5, 1.0, 2.0, 0.7])


def dealt(model, U, T, seed=0, *, own):
    """A start, steps, and what U units measure: walks as wide as the model expects."""
    F, Q, H, _ = model
    rng, n, m = np.random.default_rng(seed), len(F), len(H)
    P = np.diag(rng.uniform(0.5, 2.0, n)) * np.max(Q)
    z = np.cumsum(rng.normal(size=(T, m, U)), axis=0) * np.sqrt(np.max(Q) / 4)
    u = rng.normal(size=(T, n, U)) * np.sqrt(np.max(Q)) / 10 if own else None
    x = rng.normal(size=(n, U)) * np.sqrt(np.max(Q))
    return State(x, P), Transition(F, Q, rng.normal(size=n) * np.sqrt(np.max(Q)) / 10), z, u


def alone(model, start, steps, z, u, k, gate=np.inf):
    drift = steps.u if u is None else u[:, :, k]
    measured = Measurement(np.ascontiguousarray(z[:, :, k]), *model[2:], np.ones(len(z), dtype=bool))
    return estimate(State(start.x[:, k], start.P), Transition(*model[:2], drift), measured, gate=gate)


@pytest.mark.parametrize("model", [two_triads(), uneven()], ids=["triads", "uneven"])
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize(("U", "every", "threads"), [(1, 1, 1), (20, 7, 1), (70, 32, 2), (1100, 16, 2)])
def test_each_unit_is_as_it_is_alone(model, own, U, every, threads):
    T = 2500 if U == 20 else 300  # beyond the gains that are worked out at once, or not
    start, steps, z, u = dealt(model, U, T, own=own)
    found = run_fleet(start, steps, *model[2:], z, u=u, every=every, threads=threads)
    for k in range(0, U, max(1, U // 20)):
        one = alone(model, start, steps, z, u, k)
        x, sigma = (a[every - 1 :: every] for a in (one.x, one.sigma))
        np.testing.assert_allclose(
            (found.x[:, :, k] - x) / sigma, 0.0, atol=1e-12 * np.max(np.abs(x) / sigma, initial=1)
        )
        np.testing.assert_allclose(found.sigma, sigma, rtol=1e-12)
        np.testing.assert_allclose(found.last[:, k], one.state.x, rtol=0, atol=1e-12 * np.max(np.abs(one.x)))
        np.testing.assert_allclose(found.P, one.state.P, rtol=0, atol=1e-12 * np.max(one.state.P))
    assert np.all(found.refused == T)


def test_the_units_equal_filterpy():
    model = two_triads()
    F, Q, H, R = model
    start, steps, z, u = dealt(model, 12, 200, own=True)
    found = run_fleet(start, steps, H, R, z, u=u, every=50)
    for k in (0, 7, 11):
        theirs = KalmanFilter(dim_x=12, dim_z=6, dim_u=12)
        theirs.x, theirs.P = start.x[:, [k]].copy(), start.P.copy()
        theirs.F, theirs.Q, theirs.H, theirs.R, theirs.B = F, Q, H, R, np.eye(12)
        for row in range(200):
            theirs.predict(u=u[row, :, [k]].T)
            theirs.update(z[row, :, [k]].T)
        sigma = np.sqrt(np.diag(theirs.P))
        np.testing.assert_allclose((found.last[:, k] - theirs.x[:, 0]) / sigma, 0.0, atol=1e-7)
        np.testing.assert_allclose(found.P, theirs.P, rtol=0, atol=1e-9 * np.max(theirs.P))


def test_refused_units_are_named_and_the_others_are_as_alone():
    model = two_triads()
    start, steps = State(np.zeros((12, 20)), 1e-8 * np.eye(12)), Transition(*model[:2], np.zeros(12))
    z = np.cumsum(np.random.default_rng(1).normal(size=(600, 6, 20)), axis=0) * 1e-7
    z[250, 2, 3] += 1.0  # a knock
    z[0, 0, 8] = 1e3
    z[599, 5, 13] -= 5.0
    z[40, 1, 17] = np.nan
    found = run_fleet(start, steps, *model[2:], z, gate=100.0, every=30)
    expected = np.full(20, 600)
    expected[[3, 8, 13, 17]] = 250, 0, 599, 40
    np.testing.assert_array_equal(found.refused, expected)
    for k in range(20):
        if k == 17:
            continue
        one = alone(model, start, steps, z, None, k, gate=100.0)
        first = np.append(np.flatnonzero(~one.used), 600)[0]
        assert found.refused[k] == first
        same = first // 30
        error = (found.x[:same, :, k] - one.x[29::30][:same]) / one.sigma[29::30][:same]
        np.testing.assert_allclose(error, 0.0, atol=1e-12)


def test_gains_are_worked_out_once_for_all_units_of_a_process(monkeypatch):
    model = two_triads()
    start, steps, z, _ = dealt(model, 3, 2400, seed=5, own=False)
    wide = State(start.x, 1.37 * start.P)  # no other test begins there
    runs = []
    worked_out = loop.gains
    monkeypatch.setattr(loop, "gains", lambda *given: (runs.append(1), worked_out(*given))[1])
    first = alone(model, wide, steps, z, None, 0)
    assert runs
    runs.clear()
    found = [alone(model, wide, steps, z, None, k) for k in (1, 2)]
    run_fleet(wide, steps, *model[2:], z)
    assert not runs
    np.testing.assert_array_equal(found[0].sigma, first.sigma)


def test_what_cannot_share_its_gains_is_refused():
    model = two_triads()
    F, Q, H, R = model
    start, steps, z, u = dealt(model, 2, 10, own=True)
    with pytest.raises(ValueError, match="units share their gains"):
        run_fleet(start, Transition(np.broadcast_to(F, (10, 12, 12)), Q, steps.u), H, R, z)
    with pytest.raises(ValueError, match="R is not diagonal and positive; multiply z and H"):
        run_fleet(start, steps, H, R + 0.1 * R[0, 0], z)
    with pytest.raises(ValueError, match=r"z is \(10, 5, 2\) and H \(6, 12\), \(T, 6, U\)"):
        run_fleet(start, steps, H, R, z[:, :5])
    with pytest.raises(ValueError, match=r"x is \(12, 2\) and u \(9, 12, 2\)"):
        run_fleet(start, steps, H, R, z, u=u[:9])
    with pytest.raises(ValueError, match="every is 0"):
        run_fleet(start, steps, H, R, z, every=0)


def test_a_model_keeps_few_transients():
    model = invariant(*two_triads()[:3], np.diag(two_triads()[3]), np.eye(12))
    P = np.tile(np.eye(2), (6, 1, 1))
    for k in range(40):
        model.ahead(P * (1 + k), 300)
    assert model._transient.cache_info().currsize <= 8
