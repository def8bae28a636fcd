"""Effects beyond what they were fitted on: the part that is held back, and its share of a deviation."""

import numpy as np
import pytest

from driftlab.filtering.extrapolation import Extrapolation, beyond
from fusion_core.chunk import Chunk
from fusion_core.contracts.effect import Domain
from fusion_plugins.bias_models.thermal_derivative import ThermalDerivative
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.relaxation import Relaxation

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
    assert own.last == x[-1]
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


def test_a_filter_follows_what_is_held_back():
    """With a gain g = P / noise^2 the running estimate is off by x less its lag of 1 / g."""
    _, own = looked(SUPPLY)
    x, P, dt = np.full((5000, 1), 2.0), np.full((5000, 1), 0.01), np.array(1.0)
    left = own.of_estimate(x, P, dt, np.ones(1))
    np.testing.assert_allclose(left[:, 0], 2 * np.exp(-np.arange(1, 5001) / 100), rtol=0.3, atol=1e-6)
    assert own.of_estimate(None, P[:1], dt, np.ones(1)) is not None
