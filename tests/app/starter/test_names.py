"""Names of columns as loggers, data sheets and messages write them, and the channel that each means."""

from time import process_time

import pytest

from driftlab.starter.names import named, read_name


@pytest.mark.parametrize(("path", "quantity", "axis", "unit"), [
    ("gx", "gyro", "x", None), ("omega_z", "gyro", "z", None), ("GyrY", "gyro", "y", None), ("wz", "gyro", "z", None),
    ("Gyro X (deg/s)", "gyro", "x", "deg/s"),
    ("gyro_y [rad/s]", "gyro", "y", "rad/s"), ("gz_dps", "gyro", "z", "deg/s"), ("gx_dph", "gyro", "x", "deg/h"),
    ("gx_rad_s", "gyro", "x", "rad/s"), ("imu0/gyro", "gyro", None, None), ("imu.gyro[2]", "gyro", "z", None),
    ("/imu/data.angular_velocity.x", "gyro", "x", None), ("Rate of Turn Z", "gyro", "z", None),
    ("ax", "accel", "x", None), ("acc_y_m_s2", "accel", "y", "m/s^2"), ("Accel_Z (g)", "accel", "z", "g"),
    ("accX [mg]", "accel", "x", "mg"), ("ay_g", "accel", "y", "g"), ("linear_acceleration_x", "accel", "x", None),
    ("T", "temperature", None, None), ("board_temp", "temperature", None, None),
    ("temp_C", "temperature", None, "degC"), ("gyro_temp", "temperature", None, None),
    ("imu_T_degC", "temperature", None, "degC"), ("temp_comp_gyro_x_rad_s", "gyro", "x", "rad/s"),
    ("gyro_temp_corrected_x_dps", "gyro", "x", "deg/s"), ("temp_comp_accel_x_m_s2", "accel", "x", "m/s^2"),
    ("Temperature (K)", "temperature", None, "K"), ("oven", "temperature", None, None),
    ("t", "time", None, None), ("time_ms", "time", None, "ms"), ("TimeUS", "time", None, "us"),
    ("t_s", "time", None, "s"),
    ("timestamp_utc", "time", None, None), ("Time [ns]", "time", None, "ns"),
    ("gyro_bias_x", None, "x", None), ("bias_truth_x", None, "x", None), ("mag_x", None, "x", None),
    ("Gyro,131 LSB/(deg/s)", "gyro", None, "0.00763358779 deg/s"), ("ax 4.88e-4 g per LSB", "accel", "x", "0.000488 g"),
    ("Roll rate", "gyro", "x", None), ("Pitch Rate (deg/s)", "gyro", "y", "deg/s"),
    ("yawRate_dps", "gyro", "z", "deg/s"), ("Long. acc", "accel", "x", None),
    ("acc_lateral [g]", "accel", "y", "g"), ("a_vert", "accel", "z", None),
    ("roll", None, None, None), ("g_lat", None, None, None), ("yaw_rate_temp", "temperature", None, None),
    ("pressure", None, None, None), ("ppm", None, None, None), ("index", None, None, None),
])  # fmt: skip
def test_a_name_says_quantity_axis_and_unit(path, quantity, axis, unit):
    name = read_name(path)
    assert (name.quantity, name.axis if quantity else axis, name.unit) == (quantity, axis, unit)


@pytest.mark.parametrize("path", ["1" * 999, "1" + " " * 998, "1 " * 499, "1" * 400 + " LSB/g"])
def test_a_long_name_without_a_scale_is_read_at_once(path):
    begin = process_time()
    assert read_name(path).unit is None
    assert process_time() - begin < 1


def test_columns_of_one_sensor_go_together_whole_ones_first():
    paths = ["imu2_gx", "gyro_b_z", "gyro_a_z", "gyro_a_x", "gyro_a_y", "gyro_b_x"]
    groups = [[name.path for name in group] for group in named(map(read_name, paths), "gyro")]
    assert groups[0] == ["gyro_a_x", "gyro_a_y", "gyro_a_z"]
    assert ["gyro_b_x", "gyro_b_z"] in groups


def test_three_columns_of_one_rate_without_axes_are_a_triad_in_their_order():
    paths = ["Zeit", "A (°/s)", "B (°/s)", "C (°/s)"]
    (group,) = named(map(read_name, paths), "gyro")
    assert [(name.path, name.axis) for name in group] == [("A (°/s)", "x"), ("B (°/s)", "y"), ("C (°/s)", "z")]
    assert len(named(map(read_name, ["A (°/s)", "B (°/s)", "C (deg/h)"]), "gyro")) == 3  # of three units: guessed alone


@pytest.mark.parametrize(("outside", "own"), [
    ("chamber_T_degC", "imu_T_degC"), ("oven_temp_C", "sensor_temp_C"), ("ambient_temp", "gyro_temp"),
    ("T_chamber [degC]", "T_board [degC]"), ("Temp_Kammer [degC]", "Temp_Sensor [degC]"),
])  # fmt: skip
def test_the_thermometer_of_the_sensor_comes_before_that_of_the_chamber(outside, own):
    """A map over the temperature of a chamber that the body follows is a hysteresis."""
    found = named([read_name(outside), read_name(own)], "temperature", beside="gx_dps")
    assert [group[0].path for group in found] == [own, outside]
