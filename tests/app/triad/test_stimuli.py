import os
from pathlib import Path

import numpy as np
import pytest
from turned_units import tumble

from driftlab.triad.fit import fit_triad
from driftlab.triad.stimuli import KnownRates, PlacedForces, PlacedRates, placed_rates, rests
from fusion_core.contracts import ThermalMap
from fusion_core.errors import NotAtRest
from fusion_core.host.registry import registry

SPLINE = registry().classes(ThermalMap)["spline"].model_validate({"kind": "spline"})
rng = np.random.default_rng(0)
U = rng.normal(size=(9, 3))
UP = U / np.linalg.norm(U, axis=1)[:, None]
TURNS = [rng.normal(0, 0.5, (30 + k, 3)) for k in range(8)]
STEPS = [np.full(len(turn), 0.01) for turn in TURNS]
T, t = np.linspace(0, 40, 9), np.arange(9.0)


@pytest.mark.parametrize(
    "stimulus",
    [
        KnownRates(U, 1.01 * U + 0.1, T, t),
        PlacedForces(9.8 * UP + 0.1, T, t, 9.8),
        PlacedRates(0.1 * U, UP, T, t, TURNS, STEPS),
    ],
    ids=["known rates", "placed forces", "placed rates"],
)
def test_derivatives_are_those_of_differences(stimulus):
    values = rng.normal(0, 0.02, (len(stimulus.T), 12))
    J, h = stimulus.equations(values).J, 1e-6
    for j in range(12):
        step = h * (np.arange(12) == j)
        difference = stimulus.equations(values - step).left - stimulus.equations(values + step).left
        np.testing.assert_allclose(J[:, j], difference / (2 * h), rtol=2e-3, atol=2e-3 * np.abs(J).max())


def test_a_turn_of_a_quarter_brings_gravity_to_the_next_axis():
    turn = np.tile([0.0, 0.0, np.pi / 2], (100, 1))  # rad/s for one second about z, gravity along x before
    stimulus = PlacedRates(
        np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, -1.0, 0]]), T[:2], t[:2], [turn], [np.full(100, 0.01)]
    )
    np.testing.assert_allclose(stimulus.equations(np.zeros((3, 12))).left, 0, atol=1e-12)


def test_rests_are_found_where_the_unit_was_left_alone():
    time, y, _ = tumble(0, [20.0], placements=10, hold=5.0)
    found = rests(time, y, least=2.0)
    assert len(found) == 10
    for k, (a, b) in enumerate(found):
        assert 6 * k + 1 <= time[a] < time[b - 1] <= 6 * k + 6
    with pytest.raises(NotAtRest, match=r"0 placements at rest for 30 s .* set stimulus.rest lower"):
        rests(time, y, least=30.0)


# imu_tk's own result on its own recordings, T and K with raw counts less b (README beside the data)
IMU_TK = {
    "accel": ([[1, -0.0033593, -0.00890639], [0, 1, -0.0213341], [0, 0, 1]],
              [0.00241278, 0.00242712, 0.00241168], [33124.2, 33275.2, 32364.4]),
    "gyro": ([[1, 0.00593634, 0.00111101], [0.00808812, 1, -0.0535569], [0.0253067, -0.0025513, 1]],
             [0.000209295, 0.000209899, 0.000209483], [32777.1, 32459.8, 32511.8]),
}  # fmt: skip
GRAVITY, NOMINAL = 9.81744, {"accel": 0.0024, "gyro": 2.1e-4}


def published(name):
    """Terms (12,) of y = (I + M) u + b for counts from 32768 on in the nominal scale."""
    alignment, scale, bias = (np.array(part) for part in IMU_TK[name])
    M = np.linalg.inv(alignment @ np.diag(scale)) * NOMINAL[name] - np.eye(3)
    return np.concatenate([(bias - 32768) * NOMINAL[name], M.ravel()])


@pytest.fixture(scope="module")
def xsens():
    folder = Path(os.environ["DRIFTLAB_DATA"]) / "data" / "imu_tk"
    accel, gyro = (np.loadtxt(folder / f"xsens_{name}.txt.gz") for name in ("acc", "gyro"))
    counts = {"accel": accel[:, 1:] - 32768, "gyro": gyro[:, 1:] - 32768}
    y = {name: values * NOMINAL[name] for name, values in counts.items()}
    return accel[:, 0], y, rests(accel[:, 0], *y.values(), least=1.0)


@pytest.mark.recordings
def test_hand_placements_agree_with_imu_tk(xsens):
    time, y, places = xsens
    assert len(places) == 38  # as imu_tk finds

    def cost(terms, samples=100):
        """imu_tk's: half the squares of |g| - |a| over 100 samples of each interval."""
        used = np.concatenate([y["accel"][a : a + samples] for a, _ in places])
        force = np.linalg.solve(np.eye(3) + terms[3:].reshape(3, 3), (used - terms[:3]).T)
        return 0.5 * np.sum((GRAVITY - np.linalg.norm(force, axis=0)) ** 2)

    means = np.stack([y["accel"][a:b].mean(axis=0) for a, b in places])
    at, starts = np.full(38, 25.0), np.array([time[a] for a, _ in places])
    stimulus = PlacedForces(means, at, starts, GRAVITY)
    fit = fit_triad(stimulus, SPLINE, 0.5)
    terms, sigma = fit.terms.at(np.array([25.0]))[0], fit.sigma(np.array([25.0]))[0]
    assert fit.told.sum() == 9
    assert cost(terms) < 1.02 * cost(published("accel"))
    apart = np.abs(terms - published("accel"))[fit.told] / sigma[fit.told]
    assert np.all(apart < 3)
    assert np.median(apart) < 1.5

    force = stimulus.forces(fit.terms.at(at))
    up = force / np.linalg.norm(force, axis=1)[:, None]
    turned = placed_rates(time, y["gyro"], np.full(len(time), 25.0), places, up)
    fit = fit_triad(turned, SPLINE, np.deg2rad(1.0))
    terms, sigma = fit.terms.at(np.array([25.0]))[0], fit.sigma(np.array([25.0]))[0]
    apart = (np.abs(terms - published("gyro")) / sigma)[3:]  # imu_tk's bias is that of the first rest alone
    assert fit.told.all()
    assert np.all(apart < 2)
    assert np.all(sigma[3:] < 1.5e-3)
