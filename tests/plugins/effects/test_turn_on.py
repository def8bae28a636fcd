import numpy as np
import pytest
from effect_recordings import on_one_axis

from fusion_core.chunk import Chunk
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.turn_on import TurnOn


def test_turn_on_and_drift_count_from_the_first_sample():
    t = 5000 + np.array([0.0, 1.0, 10.0, 600.0, 6000.0])
    chunk = Chunk(t)
    np.testing.assert_allclose(on_one_axis(TurnOn(tau="10 min"), chunk)[:, 0], np.exp(-(t - 5000) / 600), rtol=1e-14)
    np.testing.assert_array_equal(on_one_axis(Drift(), chunk)[:, 0], t - 5000)


def test_turn_on_is_proposed_up_to_a_third_of_the_longest_recording():
    taus = [c.tau for c in TurnOn().proposals([Chunk(np.arange(0, 900.0)), Chunk(np.arange(0, 7201.0))])]
    assert taus[0] == pytest.approx(120)
    assert len(taus) == np.sum(np.geomspace(120, 39600, 18) <= 2400)
    assert list(TurnOn().proposals([Chunk(np.arange(0, 300.0))])) == []
