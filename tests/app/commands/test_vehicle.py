"""All inertial units of a vehicle, from logs in which each has a bias of its own that is known."""

import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest
from autopilots import parameters
from dataflash_writer import write_log
from typer.testing import CliRunner
from ulog_writer import sensor, write_ulog

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


def px4(path, gyros=GYROS, **of_soak):
    t, units = soak(**of_soak)
    topics = []
    for k, (gyro, accel, T) in enumerate(units):
        topics += [
            sensor("sensor_gyro", k, t, gyro, T, gyros[k]),
            sensor("sensor_accel", k, t + 3e-4, accel, T, ACCELS[k]),
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


def test_on_the_command_line(folder, tmp_path):
    done = CliRunner().invoke(app, ["vehicle", str(folder / "soak.ulg"), "--out", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert [one["device_id"] for one in said["sensors"]] == [str(n) for n in (*GYROS, *ACCELS)]
    assert json.loads((tmp_path / "out" / "vehicle.json").read_text())["sensors"] == said["sensors"]
    again = CliRunner().invoke(app, ["vehicle", str(folder / "soak.ulg"), "--out", str(tmp_path / "out"), "-q"])
    assert (again.exit_code, again.stdout) == (0, "")
    (tmp_path / "out" / "vehicle.params").write_text("mine")
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
    px4(tmp_path / "other.ulg", gyros=GYROS[::-1])
    with pytest.raises(ConfigError, match=f"has the device id {GYROS[1]} as gyro 0.*logs of one vehicle"):
        driftlab.vehicle([folder / "soak.ulg", tmp_path / "other.ulg"])
    with pytest.raises(ConfigError, match="are of PX4 and of ArduPilot"):
        driftlab.vehicle([folder / "soak.ulg", folder / "soak.bin"])


def test_what_it_cannot_use_is_said(folder, tmp_path):
    (tmp_path / "a.csv").write_text("t,x\n0,1\n")
    with pytest.raises(DataError, match="is no log of an autopilot"):
        driftlab.vehicle(tmp_path / "a.csv")
    with pytest.raises(ConfigError, match="export c: is no autopilot's"):
        driftlab.vehicle(folder / "soak.ulg", export="c")
    with pytest.raises(ConfigError, match="instance: is of one sensor"):
        driftlab.vehicle(folder / "soak.ulg", settings={"instance": 1})


@pytest.mark.recordings
def test_a_measured_log_of_three_units_that_is_too_short_says_so_of_each():
    logs = sorted((Path(os.environ["DRIFTLAB_DATA"]) / "data" / "px4_ulog").glob("*.ulg"))
    assert logs
    for log in logs:
        result = driftlab.vehicle(log)
        assert [one.name for one in result.sensors] == [f"{name} {k}" for name in ("gyro", "accel") for k in range(3)]
        assert len({one.device for one in result.sensors if one.channel == "gyro"}) == 3
        assert all(one.result is None and one.problem for one in result.sensors)
        assert (result.status, result.loss, result.problem) == (1, None, "no sensor has a map")
