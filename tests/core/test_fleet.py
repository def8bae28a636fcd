"""A fleet is as many single filters."""

import numpy as np
import pytest
import scipy.linalg

from fusion_core import reference
from fusion_core.contracts import Transition
from fusion_core.fast.fleet import run_fleet
from fusion_core.model import Measurement, State


def model():
    """Two axes of an integral and a bias that walks, and their prior."""
    dt, white, walk, rest = 0.1, 1.54e-5, 8.7e-6, 1e-6
    F = np.array([[1.0, -dt], [0.0, 1.0]])
    Q = np.array(
        [[white**2 * dt + walk**2 * dt**3 / 3, -(walk**2) * dt**2 / 2], [-(walk**2) * dt**2 / 2, walk**2 * dt]]
    )
    P = np.diag([0.0, 1e-6])
    F, Q, P, H = (scipy.linalg.block_diag(a, a) for a in (F, Q, P, [[1.0, 0.0]]))
    return F, Q, H, rest**2 * np.eye(2), P


@pytest.mark.parametrize("own_drift", [True, False])
def test_every_unit_of_a_fleet_is_a_filter_of_its_own(own_drift):
    F, Q, H, R, P = model()
    rng = np.random.default_rng(0)
    U, T = 5, 640
    z = np.cumsum(rng.normal(size=(T, 2, U)), axis=0) * 1e-5
    u = rng.normal(size=(T, 4, U)) * 1e-6 if own_drift else None
    shared = rng.normal(size=4) * 1e-6
    x = rng.normal(size=(4, U)) * 1e-5
    found = run_fleet(State(x, P), Transition(F, Q, shared), H, R, z, u=u, every=16)
    for k in range(U):
        drift = np.broadcast_to(shared, (T, 4)) if u is None else u[:, :, k]
        alone = reference.estimate(
            State(x[:, k], P), Transition(F, Q, drift), Measurement(z[:, :, k], H, R, np.ones(T, dtype=bool))
        )
        np.testing.assert_allclose(found.sigma, alone.sigma[15::16], rtol=1e-10)
        assert np.max(np.abs(found.x[:, :, k] - alone.x[15::16]) / alone.sigma[15::16]) < 1e-9
    assert np.max(np.abs(found.P - alone.P[-1])) < 1e-10 * np.max(alone.P[-1])
    assert not np.allclose(found.sigma[0], found.sigma[-1])


def test_a_fleet_says_what_it_cannot_share():
    F, Q, H, R, P = model()
    z = np.zeros((20, 2, 2))
    with pytest.raises(ValueError, match="no multiple of every = 32"):
        run_fleet(State(np.zeros(4), P), Transition(F, Q, np.zeros(4)), H, R, z)
    varying = Transition(np.broadcast_to(F, (20, 4, 4)), Q, np.zeros(4))
    with pytest.raises(ValueError, match="shares its gains"):
        run_fleet(State(np.zeros(4), P), varying, H, R, z, every=10)
