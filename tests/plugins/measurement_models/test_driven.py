import numpy as np
import pytest

import driftlab
from driftlab.errors import ConfigError

SETTINGS = {
    "kind": "driven", "channel": "gyro", "reference": "table", "noise": "1e-4 rad/s/sqrt(Hz)", "align": "120 s",
    "update_interval": "2 s", "bias": {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)", "sigma_0": "0.01 rad/s"},
}  # fmt: skip
M = np.array([[0.004, 0.003, -0.005], [0.002, -0.008, 0.006], [-0.001, 0.004, 0.01]])


def turned(seed, N=6000, hz=10.0):
    """A gyro that is turned about all axes at once, in steps of 4 s."""
    rng = np.random.default_rng(seed)
    t = np.arange(N + 1) / hz
    u = np.vstack([np.zeros(3), np.repeat(rng.uniform(-1, 1, (N // 40, 3)), 40, axis=0)])
    y = u + u @ M.T + [0.004, -0.002, 0.003] + rng.normal(0, 1e-4 * np.sqrt(hz), u.shape)
    return {"time": (t, "s"), "gyro": (y, "rad/s"), "table": (u, "rad/s"), "temperature": (20 + 0 * t, "degC")}


def test_all_terms_are_found_within_their_sigma():
    z = []
    for seed in range(6):
        run = driftlab.run({"filter": SETTINGS}, turned(seed))
        z.append((run.x[-1] - [*M.ravel(), 0.004, -0.002, 0.003]) / run.sigma[-1])
        assert np.max(run.sigma[-1, :9]) < 1e-4
        assert 0.9 < np.mean(run.nis) / 3 < 1.1
    assert run.labels["x"][:4] == ("scale_x", "misalignment_xy", "misalignment_xz", "misalignment_yx")
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_a_refused_measurement_leaves_the_terms_as_they_are():
    """What is integrated starts anew then; a scale factor does not."""
    data = turned(0)
    data["gyro"][0][3000:3020] += 1.0
    run = driftlab.run({"filter": SETTINGS}, data)
    assert np.sum(~run.used) > 0
    assert np.max(np.abs(run.x[-1, :9] - M.ravel()) / run.sigma[-1, :9]) < 4
    assert np.max(run.sigma[-1, :9]) < 1e-4


def test_a_scale_factor_that_walks_is_never_known_exactly():
    settings = {**SETTINGS, "matrix": {"misalignment": False, "walk": "20 ppm/sqrt(s)"}}
    run = driftlab.run({"filter": settings}, turned(0))
    assert run.labels["x"][:3] == ("scale_x", "scale_y", "scale_z")
    assert np.min(run.sigma[-1, :3]) > 20e-6  # of a second alone


def test_a_sensor_that_stands_still_tells_nothing_of_its_scale():
    data = turned(0)
    still = {**data, "table": (0 * data["table"][0], "rad/s"), "gyro": (data["gyro"][0] * 1e-3, "rad/s")}
    run = driftlab.run({"filter": SETTINGS}, still)
    np.testing.assert_allclose(run.sigma[-1, :9], 0.01, rtol=1e-6)


def test_without_its_reference_it_is_refused():
    with pytest.raises(ConfigError, match="reference: is required and missing"):
        driftlab.run({"filter": {key: value for key, value in SETTINGS.items() if key != "reference"}}, turned(0))
