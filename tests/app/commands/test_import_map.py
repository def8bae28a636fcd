"""From the log of a vehicle to its parameters and back: what is in the vehicle is what `compare` compares."""

import gzip
import json

import dataflash_writer
import numpy as np
import pytest
import ulog_writer
from flying_units import cubic, fitted, unit
from typer.testing import CliRunner
from units_at_rest import unit_at_rest

from driftlab.cli import app
from driftlab.commands.import_map import import_map
from driftlab.storage.map_file import read_map
from fusion_core.errors import ConfigError
from fusion_plugins.exporters.ardupilot import Ardupilot
from fusion_plugins.exporters.px4 import Px4

DEVICE = 2490378
EXPORTERS = [(Px4(kind="px4", device_id=DEVICE), "a.params"), (Ardupilot(kind="ardupilot"), "a.parm")]
targets = pytest.mark.parametrize(("exporter", "name"), EXPORTERS, ids=["px4", "ardupilot"])


def called(*args, status=0):
    done = CliRunner().invoke(app, [str(arg) for arg in args], catch_exceptions=True)
    if status:
        assert isinstance(done.exception, ConfigError), done.output
        return str(done.exception)
    assert done.exit_code == 0, (done.exception, done.output)
    return done.output


def imported(exporter, name, folder, out="map.json", **more):
    settings = {"device_id": DEVICE} if exporter.kind == "px4" else {}
    return import_map(exporter.kind, folder / name, folder / out, settings=settings, **more)


@targets
def test_what_comes_back_is_what_the_firmware_holds(exporter, name, tmp_path):
    exporter.export(unit(fitted()), tmp_path / name)
    found = imported(exporter, name, tmp_path)
    held = read_map(tmp_path / "map.json")
    T = np.linspace(-10, 50, 999)
    # to the rounding of single precision at the largest offset, 4e-3 rad/s, of some four operations
    np.testing.assert_allclose(held.bias(T), found.read.bias(T), atol=4 * 4e-3 * 2**-24)
    record = held.record
    assert (record.channel, record.unit, record.axes, record.kind) == ("gyro", "rad/s", ("x", "y", "z"), "polynomial")
    assert (record.residual, record.samples, record.error) == (None, 0, None)
    assert record.provenance["imported_from"] == name


@targets
def test_a_cubic_goes_round(exporter, name, tmp_path):
    exporter.export(unit(cubic()), tmp_path / name)
    imported(exporter, name, tmp_path)
    T = np.linspace(-10, 50, 999)
    np.testing.assert_allclose(read_map(tmp_path / "map.json").bias(T), cubic().bias(T), atol=3e-9)


def test_another_kind_of_map_and_a_channel_that_is_not_there(tmp_path):
    exporter, name = EXPORTERS[0]
    exporter.export(unit(fitted()), tmp_path / name)
    found = import_map(exporter.kind, tmp_path / name, tmp_path / "map.json", map_kind="spline")
    assert found.map.record.kind == "spline"
    with pytest.raises(ConfigError, match=r"--channel accel: .*a.params has a thermal calibration of gyro alone; name"):
        import_map(exporter.kind, tmp_path / name, tmp_path / "map.json", channel="accel")
    with pytest.raises(ConfigError, match=r"--kind splin: did you mean spline"):
        import_map(exporter.kind, tmp_path / name, tmp_path / "map.json", map_kind="splin")


def test_the_parameters_are_not_overwritten_by_the_map(tmp_path):
    exporter, name = EXPORTERS[0]
    exporter.export(unit(fitted()), tmp_path / name)
    with pytest.raises(ConfigError, match="is read here, and would be lost"):
        imported(exporter, name, tmp_path, name)


def test_a_form_that_cannot_be_read_back(tmp_path):
    said = called("import", "csv_table", tmp_path / "a.csv", "--out", tmp_path / "map.json", status=2)
    assert "cannot be read back; only some forms can, as px4 and ardupilot" in said


@pytest.fixture(params=["px4", "ardupilot"])
def logs(request, tmp_path):
    """The kind of target and a function that writes a vehicle's log of a unit at rest."""

    def write(name, seconds, temperature):
        at_rest = unit_at_rest(seconds=seconds, rate=5, temperature=temperature, walk=1e-8)
        t = at_rest.t + 20
        if request.param == "ardupilot":
            rows = (at_rest.gyro, at_rest.accel, at_rest.temperature)
            return dataflash_writer.write_log(tmp_path / f"{name}.bin", t, [rows, rows])
        sensors = [("sensor_gyro", at_rest.gyro), ("sensor_accel", at_rest.accel)]
        topics = [ulog_writer.sensor(topic, 0, t, xyz, at_rest.temperature, DEVICE) for topic, xyz in sensors]
        return ulog_writer.write_ulog(tmp_path / f"{name}.ulg", topics, {"CAL_GYRO3_ID": DEVICE})

    return request.param, write


def test_from_a_log_to_parameters_and_back_to_a_comparison(logs, tmp_path):
    kind, write = logs
    of_imu = {"px4": {}, "ardupilot": {"source": {"imu": 1}}}[kind]
    config = {"extends": f"{kind}_log", "latitude": "40.9 deg", "heading": "0 deg", **of_imu}
    bare, vehicle = tmp_path / "bare.yaml", tmp_path / "vehicle.yaml"
    bare.write_text(json.dumps(config))
    soak, run = write("soak", 2400, lambda t: 5 + t / 60), write("run", 400, lambda t: 20 + t / 40)
    called("fit-map", bare, "--input", soak, "--kind", "polynomial", "--out", tmp_path / "map.json")
    known = read_map(tmp_path / "map.json").record.provenance
    written = tmp_path / "a.parameters"
    said = called("export", kind, tmp_path / "map.json", "--out", written)
    if kind == "px4":
        assert (known["device_id"], known["instance"], known["calibration"]) == (str(DEVICE), "0", "3")
        assert "its renewal in stairs" in said
        assert "CAL_GYRO3_XOFF" in written.read_text()
    else:
        assert known["imu"] == "2"  # as INS_TCAL2, the log's IMU 1
        assert "INS_TCAL2_GYR1_X" in written.read_text()
    loss = json.loads((tmp_path / "loss.json").read_text())["exports"][written.name]
    assert loss["loss"][0]["unit"] == "deg/h"
    settings = ["--set", "imu=2"] if kind == "ardupilot" else ["--set", f"device_id={DEVICE}"]
    said = called("import", kind, written, "--out", tmp_path / "vehicle.json", *settings)
    line = next(line for line in said.splitlines() if "calibration:" in line)
    assert "outside: clamp" in line
    calibration = {"kind": "polynomial", "path": "vehicle.json", "outside": "clamp"}
    vehicle.write_text(json.dumps({**config, "filter": {"gyro": {"calibration": calibration}}}))
    found = json.loads(called("compare", bare, vehicle, "--input", run, "--json"))["configs"]
    before, after = (np.linalg.norm(found[name]["coast_rmse_rad_s"]["to the end"]) for name in ("bare", "vehicle"))
    assert after < 0.3 * before


def test_a_log_has_the_parameters_of_its_vehicle(tmp_path):
    t, still, path = np.arange(20.0) + 5, np.zeros((20, 3)), tmp_path / "a.params"
    Px4(kind="px4", device_id=DEVICE, instance=1).export(unit(cubic()), path)
    written = (line.split("\t")[2:] for line in path.read_text().splitlines() if line[0] != "#")
    values = {name: int(value) if kind == "6" else float(value) for name, value, kind in written}
    rows = [ulog_writer.sensor("sensor_gyro", 0, t, still, 20.0, 7)]
    log = ulog_writer.write_ulog(tmp_path / "flight.ulg", rows, values)
    packed = tmp_path / "flight.ulg.gz"
    packed.write_bytes(gzip.compress(log.read_bytes()))
    T = np.linspace(-10, 50, 99)
    for place in (log, packed):
        found = import_map("px4", place, tmp_path / "map.json", settings={"device_id": DEVICE})
        np.testing.assert_allclose(found.map.bias(T), cubic().bias(T), atol=3e-9)
        about = read_map(tmp_path / "map.json").record.provenance
        assert (about["device_id"], about["instance"], about["imported_from"]) == (str(DEVICE), "1", place.name)
    with pytest.raises(ConfigError, match=r"flight.ulg: gyro 9 has no TC_Gn_ID beside TC_G1_ID"):
        import_map("px4", log, tmp_path / "map.json", settings={"device_id": 9})
    Ardupilot(kind="ardupilot").export(unit(cubic()), tmp_path / "a.parm")
    lines = (line.split() for line in (tmp_path / "a.parm").read_text().splitlines() if line[0] != "#")
    logged = {name: float(value) for name, value in lines}
    dataflash_writer.write_log(tmp_path / "b.bin", t, [(still, still, t)], logged | {"INS_TCAL1_ENABLE": 0},
                               [(9.0, "INS_TCAL1_ENABLE", 1)])  # fmt: skip
    found = import_map("ardupilot", tmp_path / "b.bin", tmp_path / "map.json")
    np.testing.assert_allclose(found.map.bias(T), cubic().bias(T), atol=3e-9)
    assert found.map.record.provenance["imu"] == "1"
