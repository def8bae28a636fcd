"""Physics of the plugins, which no law knows."""

import numpy as np
import pytest
from driftlab_warm_up.fan import ChamberFan
from driftlab_warm_up.warm_up import WarmUp

from fusion_core.chunk import Chunk


def test_the_transient_falls_to_a_third_in_one_time_constant():
    step, _ = WarmUp(tau=60.0, walk=0.0, axes=("x",)).transition(Chunk(np.array([0.0, 60.0])).part(1, 2), None)
    np.testing.assert_allclose(np.diag(step.F), [1.0, np.exp(-1)])
    np.testing.assert_array_equal(step.C, [[1.0, 1.0]])


def test_a_fan_acts_from_its_start_on():
    t = np.arange(5.0)
    chunk = Chunk(t, {"fan": np.array([1.0, 0.0, 1.0, 1.0, 0.0])})
    found, _ = ChamberFan(tau=2.0, axes=("x",)).signature(chunk, None)
    np.testing.assert_allclose(found[:, 0, 0], [0, 0, 1, np.exp(-0.5), np.exp(-1)])


def test_a_config_must_have_units():
    with pytest.raises(ValueError, match="cannot be converted to s"):
        WarmUp(tau="3 m", walk="1e-4 deg/s/sqrt(s)")
