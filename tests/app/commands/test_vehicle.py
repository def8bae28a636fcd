"""All inertial units of a vehicle, from logs in which each has a bias of its own that is known."""

import gzip
import json

import numpy as np
import pytest
from autopilots import parameters
from dataflash_writer import write_log
from typer.testing import CliRunner
from ulog_writer import FORMATS, Topic, sensor, write_ulog

import driftlab
from driftlab.cli import app
from driftlab.errors import ConfigError, DataError
from fusion_plugins.exporters.ardupilot import Ardupilot
from fusion_plugins.exporters.px4 import Px4

GYROS, ACCELS = (0x26000A, 0x3C0312), (0x260012, 0x3C031A)
SLOPE = np.deg2rad([0.012, -0.02, 0.006])  # rad/s/K
SECONDS, RATE, NOISE, G = 420, 10, np.deg2rad(0.03), 9.80665


def soak(seed=6, start=30.0):
    """Return t, and of two units gyro, accel and T; the second has other slopes, and is warmer by 4 K."""
    rng = np.random.default_rng(seed)
    t = start + np.arange(SECONDS * RATE) / RATE
    units = []
    for k in range(2):
        T = np.round(15 + 4 * k + 30 * (t - start) / SECONDS, 1)
        gyro = (1 + 2 * k) * SLOPE * (T - 30)[:, None] + NOISE * rng.normal(size=(len(t), 3))
        accel = np.zeros((len(t), 3))
        accel[:, 2] = -G - (1 + k) * 2e-3 * (T - 30)
        units.append((gyro, accel + 0.02 * rng.normal(size=(len(t), 3)), T))
    return t, units


def px4(path, order=(0, 1), gyros=GYROS, **of_soak):
    """Write a log with the units in an order, as their drivers happened to start."""
    t, units = soak(**of_soak)
    topics = []
    for place, k in enumerate(order):
        gyro, accel, T = units[k]
        topics += [
            sensor("sensor_gyro", place, t, gyro, T, gyros[k]),
            sensor("sensor_accel", place, t + 3e-4, accel, T, ACCELS[k]),
        ]
    return write_ulog(path, topics, {"TC_G_ENABLE": 0})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("vehicle")
    px4(folder / "soak.ulg")
    t, units = soak()
    write_log(folder / "soak.bin", t, units, parameters("GYR") | parameters("GYR", 1))
    return folder


def slopes(bias):
    """Return the change of a bias (d,) over 20 K of what both units have seen."""
    low, high = bias(np.array([21.0, 41.0]))
    return high - low


def check(sensors, first):
    sigma = 5 * NOISE / np.sqrt(RATE * SECONDS / 10)
    for one in sensors:
        factor = one.number - first + 1
        swing = slopes(one.result.map.bias)
        if one.channel == "gyro":
            np.testing.assert_allclose(swing, (2 * factor - 1) * SLOPE * 20, atol=2 * sigma)
        else:
            np.testing.assert_allclose(swing[2], -factor * 2e-3 * 20, atol=0.005)


def test_each_sensor_of_a_px4_vehicle_has_its_map_and_its_parameters(folder, tmp_path):
    result = driftlab.vehicle([folder / "soak.ulg"], out=tmp_path / "out", kind="polynomial")
    assert [one.name for one in result.sensors] == ["gyro 0", "gyro 1", "accel 0", "accel 1"]
    assert [int(one.device) for one in result.sensors] == [*GYROS, *ACCELS]
    check(result.sensors, 0)
    file = tmp_path / "out" / "vehicle.params"
    for instance in (0, 1):  # the parameters of each are those of its own map, by its own device
        given = {"kind": "px4", "instance": instance, "device_id": GYROS[instance], "accel_device_id": ACCELS[instance]}
        read = Px4.model_validate(given).read(file)
        assert [one.channel for one in read] == ["gyro", "accel"]
        for one, back in zip(result.sensors[instance::2], read, strict=True):
            T = np.linspace(*one.result.map.domain, 50)
            np.testing.assert_allclose(back.bias(T), one.result.map.bias(T), atol=2e-6)
    names = [line.split("\t")[2] for line in file.read_text().splitlines() if line[0] != "#"]
    assert len(names) == len(set(names))
    assert [one.sensor.channel for one in result.loss.sensors] == [one.name for one in result.sensors]
    assert result.status == 0


def test_each_sensor_of_an_ardupilot_vehicle_has_its_own_limits(folder, tmp_path):
    result = driftlab.vehicle(folder / "soak.bin", out=tmp_path / "out", kind="polynomial")
    assert [one.name for one in result.sensors] == ["gyro 1", "gyro 2", "accel 1", "accel 2"]
    check(result.sensors, 1)
    for imu in (1, 2):
        gyro, accel = Ardupilot(imu=imu).read(tmp_path / "out" / "vehicle.parm")
        assert gyro.domain == pytest.approx((15 + 4 * (imu - 1), 45 + 4 * (imu - 1)), abs=0.2)
        np.testing.assert_allclose(slopes(gyro.bias), (2 * imu - 1) * SLOPE * 20, atol=0.001)
        np.testing.assert_allclose(slopes(accel.bias)[2], -imu * 2e-3 * 20, atol=0.005)


def test_on_the_command_line(folder, tmp_path, monkeypatch):
    done = CliRunner().invoke(app, ["vehicle", str(folder / "soak.ulg"), "--out", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert [one["device_id"] for one in said["sensors"]] == [str(n) for n in (*GYROS, *ACCELS)]
    assert json.loads((tmp_path / "out" / "vehicle.json").read_text())["sensors"] == said["sensors"]
    again = CliRunner().invoke(app, ["vehicle", str(folder / "soak.ulg"), "--out", str(tmp_path / "out"), "-q"])
    assert (again.exit_code, again.stdout) == (0, "")
    (tmp_path / "out" / "vehicle.params").write_text("mine")
    monkeypatch.delattr("driftlab.commands.vehicle.sensors_of")  # it is refused before a log is read
    edited = CliRunner().invoke(app, ["vehicle", str(folder / "soak.ulg"), "--out", str(tmp_path / "out")])
    assert isinstance(edited.exception, ConfigError)
    assert (tmp_path / "out" / "vehicle.params").read_text() == "mine"


def test_a_log_that_is_given_twice_is_refused_and_parts_of_it_are_not(folder, tmp_path):
    log, packed = folder / "soak.ulg", tmp_path / "other.ulg.gz"
    packed.write_bytes(gzip.compress(log.read_bytes()))
    for logs in ([log, log], [log, packed], [f"{log}::0:300", f"{packed}::200:"], [f"{log}::0:300", log]):
        with pytest.raises(ConfigError, match="has the same rows as"):
            driftlab.vehicle(logs)
    parts = driftlab.vehicle([f"{log}::0:210", f"{packed}::210:"], kind="polynomial")
    check(parts.sensors, 0)


def test_two_logs_of_a_vehicle_count_together_and_those_of_two_vehicles_are_refused(folder, tmp_path):
    px4(tmp_path / "second.ulg", seed=7)
    both = driftlab.vehicle([folder / "soak.ulg", tmp_path / "second.ulg"], kind="polynomial")
    alone = driftlab.vehicle([folder / "soak.ulg"], kind="polynomial")
    samples = [result.sensors[1].result.map.record.samples for result in (alone, both)]
    assert samples[1] > 1.8 * samples[0]
    check(both.sensors, 0)
    px4(tmp_path / "other.ulg", gyros=(77, 78))
    with pytest.raises(
        ConfigError, match=f"has the device id 77 as gyro 0, .* has {GYROS[0]}; give the logs of one veh"
    ):
        driftlab.vehicle([folder / "soak.ulg", tmp_path / "other.ulg"])
    with pytest.raises(ConfigError, match="are of PX4 and of ArduPilot"):
        driftlab.vehicle([folder / "soak.ulg", folder / "soak.bin"])


def test_a_sensor_is_the_same_by_its_device_in_whatever_order_a_log_has_it(folder, tmp_path):
    turned = px4(tmp_path / "turned.ulg", order=(1, 0), seed=8)
    both = driftlab.vehicle([folder / "soak.ulg", turned], kind="polynomial")
    assert [int(one.device) for one in both.sensors] == [*GYROS, *ACCELS]
    assert [one.places for one in both.sensors] == [(0, 1), (1, 0)] * 2
    check(both.sensors, 0)


def test_what_it_cannot_use_is_said(folder, tmp_path):
    (tmp_path / "a.csv").write_text("t,x\n0,1\n")
    with pytest.raises(DataError, match="is no log of an autopilot"):
        driftlab.vehicle(tmp_path / "a.csv")
    with pytest.raises(ConfigError, match="export c: is no autopilot's"):
        driftlab.vehicle(folder / "soak.ulg", export="c")
    one_id = px4(tmp_path / "one_id.ulg", gyros=(GYROS[0], GYROS[0]))
    with pytest.raises(ConfigError, match=f"has the device id {GYROS[0]} as gyro 0 and as gyro 1"):
        driftlab.vehicle(one_id)
    with pytest.raises(ConfigError, match="instance: is of one sensor"):
        driftlab.vehicle(folder / "soak.ulg", settings={"instance": 1})


def test_a_sensor_that_the_firmware_refuses_is_left_out_and_the_others_are_written(tmp_path):
    t, (first, (gyro, accel, T)) = soak()
    narrow = gyro, accel, np.round(20 + 0.2 * (T - T[0]), 1)  # 6 K, ArduPilot asks for ten
    write_log(tmp_path / "soak.bin", t, [first, narrow], parameters("GYR") | parameters("GYR", 1))
    made = driftlab.vehicle(tmp_path / "soak.bin", out=tmp_path / "made")
    left_out = {sensor.name: sensor.left_out for sensor in made.sensors}
    assert [name for name, why in left_out.items() if why] == ["gyro 2", "accel 2"]
    assert "ArduPilot asks for 10 K and more" in left_out["gyro 2"]
    text = next((tmp_path / "made").glob("vehicle.par*")).read_text()
    assert "INS_TCAL1_ENABLE" in text
    assert "INS_TCAL2" not in text


HOURS, PERIOD = 2, 3600.0
PRESSURE, FIELD = np.array([3.0, 0.05]), np.array([[2e-4, -1e-4, 3e-4], [1e-6, 0.0, -2e-6]])  # Pa, G by K, K^2
MAG = [name for name in FORMATS["sensor_gyro"] if "clip" not in name and "samples" not in name]


def air_and_field(path, drift=0.0, once=False):
    """Write a log with two barometers and a magnetometer over sweeps of temperature; of the second, weather too."""
    rng = np.random.default_rng(5)
    t = 30 + np.arange(HOURS * 3600.0)
    swing = np.minimum(t / HOURS / 1800, 2) if once else 2 * np.abs((t / PERIOD) % 1 - 0.5) * 2
    T = 15 + 15 * swing
    x, stamp, same = T - 30, np.round(t * 1e6).astype(np.uint64), np.ones(len(t))
    about = {"timestamp": stamp, "timestamp_sample": stamp, "temperature": T, "error_count": 0 * same}
    still = np.array([0, 0, -G]) + 2e-3 * rng.normal(size=(len(t), 3)) - 1e-3 * x[:, None]
    topics = [
        sensor("sensor_gyro", 0, t, NOISE * rng.normal(size=(len(t), 3)), T, GYROS[0]),
        sensor("sensor_accel", 0, t, still, T, ACCELS[0]),
    ]
    for k in range(2):
        pressure = 100_900 + 300 * k + PRESSURE[0] * x + PRESSURE[1] * x**2 + k * drift * (t / t[-1]) ** 2
        values = {"device_id": (6620172 + k) * same, "pressure": pressure + 2 * rng.normal(size=len(t))}
        topics.append(Topic("sensor_baro", about | values, k))
    field = [0.2, 0.05, -0.4] + FIELD[0] * x[:, None] + FIELD[1] * x[:, None] ** 2
    field = field + 2e-3 * rng.normal(size=field.shape)
    values = {"device_id": 197388 * same, **{axis: field[:, k] for k, axis in enumerate("xyz")}}
    topics.append(Topic("sensor_mag", about | values, 0, MAG))
    return write_ulog(path, topics)


def read_back(path, channel, **settings):
    (found,) = (one for one in Px4(kind="px4", **settings).read(path) if one.channel == channel)
    return found


def test_barometers_and_a_magnetometer_are_corrected_about_the_middle(tmp_path):
    result = driftlab.vehicle(air_and_field(tmp_path / "a.ulg"), out=tmp_path / "out", kind="polynomial")
    assert [one.name for one in result.sensors] == ["gyro 0", "accel 0", "mag 0", "baro 0", "baro 1"]
    assert [bool(one.left_out) for one in result.sensors] == [False] * 5
    x = np.linspace(-14, 14, 50)
    for k in range(2):
        back = read_back(tmp_path / "out" / "vehicle.params", "baro", baro_device_id=6620172 + k)
        expected = PRESSURE[0] * x + PRESSURE[1] * x**2  # the pressure of the air is not in it
        np.testing.assert_allclose(back.bias(30 + x)[:, 0], expected, atol=0.5)
    back = read_back(tmp_path / "out" / "vehicle.params", "mag", mag_device_id=197388)
    expected = 1e-4 * (FIELD[0] * x[:, None] + FIELD[1] * x[:, None] ** 2)
    np.testing.assert_allclose(back.bias(30 + x), expected, atol=5e-8)


@pytest.mark.parametrize(("drift", "once"), [(400.0, False), (0.0, True)], ids=["weather", "one way"])
def test_what_may_be_the_weather_is_not_among_the_parameters(drift, once, tmp_path):
    log = air_and_field(tmp_path / "a.ulg", drift, once)
    result = driftlab.vehicle(log, out=tmp_path / "out", kind="polynomial")
    second = result.sensors[-1]
    assert "air pressure and field drift by themselves" in second.left_out
    assert "6620173" not in (tmp_path / "out" / "vehicle.params").read_text()
    assert bool(result.sensors[3].left_out) is once
    assert result.status == 0  # gyros and accelerometers are there
    page = (tmp_path / "out" / "report.html").read_text()
    assert all(one.title in page for one in result.sensors)
    assert f"{len(result.sensors)} of {len(result.sensors)} sensors have a map" in page


def test_levels_of_two_days_do_not_bend_the_curve(tmp_path):
    one = air_and_field(tmp_path / "a.ulg")
    result = driftlab.vehicle([f"{one}::0:3600", f"{one}::3600:"], kind="polynomial")
    assert len(result.sensors[3].recordings) == 2
    x = np.linspace(-14, 14, 50)
    bias = result.sensors[3].result.map.bias(30 + x)[:, 0]
    np.testing.assert_allclose(bias - bias.mean(), (e := PRESSURE[0] * x + PRESSURE[1] * x**2) - e.mean(), atol=0.5)


def test_maps_keep_their_devices_through_parameters_and_back(folder, tmp_path):
    driftlab.vehicle(folder / "soak.ulg", out=tmp_path / "out", kind="polynomial")
    again = []
    for channel, k in (("gyro", 1), ("accel", 1)):
        settings = {"instance": k}
        out = tmp_path / f"{channel}.json"
        driftlab.import_map("px4", tmp_path / "out" / "vehicle.params", out, channel=channel, settings=settings)
        driftlab.export("px4", out, tmp_path / f"{channel}.params")
        again += (tmp_path / f"{channel}.params").read_text().splitlines()
    lines = {line for line in (tmp_path / "out" / "vehicle.params").read_text().splitlines() if line[:4] == "1\t1\t"}
    ids = [line for line in again if "_ID\t" in line]
    assert ids == [f"1\t1\tTC_G1_ID\t{GYROS[1]}\t6", f"1\t1\tTC_A1_ID\t{ACCELS[1]}\t6"]
    assert set(ids) <= lines


@pytest.mark.recordings
def test_a_measured_log_of_three_units_that_is_too_short_says_so_of_each(recordings):
    logs = sorted((recordings / "data" / "px4_ulog").glob("*.ulg"))
    assert logs
    for log in logs:
        result = driftlab.vehicle(log)
        inertial, beside = result.sensors[:6], result.sensors[6:]
        assert [one.name for one in inertial] == [f"{name} {k}" for name in ("gyro", "accel") for k in range(3)]
        assert [one.name for one in beside] == [f"{name} {k}" for name in ("mag", "baro") for k in range(2)]
        assert len({one.device for one in result.sensors if one.channel == "gyro"}) == 3
        assert all(one.result is None and one.problem for one in result.sensors)
        assert (result.status, result.loss, result.problem) == (1, None, "no sensor has a map")
