"""Bags that `simulate` writes, cell by cell as rosbags reads them, and as the source does."""

import numpy as np
import pytest
from bags import FIELDS, SECOND, of_rosbags
from recordings_on_disk import read, simulated_as

from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag import Rosbag
from fusion_plugins.sources.rosbag.writer import BEGAN, FRAME


@pytest.mark.parametrize("ending", [".bag", ".mcap"])
def test_every_cell_is_as_it_was_simulated(tmp_path, ending):
    path, made = simulated_as(tmp_path / f"twin{ending}")
    stamps = BEGAN * SECOND + np.rint(made["time"] * SECOND).astype(np.int64)
    imu = of_rosbags(path, "/imu/data")
    np.testing.assert_array_equal([time for time, _ in imu], stamps)
    np.testing.assert_array_equal([m.header.stamp.sec * SECOND + m.header.stamp.nanosec for _, m in imu], stamps)
    for name, field in (("gyro", "angular_velocity"), ("accel", "linear_acceleration")):
        theirs = [getattr(m, field) for _, m in imu]
        np.testing.assert_array_equal([(v.x, v.y, v.z) for v in theirs], made[name])
    first = imu[0][1]
    assert (first.header.frame_id, first.orientation.w, first.orientation_covariance[0]) == (FRAME, 1.0, -1.0)
    assert not np.any(first.linear_acceleration_covariance)
    temperature = of_rosbags(path, "/imu/temperature")
    np.testing.assert_array_equal([m.temperature for _, m in temperature], made["temperature"])
    assert of_rosbags(path, "/note")[0][1].data.startswith("driftlab simulate ")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("ending", [".bag", ".mcap"])
def test_the_source_reads_it_back(tmp_path, ending):
    path, made = simulated_as(tmp_path / f"twin{ending}")
    faults = Faults()
    got = read(Rosbag(path=path, channels=FIELDS), 1000, faults)
    np.testing.assert_allclose(got.t, BEGAN + made["time"], atol=1e-6)
    for name in ("gyro", "accel", "temperature"):
        np.testing.assert_array_equal(got[name], made[name])
    assert not faults.lines(notes=False)
