"""PX4's parameters: what is written is read alike by PX4's tools and back by us; nothing useless is written."""

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import ulog_writer
from flying_units import DEG_H, cubic, fitted, sensor, unit

from fusion_core.contracts import Export
from fusion_core.errors import ConfigError
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.exporters.px4 import Px4
from fusion_plugins.thermal_maps.polynomial import Polynomial

DEVICE = 2490378


def px4(**settings):
    return Px4.model_validate({"kind": "px4", "device_id": DEVICE, **settings})


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.params"


def rows(path):
    """Return {name: (value, type)} as QGroundControl reads them: five columns by tabs, unless a line begins with #."""
    found = {}
    for line in path.read_text().splitlines():
        if not line.startswith("#"):
            vehicle, component, name, value, type_ = line.split("\t")
            assert (vehicle, component, found.get(name)) == ("1", "1", None)
            found[name] = (float(value) if type_ == "9" else int(value), int(type_))
    return found


def test_the_file_has_what_the_firmware_looks_up(path):
    px4(instance=2).export(unit(cubic()), path)
    found = rows(path)
    expected = {"TC_G_ENABLE", *(f"TC_G2_{end}" for end in ("ID", "TMIN", "TMAX", "TREF"))}
    expected |= {f"TC_G2_X{power}_{axis}" for power in range(4) for axis in range(3)}
    expected |= {f"CAL_GYRO2_{axis}OFF" for axis in "XYZ"}
    assert set(found) == expected
    assert found["TC_G_ENABLE"] == (1, 6)
    assert found["TC_G2_ID"] == (DEVICE, 6)
    assert found["CAL_GYRO2_YOFF"] == (0.0, 9)
    assert {type_ for _, type_ in found.values()} == {6, 9}
    assert max(map(len, found)) <= 16  # of a parameter's name in MAVLink


def test_what_is_written_is_what_the_firmware_takes_off(path):
    exact = fitted()
    (loss,) = px4().export(unit(exact), path).sensors
    (back,) = px4().read(path)
    T = np.linspace(-10, 50, 20_010)
    np.testing.assert_array_equal(np.max(np.abs(back.bias(T) - exact.bias(T)), axis=0), loss.domain.largest)
    assert (back.channel, back.unit, back.axes) == ("gyro", "rad/s", ("x", "y", "z"))
    assert back.domain == (-10.0, 50.0)
    np.testing.assert_array_equal(back.bias(np.array([-40.0, 80.0])), back.bias(np.array([-10.0, 50.0])))


def test_a_cubic_loses_nothing_but_the_stairs(path):
    """On a map that fits, the stairs cost the slope times the rms of what is uniform from 0 to 1 K: 1/sqrt(3) K."""
    exact = cubic()
    (loss,) = px4().export(unit(exact), path).sensors
    assert np.all(loss.domain.largest * DEG_H < 0.01)
    T = 50 - 60 * np.exp(-np.arange(3601.0) / 900)
    slope = np.sqrt(np.mean(exact.slope(T) ** 2, axis=0))
    ratio = loss.warm_up.rms / (slope / np.sqrt(3))
    assert np.all((ratio > 0.7) & (ratio < 1.3))
    stairs = loss.causes["its renewal in stairs"]
    np.testing.assert_allclose(stairs.rms, loss.warm_up.rms, rtol=1e-3)
    assert np.all(loss.causes["single precision"].largest * DEG_H < 0.01)


def test_causes_add_up_to_what_is_lost(path):
    """Each is measured by itself, so the largest of all is no more than their sum, and the rms no more than that."""
    (loss,) = px4().export(unit(fitted()), path).sensors
    assert list(loss.causes) == [
        "the polynomial in place of the map", "single precision", "its renewal in stairs"
    ]  # fmt: skip
    assert np.all(loss.warm_up.largest <= sum(cause.largest for cause in loss.causes.values()) * (1 + 1e-9))
    assert np.all(loss.warm_up.rms <= sum(cause.rms for cause in loss.causes.values()) * (1 + 1e-9))


def test_the_device_id_of_the_log_is_taken(path):
    Px4(kind="px4").export(unit(fitted(provenance={"device_id": "1310988"})), path)
    assert rows(path)["TC_G0_ID"] == (1310988, 6)


def test_without_a_device_id_nothing_is_written(path):
    with pytest.raises(ConfigError, match=r"the device id of the gyro is not known.*; give --set device_id=N"):
        Px4(kind="px4").export(unit(fitted()), path)
    assert not path.exists()


def test_accelerometers_and_barometers_have_their_own(path):
    both = Export(
        (
            sensor(fitted()),
            sensor(fitted(unit="m/s^2", channel="accel"), channel="accel", unit="m/s^2", shown="mg"),
            sensor(fitted("fifth", axes=1), ("x",), "pressure", "Pa", "Pa"),
        )
    )
    loss = px4(accel_device_id=1311500, baro_device_id=6620193).export(both, path)
    found = rows(path)
    assert found["TC_A0_ID"] == (1311500, 6)
    assert found["TC_B_ENABLE"] == (1, 6)
    assert {name for name in found if name.startswith("TC_B0_X")} == {f"TC_B0_X{power}" for power in range(6)}
    # the barometer's map is of fifth order, as PX4's is: nothing is lost
    assert np.all(loss.sensors[2].domain.largest < 1e-6 * np.max(np.abs(fitted(axes=1).bias(np.linspace(-10, 50, 99)))))
    back = px4(accel_device_id=1311500, baro_device_id=6620193).read(path)
    assert [(one.channel, one.unit, one.order) for one in back] == [
        ("gyro", "rad/s", 3), ("accel", "m/s^2", 3), ("baro", "Pa", 5)
    ]  # fmt: skip


def test_a_map_of_another_unit_is_refused(path):
    with pytest.raises(ConfigError, match="the map of the supply is in V, PX4 corrects sensors in rad/s"):
        px4().export(Export((sensor(fitted(), channel="supply", unit="V", shown="mV"),)), path)


def test_a_magnetometer_is_held_in_gauss_and_comes_back_in_tesla(path):
    tesla = sensor(fitted("cubic", unit="T", channel="mag"), channel="mag", unit="T", shown="uT")
    (loss,) = px4(mag_device_id=197388, instance=1).export(Export((tesla,)), path).sensors
    found, T = rows(path), np.linspace(-10, 50, 99)
    middle = tesla.fitted.bias(np.array([20.0]))[0]
    np.testing.assert_allclose([found[f"TC_M1_X0_{k}"][0] for k in range(3)], middle * 1e4, rtol=1e-6)  # 1 T is 1e4 G
    assert (found["TC_M_ENABLE"], found["TC_M1_ID"]) == ((1, 6), (197388, 6))
    (back,) = Px4(kind="px4", mag_device_id=197388).read(path)
    np.testing.assert_allclose(back.bias(T), tesla.fitted.bias(T), atol=1e-9)
    np.testing.assert_array_equal(
        np.max(np.abs(back.bias(T) - tesla.fitted.bias(T)), axis=0) <= loss.domain.largest, True
    )
    assert dict(back.about) == {"device_id": "197388", "instance": "1"}


def test_the_pressure_of_the_air_is_no_offset(path):
    T = np.linspace(-10, 50, 500)
    whole = Polynomial(order=3).fit(T, (101325 + 3 * T)[:, None], {})
    with pytest.raises(ConfigError, match="pressure is 101385 Pa at 20 °C, the pressure of the air and no offset; fit"):
        px4(baro_device_id=5).export(Export((sensor(whole, ("x",), "pressure", "Pa", "Pa"),)), path)


def test_stairs_are_finer_beside_a_sensor_of_other_temperatures(path):
    other = sensor(fitted(low=0.0, high=30.0), channel="gyro 1")
    one = sensor(fitted(provenance={"device_id": "7", "instance": "0"}), channel="gyro 0")
    two = replace(other, map=fitted(low=0.0, high=30.0, provenance={"device_id": "9", "instance": "1"}))
    exporter = Px4(kind="px4")
    alone = exporter.export(Export((one,)), path).sensors[0]
    both = exporter.export(Export((one, two)), path).sensors[0]
    stairs = [loss.causes["its renewal in stairs"].rms for loss in (alone, both)]
    assert np.all(stairs[1] < 0.9 * stairs[0])
    assert rows(path)["TC_G1_ID"] == (9, 6)


def test_axes_that_the_map_lacks_stay_uncorrected_and_that_is_said(path):
    loss = px4().export(unit(fitted(axes=1), ("z",)), path)
    assert "gyro: the map has no x, y, which stay uncorrected" in loss.left_out
    found = rows(path)
    assert all(found[f"TC_G0_X{power}_{axis}"][0] == 0 for power in range(4) for axis in (0, 1))
    assert found["TC_G0_X0_2"][0] != 0
    # nor is the offset of those axes another one
    assert {name for name in found if name.startswith("CAL")} == {"CAL_GYRO0_ZOFF"}
    assert any("CAL_GYRO0_ZOFF are set to 0" in note for note in loss.notes)


def test_effects_are_left_out_with_their_size(path):
    play = Hysteresis.model_validate({"kind": "hysteresis", "width": "9 K", "coefficients": [2e-5, 0, 1e-5]})
    walk = np.full(3, 1 / 3600 / 60)
    loss = px4().export(unit(fitted(), effects=(play,), walk=np.radians(walk)), path)
    T = 50 - 60 * np.exp(-np.arange(3601.0) / 900)
    # a play of width w begun in its middle: it moves once w / 2 is used up, so by T - T_0 - w / 2 from there on
    said, of_walk = loss.left_out
    sizes = [
        float(x)
        for x in re.fullmatch(r"gyro: hysteresis of temperature, (.*) deg/h rms over a warm-up", said)[1].split("/")
    ]
    assert sizes[1] == 0
    assert sizes[0] == pytest.approx(2 * sizes[2], rel=0.01)
    assert 0 < sizes[0] < 2e-5 * np.ptp(T) * DEG_H
    assert of_walk == "gyro: the random walk about it, 1/1/1 deg/h after an hour (1 sigma)"
    (lost,) = loss.sensors
    np.testing.assert_allclose(lost.causes["effects beyond a map"].rms * DEG_H, sizes, rtol=0.01)


def test_the_comment_says_what_the_screen_says(path):
    loss = px4().export(unit(fitted()), path)
    comments = [line[2:] for line in path.read_text().splitlines() if line.startswith("# ")]
    assert comments[1:-1] == loss.lines()
    assert path.read_text().isascii()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"TC_G_ENABLE": 0}, "TC_G_ENABLE is 0"),
        ({"TC_G_ENABLE": None}, "TC_G_ENABLE is missing"),
        ({"TC_G0_ID": 0}, "gyro 0 has no TC_Gn_ID"),
        ({f"TC_G0_X{p}_{a}": 0 for p in range(4) for a in range(3)}, "TC_G0_X0 to _X3 are all 0 or missing"),
        ({"TC_G0_TMAX": -10}, "TC_G0_TMIN -10, _TMAX -10, _TREF 20 are no range"),
    ],
)
def test_what_corrects_nothing_is_said_so(change, says, path):
    px4().export(unit(fitted()), path)
    held = {name: value for name, (value, _) in rows(path).items()} | change
    path.write_text("".join(f"{name},{value}\n" for name, value in held.items() if value is not None))
    with pytest.raises(ConfigError, match=f"corrects nothing for temperature .*{says}.*; give all parameters"):
        Px4(kind="px4").read(path)


def test_a_vehicle_that_was_given_the_file_logs_what_we_read(path, tmp_path):
    """The parameters through PX4's own log and pyulog's `ulog_params`, in both of its formats for ground stations."""
    px4().export(unit(fitted()), path)
    held = {name: value for name, (value, _) in rows(path).items()}
    log = ulog_writer.write_ulog(tmp_path / "a.ulg", [], held)
    T = np.linspace(-20, 60, 99)
    (expected,) = px4().read(path)
    for form in ("qgc", "csv"):
        ulog_params = [sys.executable, "-c", "from pyulog.params import main; main()"]
        subprocess.run([*ulog_params, "-i", "-f", form, log, tmp_path / form], check=True)
        (found,) = px4().read(tmp_path / form)
        assert np.array_equal(found.bias(T), expected.bias(T))


def test_a_coefficient_that_is_missing_is_said(path):
    px4().export(unit(fitted()), path)
    (whole,) = px4().read(path)
    path.write_text("".join(f"{line}\n" for line in path.read_text().splitlines() if "_X1_0" not in line))
    (back,) = px4().read(path)
    assert back.notes[1] == "TC_G0_X1_0: missing, taken as 0, which they are by default"
    assert np.all(np.ptp(back.bias(np.array([-10.0, 50.0])) - whole.bias(np.array([-10.0, 50.0])), axis=0)[1:] == 0)


def test_a_device_that_is_not_there(path):
    px4().export(unit(fitted()), path)
    with pytest.raises(ConfigError, match=f"gyro 7 has no TC_Gn_ID beside TC_G0_ID {DEVICE}; name a device"):
        px4(device_id=7).read(path)


def test_an_offset_of_the_same_device_is_taken_off_besides(path):
    px4().export(unit(fitted()), path)
    (before,) = px4().read(path)
    with path.open("a") as file:
        file.write(f"CAL_GYRO1_ID,{DEVICE}\nCAL_GYRO1_XOFF,0.002\nCAL_GYRO1_YOFF,0\nCAL_GYRO1_ZOFF,-0.001\n")
    (after,) = px4().read(path)
    T = np.array([-5.0, 30.0])
    np.testing.assert_allclose(after.bias(T) - before.bias(T), [[0.002, 0, -0.001]] * 2, atol=1e-12)
    assert "CAL_GYRO1_XOFF" in after.notes[1]


def test_a_barometer_has_one_axis(path):
    two = sensor(fitted(axes=2), ("x", "y"), "pressure", "Pa", "Pa")
    with pytest.raises(ConfigError, match="pressure has 2 axes, a barometer has one; give"):
        px4(baro_device_id=5).export(Export((two,)), path)


def test_names_are_those_of_the_sensor_in_its_log(path):
    """The second of two gyros, whose offset is in the third slot: nothing of another gyro is touched."""
    log = {"device_id": "1310988", "instance": "1", "calibration": "2"}
    loss = Px4(kind="px4").export(unit(fitted(provenance=log)), path)
    found = rows(path)
    assert found["TC_G1_ID"] == (1310988, 6)
    assert {name for name in found if name.startswith("CAL")} == {f"CAL_GYRO2_{axis}OFF" for axis in "XYZ"}
    assert any("CAL_GYRO2_XOFF" in note for note in loss.notes)
