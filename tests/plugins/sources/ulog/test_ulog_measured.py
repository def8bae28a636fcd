"""Two real logs of PX4: one of a vehicle with three units (1.11), one of its simulator (1.13)."""

import numpy as np
import pytest
from pyulog import ULog

from fusion_core.chunk import concatenate
from fusion_core.errors import UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.ulog import Ulog

LOGS = ("sample_log_small.ulg", "sample_logging_tagged_and_default_params.ulg")
AXES = ("x", "y", "z")


@pytest.fixture(params=LOGS)
def path(request, recordings):
    return recordings / "data/px4_ulog" / request.param


def read(path, faults, **settings):
    channels = {
        "time": {"path": "sensor_gyro.time"},
        "gyro": {"path": [f"sensor_gyro.{a}" for a in AXES]},
        "accel": {"path": [f"sensor_accel.{a}" for a in AXES]},
        "temperature": {"path": "sensor_gyro.temperature"},
    }
    return concatenate(list(Ulog(path=path, channels=channels, **settings).chunks(4, faults)))


@pytest.mark.recordings
@pytest.mark.parametrize("instance", [0, 1, 2])
def test_every_cell_is_pyulogs(path, instance):
    oracle, faults = ULog(str(path)), Faults()
    gyro, accel = (oracle.get_dataset(name, instance).data for name in ("sensor_gyro", "sensor_accel"))
    got = read(path, faults, device_id=int(gyro["device_id"][0]))
    np.testing.assert_allclose(got.t, gyro["timestamp_sample"] / 1e6, rtol=1e-14)
    np.testing.assert_array_equal(got["gyro"], np.column_stack([gyro[a] for a in AXES]))
    np.testing.assert_array_equal(got["temperature"], gyro["temperature"])
    nearest = np.argmin(np.abs(accel["timestamp_sample"].astype(float) - gyro["timestamp_sample"][:, None]), axis=1)
    assert np.array_equal(accel["device_id"], gyro["device_id"])  # one chip
    np.testing.assert_array_equal(got["accel"], np.column_stack([accel[a] for a in AXES])[nearest])
    dropped = [f.count for what, f in faults.found.items() if "dropouts" in what]
    assert dropped == [len(oracle.dropouts)] * bool(oracle.dropouts)
    assert not any("bytes" in what for what in faults.found)


@pytest.mark.recordings
def test_all_topics_are_those_of_pyulog(path):
    """Beside sensors too: strings of fields, nested types and single rows."""
    from fusion_plugins.sources.ulog.file import LogFile

    log, oracle = LogFile(path, "ulog"), ULog(str(path))
    theirs = {(d.name, d.multi_id): d.data for d in oracle.data_list}
    assert set(log.instances) == set(theirs)
    assert all(log.instances[key].rows == len(data["timestamp"]) for key, data in theirs.items())
    assert log.parameters == oracle.initial_parameters
    by_instance = log.read({log.instances[key]: data for key, data in theirs.items()}, Faults())
    ours = {(instance.topic, instance.number): data for instance, data in by_instance.items()}
    for key, data in theirs.items():
        assert ours[key].keys() == data.keys()
        for name, values in data.items():
            np.testing.assert_array_equal(ours[key][name], values)


@pytest.mark.recordings
def test_a_damaged_one_is_read_as_far_as_it_goes(path, tmp_path, capfd):
    content = path.read_bytes()
    whole = read(path, Faults())
    rng = np.random.default_rng(1)
    begin = content.index(bytes.fromhex("2f731320250cbb12"))  # the first synchronisation is in the data
    for _ in range(12):
        damaged = bytearray(content)
        for at in rng.integers(begin, len(content), 10):
            damaged[at] ^= 1 << int(rng.integers(8))
        copy = tmp_path / "v.ulg"
        copy.write_bytes(damaged[: rng.integers(len(content) * 3 // 4, len(content))])
        got = read(copy, Faults())
        assert len(got) >= len(whole) // 2
        assert np.mean(np.isin(got["gyro"][:, 0], whole["gyro"][:, 0])) > 0.7
    assert capfd.readouterr() == ("", "")


@pytest.mark.recordings
def test_a_log_cut_within_its_definitions_says_what_it_lacks(path, tmp_path):
    copy = tmp_path / "v.ulg"
    for size in (17, 60, 500, 5000):
        copy.write_bytes(path.read_bytes()[:size])
        with pytest.raises(UnreadableFile, match="ends before its first row"):
            read(copy, Faults())
