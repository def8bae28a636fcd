import numpy as np

from fusion_core.chunk import Chunk
from fusion_plugins.effects.g_sensitivity import GSensitivity


def test_g_sensitivity_is_a_matrix_on_specific_force():
    f = np.random.default_rng(5).normal(size=(20, 3))
    M = np.arange(9.0).reshape(3, 3)
    signature, _ = GSensitivity().signature(Chunk(np.arange(20.0), {"accel": f}), None)
    np.testing.assert_allclose(signature @ M.ravel(), f @ M.T, rtol=1e-13)
    assert GSensitivity().labels[:4] == ("x_f_x", "x_f_y", "x_f_z", "y_f_x")
