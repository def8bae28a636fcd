"""ArduPilot's parameters: what is written is read alike by its tools and back by us; nothing useless is written."""

import contextlib
import io

import numpy as np
import pytest
from flying_units import DEG_H, cubic, fitted, sensor, unit

from fusion_core.contracts import Export
from fusion_core.errors import ConfigError
from fusion_plugins.exporters.ardupilot import Ardupilot


def ardupilot(**settings):
    return Ardupilot.model_validate({"kind": "ardupilot", **settings})


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.parm"


def rows(path):
    """Return the parameters as pymavlink reads them, which MAVProxy loads files with."""
    from pymavlink.mavparm import MAVParmDict

    found = MAVParmDict()
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert found.load(str(path))
    assert "Invalid" not in said.getvalue()
    return dict(found)


def both(low=-10.0, high=50.0):
    accel = fitted(low=low, high=high, unit="m/s^2", channel="accel")
    return Export((sensor(fitted()), sensor(accel, channel="accel", unit="m/s^2", shown="mg")))


def test_the_file_has_what_the_firmware_looks_up(path):
    ardupilot().export(both(), path)
    found = rows(path)
    expected = {"INS_TCAL1_ENABLE", "INS_TCAL1_TMIN", "INS_TCAL1_TMAX", "INS_GYR1_CALTEMP"}
    expected |= {f"INS_TCAL1_{kind}{power}_{axis}" for kind in ("ACC", "GYR") for power in (1, 2, 3) for axis in "XYZ"}
    expected |= {f"INS_GYROFFS_{axis}" for axis in "XYZ"}
    assert set(found) == expected
    assert (found["INS_TCAL1_ENABLE"], found["INS_TCAL1_TMIN"], found["INS_TCAL1_TMAX"]) == (1, -10, 50)
    assert max(map(len, found)) <= 16  # of a parameter's name in MAVLink
    first = next(line for line in path.read_text().splitlines() if not line.startswith("#"))
    assert first == "INS_TCAL1_ENABLE 1"  # which makes the rest appear


@pytest.mark.parametrize(
    ("imu", "names"),
    [
        (1, {"INS_TCAL1_GYR3_Z", "INS_GYROFFS_X", "INS_GYR1_CALTEMP", "INS_ACCOFFS_Y", "INS_ACC1_CALTEMP"}),
        (3, {"INS_TCAL3_GYR3_Z", "INS_GYR3OFFS_X", "INS_GYR3_CALTEMP", "INS_ACC3OFFS_Y", "INS_ACC3_CALTEMP"}),
        (4, {"INS4_TCAL_GYR3_Z", "INS4_GYROFFS_X", "INS4_GYR_CALTEMP", "INS4_ACCOFFS_Y", "INS4_ACC_CALTEMP"}),
        (5, {"INS5_TCAL_TMAX", "INS5_GYROFFS_X", "INS5_GYR_CALTEMP", "INS5_ACCOFFS_Y", "INS5_ACC_CALTEMP"}),
    ],
)
def test_names_are_those_of_the_imu(imu, names, path):
    """Names by ArduPilot's parameter list: groups INS_ and INS4_, INS5_."""
    ardupilot(imu=imu, accel_offsets=True).export(both(), path)
    assert names <= set(rows(path))
    assert len(ardupilot(imu=imu).read(path)) == 2


@pytest.mark.parametrize(("low", "high", "T_cal"), [(-10.0, 50.0, 35.0), (-20.0, 22.0, 22.0), (41.0, 75.0, 41.0)])
def test_what_is_written_is_what_the_firmware_takes_off(low, high, T_cal, path):
    exact = fitted(low=low, high=high)
    (loss,) = ardupilot().export(unit(exact), path).sensors
    (back,) = ardupilot().read(path)
    assert rows(path)["INS_GYR1_CALTEMP"] == T_cal
    T = np.linspace(low, high, 20_010)
    found = np.max(np.abs(back.bias(T) - exact.bias(T)), axis=0)
    np.testing.assert_allclose(found, loss.domain.largest, rtol=1e-9)
    assert back.domain == (low, high)


def test_a_cubic_loses_nothing(path):
    (loss,) = ardupilot().export(unit(cubic()), path).sensors
    assert np.all(loss.domain.largest * DEG_H < 0.01)
    assert np.all(loss.warm_up.largest * DEG_H < 0.01)


def test_limits_are_rounded_to_a_tenth_and_what_that_costs_is_said(path):
    exact = cubic(-10.04, 50.06)
    (loss,) = ardupilot().export(unit(exact), path).sensors
    found = rows(path)
    assert (found["INS_TCAL1_TMIN"], found["INS_TCAL1_TMAX"]) == (-10, 50.1)
    # from -10.04 to -10 degC the value at -10 is used
    (lost,) = (cause for what, cause in loss.causes.items() if what == "the limits of temperature")
    np.testing.assert_allclose(
        lost.largest, np.abs(exact.bias(np.array([-10.04])) - exact.bias(np.array([-10.0])))[0], rtol=1e-6
    )


def test_sensors_of_an_imu_share_the_limits_that_both_know(path):
    loss = ardupilot().export(both(0.0, 60.0), path)
    found = rows(path)
    assert (found["INS_TCAL1_TMIN"], found["INS_TCAL1_TMAX"]) == (0, 50)
    assert "the limits of temperature" in loss.sensors[0].causes
    assert "gyro: gyro and accelerometer share 0 to 50 degC, less than the map's -10 to 50" in loss.notes
    assert not any(note.startswith("gyro: gyro and") for note in ardupilot().export(unit(fitted()), path).notes)


@pytest.mark.parametrize("high", [5.0, -0.1])
def test_a_swing_that_the_firmware_does_not_take_is_refused(high, path):
    with pytest.raises(ConfigError, match="ArduPilot asks for 10 K and more; calibrate over a wider soak"):
        ardupilot().export(unit(fitted(low=-10.0, high=high - 5.1)), path)
    assert not path.exists()


def test_a_map_of_another_unit_is_refused(path):
    with pytest.raises(ConfigError, match="the map of the mag is in T, ArduPilot corrects gyros"):
        ardupilot().export(Export((sensor(fitted(), channel="mag", unit="T", shown="uT"),)), path)


def test_coefficients_are_those_of_the_cubic_to_single_precision(path):
    """A cubic about 35 degC by its derivatives there, in millionths."""
    exact, h = cubic(), 1.0
    ardupilot().export(unit(exact), path)
    b = exact.bias(35 + h * np.arange(-2.0, 3.0))
    slope = exact.slope(np.array([35.0]))[0]
    bend, third = (b[3] - 2 * b[2] + b[1]) / 2, (b[4] - 2 * b[3] + 2 * b[1] - b[0]) / 12
    found = rows(path)
    for power, expected in enumerate((slope, bend, third), 1):
        held = [found[f"INS_TCAL1_GYR{power}_{axis}"] * 1e-6 for axis in "XYZ"]
        np.testing.assert_allclose(held, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose([found[f"INS_GYROFFS_{axis}"] for axis in "XYZ"], b[2], rtol=1e-6)


def test_accelerometers_keep_their_offset_unless_asked(path):
    loss = ardupilot().export(both(), path)
    assert not any("ACCOFFS" in name for name in rows(path))
    assert any("accel: its offset stays as it is" in note for note in loss.notes)
    ardupilot(accel_offsets=True).export(both(), path)
    assert {"INS_ACCOFFS_X", "INS_ACC1_CALTEMP"} <= set(rows(path))


def test_an_axis_without_a_map_keeps_its_offset(path):
    loss = ardupilot().export(unit(fitted(axes=1), ("z",)), path)
    found = rows(path)
    assert {name for name in found if "OFFS" in name} == {"INS_GYROFFS_Z"}
    assert all(found[f"INS_TCAL1_GYR{power}_X"] == 0 for power in (1, 2, 3))
    assert "gyro: the map has no x, y, which stay uncorrected" in loss.left_out


def test_the_comment_says_what_the_screen_says(path):
    loss = ardupilot().export(unit(fitted()), path)
    comments = [line[2:] for line in path.read_text().splitlines() if line.startswith("# ")]
    assert comments[1:] == loss.lines()
    assert path.read_text().isascii()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"INS_TCAL1_ENABLE": 0}, "INS_TCAL1_ENABLE is 0"),
        ({"INS_TCAL1_ENABLE": None}, "INS_TCAL1_ENABLE is missing"),
        ({"INS_TCAL1_ENABLE": 2}, "INS_TCAL1_ENABLE is 2, it is being learned"),
        ({f"INS_TCAL1_GYR{p}_{a}": 0 for p in (1, 2, 3) for a in "XYZ"}, "GYR1 to 3 and ACC1 to 3 are all 0"),
        ({"INS_TCAL1_TMAX": -10}, "INS_TCAL1_TMIN -10 and TMAX -10: expected a range; calibrate"),
    ],
)
def test_what_corrects_nothing_is_said_so(change, says, path):
    ardupilot().export(unit(fitted()), path)
    held = rows(path) | change
    path.write_text("".join(f"{name},{value}\n" for name, value in held.items() if value is not None))
    with pytest.raises(ConfigError, match=says):
        ardupilot().read(path)


def test_another_imu_that_is_corrected_is_named(path):
    ardupilot(imu=2).export(unit(fitted()), path)
    with pytest.raises(ConfigError, match=r"IMU 1 is not corrected .*and IMU 2 is corrected.*--set imu=N"):
        ardupilot().read(path)


def test_an_offset_without_its_temperature_is_read_as_the_firmware_does(path):
    ardupilot().export(unit(fitted()), path)
    path.write_text("".join(f"{k} {v!r}\n" for k, v in rows(path).items() if k != "INS_GYR1_CALTEMP"))
    (back,) = ardupilot().read(path)
    assert "INS_GYR1_CALTEMP is not set, the firmware takes TMIN" in back.notes[1]
    offset = [rows(path)[f"INS_GYROFFS_{axis}"] for axis in "XYZ"]
    np.testing.assert_allclose(back.bias(np.array([-10.0]))[0], offset, atol=1e-9)


def test_the_imu_of_the_log_is_taken(path):
    ardupilot().export(unit(fitted(provenance={"imu": "3"})), path)
    assert "INS_TCAL3_GYR1_X" in rows(path)
    two = Export((sensor(fitted(provenance={"imu": "1"})), sensor(fitted(provenance={"imu": "2"}), channel="gyro2")))
    ardupilot().export(two, path)
    assert {"INS_TCAL1_GYR1_X", "INS_TCAL2_GYR1_X", "INS_TCAL2_ENABLE", "INS_GYR2OFFS_X"} <= set(rows(path))
    of_one = Export((sensor(fitted()), sensor(fitted(unit="rad/s", high=40.0), channel="gyro2")))
    with pytest.raises(ConfigError, match="two of the sensors set it"):
        ardupilot(imu=1).export(of_one, path)
