"""The zero-velocity model against closed forms."""

import numpy as np
import pytest

from driftlab.config import Config
from driftlab.filtering.setup import bias_steps, prior
from fusion_core.chunk import Chunk
from fusion_core.contracts import Alignment
from fusion_core.errors import ConfigError
from fusion_core.kalman import estimate
from fusion_plugins.earth import earth_rate, gravity

SETTINGS = {
    "filter": {
        "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}},
        "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2 m/s/h/sqrt(s)"}},
    }
}
UP = np.array([0, 0, 1.0])
ALIGNMENT = Alignment(0.0, 0.1, {"gyro": np.zeros(3), "accel": 9.8 * UP}, {}, np.zeros(3), UP)


def model_at_rest():
    return Config.model_validate(SETTINGS).filter


def epoch_chunk(tau, dt, N=1):
    t = np.cumsum(np.full(N, dt))
    channels = {"tau": np.full(N, tau), "gyro": np.zeros((N, 3)), "accel": np.tile([0, 0, 9.8], (N, 1))}
    return Chunk(t, channels, Chunk(t[:1] - dt))


def test_twelve_states_in_the_order_of_the_paper():
    model = model_at_rest()
    assert model.space.n == 12
    assert model.space.labels[:2] == ["velocity_error_x", "velocity_error_y"]
    assert model.space.labels[3] == "attitude_error_x"
    assert model.space.labels[6] == "accel_bias_x"
    assert model.space.labels[9] == "gyro_bias_x"


def test_a_prior_beyond_the_digits_of_the_noise_is_refused():
    model = model_at_rest()
    prior(model)
    wide = model.with_tracked(bias=model.tracked.bias.model_copy(update={"sigma_0": 1.7e6}))
    with pytest.raises(
        ConfigError, match=r"filter\.gyro\.bias: the deviation before the first sample is 1\.7e\+06 in SI"
    ):
        prior(wide)


@pytest.mark.parametrize(("tau", "dt"), [(0.1, 0.1), (1.0, 1.0), (0.1, 300.0), (2.0, 50.0)])
def test_integrals_of_a_walking_bias_have_the_exact_covariance(tau, dt):
    """Of a random walk W over dt whose last tau seconds are integrated: var = q (tau^2 (dt - tau) + tau^3 / 3)."""
    model = model_at_rest()
    chunk = epoch_chunk(tau, dt)
    steps, _ = bias_steps(model, chunk, [None, None])
    found, _ = model.equations(chunk, steps, ALIGNMENT)
    Q = found.Q.reshape(12, 12)
    q, n2 = 2.617993877991494e-6**2, 1.5417075059283247e-5**2
    assert Q[3, 3] == pytest.approx(q * (tau**2 * (dt - tau) + tau**3 / 3) + n2 * tau, rel=1e-9)
    assert Q[3, 9] == pytest.approx(-q * (tau * (dt - tau) + tau**2 / 2), rel=1e-9)
    assert Q[9, 9] == pytest.approx(q * dt, rel=1e-9)
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() > -1e-15 * np.abs(Q).max()
    F = found.F.reshape(12, 12)
    assert F[3, 9] == pytest.approx(-tau)


def test_a_constant_bias_is_found_from_pure_integration():
    """No noise at all: the estimate after N epochs is the bias, whatever its size."""
    model = model_at_rest()
    bias = np.array([0.5, -0.1, 0.02])  # rad/s, far beyond any small angle over the stretch
    chunk = epoch_chunk(0.1, 0.1, N=3000)
    chunk = chunk.having(gyro=np.tile(bias, (3000, 1)))
    steps, _ = bias_steps(model, chunk, [None, None])
    found = estimate(prior(model), *model.equations(chunk, steps, ALIGNMENT))
    np.testing.assert_allclose(found.x[-1, 9:], bias, rtol=1e-9)


@pytest.mark.parametrize(
    ("noise", "sigma_0", "noted"),
    [("2e-7 rad/s/sqrt(Hz)", None, True), ("2e-7 rad/s/sqrt(Hz)", "20 mg", False), ("3 deg/h/sqrt(Hz)", None, False)],
)
def test_an_unknown_bias_of_the_accelerometers_is_noted_where_the_gyro_could_see_it(noise, sigma_0, noted):
    """20 mg across the vertical look like a tilt of 20 mrad: 0.2 deg/h of the Earth rate about each level axis."""
    bias = {"kind": "random_walk", "walk": "1e-5 m/s^2/sqrt(s)", **({"sigma_0": sigma_0} if sigma_0 else {})}
    filter = {
        "gyro": {"noise": noise, "bias": {"kind": "random_walk", "walk": "1e-9 rad/s/sqrt(s)"}},
        "accel": {"noise": "1e-4 m/s^2/sqrt(Hz)", "bias": bias},
    }
    config = Config.model_validate({"latitude": "40.9 deg", "heading": "0 deg", "filter": filter})
    chunk = epoch_chunk(0.1, 0.1, 600)
    chunk = chunk.having(accel=np.tile([0.196, -0.196, 9.8], (600, 1)))
    found = config.filter.aligned(chunk, config.site)
    assert bool(found.notes) == noted
    if noted:
        assert "filter.accel.bias.sigma_0: is missing" in found.notes[0]
        assert found.notes[0].endswith("as in filter.accel.bias.sigma_0: 20 mg"), "with a value and its unit"
        assert "one of 20 mg puts the gyro's bias off by x 0.19, y 0.19" in found.notes[0]
    told = found.unsure[:2] > np.deg2rad(0.15 / 3600)
    assert np.all(told) == (sigma_0 is not None), "what is said of it is in the sigma"


@pytest.mark.parametrize(
    ("factor", "sigma_0", "noted"),
    [(1.02, None, False), (1.04, None, True), (0.9, None, True), (1.04, "20 mg", False), (1.1, "20 mg", True)],
)
def test_accelerometers_that_do_not_show_gravity_are_noted(factor, sigma_0, noted):
    """However the unit lies: by 3 % of gravity, or by three deviations of the bias that is declared."""
    bias = SETTINGS["filter"]["accel"]["bias"] | ({"sigma_0": sigma_0} if sigma_0 else {})
    filter = SETTINGS["filter"] | {"accel": SETTINGS["filter"]["accel"] | {"bias": bias}}
    config = Config.model_validate({"latitude": "40.9 deg", "filter": filter})
    force = factor * gravity(config.site.latitude) * np.array([0.6, 0.0, -0.8])
    chunk = epoch_chunk(0.1, 0.1, 600)
    found = config.filter.aligned(chunk.having(accel=np.tile(force, (600, 1))), config.site)
    assert bool(found.off) == noted
    if noted:
        assert f"is off by {factor - 1:+.1%}; " in found.off[0]


@pytest.mark.parametrize("heading", [None, "0.7 rad"])
@pytest.mark.parametrize("up", [(0, 0, 1), (0.3, -0.5, 0.8), (-0.8, 0.1, 0.5)])
def test_a_tilt_is_unsure_by_what_it_moves_the_earth_rate(up, heading):
    """The rate at a vertical that is off by a small angle, in two directions across it, less that at the true one."""
    up = np.array(up) / np.linalg.norm(up)
    accel = SETTINGS["filter"]["accel"] | {"bias": SETTINGS["filter"]["accel"]["bias"] | {"sigma_0": "10 mg"}}
    turned = {} if heading is None else {"heading": heading}
    given = {"latitude": "40.9 deg", "filter": SETTINGS["filter"] | {"accel": accel}, **turned}
    config = Config.model_validate(given)
    length = gravity(config.site.latitude)
    chunk = epoch_chunk(0.1, 0.1, 60).having(accel=np.tile(length * up, (60, 1)))
    across = np.linalg.svd(up[None])[2][1:]

    def rate(vertical):
        return earth_rate(vertical / np.linalg.norm(vertical), config.site.latitude, config.site.heading)

    moved = [(rate(up + 1e-5 * a) - rate(up - 1e-5 * a)) / 2e-5 for a in across]
    expected = np.linalg.norm(moved, axis=0) * 10e-3 * 9.80665 / length
    np.testing.assert_allclose(config.filter.aligned(chunk, config.site).unsure, expected, rtol=1e-8, atol=1e-16)
