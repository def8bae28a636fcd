import shutil

import h5py
import numpy as np
import pytest
from recordings_on_disk import DEG, TIME, h5, read, text

from fusion_core.errors import (
    BadValue,
    MissingChannel,
    UnitConflict,
    UnitError,
    UnreadableFile,
)
from fusion_plugins.sources.hdf5 import Hdf5


@pytest.mark.parametrize("name", ["scale_factor", "add_offset"])
@pytest.mark.parametrize("value", ["rad/s", b"\xff\xfe", np.array([]), np.array([1.0, 2.0]), np.nan, np.inf, 1j])
def test_packing_that_is_no_number(tmp_path, name, value):
    source = h5(tmp_path / "r.h5", unit="rad/s")
    with h5py.File(tmp_path / "r.h5", "a") as file:
        file["v"].attrs[name] = value
    with pytest.raises(BadValue, match=f"data set 'v' has the attribute {name} .*, one finite number was expected"):
        read(source)


@pytest.mark.parametrize("attribute", ["deg/s", np.bytes_(b"deg/s"), "degree/second", np.array(["deg/s"], dtype="S")])
@pytest.mark.parametrize("key", ["unit", "units"])
@pytest.mark.parametrize("unit", [None, "deg/s"])
def test_the_files_own_unit(tmp_path, attribute, key, unit):
    got = read(h5(tmp_path / "r.h5", unit, attribute, key=key))
    np.testing.assert_allclose(got["gyro"], np.arange(12.0).reshape(4, 3) * DEG, rtol=1e-14)


@pytest.mark.parametrize(
    ("name", "unit", "attribute"),
    [
        ("gyro", "rad/s", "deg/s"),
        ("gyro", "0.5 rad/s", "rad/s"),
        ("pressure", "kPa", "hPa"),
        ("length", "m", "km"),
        ("temperature", "degC", "K"),
        ("temperature", "degF", "degC"),
        ("accel", "g", "m/s^2"),
    ],
)
def test_unit_conflict(tmp_path, name, unit, attribute):
    values = np.arange(4.0)
    message = rf"channel {name} is in '{unit}' by the config and in '.*' by the file \('v'\); remove the wrong one"
    with pytest.raises(UnitConflict, match=message):
        read(h5(tmp_path / "r.h5", unit, attribute, name, values))


@pytest.mark.parametrize("attribute", ["C", "seconds since 2002-01-05T11:32:00", "°Celsius?", 5, ["a", "b"], ""])
def test_the_config_wins_over_what_is_no_such_unit(tmp_path, attribute):
    got = read(h5(tmp_path / "r.h5", "degF", attribute, "temperature", np.array([32.0, 212.0])))
    np.testing.assert_allclose(got["temperature"], [0, 100], atol=1e-10)


def test_a_unit_in_the_file_that_cannot_be_used(tmp_path):
    message = r"channel temperature is in 'C' by the file, which is no unit of degC; write unit: degC under source"
    with pytest.raises(UnitError, match=message):
        read(h5(tmp_path / "r.h5", None, "C", "temperature", np.arange(4.0)))
    np.testing.assert_array_equal(
        read(h5(tmp_path / "r.h5", None, "m H2O", "depth", np.arange(4.0)))["depth"], range(4)
    )
    np.testing.assert_array_equal(
        read(h5(tmp_path / "r.h5", None, "km", "depth", np.arange(4.0)))["depth"], np.arange(4) * 1000
    )


def test_netcdf_conventions(tmp_path):
    path = tmp_path / "r.nc"
    with h5py.File(path, "w") as file:
        file.attrs["_NCProperties"] = np.bytes_(b"version=2,netcdf=4.7.4,hdf5=1.12.0,")
        time = file.create_dataset("imu/date_time", data=np.arange(4, dtype=">i8"))
        time.attrs["units"] = np.bytes_(b"seconds since 2002-01-05T11:32:00")
        packed = file.create_dataset("imu/T", data=np.array([100, -999, 250, 300], np.int16))
        packed.attrs.update({"units": np.bytes_(b"degC"), "scale_factor": [0.1], "add_offset": 5.0})
        packed.attrs["_FillValue"] = np.array([-999], np.int16)
        depth = file.create_dataset("imu/depth", (4,), np.float32, fillvalue=np.float32(9.969209968386869e36))
        depth[:2] = [1, 2]
        speed = file.create_dataset("imu/speed", data=[1.0, np.nan, 0.0, 4.0])
        speed.attrs["_FillValue"] = np.array([np.nan])
    got = read(
        Hdf5(
            path=path,
            channels={
                "time": {"path": "imu/date_time", "unit": "s"},
                "temperature": {"path": "/imu/T"},
                "depth": {"path": "imu/depth"},
                "speed": {"path": "imu/speed"},
            },
        ),
        3,
    )
    np.testing.assert_array_equal(got.t, range(4))
    np.testing.assert_allclose(got["temperature"], [15, np.nan, 30, 35], rtol=1e-14)
    np.testing.assert_array_equal(got["depth"], [1, 2, np.nan, np.nan])
    np.testing.assert_array_equal(got["speed"], [1, np.nan, 0, 4])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            np.zeros((3, 4)),
            r"data set 'v' has shape \(3, 4\) and 'time' \(5,\), the same number of rows was expected",
        ),
        (
            np.zeros((5, 3, 2)),
            r"data set 'v' has shape \(5, 3, 2\), \(rows,\) or \(rows, axes\) was expected",
        ),
        (np.float64(3), r"data set 'v' has shape \(\), "),
        (
            np.array([b"a"] * 5),
            r"data set 'v' has values of type \|S1, numbers were expected; name another data set",
        ),
        (np.zeros(5, complex), r"data set 'v' has values of type complex128"),
        (np.zeros((5, 4)), r"channel gyro has 4 columns, 1 to 3 were expected"),
    ],
)
def test_shapes_and_types(tmp_path, values, message):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["time"], file["v"] = np.arange(5.0), values
    with pytest.raises(BadValue, match=message):
        read(Hdf5(path=tmp_path / "r.h5", channels={**TIME, "gyro": {"path": "v", "unit": "deg/s"}}))


def test_a_group_is_no_data_set(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["imu/time"] = np.arange(5.0)
    with pytest.raises(MissingChannel, match="has no data set 'imu' for channel time, it has imu/time; did you mean"):
        read(Hdf5(path=tmp_path / "r.h5", channels={"time": {"path": "imu", "unit": "s"}}))


@pytest.mark.parametrize("options", [{}, {"compression": "gzip", "chunks": (50,), "shuffle": True}])
@pytest.mark.parametrize("libver", ["earliest", "latest"])
def test_truncated_anywhere(tmp_path, options, libver):
    whole = tmp_path / "whole.h5"
    with h5py.File(whole, "w", libver=libver) as file:
        for name in ("time", "v"):
            file.create_dataset(name, data=np.arange(300.0), **options)
    data = whole.read_bytes()
    for n in {*range(1, len(data), 97), *range(1, 16), len(data) - 1}:
        cut = text(tmp_path, data[:n], "cut.h5")
        with pytest.raises(UnreadableFile, match=r"cut\.h5: is cut short or damaged \((?!.*eof = )"):
            read(Hdf5(path=cut, channels={**TIME, "gyro": {"path": "v", "unit": "deg/s"}}))


def test_damaged_inside(tmp_path):
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("time", data=np.random.default_rng(0).normal(size=5000), compression="gzip")
        at, length = file["time"].id.get_chunk_info(0).byte_offset, file["time"].id.get_chunk_info(0).size
    data = bytearray(path.read_bytes())
    data[at : at + length] = bytes(length)
    path.write_bytes(data)
    with pytest.raises(UnreadableFile, match=r"is cut short or damaged .*; copy or record it again"):
        read(Hdf5(path=path, channels=TIME))


def test_a_file_that_another_program_holds(tmp_path):
    fcntl = pytest.importorskip("fcntl", reason="locks of HDF5 are those of POSIX")
    source = h5(tmp_path / "r.h5", "deg/s")
    with source.path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(UnreadableFile, match="is being written by another program; wait until it is closed, or"):
            read(source)


def test_a_file_whose_writer_died(tmp_path):
    path = tmp_path / "r.h5"
    with h5py.File(path, "w", libver="latest") as file:
        file["time"] = np.arange(5.0)
        file.flush()
        shutil.copy(path, tmp_path / "copy.h5")
    with pytest.raises(
        UnreadableFile, match=r"was not closed by the program that wrote it; repair a copy with `h5clear"
    ):
        read(Hdf5(path=tmp_path / "copy.h5", channels=TIME))


def test_hdf5_reads_only_time_before_the_range(tmp_path, monkeypatch):
    from fusion_plugins.sources.hdf5 import DataSets

    asked, real = [], DataSets._read
    monkeypatch.setattr(
        DataSets,
        "_read",
        lambda self, packing, rows, path: asked.append((path, rows.start)) or real(self, packing, rows, path),
    )
    source = h5(tmp_path / "r.h5", "deg/s", values=np.zeros((100, 3)), start="50 s", stop="60 s")
    assert len(read(source, 10)) == 10
    assert asked == [("time", k) for k in range(0, 50, 10)] + [("time", 50), ("v", 50), ("time", 60)]


def test_names_that_are_not_utf8(tmp_path):
    """Such a data set is in the way of nothing, and messages show its bytes."""
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        file["t"], file["g"] = np.arange(5.0), np.zeros(5)
        file[b"\xff\xfe"] = np.zeros(5)
    channels = {"time": {"path": "t", "unit": "s"}, "gyro": {"path": "g", "unit": "deg/s"}}
    assert len(read(Hdf5(path=path, channels=channels)).t) == 5
    for missing in ("x", r"\xff\xfe"):
        wrong = {**channels, "gyro": {"path": missing, "unit": "deg/s"}}
        with pytest.raises(MissingChannel, match=r"no data set .* it has g, t, \\xff\\xfe"):
            read(Hdf5(path=path, channels=wrong))


@pytest.mark.parametrize("unit", ["9**9**9**9 deg/s", "(" * 30_000, "s**9999999", "deg/s\x1b[31m"])
def test_a_unit_in_the_file_is_never_worked_out(tmp_path, unit):
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        file["t"], file["g"] = np.arange(5.0), np.zeros(5)
        file["g"].attrs["unit"] = unit
    channels = {"time": {"path": "t", "unit": "s"}, "gyro": {"path": "g"}}
    with pytest.raises(UnitError, match="by the file, which is no unit of rad/s") as error:
        read(Hdf5(path=path, channels=channels))
    assert len(str(error.value)) < 400
    assert str(error.value).isprintable()
