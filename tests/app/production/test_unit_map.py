"""The sigma of figures, against what soaks of the same unit scatter by."""

import numpy as np
import pytest

from driftlab.family.basis import STEP
from driftlab.family.unit_information import UnitInformation
from driftlab.maps.residual import AVERAGED
from driftlab.production.unit_map import residual_sigma
from driftlab.soak.blocks import SoakRows


@pytest.mark.parametrize("walk", [0.0, 0.01, 0.03])
def test_the_residual_is_as_sure_as_its_logarithm_scatters_from_soak_to_soak(walk):
    rng, white = np.random.default_rng(1), 2.0
    t = np.arange(5.0, 3600.0, 10.0)
    T = 20 - 40 * np.cos(2 * np.pi * t / 3600)
    soaked = UnitInformation.of(
        "0", ("x",), [SoakRows(t, T, np.zeros((len(t), 1)), np.full(len(t), 10.0), {})], np.array([white]),
        np.array([walk]), STEP,
    )  # fmt: skip
    means = T.reshape(-1, 3).mean(axis=1)
    K = len(means)
    U, s, _ = np.linalg.svd(soaked.knots.values(means), full_matrices=False)
    U = U[:, s > 1e-6 * s[0]]
    y = np.cumsum(walk * np.sqrt(AVERAGED) * rng.normal(size=(2000, K)), axis=1)
    y += white / np.sqrt(AVERAGED) * rng.normal(size=(2000, K))
    rms = np.sqrt(np.mean((y - (y @ U) @ U.T) ** 2, axis=1))
    said = [float(residual_sigma(np.array([value]), soaked)[0]) / value for value in rms[:5]]
    assert np.ptp(said) < 1e-9  # a soak that happens to leave little is no surer of it
    assert np.std(np.log(rms)) == pytest.approx(said[0], rel=0.2)
