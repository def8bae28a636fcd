"""Maps of other sensors than gyros: accelerometers of a unit that is turned over, a barometer, a magnetometer."""

import json

import numpy as np
import pytest

import driftlab
from driftlab.commands.export import of_config
from driftlab.commands.fit_map import fit_map
from driftlab.commands.inputs import config_of
from fusion_core.errors import ConfigError, MapError

G = 9.80665
ZUPT = """
filter:
  update_interval: 1 s
  align: 30 s
  gyro: {noise: 3 deg/h/sqrt(Hz), bias: {kind: random_walk, walk: 1e-5 deg/s/sqrt(s)}}
  accel:
    noise: 100 ug/sqrt(Hz)
    bias: {kind: random_walk, walk: 1 ug/sqrt(s)}
    calibration: {kind: polynomial, order: 2}
"""
HELD = """
filter:
  kind: held
  channel: {channel}
  update_interval: 1 s
  align: 30 s
  noise: {noise}/sqrt(Hz)
  bias: {{kind: thermal_derivative, walk: {walk}/sqrt(s), map: {{kind: polynomial, order: 2}}{axes}}}
"""


def warmed(N=2400):
    """Temperature (N,) that goes up and comes back, and the same about its middle in units of half its range."""
    T = 45 - 25 * np.cos(2 * np.pi * np.arange(N) / N)
    return T, (T - 45) / 25


def turned_over(rng):
    """A unit that lies on two faces, with half a minute of handling between: 1 Hz."""
    parts = []
    for up in ([0.0, 0.0, 1.0], None, [0.02, 0.0, -1.0]):
        T, x = warmed() if up is not None else (np.full(33, 20.0), np.zeros(33))
        bias = np.outer(x, [0.02, -0.01, 0.03]) + np.outer(x**2, [0.005, 0.0, -0.01])
        force = G * np.array(up) / np.linalg.norm(up) if up is not None else rng.normal(size=(33, 3)) * 3
        gyro = rng.normal(size=(len(T), 3)) * (1e-5 if up is not None else 0.3)
        parts.append((T, force + bias + rng.normal(size=bias.shape) * 1e-3, gyro))
    T, accel, gyro = (np.concatenate(values) for values in zip(*parts, strict=True))
    t = np.arange(float(len(T)))
    return {"time": (t, "s"), "gyro": (gyro, "rad/s"), "accel": (accel, "m/s^2"), "temperature": (T, "degC")}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("accel")
    config = config_of(ZUPT).tracking("accel")
    data = turned_over(np.random.default_rng(0))
    return folder, driftlab.fit_map(config, data, out=folder / "accel.json"), data


def test_the_map_of_accelerometers_says_whose_it_is_in_their_unit(fitted):
    folder, result, _ = fitted
    record = json.loads((folder / "accel.json").read_text())["record"]
    assert (record["channel"], record["unit"]) == ("accel", "m/s^2")
    text = "\n".join(result.lines())
    assert " mg" in text
    assert "deg/h" not in text
    assert "2 placements: level z" in text
    assert "the level of x, y is one with the tilt" in text
    assert "motion, left out" in text
    page = (folder / "accel.report.html").read_text()
    assert "2 placements: level z" in page
    assert "deg/h" not in page
    judged = result.summary["judged"]["placements"]
    assert [axis["level_told"] for axis in judged["axes"]] == ["tilt", "tilt", "told"]


def test_its_curve_is_that_of_the_unit(fitted):
    _, result, _ = fitted
    T = np.linspace(21, 69, 40)
    x = (T - 45) / 25
    error = result.map.bias(T) - np.outer(x, [0.02, -0.01, 0.03]) - np.outer(x**2, [0.005, 0.0, -0.01])
    assert np.all(np.ptp(error, axis=0) < 8 * np.max(result.map.sigma(T), axis=0))
    assert np.all(np.ptp(error, axis=0) < 1e-3)


def test_it_calibrates_a_run_and_is_refused_for_the_gyro(fitted):
    folder, _, data = fitted
    named = {"kind": "polynomial", "path": str(folder / "accel.json")}
    part = {name: (values[:2400], unit) for name, (values, unit) in data.items()}
    for track in ("gyro", "accel"):
        config = config_of(ZUPT).model_dump(mode="json", exclude_none=True)
        config["filter"]["accel"]["calibration"] = named
        config["filter"]["track"] = track
        driftlab.check(config)
        result = driftlab.run(config, part)
        unit = {"gyro": "rad/s", "accel": "m/s^2"}[track]
        assert result.units["bias"] == unit
    config["filter"]["gyro"]["calibration"] = config["filter"]["accel"].pop("calibration")
    for job in (
        lambda: driftlab.run(config, part),
        lambda: driftlab.check(config),
        lambda: driftlab.compare({"one": config, "two": config}, part),
        lambda: of_config(config_of(config)),
    ):
        with pytest.raises(MapError, match=r"filter.gyro: the map .* channel accel in m/s\^2"):
            job()


def test_a_map_of_one_sensor_is_neither_planned_with_nor_lost_for_another(fitted):
    folder, _, _ = fitted
    config = config_of(ZUPT).model_dump(mode="json", exclude_none=True)
    named = {"kind": "polynomial", "path": str(folder / "accel.json")}
    config["filter"]["accel"]["calibration"] = named
    with pytest.raises(ConfigError, match="is read here, and would be lost"):
        fit_map(config_of(config), out=folder / "accel.json", kind="polynomial")
    config["filter"]["gyro"]["calibration"] = named
    with pytest.raises(MapError, match=r"filter.gyro: the map .* channel accel in m/s\^2"):
        driftlab.plan(config, 3.0, range="20..70 degC")


def test_maps_of_two_sensors_of_one_run_are_told_apart(fitted):
    folder, _, data = fitted
    driftlab.fit_map(ZUPT, data, kind="polynomial", out=folder / "gyro.json")
    config = config_of(ZUPT).model_dump(mode="json", exclude_none=True)
    for channel in ("gyro", "accel"):
        named = {"kind": "polynomial", "path": str(folder / f"{channel}.json"), "outside": "clamp"}
        config["filter"][channel]["calibration"] = named
    part = {name: (values[:1200], unit) for name, (values, unit) in data.items()}
    part["temperature"] = (part["temperature"][0] + 10, "degC")
    notes = driftlab.run(config, part).lines()
    for channel in ("gyro", "accel"):
        assert any(f"beyond the {channel} polynomial's domain" in line for line in notes)


def test_a_map_of_a_held_triad_is_one_of_the_triad_in_another_filter(fitted):
    _, result, _ = fitted
    text = HELD.format(channel="accel", noise="100 ug", walk="1 ug", axes=", axes: [x, y, z]")
    assert config_of(text).filter.tracked.unit == result.map.record.unit


@pytest.mark.parametrize(
    ("channel", "unit", "d", "noise", "walk", "si"),
    [("pressure", "Pa", 1, "2 Pa", "1e-3 Pa", "Pa"), ("field", "uT", 3, "0.1 uT", "1e-4 uT", "T")],
)
def test_a_barometer_and_a_magnetometer_get_maps_in_their_units(tmp_path, channel, unit, d, noise, walk, si):
    rng = np.random.default_rng(1)
    T, x = warmed()
    size = {"Pa": 20.0, "uT": 3.0}[unit]
    level = {"Pa": 101325.0, "uT": 40.0}[unit]
    values = level + size * (np.outer(x, np.arange(1, d + 1)) + 0.3 * np.outer(x**2, np.ones(d)))
    values = values + rng.normal(size=values.shape) * size / 20
    axes = ", axes: [x, y, z]" if d == 3 else ""
    text = HELD.format(channel=channel, noise=noise, walk=walk, axes=axes)
    data = {
        "time": (np.arange(float(len(T))), "s"),
        channel: (values if d > 1 else values[:, 0], unit),
        "temperature": (T, "degC"),
    }
    result = driftlab.fit_map(text, data, out=tmp_path / "map.json")
    assert (result.map.record.channel, result.map.record.unit, result.map.record.d) == (channel, si, d)
    assert f" {unit}" in "\n".join(result.lines())
    config = config_of(text).model_dump(mode="json", exclude_none=True)
    config["filter"]["bias"]["map"]["path"] = str(tmp_path / "map.json")
    done = driftlab.run(config, data)
    assert done.units["bias"] == si
    coast = done["coast"] - done["bias"]
    factor = 1e-6 if unit == "uT" else 1.0
    assert np.nanmax(np.abs(coast[-600:])) < 0.3 * size * factor


def powered(seed, up, n=10800):
    """A unit at rest whose accelerometers follow temperature and, with steps, the supply: 1 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(n))
    T = 35 + 20 * np.sin(4 * np.pi * t / n + seed) + 5 * np.sin(2 * np.pi * t / 1700 + 2 * seed)
    volts = 5 + 0.3 * np.sign(np.sin(2 * np.pi * t / 2300 + seed)) + 0.2 * np.sin(2 * np.pi * t / 900 + 3 * seed)
    x = (T - 35) / 25
    bias = np.outer(x, [0.02, -0.01, 0.03]) + np.outer(volts - 5, [0.01, 0.02, -0.015])
    accel = G * np.asarray(up) + bias + rng.normal(size=(n, 3)) * 1e-3
    gyro = rng.normal(size=(n, 3)) * 1e-5
    return {"time": (t, "s"), "gyro": (gyro, "rad/s"), "accel": (accel, "m/s^2"), "temperature": (T, "degC"),
            "supply": (volts, "V")}  # fmt: skip


def test_what_is_planted_in_accelerometers_is_found_and_predicts_another_placement():
    config = config_of(ZUPT.replace("    calibration: {kind: polynomial, order: 2}\n", "").replace(
        "{kind: random_walk, walk: 1 ug/sqrt(s)}",
        "{kind: thermal_derivative, walk: 2 ug/sqrt(s), map: {kind: polynomial, order: 2}}",
    )).tracking("accel")  # fmt: skip
    one, two, three = (powered(k, up) for k, up in enumerate(([0, 0, 1.0], [1.0, 0, 0], [0, 0.6, -0.8])))
    found = driftlab.explain(config, [one, two], [one, two], [three])
    assert found.verdict == "explained"
    assert any("channel of supply" in line for line in found.lines())
    before, after = (np.sqrt(np.nanmean((found[k] - found["reference"]) ** 2, axis=0)) for k in ("before", "after"))
    assert np.all(after < 0.2 * before)
