"""Corrections of an autopilot, undone: against an emulation of its firmware's forward path in float32."""

import numpy as np
import pytest
from autopilots import TURNS, logged, parameters
from dataflash_writer import ACC, GYR, IMU, formats, record, rows, write_log
from dataflash_writer import parameters as parm
from pymavlink.rotmat import Matrix3
from recordings_on_disk import read

from fusion_core.errors import MissingChannel, UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash import DataFlash
from fusion_plugins.sources.dataflash.imu import ORIENTATIONS, rotation

COEFFICIENTS = {
    "GYR": np.array([[210.5, -80.25, 33.3], [3.1, -2.2, 0.4], [-0.05, 0.021, 0.013]]),
    "ACC": np.array([[-9000.0, 4000.0, 2500.0], [70.0, -35.0, 12.0], [-0.9, 0.4, 0.2]]),
}
TCAL = {sensor: (5.0, 62.3, 41.7, coefficients) for sensor, coefficients in COEFFICIENTS.items()}
SETTINGS = {
    "GYR": {"offset": (0.012, -0.034, 0.0056), "tcal": TCAL["GYR"]},
    "ACC": {"offset": (0.31, -0.22, 0.11), "scale": (1.01, 0.99, 1.004), "tcal": TCAL["ACC"]},
}


def channels(imu="IMU"):
    return {
        "time": {"path": f"{imu}.TimeUS"},
        "gyro": {"path": [f"{imu}.Gyr{axis}" for axis in "XYZ"]},
        "accel": {"path": [f"{imu}.Acc{axis}" for axis in "XYZ"]},
        "temperature": {"path": f"{imu}.T"},
    }


def samples(N=400):
    rng = np.random.default_rng(7)
    T = np.linspace(-5.0, 75.0, N)  # beyond both of the polynomial's limits
    return 3.0 + np.arange(N) / 50, rng.normal(size=(N, 3)), rng.normal(0, 5, (N, 3)), T


def test_every_orientation_is_the_firmwares():
    for number, turn in TURNS.items():
        R = np.stack([turn(*np.eye(3, dtype=np.float32)[k]) for k in range(3)], axis=1)
        np.testing.assert_allclose(rotation(*ORIENTATIONS[number]), R, atol=2e-6, err_msg=str(number))
    assert list(ORIENTATIONS) == list(range(44))


@pytest.mark.parametrize("angles", [(10.0, -20.0, 30.0), (180.0, 45.0, 270.0), (-7.5, 89.0, 3.0)])
def test_angles_turn_in_the_order_of_euler_321(angles):
    m = Matrix3()
    m.from_euler(*np.radians(angles))
    np.testing.assert_allclose(rotation(*angles), [[row.x, row.y, row.z] for row in (m.a, m.b, m.c)], atol=1e-12)


@pytest.mark.parametrize("orientation", [0, 6, 12, 38])
@pytest.mark.parametrize("imu", [0, 1, 2, 3])
def test_a_log_shows_what_the_sensors_measured(tmp_path, imu, orientation):
    t, omega, f, T = samples()
    seen, values = [], {}
    for sensor, v in (("GYR", omega), ("ACC", f)):
        settings = SETTINGS[sensor] | {"orientation": orientation}
        seen.append(logged(v, T, **settings))
        values |= parameters(sensor, imu, **settings)
    idle = (np.zeros((len(t), 3)), np.zeros((len(t), 3)), T)
    path = write_log(tmp_path / "l.bin", t, [*[idle] * imu, (*seen, T)], values)
    faults = Faults()
    got = read(DataFlash(path=path, imu=imu, channels=channels()), faults=faults)
    np.testing.assert_allclose(got["gyro"], omega, atol=2e-6)  # float32 of numbers up to 4
    np.testing.assert_allclose(got["accel"], f, atol=3e-5)  # of 15 and more
    kept = read(DataFlash(path=path, imu=imu, channels=channels(), compensated="keep"))
    np.testing.assert_array_equal(kept["gyro"], seen[0])
    assert np.abs(got["gyro"] - kept["gyro"]).max() > 1e-2
    name = "INS_TCAL" if imu < 3 else "INS4_TCAL"
    note = f"rows of gyro {imu} with corrections of the autopilot undone: "
    assert any(
        line.startswith(note) and f"{name}{imu + 1 if imu < 3 else ''} (polynomial)" in line for line in faults.lines()
    )


def test_a_polynomial_can_be_refused(tmp_path):
    t, omega, f, T = samples(50)
    path = write_log(tmp_path / "l.bin", t, [(omega, f, T)], parameters("GYR", tcal=TCAL["GYR"]))
    with pytest.raises(
        UnreadableFile, match=r"IMU 0 was compensated by the autopilot .*raw data were expected; set comp"
    ):
        read(DataFlash(path=path, channels=channels(), compensated="refuse"))
    path = write_log(tmp_path / "l.bin", t, [(omega, f, T)], parameters("GYR", offset=(1, 2, 3)))
    got = read(DataFlash(path=path, channels=channels(), compensated="refuse"))
    np.testing.assert_allclose(got["gyro"], omega + np.array([1.0, 2.0, 3.0]), atol=1e-6)


def test_while_a_polynomial_is_learned_it_is_not_applied(tmp_path):
    t, omega, f, T = samples(50)
    values = parameters("GYR", tcal=TCAL["GYR"]) | {"INS_TCAL1_ENABLE": 2}
    path = write_log(tmp_path / "l.bin", t, [(omega, f, T)], values)
    got = read(DataFlash(path=path, channels=channels(), compensated="refuse"))
    np.testing.assert_allclose(got["gyro"], omega, atol=1e-6)


def test_a_parameter_that_changes_holds_from_there_on(tmp_path):
    t, omega, f, T = samples()
    when = t[150] - 0.001
    seen = logged(omega, T, tcal=TCAL["GYR"])  # learned until then, as ENABLE 2, applied with an offset from there
    seen[:150] = logged(omega, T)[:150]
    seen[300:] = logged(omega, T, tcal=TCAL["GYR"], offset=(0.1, 0.2, 0.3))[300:]
    values = parameters("GYR", tcal=TCAL["GYR"]) | {"INS_TCAL1_ENABLE": 2}
    changes = [(when, "INS_TCAL1_ENABLE", 1.0)]
    changes += [
        (t[300] - 0.001, f"INS_GYROFFS_{axis}", value) for axis, value in zip("XYZ", (0.1, 0.2, 0.3), strict=True)
    ]
    path = write_log(tmp_path / "l.bin", t, [(seen, f, T)], values, changes)
    faults = Faults()
    for size in (37, 1000):
        got = read(DataFlash(path=path, channels=channels()), size, faults)
        np.testing.assert_allclose(got["gyro"], omega, atol=2e-6)
    assert any("undone: INS_GYROFFS (changed 1 times), INS_TCAL1 (polynomial)" in line for line in faults.lines())


@pytest.mark.parametrize("number", [100, 101, 102])
def test_a_custom_orientation(tmp_path, number):
    t, omega, f, T = samples(50)
    angles = (12.0, -34.0, 56.0)
    m = Matrix3()
    m.from_euler(*np.radians(angles))
    R = np.array([[row.x, row.y, row.z] for row in (m.a, m.b, m.c)])
    head, pitch = {100: ("AHRS_CUSTOM_", "PIT"), 101: ("CUST_ROT1_", "PITCH"), 102: ("CUST_ROT2_", "PITCH")}[number]
    values = {f"{head}{name}": angle for name, angle in zip(("ROLL", pitch, "YAW"), angles, strict=True)}
    path = write_log(tmp_path / "l.bin", t, [(omega @ R.T, f @ R.T, T)], {"AHRS_ORIENTATION": number} | values)
    got = read(DataFlash(path=path, channels=channels()))
    np.testing.assert_allclose(got["gyro"], omega, atol=1e-6)


def test_an_orientation_that_is_none(tmp_path):
    t, omega, f, T = samples(50)
    path = write_log(tmp_path / "l.bin", t, [(omega, f, T)], {"AHRS_ORIENTATION": 77})
    with pytest.raises(
        UnreadableFile, match="AHRS_ORIENTATION is 77, a known orientation was expected; set compensated: keep"
    ):
        read(DataFlash(path=path, channels=channels()))
    assert len(read(DataFlash(path=path, channels=channels(), compensated="keep"))) == 50


def test_a_log_without_parameters_says_so(tmp_path):
    t, omega, f, T = samples(50)
    path = write_log(tmp_path / "l.bin", t, [(omega, f, T)])
    faults = Faults()
    read(DataFlash(path=path, channels=channels()), faults=faults)
    note = "rows of gyro 0 in a log without parameters (PARM): what was corrected is not known: 50 "
    assert any(line.startswith(note) for line in faults.lines())


@pytest.mark.parametrize("T", [0.0, 23.0])
def test_a_thermometer_that_stands_still_is_told(tmp_path, T):
    t, omega, f, _ = samples(50)
    path = write_log(tmp_path / "l.bin", t, [(omega, f, np.full(50, T))], {"AHRS_ORIENTATION": 0})
    faults = Faults()
    read(DataFlash(path=path, channels=channels()), faults=faults)
    why = "it has no thermometer" if T == 0 else "its thermometer stands still"
    assert any(f"all show {T:g} °C ({why}" in line for line in faults.lines())


def test_samples_at_the_sensors_own_rate(tmp_path):
    """GYR and ACC are corrected as IMU is, with a temperature that IMU shows; behind the filters I counts on."""
    t, omega, f, T = samples()
    gyro, accel = (logged(v, T, **SETTINGS[s]) for s, v in (("GYR", omega), ("ACC", f)))
    values = parameters("GYR", **SETTINGS["GYR"]) | parameters("ACC", **SETTINGS["ACC"])
    body = formats() + parm(values)
    for k in range(len(t)):
        us, shift = round(t[k] * 1e6), 0.01 * (k % 3)  # written in bursts, later than sampled
        body += record(IMU, TimeUS=us, T=T[k])
        for unit in (0, 1):
            body += record(
                GYR, TimeUS=us + round(shift * 1e6), SampleUS=us, I=unit, **axes("Gyr", gyro[k] * (1 + unit))
            )
        body += record(ACC, TimeUS=us + round(shift * 1e6), SampleUS=us, **axes("Acc", accel[k]))
    path = tmp_path / "l.bin"
    path.write_bytes(body)
    of = {"time": {"path": "GYR.SampleUS"}, "gyro": {"path": ["GYR.GyrX", "GYR.GyrY", "GYR.GyrZ"]},
          "accel": {"path": ["ACC.AccX", "ACC.AccY", "ACC.AccZ"]}, "temperature": {"path": "IMU.T"}}  # fmt: skip
    got = read(DataFlash(path=path, channels=of))
    np.testing.assert_allclose(got.t, t, atol=1e-6)
    np.testing.assert_allclose(got["gyro"], omega, atol=2e-4)  # T by the time of writing, up to 20 ms late
    np.testing.assert_allclose(got["accel"], f, atol=5e-3)
    np.testing.assert_allclose(got["temperature"], T, atol=1e-5)
    of["gyro"]["path"] = ["GYR[1].GyrX", "GYR[1].GyrY", "GYR[1].GyrZ"]
    behind = read(DataFlash(path=path, channels=of))
    undone = 2 * (omega - SETTINGS["GYR"]["offset"]) + SETTINGS["GYR"]["offset"]
    assert np.abs(behind["gyro"] - undone).max() < 0.05  # the polynomial once more, nothing larger
    with pytest.raises(MissingChannel, match=r"has no GYR 2, it has GYR 0 \(400 rows"):
        read(DataFlash(path=path, imu=2, channels=of))


def axes(head, v):
    return {f"{head}{axis}": v[j] for j, axis in enumerate("XYZ")}


def test_earlier_vehicles_turned_first(tmp_path):
    """Up to Copter 3.2 (TimeMS): v = scale * R v - offset."""
    from dataflash_writer import Format

    t, omega, f, T = samples(60)
    old = Format(131, "IMU", "IffffffIIf", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,ErrG,ErrA,Temp")
    parm_old = Format(129, "PARM", "Nf", "Name,Value")
    offset, scale = np.array([0.1, -0.2, 0.3]), np.array([1.01, 0.98, 1.02])
    turned = [np.stack(TURNS[6](*v.T), axis=1) for v in (omega, f)]
    values = {"AHRS_ORIENTATION": 6}
    for j, axis in enumerate("XYZ"):
        values |= {f"INS_GYROFFS_{axis}": offset[j], f"INS_ACCOFFS_{axis}": offset[j], f"INS_ACCSCAL_{axis}": scale[j]}
    columns = {"TimeMS": np.rint(t * 1e3), "Temp": T}
    columns |= {f"Gyr{axis}": turned[0][:, j] - offset[j] for j, axis in enumerate("XYZ")}
    columns |= {f"Acc{axis}": turned[1][:, j] * scale[j] - offset[j] for j, axis in enumerate("XYZ")}
    path = tmp_path / "l.bin"
    parms = b"".join(record(parm_old, Name=name.encode(), Value=value) for name, value in values.items())
    path.write_bytes(formats([parm_old, old], units=False) + parms + rows(old, columns, 60).tobytes())
    got = read(DataFlash(path=path, channels=channels()))
    np.testing.assert_allclose(got.t, t, atol=6e-4)
    np.testing.assert_allclose(got["gyro"], omega, atol=1e-6)
    np.testing.assert_allclose(got["accel"], f, atol=1e-5)
    np.testing.assert_allclose(got["temperature"], T, atol=1e-5)
