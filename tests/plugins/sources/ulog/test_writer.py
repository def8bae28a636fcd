"""Logs that `simulate` writes, cell by cell as pyulog reads them, and as the source does."""

import numpy as np
from device_frames import source_of
from pyulog import ULog
from recordings_on_disk import read, simulated_as

from fusion_core.faults import Faults
from fusion_plugins.sources.ulog.writer import BOOT, DEVICE

TOPICS = {"sensor_gyro": "gyro", "sensor_accel": "accel"}


def test_every_cell_is_as_it_was_simulated(tmp_path):
    path, made = simulated_as(tmp_path / "twin.ulg")
    log = ULog(str(path))
    assert [one.name for one in log.data_list] == sorted(TOPICS)
    for one in log.data_list:
        np.testing.assert_array_equal(one.data["timestamp_sample"], np.rint((BOOT + made["time"]) * 1e6))
        np.testing.assert_array_equal(one.data["device_id"], DEVICE)
        np.testing.assert_array_equal(one.data["temperature"], made["temperature"].astype(np.float32))
        for k, axis in enumerate("xyz"):
            np.testing.assert_array_equal(one.data[axis], made[TOPICS[one.name]][:, k].astype(np.float32))
    assert log.initial_parameters["CAL_GYRO0_ID"] == DEVICE
    assert log.initial_parameters["TC_G_ENABLE"] == 0
    assert not log.file_corruption
    assert log.msg_info_dict["note"].startswith("driftlab simulate ")


def test_the_source_reads_it_back(tmp_path):
    path, made = simulated_as(tmp_path / "twin.ulg")
    faults = Faults()
    got = read(source_of("px4_log", {"path": str(path)}), 1000, faults)
    np.testing.assert_allclose(got.t, BOOT + made["time"], atol=1e-9)
    for name in ("gyro", "accel", "temperature"):
        np.testing.assert_array_equal(got[name], made[name].astype(np.float32))
    assert not faults.lines(notes=False)
