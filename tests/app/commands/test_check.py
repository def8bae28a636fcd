"""What `check` says of the first rows of a recording."""

import numpy as np
import pytest

import driftlab

CONFIG = {
    "latitude": "45 deg",
    "filter": {
        "update_interval": "1 s",
        "align": "60 s",
        "gyro": {"noise": "2 deg/h/sqrt(Hz)", "bias": {
            "kind": "thermal_derivative", "walk": "0.02 deg/h/sqrt(s)", "map": {"kind": "polynomial", "order": 1},
        }},
        "accel": {"noise": "1e-3 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 m/s^2/sqrt(s)"}},
    },
}  # fmt: skip


@pytest.mark.parametrize(("factor", "noted"), [(1.0, False), (1.1, True)])
def test_accelerometers_that_do_not_show_gravity_are_noted_by_check_and_by_a_fit(factor, noted):
    rng, t = np.random.default_rng(0), np.arange(1200.0)
    white = rng.standard_normal((2, len(t), 3)) * np.array([2 * np.pi / 180 / 3600, 1e-3])[:, None, None]
    data = {
        "time": (t, "s"), "temperature": (20 + 10 * np.sin(t / 200), "degC"), "gyro": (white[0], "rad/s"),
        "accel": (factor * (white[1] + [0.0, 0.0, 9.80665]), "m/s^2"),
    }  # fmt: skip
    for lines in (driftlab.check(CONFIG, data).remarks, driftlab.fit_map(CONFIG, data).lines()):
        said = [line for line in lines if "m/s^2 at rest, gravity there is 9.806: its scale" in line]
        assert len(said) == noted
