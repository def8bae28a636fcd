"""What is held back beyond what effects were fitted on, and what of it a deviation has."""

import numpy as np
import pytest

import driftlab
from driftlab.filtering.extrapolation import Extrapolation, beyond
from fusion_core.chunk import Chunk
from fusion_core.contracts.effect import Domain
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.relaxation import Relaxation

ACCEL = {"noise": "1e-3 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 m/s^2/sqrt(s)"}}
T = np.arange(0.0, 4000.0, 10.0)
U = 5 + 2 * np.sin(T / 400)  # 3 to 7
SUPPLY = Channel(channel="supply", axes=("r",), coefficients=(3.0,), domain=Domain(supply=(4.0, 6.0)))
LATE = Relaxation(channel="supply", tau=500.0, axes=("r",), coefficients=(2.0,), domain=Domain(supply=(4.0, 6.0)),
                  regressors=((-0.5, 0.5),))  # fmt: skip


def looked(effect, cuts=(), t=T, u=U):
    own = Extrapolation(ThermalDerivative(axes=("r",), walk=1e-3, effects=(effect,)))
    chunk, found = Chunk(t, {"supply": u}), []
    for start, stop in zip((0, *cuts), (*cuts, len(t)), strict=True):
        x = own.look(chunk.part(start, stop))
        found.append(np.zeros((stop - start, 1)) if x is None else x)
    return np.concatenate(found)[:, 0], own


def test_a_channel_is_held_back_by_what_is_beyond():
    x, own = looked(SUPPLY)
    np.testing.assert_allclose(x, 3 * (U - np.clip(U, 4, 6)), atol=1e-12)
    assert own.memory.last == x[-1]
    ((name, outside),) = beyond(SUPPLY, Chunk(T, {"supply": U}))
    assert name == "supply"
    np.testing.assert_array_equal(outside, (U < 4) | (U > 6))


def test_what_a_memory_is_not_believed_stays_as_long_as_it_remembers():
    x, _ = looked(LATE)
    chunk = Chunk(T, {"supply": U})
    free = LATE.signature(chunk, None)[0][:, 0, 0]
    held = LATE.signature(LATE.within_domain(chunk), None)[0][:, 0, 0]
    np.testing.assert_allclose(x, 2 * (free - np.clip(held, -0.5, 0.5)), atol=1e-12)
    followed = LATE.held(chunk, None)[0][:, 0, 0]
    np.testing.assert_array_equal(followed, np.clip(free, -0.5, 0.5))


@pytest.mark.parametrize("effect", [SUPPLY, LATE])
@pytest.mark.parametrize("cuts", [(1,), (130, 131), tuple(range(7, 400, 7))])
def test_any_split_gives_the_same(effect, cuts):
    np.testing.assert_allclose(looked(effect, cuts)[0], looked(effect)[0], rtol=1e-12, atol=1e-14)


def test_within_what_was_fitted_on_there_is_nothing():
    for effect in (SUPPLY, LATE.model_copy(update={"regressors": ((-2.0, 2.0),)})):
        x, own = looked(effect, u=np.clip(U, 4, 6))
        assert not np.any(x)
        assert own.of_estimate(None, np.ones((3, 1)), np.array(1.0), np.ones(1)) is None
    assert Extrapolation(ThermalDerivative(axes=("r",), walk=1e-3)).look(Chunk(T, {})) is None


def test_what_goes_on_beyond_counts_all_the_same():
    """An effect that has shown to go on is followed beyond what it was fitted on, and the deviation has it whole."""
    further = SUPPLY.model_copy(update={"reach": 0.25})
    chunk = Chunk(T, {"supply": U})
    np.testing.assert_allclose(further.held(chunk, None)[0][:, 0, 0], np.clip(U, 3.5, 6.5))
    np.testing.assert_array_equal(looked(further)[0], looked(SUPPLY)[0])
    late = LATE.model_copy(update={"reach": 0.25})
    free = LATE.signature(chunk, None)[0][:, 0, 0]
    np.testing.assert_allclose(late.held(chunk, None)[0][:, 0, 0], np.clip(free, -0.75, 0.75))
    np.testing.assert_array_equal(looked(late)[0], looked(LATE)[0])


def test_a_filter_follows_what_is_held_back():
    """With a gain g = P / noise^2 the running estimate is off by x less its lag of 1 / g."""
    _, own = looked(SUPPLY)
    x, P, dt = np.full((5000, 1), 2.0), np.full((5000, 1), 0.01), np.array(1.0)
    left = own.of_estimate(x, P, dt, np.ones(1))
    np.testing.assert_allclose(left[:, 0], 2 * np.exp(-np.arange(1, 5001) / 100), rtol=0.3, atol=1e-6)
    assert own.of_estimate(None, P[:1], dt, np.ones(1)) is not None


def test_noise_of_an_effects_channel_is_predicted_once():
    """What a channel does within an epoch is not smooth: half a step more of it would add half again of its noise."""
    rng = np.random.default_rng(0)
    N, slope = 2000, 3e-4
    t, u = np.arange(N, dtype=np.float64), rng.normal(5, 0.05, N)
    effect = {"kind": "channel", "channel": "supply", "coefficients": [slope] * 3, "axes": ["x", "y", "z"]}
    bias = {"kind": "thermal_derivative", "walk": "1e-9 rad/s/sqrt(s)", "effects": [effect]}
    noise = {"noise": "1e-6 rad/s/sqrt(Hz)", "bias": bias}
    gyro = slope * (u - 5)[:, None] + 1e-6 * rng.normal(size=(N, 3))
    accel = np.tile([0.0, 0.0, 9.8], (N, 1)) + 1e-4 * rng.normal(size=(N, 3))
    units = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC", "supply": "V"}
    data = {"time": t, "gyro": gyro, "accel": accel, "temperature": np.full(N, 20.0), "supply": u}
    run = driftlab.run(
        {"filter": {"update_interval": "1 s", "align": "60 s", "gyro": noise, "accel": ACCEL}}, data, units=units
    )
    off = run.coast[200:, 0] - slope * (u[-len(run.coast) :] - 5)[200:]
    assert np.std(off) < 0.02 * slope * 0.05
