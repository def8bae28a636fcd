"""The triad that a unit at rest is asked about: gyro or accelerometers, and what a calibration of the latter is for."""

import numpy as np
import pytest
from pydantic import ValidationError

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.filtering.setup import RunSetup
from fusion_core.chunk import Chunk
from fusion_core.contracts import Site, ThermalMap
from fusion_core.errors import ConfigError, MapError
from fusion_core.host.registry import registry
from fusion_plugins.earth import earth_rate, gravity

LATITUDE = np.deg2rad(45)
G = gravity(LATITUDE)
SLOPE = np.array([0.02, -0.01, 0.03])  # m/s^2/K, of the made-up accelerometers


def curve(T):
    return np.array([0.1, -0.2, 0.05]) + (T - 20)[:, None] * SLOPE


@pytest.fixture
def path(tmp_path):
    T = np.linspace(0, 60, 600)
    kind = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 1})
    fitted = kind.fit(T, curve(T), {})
    record = fitted.record.model_copy(update={"channel": "accel", "unit": "m/s^2"})
    type(fitted)(**{**fitted.__dict__, "record": record}).save(tmp_path / "accel.json")
    return tmp_path / "accel.json"


def config(track="gyro", walk="1e-5 m/s^2/sqrt(s)", **accel):
    gyro = {"noise": "3 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-5 deg/s/sqrt(s)"}}
    own = {"noise": "1e-3 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": walk}, **accel}
    return Config.model_validate({
        "latitude": "45 deg", "filter": {"update_interval": "1 s", "track": track, "gyro": gyro, "accel": own}
    })  # fmt: skip


def recording(up=(0.0, 0.0, 1.0), N=1500):
    """A unit at rest that warms by 20 K, after two minutes at 20 degC."""
    rng = np.random.default_rng(0)
    t = np.arange(1.0, N + 1)
    T = 20 + 20 * np.clip((t - 120) / 1000, 0, 1)
    up = np.asarray(up)
    gyro = earth_rate(up, LATITUDE, None) + rng.normal(size=(N, 3)) * 1e-5
    accel = G * up + curve(T) + rng.normal(size=(N, 3)) * 1e-3
    one = np.ones(N)
    channels = {"gyro": gyro, "accel": accel, "temperature": T, "tau": one, "dt": one}
    return Chunk(t, channels, sensors=frozenset({"gyro", "accel"}))


def run(config):
    journal = RunLog()
    return joined(Run(config, journal).over([recording()])), journal


def test_the_tracked_triad_is_chosen_and_changed():
    model = config().filter
    other = model.tracking("accel")
    assert (model.tracked.channel, other.tracked.channel) == ("gyro", "accel")
    assert other.tracked.shown == "mg"
    assert other.tracking("gyro") == model
    wide = other.with_tracked(noise=1.0)
    assert np.all(wide.tracked.noise == 1.0)
    assert np.all(wide.tracking("gyro").tracked.noise == model.tracked.noise)
    assert Config.model_validate(config("accel").model_dump(mode="json")).filter.tracked.channel == "accel"


def test_a_sensor_that_is_not_there_is_named():
    with pytest.raises(ConfigError, match=r"no sensor 'acel', it has accel, gyro; did you mean 'accel'\?"):
        config().tracking("acel")
    with pytest.raises(ValidationError, match="track is accel and there are no accelerometers"):
        config("accel").filter.__class__.model_validate({**dict(config("accel").filter), "accel": None})


def test_a_calibration_and_a_followed_map_of_accelerometers_are_one_too_many(path):
    settings = {"kind": "polynomial", "path": str(path)}
    bias = {"kind": "thermal_derivative", "walk": "1e-5 m/s^2/sqrt(s)", "map": settings}
    with pytest.raises(ValidationError, match="applied twice"):
        config(calibration=settings, bias=bias)


def test_the_maps_of_all_sensors_are_files_of_the_config(path):
    found = config(calibration={"kind": "polynomial", "path": str(path)})
    assert found.files() == [path]
    assert found.tracked_maps() == []
    assert found.tracking("accel").tracked_maps() == found.maps()


def test_a_map_of_other_axes_is_refused(path):
    text = path.read_text().replace('"axes": []', '"axes": ["z", "y", "x"]')
    assert text != path.read_text()
    path.write_text(text)
    with pytest.raises(MapError, match="of the axes z, y, x, x, y, z were expected"):
        Run(config(calibration={"kind": "polynomial", "path": str(path)}), RunLog())


def test_the_vertical_and_the_earth_rate_are_those_of_the_corrected_unit(path):
    found = config(calibration={"kind": "polynomial", "path": str(path)})
    window = recording().part(0, 100)
    ideal = earth_rate(np.array([0.0, 0.0, 1.0]), LATITUDE, None)
    errors = []
    for maps in ({}, {"accel": found.filter.sensors[0].calibration.load()}):
        plan = RunSetup(found.filter, Site(LATITUDE, None), maps, {}, 1.0, 0.0, False)
        errors.append(np.linalg.norm(plan.aligned(window).inputs["gyro"] - ideal))
    tilt = np.hypot(0.1, 0.2) / G  # of a vertical that takes the bias for gravity
    assert errors[0] == pytest.approx(np.linalg.norm(ideal) * tilt, rel=0.02)
    assert errors[1] < 0.01 * errors[0]


def test_a_coast_of_the_accelerometers_is_better_by_what_the_map_knows(path):
    settings = {"kind": "polynomial", "path": str(path)}
    follows = {"kind": "thermal_derivative", "walk": "1e-5 m/s^2/sqrt(s)", "map": settings}
    configs = {"plain": config("accel", walk="1e-3 m/s^2/sqrt(s)"), "calibrated": config("accel", calibration=settings),
               "followed": config("accel", bias=follows)}  # fmt: skip
    end = {}
    for name, own in configs.items():
        columns, _ = run(own)
        assert columns["bias"].shape[1] == 3
        end[name] = (columns["coast"] - columns["rate"])[-300:].mean(axis=0)
    np.testing.assert_allclose(end["plain"], -20 * SLOPE, atol=2e-3)  # theory: all that the map would have told
    for name in ("calibrated", "followed"):
        assert np.all(np.abs(end[name]) < 2e-3), name
