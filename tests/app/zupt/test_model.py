"""Epochs, Earth rate, temperature rate and the zero-velocity model against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from driftlab.config import Config
from driftlab.judging.yardsticks import moving_average
from driftlab.samples.epochs import epochs
from driftlab.samples.temperature_rate import Kalman, Regression
from driftlab.zupt.alignment import Alignment
from driftlab.zupt.earth import RATE, earth_rate, gravity
from driftlab.zupt.model import Zupt
from fusion_core.chunk import Chunk, concatenate
from fusion_core.errors import ConfigError
from fusion_core.kalman import estimate

SETTINGS = {
    "filter": {
        "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}},
        "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2 m/s/h/sqrt(s)"}},
    }
}


def chunks(t, size, **channels):
    for k in range(0, len(t), size):
        yield Chunk(t[k : k + size], {name: values[k : k + size] for name, values in channels.items()})


def cut(t, size, **channels):
    """Chunks with what came before them, as the intake gives them."""
    whole = Chunk(t, channels)
    for k in range(0, len(t), size):
        yield whole.part(k, min(k + size, len(t)))


# Earth


def test_gravity_at_the_pole_and_the_equator_is_that_of_wgs84():
    assert gravity(0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert gravity(np.pi / 2) == pytest.approx(9.8321849379, abs=1e-9)


@given(st.floats(-1.5, 1.5), st.floats(-3, 3), st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_earth_rate_has_its_length_and_its_vertical_part(latitude, heading, up):
    up = np.array(up)
    if np.linalg.norm(up) < 0.1 or np.linalg.norm(np.cross(up, [1, 0, 0])) < 0.1 * np.linalg.norm(up):
        return
    up /= np.linalg.norm(up)
    omega = earth_rate(up, latitude, heading)
    assert np.linalg.norm(omega) == pytest.approx(RATE)
    assert omega @ up == pytest.approx(RATE * np.sin(latitude), abs=1e-12)
    np.testing.assert_allclose(earth_rate(up, latitude, None), (omega @ up) * up, atol=1e-12)


def test_earth_rate_with_x_to_the_east_and_z_up_lies_in_y():
    omega = earth_rate(np.array([0.0, 0.0, 1.0]), 0.0, np.pi / 2)
    np.testing.assert_allclose(omega, [0, RATE, 0], atol=1e-18)


def test_heading_of_a_vertical_x_axis_is_refused():
    with pytest.raises(ConfigError, match="heading: the x axis stands vertical"):
        earth_rate(np.array([1.0, 0.0, 0.0]), 0.5, 0.0)


# epochs


def test_an_epoch_integrates_its_samples():
    t = np.arange(0, 10.0001, 0.01)
    gyro = np.random.default_rng(0).normal(size=(len(t), 3))
    got = concatenate(list(epochs(cut(t, 400, gyro=gyro, temperature=t), 0.1)))
    assert len(got) == 100
    np.testing.assert_allclose(got.t, np.arange(1, 101) * 0.1)
    np.testing.assert_allclose(got["tau"], 0.1)
    np.testing.assert_allclose(got["gyro"][7], gyro[71:81].mean(axis=0))
    total = np.sum(got["gyro"] * got["tau"][:, None], axis=0)
    np.testing.assert_allclose(total, np.sum(gyro[1:] * 0.01, axis=0))


def test_stamps_since_1970_fall_into_the_same_epochs():
    """Their rounding (0.24 us) must not push a sample over an epoch's edge."""
    t = np.arange(0, 50.0001, 0.01)
    gyro = np.random.default_rng(0).normal(size=(len(t), 3))
    small = concatenate(list(epochs(cut(t, 400, gyro=gyro), 0.1)))
    large = concatenate(list(epochs(cut(t + 1.7e9, 400, gyro=gyro), 0.1)))
    assert len(small) == len(large) == 500
    np.testing.assert_allclose(large["gyro"], small["gyro"], atol=1e-4)


@pytest.mark.parametrize("later", [0.1, 0.01])
def test_a_recording_may_change_its_rate(later):
    t = np.concatenate([np.arange(0, 100, 0.05), np.arange(100, 200, later)])
    got = concatenate(list(epochs(cut(t, 333, gyro=np.ones((len(t), 1))), 1.0)))
    assert got["tau"].sum() == pytest.approx(200, abs=1.5)


def test_a_gap_is_no_ones_time():
    t = np.concatenate([np.arange(0, 5, 0.1), np.arange(300, 305, 0.1)])
    got = concatenate(list(epochs(cut(t, 33, gyro=np.ones((len(t), 1))), 1.0)))
    k = int(np.searchsorted(got.t, 200))
    assert got["tau"].sum() == pytest.approx(4.9 + 4.9)
    assert got.dt[k] > 290
    assert got["tau"][k] <= 1.0 + 1e-9
    np.testing.assert_allclose(got["gyro"], 1.0)


@given(size=st.integers(1, 700), interval=st.sampled_from([0.01, 0.1, 0.25, 3.0]))
@settings(max_examples=30, deadline=None)
def test_epochs_do_not_depend_on_the_chunks(size, interval):
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.choice([0.01, 0.012, 0.5], size=600, p=[0.9, 0.09, 0.01]))
    channels = {"gyro": rng.normal(size=(600, 3)), "temperature": rng.normal(size=600)}
    whole = concatenate(list(epochs(cut(t, 600, **channels), interval)))
    split = concatenate(list(epochs(cut(t, size, **channels), interval)))
    np.testing.assert_array_equal(whole.t, split.t)
    np.testing.assert_array_equal(whole.dt, split.dt)
    for name in whole.channels:
        np.testing.assert_array_equal(whole[name], split[name])


# temperature rate


@pytest.mark.parametrize("estimator", [Regression(window="60 s"), Kalman()], ids=lambda e: e.kind)
def test_a_steady_ramp_is_followed_without_lag(estimator):
    t = np.arange(0, 3000, 0.1)
    T = 20 + t / 30.0  # 2 K/min
    smooth, rate, _ = estimator.run(np.full(len(t), 0.1), T, estimator.start(T[0]))
    late = t > 600
    np.testing.assert_allclose(smooth[late], T[late], atol=2e-3)
    np.testing.assert_allclose(rate[late], 1 / 30.0, rtol=2e-3)


@pytest.mark.parametrize(
    "estimator", [Regression(window="120 s"), Kalman(noise="0.3 K", walk="5e-5 K/s/sqrt(s)")], ids=lambda e: e.kind
)
def test_a_sensor_with_steps_of_one_degree_still_gives_a_rate(estimator):
    t = np.arange(0, 1800, 0.1)
    T = np.round(20 + t / 30.0)
    smooth, rate, _ = estimator.run(np.full(len(t), 0.1), T, estimator.start(T[0]))
    late = t > 900
    assert np.abs(rate[late] - 1 / 30).max() < 0.5 / 30
    assert np.abs(smooth[late] - (20 + t[late] / 30.0)).max() < 0.5


@pytest.mark.parametrize("estimator", [Regression(), Kalman()], ids=lambda e: e.kind)
def test_a_temperature_that_stalls_has_no_rate(estimator):
    dt, T = np.full(5000, 0.1), np.full(5000, 25.0)
    dt[2000] = 5000.0  # a gap
    smooth, rate, _ = estimator.run(dt, T, estimator.start(25.0))
    np.testing.assert_allclose(smooth, 25.0, atol=1e-9)
    np.testing.assert_allclose(rate, 0.0, atol=1e-9)


@given(cut_at=st.integers(1, 499))
@settings(max_examples=20, deadline=None)
@pytest.mark.parametrize("estimator", [Regression(), Kalman()], ids=lambda e: e.kind)
def test_a_rate_estimator_can_be_cut_anywhere(estimator, cut_at):
    rng = np.random.default_rng(0)
    dt, T = rng.uniform(0.05, 0.2, 500), 20 + np.cumsum(rng.normal(size=500)) * 0.01
    whole = estimator.run(dt, T, estimator.start(T[0]))
    first = estimator.run(dt[:cut_at], T[:cut_at], estimator.start(T[0]))
    second = estimator.run(dt[cut_at:], T[cut_at:], first[2])
    np.testing.assert_array_equal(whole[0], np.concatenate([first[0], second[0]]))
    np.testing.assert_array_equal(whole[1], np.concatenate([first[1], second[1]]))


# the model


def model_and_alignment():
    config = Config.model_validate(SETTINGS)
    return Zupt(config.filter), Alignment(
        0.0, 0.1, np.zeros(3), np.array([0, 0, 9.8]), np.array([0, 0, 1.0]), {}, np.zeros(3)
    )  # fmt: skip


def epoch_chunk(tau, dt, N=1):
    t = np.cumsum(np.full(N, dt))
    channels = {"tau": np.full(N, tau), "gyro": np.zeros((N, 3)), "accel": np.tile([0, 0, 9.8], (N, 1))}
    return Chunk(t, channels, Chunk(t[:1] - dt))


def test_twelve_states_in_the_order_of_the_paper():
    model, _ = model_and_alignment()
    assert model.n == 12
    assert model.labels[:2] == ["velocity_error_x", "velocity_error_y"]
    assert model.labels[3] == "attitude_error_x"
    assert model.labels[6] == "accel_bias_x"
    assert model.labels[9] == "gyro_bias_x"


def test_a_prior_beyond_the_digits_of_the_noise_is_refused():
    model, _ = model_and_alignment()
    model.prior()
    wide = model.triads[1].model.model_copy(update={"sigma_0": 1.7e6})
    model.triads[1] = replace(model.triads[1], model=wide)
    with pytest.raises(
        ConfigError, match=r"filter\.gyro\.bias: the deviation before the first sample is 1\.7e\+06 in SI"
    ):
        model.prior()


@pytest.mark.parametrize(("tau", "dt"), [(0.1, 0.1), (1.0, 1.0), (0.1, 300.0), (2.0, 50.0)])
def test_integrals_of_a_walking_bias_have_the_exact_covariance(tau, dt):
    """Of a random walk W over dt whose last tau seconds are integrated: var = q (tau^2 (dt - tau) + tau^3 / 3)."""
    model, alignment = model_and_alignment()
    chunk = epoch_chunk(tau, dt)
    steps, _ = model.bias_steps(chunk, [None, None])
    found = model.transition(chunk, steps, alignment)
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
    model, alignment = model_and_alignment()
    bias = np.array([0.5, -0.1, 0.02])  # rad/s, far beyond any small angle over the stretch
    chunk = epoch_chunk(0.1, 0.1, N=3000)
    chunk = chunk.having(gyro=np.tile(bias, (3000, 1)))
    steps, _ = model.bias_steps(chunk, [None, None])
    found = estimate(model.prior(), model.transition(chunk, steps, alignment), model.measurement(3000))
    np.testing.assert_allclose(found.x[-1, 9:], bias, rtol=1e-9)


# the reference


def test_moving_average_with_gaps_and_motion_is_the_plain_sum():
    rng = np.random.default_rng(1)
    dt = rng.choice([0.1, 0.2, 4.0], p=[0.75, 0.19, 0.06], size=1500)
    t, tau = np.cumsum(dt), np.minimum(dt, 0.2)
    rate, still = rng.normal(size=(1500, 2)) + 5.0, rng.random(1500) > 0.2
    still[700:740] = False  # in the midst of it nothing is left to average
    got = moving_average(t, rate, tau, still, window=6.05)
    for k in range(1500):
        near = (np.abs(t - t[k]) <= 3.025) & still
        enough = still[k] and np.sum(tau[near]) >= 2.0
        expected = np.average(rate[near], axis=0, weights=tau[near]) if enough else [np.nan, np.nan]
        np.testing.assert_allclose(got[k], expected, rtol=1e-12)
    assert 0.1 < np.mean(np.isfinite(got[still])) < 0.99
    assert np.all(np.isnan(got[~still]))


def test_moving_average_is_the_mean_of_the_window():
    t = np.arange(1, 2001) * 0.1
    rate = np.random.default_rng(0).normal(size=(2000, 2))
    got = moving_average(t, rate, np.full(2000, 0.1), np.ones(2000, bool), window=30.0)
    k = 1000
    np.testing.assert_allclose(got[k], rate[k - 150 : k + 151].mean(axis=0), rtol=1e-9)
    # at the ends it is as much of the window as there is
    np.testing.assert_allclose(got[0], rate[:151].mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(got[-1], rate[-151:].mean(axis=0), rtol=1e-9)
