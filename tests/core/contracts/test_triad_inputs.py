import numpy as np
import pytest

from fusion_core.contracts import KnownRates, PlacedForces, PlacedRates

rng = np.random.default_rng(0)
U = rng.normal(size=(9, 3))
UP = U / np.linalg.norm(U, axis=1)[:, None]
TURNS = [rng.normal(0, 0.5, (30 + k, 3)) for k in range(8)]
STEPS = [np.full(len(turn), 0.01) for turn in TURNS]
T, t = np.linspace(0, 40, 9), np.arange(9.0)
PULLS = [rng.normal(0, 5.0, turn.shape) for turn in TURNS]


@pytest.mark.parametrize(
    "stimulus",
    [
        KnownRates(U, 1.01 * U + 0.1, T, t, 9.8 * UP),
        KnownRates(U, 1.01 * U + 0.1, T, t),
        PlacedForces(9.8 * UP + 0.1, T, t, 9.8),
        PlacedRates(0.1 * U, UP, T, t, TURNS, STEPS, 9.8 * UP, PULLS),
        PlacedRates(0.1 * U, UP, T, t, TURNS, STEPS),
    ],
    ids=["known rates and forces", "known rates", "placed forces", "placed rates and forces", "placed rates"],
)
@pytest.mark.parametrize("q", [12, 21])
def test_derivatives_are_those_of_differences(stimulus, q):
    values = rng.normal(0, 0.02, (len(stimulus.T), q))
    J, h = stimulus.equations(values).J, 1e-6
    assert J.shape[1] == q
    for j in range(q):
        step = h * (np.arange(q) == j)
        difference = stimulus.equations(values - step).left - stimulus.equations(values + step).left
        np.testing.assert_allclose(J[:, j], difference / (2 * h), rtol=2e-3, atol=2e-3 * np.abs(J).max())


def test_a_turn_of_a_quarter_brings_gravity_to_the_next_axis():
    turn = np.tile([0.0, 0.0, np.pi / 2], (100, 1))  # rad/s for one second about z, gravity along x before
    stimulus = PlacedRates(
        np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, -1.0, 0]]), T[:2], t[:2], [turn], [np.full(100, 0.01)]
    )
    np.testing.assert_allclose(stimulus.equations(np.zeros((3, 12))).left, 0, atol=1e-12)
