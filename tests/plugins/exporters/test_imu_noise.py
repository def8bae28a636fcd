"""Noise for Kalibr, OpenVINS and VINS: as their readers take it, and as their integration uses it."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from driftlab.errors import ConfigError
from fusion_core.contracts import CurveError, Factor, Inflation, Lag, TriadMatrix
from fusion_core.testing.exporters import unit
from fusion_core.units import Quantity
from fusion_plugins.exporters.kalibr import Kalibr
from fusion_plugins.exporters.openvins import OpenVins

KEYS = {
    "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density", "gyroscope_random_walk",
    "rostopic", "update_rate",
}  # fmt: skip


def written(exporter, what, path):
    loss = exporter.export(what, path / "imu.yaml")
    return (path / "imu.yaml").read_text(), loss


def inflated(what, white, walk, lags=(), name="raw"):
    """The unit with a gyro whose run says these factors."""
    gyro = what.sensor("gyro")
    white, walk = (Factor(np.array(v), 0.9 * np.array(v), 1.1 * np.array(v)) for v in (white, walk))
    found = Inflation(gyro.noise, gyro.walk, white, walk, lags)
    return replace(what, sensors=(replace(gyro, **{name: found}), *what.sensors[1:]))


def test_kalibr_reads_the_largest_density_of_each_sensor(tmp_path):
    what = unit()
    text, loss = written(Kalibr(topic="/unit/imu"), what, tmp_path)
    read = yaml.safe_load(text)
    assert set(read) == KEYS
    assert (read["rostopic"], read["update_rate"]) == ("/unit/imu", 200.0)
    for name, channel in (("gyroscope", "gyro"), ("accelerometer", "accel")):
        sensor = what.sensor(channel)
        assert read[f"{name}_noise_density"] == pytest.approx(np.max(sensor.noise), rel=1e-8)
        assert read[f"{name}_random_walk"] == pytest.approx(np.max(sensor.walk), rel=1e-8)
    assert all(isinstance(read[key], float) for key in KEYS - {"rostopic"})
    assert "gyro: no inflation was measured" in "\n".join(loss.notes)
    assert "# one value for three axes: the largest" in text


def test_numbers_are_numbers_to_a_reader_of_yaml_1_1(tmp_path):
    """PyYAML takes 5e-06 for a text: there has to be a point."""
    what = unit()
    plain = tuple(replace(one, noise=np.full(3, 5e-3), walk=np.full(3, 5e-6)) for one in what.sensors)
    text, _ = written(Kalibr(), replace(what, sensors=plain), tmp_path)
    assert yaml.safe_load(text)["gyroscope_random_walk"] == 5e-6


def test_openvins_has_what_its_reader_wants(tmp_path):
    text, _ = written(OpenVins(), unit(), tmp_path)
    first, rest = text.split("\n", 1)
    assert first == "%YAML:1.0"  # OpenCV's, which is no YAML directive: the rest is YAML
    (name, read), = yaml.safe_load(rest).items()  # fmt: skip
    assert name == "imu0"
    assert set(read) >= {*KEYS, "T_i_b", "time_offset", "model", "Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC", "Tg"}
    for key, value in {
        "T_i_b": np.eye(4),
        **dict.fromkeys(("Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC"), np.eye(3)),
    }.items():
        np.testing.assert_array_equal(read[key], value)
    np.testing.assert_array_equal(read["Tg"], np.zeros((3, 3)))


def constant_matrix(M, domain):
    """M (3, 3) at all temperatures."""
    return TriadMatrix(
        T=domain, values=(tuple(M.ravel().tolist()),) * 2, slopes=((0.0,) * 9,) * 2, frame="given",
        kinds=("constant",) * 9, told=(True,) * 9,
    )  # fmt: skip


def test_openvins_takes_off_scale_factor_and_misalignment_at_a_temperature(tmp_path):
    """By its own arithmetic: R_GYROtoIMU Dw (reading - bias), Dw lower triangular, R the inverse of the file's."""
    rng, T = np.random.default_rng(4), np.array([-20.0, 5.0, 60.0])
    error = CurveError(T=(-20.0, 60.0), modes=(((1e-4,) * 9, (2e-4,) * 9),), bend=(0.0,) * 9)
    what, matrices = unit("gyro", "accel"), {}
    sensors = []
    for sensor in what.sensors:
        values, slopes = rng.normal(0, 0.02, (3, 9)), rng.normal(0, 1e-4, (3, 9))
        matrix = TriadMatrix(
            T=T.tolist(), values=values.tolist(), slopes=slopes.tolist(), frame="given", kinds=("order 3",) * 9,
            told=(True,) * 9, error=error,
        )  # fmt: skip
        matrices[sensor.channel] = matrix
        sensors.append(replace(sensor, map=sensor.map.noting(matrix=matrix, domain=(-20.0, 60.0))))
    exporter, what = OpenVins(at=Quantity(5.0, "5 degC")), replace(what, sensors=tuple(sensors))
    text, loss = written(exporter, what, tmp_path)
    read, u = yaml.safe_load(text.split("\n", 1)[1])["imu0"], rng.normal(size=3)
    for channel, names in (("gyro", ("Tw", "R_IMUtoGYRO")), ("accel", ("Ta", "R_IMUtoACC"))):
        triangle, rotation = (np.array(read[name]) for name in names)
        D = np.linalg.inv(triangle)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-8)
        assert np.linalg.det(rotation) > 0
        np.testing.assert_allclose(triangle[np.triu_indices(3, 1)], 0.0, atol=1e-9)
        y = u + matrices[channel].at(np.array([5.0]))[0] @ u
        np.testing.assert_allclose(rotation.T @ np.tril(D) @ y, u, atol=1e-8)
        change = matrices[channel].at(np.linspace(-20, 60, 2001)) - matrices[channel].at(np.array([5.0]))
        ppm = 1e6 * np.max(np.abs(change).sum(axis=2))
        assert f"{channel}: scale factor and misalignment are those of 5 degC" in text
        assert f"they lose {ppm:.3g} ppm of the input at most" in "\n".join(loss.notes)
    with pytest.raises(ConfigError, match="at 80 degC is beyond the map of gyro, -20 to 60 degC; give one within"):
        written(OpenVins(at=Quantity(80.0, "80 degC")), what, tmp_path)
    vins = OpenVins(form="vins")
    lost = written(vins, what, tmp_path)[1]
    assert not any("misalignment" in note for note in lost.notes)
    for channel, matrix in matrices.items():
        M = np.abs(matrix.at(np.linspace(-20, 60, 2001)))
        largest = "/".join(f"{float(f'{1e6 * M[:, k, k].max():.3g}'):g}" for k in range(3))
        assert any(text.startswith(f"{channel}: {largest} ppm of scale factor and ") for text in lost.left_out)


def test_kalibr_takes_off_scale_factor_and_misalignment_at_a_temperature(tmp_path):
    """By its model: accelerations are M a, rates M C_gyro_i omega in the frame of the accelerometer's M."""
    rng, what = np.random.default_rng(6), unit("gyro", "accel")
    assert "model" not in yaml.safe_load(written(Kalibr(), what, tmp_path)[0])
    matrices = {s.channel: constant_matrix(rng.normal(0, 0.02, (3, 3)), (-20.0, 60.0)) for s in what.sensors}
    sensors = (replace(s, map=s.map.noting(matrix=matrices[s.channel], domain=(-20.0, 60.0))) for s in what.sensors)
    text, loss = written(Kalibr(), replace(what, sensors=tuple(sensors)), tmp_path)
    read = yaml.safe_load(text)
    assert read["model"] == "scale-misalignment"
    of_accel, of_gyro, turn = (
        np.array(m) for m in (read["accelerometers"]["M"], read["gyroscopes"]["M"], read["gyroscopes"]["C_gyro_i"])
    )
    for triangle in (of_accel, of_gyro):
        np.testing.assert_array_equal(triangle[np.triu_indices(3, 1)], 0.0)
    np.testing.assert_array_equal(read["gyroscopes"]["A"], np.zeros((3, 3)))
    whole = {channel: np.eye(3) + matrix.at(np.array([0.0]))[0] for channel, matrix in matrices.items()}
    frame = np.linalg.solve(of_accel, whole["accel"])  # from the map's frame to Kalibr's i
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-8)
    np.testing.assert_allclose(of_gyro @ turn @ frame, whole["gyro"], atol=1e-8)
    assert np.linalg.det(turn) == pytest.approx(1)
    assert any("are those of 20 degC; from -20 to 60 degC they lose" in note for note in loss.notes)
    assert any(note.startswith("C_gyro_i: is right where both maps are in one frame") for note in loss.notes)


def test_vins_integrates_to_the_same_variances(tmp_path):
    """By the noise matrices of its midpoint integration, over a second of samples: angle, velocity and bias."""
    what, rate = unit(), 250.0
    text, _ = written(OpenVins(form="vins", rate=Quantity(rate, "250 Hz")), what, tmp_path)
    read = yaml.safe_load(text.split("\n", 1)[1])
    dt, gyro, accel = 1 / rate, what.sensor("gyro"), what.sensor("accel")
    V = np.array([0.5 * dt, 0.5 * dt])  # of the noise of the two samples that a step is the mean of
    for key, sensor in (("gyr", gyro), ("acc", accel)):
        integral = rate * V @ (read[f"{key}_n"] ** 2 * np.eye(2)) @ V
        bias = rate * (read[f"{key}_w"] * dt) ** 2
        assert integral == pytest.approx(np.max(sensor.noise) ** 2, rel=1e-6)  # noise^2 times a second
        assert bias == pytest.approx(np.max(sensor.walk) ** 2, rel=1e-6)


def test_factors_of_a_run_are_in_and_told(tmp_path):
    what = inflated(unit(), [1.0, 1.2, 2.0], [1.0, 4.0, 1.0])
    gyro = what.sensor("gyro")
    text, loss = written(Kalibr(), what, tmp_path)
    read = yaml.safe_load(text)
    assert read["gyroscope_noise_density"] == pytest.approx(np.max(gyro.noise * [1.0, 1.2, 2.0]))
    assert read["gyroscope_random_walk"] == pytest.approx(np.max(gyro.walk * [1.0, 4.0, 1.0]))
    assert "(axis y), 4 times the declared 1e-06: innovations say 4 (3.6 to 4.4 at 95 %)" in text
    assert not any(note.startswith("gyro: no inflation") for note in loss.notes)
    assert any(note.startswith("accel: no inflation") for note in loss.notes)


def test_the_walk_covers_lags_up_to_the_horizon_only(tmp_path):
    lag = Lag(600.0, np.array([5.0, 1.0, 1.0]), np.full(3, 1.2), np.array([30.0, 0.5, 0.5]), 40)
    what = inflated(unit(), [1.0] * 3, [1.0] * 3, (lag,))
    walks = []
    for seconds in (60.0, 600.0):
        text, loss = written(Kalibr(horizon=Quantity(seconds, f"{seconds:g} s")), what, tmp_path)
        walks.append(yaml.safe_load(text)["gyroscope_random_walk"])
        assert any("5/1/1 over 600 s (up to 1.2 is chance)" in note for note in loss.notes)
    walk = what.sensor("gyro").walk
    assert walks == pytest.approx([np.max(walk), 30 * walk[0]])


def test_readings_that_are_compensated_have_factors_of_their_own(tmp_path):
    what = inflated(inflated(unit("gyro"), [1.0] * 3, [9.0] * 3), [1.0] * 3, [2.0] * 3, name="compensated")
    text, loss = written(Kalibr(), what, tmp_path)
    with_temperature = yaml.safe_load(text)["gyroscope_random_walk"]
    assert any("a walk of" in note and "over 60 s, at most" in note for note in loss.notes)
    text, loss = written(Kalibr(compensated=True), what, tmp_path)
    assert with_temperature / yaml.safe_load(text)["gyroscope_random_walk"] == pytest.approx(4.5)
    assert any("from which map and effects have been taken" in note for note in loss.notes)
    assert loss.left_out == ("the gyro's thermal map and effects",)


def test_what_is_not_known_is_asked_for(tmp_path):
    what = unit()
    with pytest.raises(ConfigError, match="kalibr: the rate of the messages is not known; add --set 'rate=200 Hz'"):
        Kalibr().export(replace(what, rate=None), tmp_path / "a")
    with pytest.raises(ConfigError, match=r"no sensor of accel in m/s\^2 is known; give a config whose filter.accel"):
        Kalibr().export(replace(what, sensors=what.sensors[:1]), tmp_path / "a")
    still = tuple(replace(one, walk=np.zeros(3)) for one in what.sensors)
    with pytest.raises(ConfigError, match="the walk of gyro is zero; declare one"):
        Kalibr().export(replace(what, sensors=still), tmp_path / "a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("topic", ["no", "~/imu", "/a/b_1"])
def test_a_topic_is_a_text_whatever_it_is_called(topic, tmp_path):
    text, _ = written(Kalibr(topic=topic), unit(), tmp_path)
    assert yaml.safe_load(text)["rostopic"] == topic


@pytest.mark.parametrize("topic", ["", "imu data", 'a"b', "/imu:0", "a//b"])
def test_what_ros_would_not_take_for_a_topic_is_refused(topic):
    with pytest.raises(ValidationError):
        Kalibr(topic=topic)
