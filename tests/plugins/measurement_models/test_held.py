"""A sensor at a known input against independent solutions of the same problem, and in the unit of its noise."""

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.maps.fit import fit_map
from driftlab.recordings.epochs import epochs
from fusion_core.chunk import Chunk, concatenate
from fusion_core.errors import ConfigError, MapError
from fusion_core.faults import Faults
from fusion_core.units import unit_of_density

NOISE, WALK = 6e-8, 2e-9  # of the resistor below, in parts of one


def held(bias=None, source=None, **fields):
    walk = {"kind": "random_walk", "walk": "2e-3 ppm/sqrt(s)"}
    content = {"kind": "held", "channel": "resistance", "update_interval": "1 s", "align": "60 s"}
    content |= {"noise": "0.06 ppm/sqrt(Hz)", "bias": bias or walk, **fields}
    return Config.model_validate({"filter": content, "source": source})


def resistor(N=2000, seed=0, level=3e-6, d=1):
    rng = np.random.default_rng(seed)
    b = level + np.cumsum(WALK * rng.normal(size=(N, d)), axis=0)
    t = np.arange(1.0, N + 1)
    z = b + NOISE * rng.normal(size=b.shape)
    return Chunk(t, {"resistance": z, "tau": np.ones(N)}, None, frozenset({"resistance"})), b


def filtered(config, chunk):
    return joined(Run(config, RunLog()).over([chunk]))


# independent solutions


def test_estimates_are_those_of_a_local_level_model():
    statsmodels = pytest.importorskip("statsmodels.api")
    chunk, _ = resistor()
    got = filtered(held(bias={"kind": "random_walk", "walk": "2e-3 ppm/sqrt(s)", "sigma_0": "10 ppm"}), chunk)
    scale = 1e6  # statsmodels minds small numbers, and wide priors
    other = statsmodels.tsa.UnobservedComponents(chunk["resistance"][:, 0] * scale, level="llevel")
    other.ssm.initialize_known(np.zeros(1), np.array([[10.0**2]]))
    other.ssm.tolerance = 0.0  # it would take its gain for settled too soon
    found = other.filter([(NOISE * scale) ** 2, (WALK * scale) ** 2])
    np.testing.assert_allclose(got["bias"][:, 0], found.filtered_state[0] / scale, rtol=1e-7)
    np.testing.assert_allclose(got["bias_sigma"][:, 0], np.sqrt(found.filtered_state_cov[0, 0]) / scale, rtol=1e-6)


@given(seed=st.integers(0, 50), gap=st.integers(0, 300))
@settings(max_examples=10)
def test_the_last_estimate_is_that_of_joint_least_squares(seed, gap):
    """All biases at once: weighted differences of neighbours, and the readings; with a gap in the middle."""
    N = 300
    chunk, _ = resistor(N, seed)
    late = chunk.t > 150
    chunk = Chunk(np.where(late, chunk.t + gap, chunk.t), chunk.channels, None, chunk.sensors)
    got = filtered(held(), chunk)
    dt = np.diff(chunk.t)
    rows = np.vstack([np.eye(N) / NOISE, np.diff(np.eye(N), axis=0) / (WALK * np.sqrt(dt))[:, None]])
    rhs = np.concatenate([chunk["resistance"][:, 0] / NOISE, np.zeros(N - 1)])
    joint, *_ = np.linalg.lstsq(rows, rhs, rcond=None)
    sigma = np.sqrt(np.linalg.inv(rows.T @ rows)[-1, -1])
    assert got["bias"][-1, 0] == pytest.approx(joint[-1], abs=1e-6 * sigma)
    assert got["bias_sigma"][-1, 0] == pytest.approx(sigma, rel=1e-6)


def test_a_bias_of_two_states_an_axis_is_measured_through_its_output():
    """Constant and correlated part: the covariance of all readings, inverted, says what the sum is."""
    bias = {"kind": "gauss_markov", "sigma": "0.2 ppm", "tau": "100 s", "sigma_0": "5 ppm"}
    chunk, _ = resistor(200)
    got = filtered(held(bias=bias), chunk)
    t = chunk.t
    K = (5e-6) ** 2 + (2e-7) ** 2 * np.exp(-np.abs(np.subtract.outer(t, t)) / 100)
    gain = np.linalg.solve(K + NOISE**2 * np.eye(200), K[:, -1])
    assert got["bias"][-1, 0] == pytest.approx(gain @ chunk["resistance"][:, 0], rel=1e-6)
    assert got["bias_sigma"][-1, 0] == pytest.approx(np.sqrt(K[-1, -1] - K[-1] @ gain), rel=1e-6)


def test_what_coasts_says_how_far_off_it_is():
    errors, sigmas = [], []
    for seed in range(60):
        chunk, b = resistor(400, seed)
        got = filtered(held(), chunk)
        errors.append(got["coast"][-1, 0] - b[-1, 0])
        sigmas.append(got["coast_sigma"][-1, 0])
    assert np.sqrt(np.mean(np.square(errors) / np.square(sigmas))) == pytest.approx(1, abs=0.25)


# laws


@given(size=st.integers(1, 900))
@settings(max_examples=15)
def test_any_split_gives_the_same_run(size):
    chunk, _ = resistor(1000)
    parts = [chunk.part(k, min(k + size, 1000)) for k in range(0, 1000, size)]
    whole, split = filtered(held(), chunk), joined(Run(held(), RunLog()).over(parts))
    for name in ("bias", "coast", "bias_sigma", "coast_sigma"):
        # where the steady gain takes over depends on the cut: deviations agree to 1e-10, means to as much of them
        np.testing.assert_allclose(split[name], whole[name], rtol=1e-10, atol=1e-10 * NOISE)


def test_nothing_moves_and_every_epoch_counts():
    chunk, _ = resistor(500)
    z = chunk["resistance"].copy()
    z[300:] += 1e-3  # a level that jumps by a thousand ppm is no motion
    journal = RunLog()
    got = joined(Run(held(realign_after="30 s"), journal).over([chunk.having(resistance=z)]))
    assert np.all(got["still"])
    assert not journal.moving.spans
    assert 330 <= journal.alignments[1].t <= 333
    assert got["bias"][-1, 0] == pytest.approx(1e-3 + 3e-6, abs=3e-7)


@pytest.mark.parametrize("level", [0.0, 1e4, -1e4])
def test_a_prior_of_which_nothing_is_said_reaches_the_first_readings(level):
    """1 SI unit is narrow for 10 kohm."""
    rng = np.random.default_rng(0)
    chunk, _ = resistor(300)
    z = level + 1e-3 * rng.normal(size=(300, 1))
    journal = RunLog()
    config = held(bias={"kind": "random_walk", "walk": "1e-5 ohm/sqrt(s)"}, noise="1 mohm/sqrt(Hz)")
    got = joined(Run(config, journal).over([chunk.having(resistance=z)]))
    assert np.all(got["used"])
    assert got["bias"][-1, 0] == pytest.approx(level, abs=5e-4)


# references


@pytest.mark.parametrize("reference", ["set_point", "10 V", ["10 V"]])
def test_a_reference_is_subtracted(reference):
    rng = np.random.default_rng(1)
    N = 400
    t, V = np.arange(1.0, N + 1), np.full(N, 10.0)
    if reference == "set_point":
        V = 10 + np.sin(t / 30)
    z = V[:, None] + 2e-3 + 1e-5 * rng.normal(size=(N, 1))
    chunk = Chunk(t, {"resistance": z, "set_point": V, "tau": np.ones(N)}, None, frozenset({"resistance"}))
    walk = {"kind": "random_walk", "walk": "0.1 uV/sqrt(s)"}
    config = held(bias=walk, noise="10 uV/sqrt(Hz)", reference=reference)
    got = filtered(config, chunk)
    assert got["bias"][-1, 0] == pytest.approx(2e-3, abs=3e-6)
    np.testing.assert_allclose(got["rate"][:, 0], z[:, 0] - V, rtol=0, atol=1e-12)
    assert config.filter.requires == (("set_point",) if reference == "set_point" else ())
    again = Config.model_validate({"filter": config.filter.model_dump(mode="json")})
    assert again == config


def test_a_thermometers_reference_is_a_reading_and_its_noise_a_difference():
    fields = {"channel": "probe", "noise": "0.01 degC/sqrt(Hz)", "reference": "25 degC"}
    config = held(bias={"kind": "random_walk", "walk": "1e-4 K/sqrt(s)"}, **fields)
    assert config.filter.reference == pytest.approx(25)
    assert config.filter.tracked.unit == "K"
    assert config.filter.tracked.noise[0] == pytest.approx(0.01)


# units and axes


@pytest.mark.parametrize(
    ("text", "si", "shown"),
    [
        ("0.06 ppm/sqrt(Hz)", "1", "ppm"),
        ("3 mV/sqrt(Hz)", "V", "mV"),
        ("3.18 deg/h/sqrt(Hz)", "rad/s", "deg/h"),
        ("0.012 deg/sqrt(h)", "rad/s", "rad/s"),  # not written per sqrt(Hz): it says no unit
        ("2 nT/sqrt(Hz)", "T", "nT"),
        ("1e-3 Hz/sqrt(Hz)", "1/s", "Hz"),
        ("0.01 degC/sqrt(Hz)", "K", "degC"),
    ],
)
def test_the_unit_is_that_of_the_written_noise(text, si, shown):
    assert unit_of_density(text) == (si, shown)


def test_its_section_is_read_in_its_own_unit():
    config = held(range="100 ppm")
    sensor = config.filter.tracked
    assert (sensor.unit, sensor.shown, sensor.factor) == ("1", "ppm", pytest.approx(1e6))
    assert sensor.range == pytest.approx(1e-4)
    assert sensor.bias.walk == pytest.approx(WALK)
    assert sensor.bias.axes == ("resistance",)
    for fields in ({"range": "3 V"}, {"bias": {"kind": "random_walk", "walk": "1 deg/h/sqrt(s)"}}, {"noise": "3"}):
        with pytest.raises(ValueError, match=r"cannot be converted to|has no unit"):
            held(**fields)


def test_three_axes_have_the_names_that_they_are_given():
    bias = {"kind": "random_walk", "walk": "2e-3 ppm/sqrt(s)", "axes": ["a", "b"]}
    chunk, b = resistor(300, d=2)
    got = filtered(held(bias=bias), chunk)
    np.testing.assert_allclose(got["bias"][-1], b[-1], atol=5e-8)
    assert held(bias=bias).filter.space.labels == ["resistance_bias_a", "resistance_bias_b"]
    with pytest.raises(ConfigError, match="resistance: the recording has 1 axes and the bias model 2"):
        filtered(held(bias=bias), resistor(300)[0])


def test_a_channel_in_another_dimension_or_in_none_is_refused(tmp_path):
    for unit, message in (("V", "is in V, filter.noise is in ppm"), (None, "has no unit, filter.noise is in ppm")):
        channels = {"time": {"path": "t", "unit": "s"}, "resistance": {"path": "r"} | ({"unit": unit} if unit else {})}
        with pytest.raises(ValueError, match=message):
            held(source={"kind": "csv", "channels": channels})


def test_from_a_file_in_its_own_unit_to_a_map_and_back(tmp_path):
    """A curve of 2 ppm/K is found in ppm, and its map is refused by another channel."""
    t = np.arange(0, 2000.0)
    T = 25 + 5 * np.sin(t / 2000)  # slow: the temperature is averaged over a minute
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["t"], file["T"] = t, T
        file["r"] = 2 * (T - 25) + 0.06 * rng.normal(size=len(t))
    channels = {"time": {"path": "t", "unit": "s"}, "resistance": {"path": "r", "unit": "ppm"}}
    source = {"kind": "hdf5", "channels": {**channels, "temperature": {"path": "T", "unit": "degC"}}}
    source["path"] = str(tmp_path / "r.h5")
    settings = {"kind": "polynomial", "order": 1, "path": str(tmp_path / "map.json")}
    bias = {"kind": "thermal_derivative", "walk": "1e-4 ppm/sqrt(s)", "map": settings}
    config = held(bias=bias, source=source)
    fitted = fit_map(config, [], None, Faults())
    assert (fitted.record.channel, fitted.record.unit) == ("resistance", "1")
    np.testing.assert_allclose(fitted.slope(np.array([26.0, 27.0])), 2e-6, rtol=1e-3)
    fitted.save(tmp_path / "map.json")
    got = joined(Run(config, RunLog()))
    away = got["coast"][-1, 0] - 2e-6 * (T[-1] - 25)
    assert abs(away) < 4 * got["coast_sigma"][-1, 0] < 1e-6
    with pytest.raises(MapError, match=r"filter: the map \(polynomial\) is of the channel resistance in 1 with 1 axes"):
        Run(held(bias=bias, channel="other"), RunLog())


def test_irregular_samples_count_for_as_long_as_they_lasted():
    t = np.cumsum(np.random.default_rng(0).choice([0.1, 0.25], size=1000))
    z = np.random.default_rng(1).normal(size=(1000, 1))
    whole = Chunk(t, {"resistance": z}, None, frozenset({"resistance"}))
    got = concatenate(list(epochs([whole], 1.0)))
    total = np.sum(got["resistance"][:, 0] * got["tau"])
    assert total == pytest.approx(np.sum(z[1:, 0] * np.diff(t)))
