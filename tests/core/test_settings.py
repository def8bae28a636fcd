"""Words that are suggested for one that is not known."""

import pytest

from fusion_core.settings import nearest


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        ("gyro_x", ["gyro_y", "gyro_z", "time"], None),
        ("gyroX", ["gyroY", "accX"], None),
        ("Gyro X (deg/s)", ["Gyro Y (deg/s)", "Gyro Z (deg/s)"], None),
        ("wx", ["wy", "wz"], None),
        ("imu.gyro.x", ["imu.gyro.y", "imu.gyr.x"], "imu.gyr.x"),
        ("gyro_x", ["gyro_y", "gyr_x"], "gyr_x"),
        ("gyro_x", ["gyro", "gyro_y"], "gyro"),
        ("tempurature", ["temperature", "time"], "temperature"),
        ("max_y", ["max_y_", "may_x"], "max_y_"),
    ],
)
def test_a_word_of_another_axis_is_not_suggested(word, known, meant):
    assert nearest(word, known) == meant
