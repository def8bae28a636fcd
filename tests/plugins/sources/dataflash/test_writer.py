"""Logs that `simulate` writes, cell by cell as pymavlink reads them, and as the source does."""

import numpy as np
from device_frames import source_of
from pymavlink import DFReader
from recordings_on_disk import read, simulated_as

from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash.writer import BOOT, PARAMETERS


def messages(path):
    """Every message of a log by its kind, as pymavlink has them."""
    reader, found = DFReader.DFReader_binary(str(path)), {}
    try:
        while (message := reader.recv_msg()) is not None:
            found.setdefault(message.get_type(), []).append(message)
    finally:
        reader.data_map.close()
        reader.filehandle.close()
    return found


def test_every_cell_is_as_it_was_simulated(tmp_path):
    path, made = simulated_as(tmp_path / "twin.bin")
    found = messages(path)
    rows = found["IMU"]
    np.testing.assert_array_equal([m.TimeUS for m in rows], np.rint((BOOT + made["time"]) * 1e6))
    np.testing.assert_array_equal([m.T for m in rows], made["temperature"].astype(np.float32))
    for name, sensor in (("Gyr", "gyro"), ("Acc", "accel")):
        theirs = [[getattr(m, f"{name}{axis}") for axis in "XYZ"] for m in rows]
        np.testing.assert_array_equal(theirs, made[sensor].astype(np.float32))
    assert {m.Name: m.Value for m in found["PARM"]} == PARAMETERS
    assert found["NOTE"][0].Begin.startswith("driftlab simulate ")
    assert {m.Id: m.Label for m in found["UNIT"]}[ord("E")] == "rad/s"


def test_the_source_reads_it_back(tmp_path):
    path, made = simulated_as(tmp_path / "twin.bin")
    faults = Faults()
    got = read(source_of("ardupilot_log", {"path": str(path)}), 1000, faults)
    np.testing.assert_allclose(got.t, BOOT + made["time"], atol=1e-9)
    for name in ("gyro", "accel", "temperature"):
        np.testing.assert_array_equal(got[name], made[name].astype(np.float32))
    assert not faults.lines(notes=False)
