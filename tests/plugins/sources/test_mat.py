"""MAT files that Octave, scipy and h5py write, and what Octave reads of ours."""

import contextlib
import struct

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
from octaves import octave
from recordings_on_disk import read

from fusion_core.errors import BadValue, MissingChannel, UnreadableFile
from fusion_plugins.sources.mat import Mat

N = 50
T = 100 + 0.5 * np.arange(N)
GYRO = np.arange(3.0 * N).reshape(N, 3) / 7
RAW = (np.arange(N) * 600 - 15000).astype(np.int16)
TIME = {"path": "t", "unit": "s"}
WRITE = "k = (0:49)'; t = 100 + 0.5 * k; imu.gyro = [3*k, 3*k + 1, 3*k + 2] / 7; imu.temp.raw = int16(600 * k - 15000);"


def mat(path, gyro="imu.gyro", temperature="imu.temp.raw", unit="0.01 degC", time=TIME, **more):
    channels = {
        "time": time,
        "gyro": {"path": gyro, "unit": "rad/s"},
        "temperature": {"path": temperature, "unit": unit},
    }
    return Mat(path=path, channels={name: channel for name, channel in channels.items() if channel}, **more)


def contents(**more):
    return {"t": T, "imu": {"gyro": GYRO, "temp": {"raw": RAW[:, None]}}, **more}


def write_73(path, tree):
    """Write a file as MATLAB does with -v7.3: a block of text, then HDF5 with the dimensions the other way round."""

    def write(group, name, value):
        if isinstance(value, dict):
            inner = group.create_group(name)
            inner.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, item in value.items():
                write(inner, key, item)
            return
        value = np.asarray(value)
        value = value[None] if value.ndim == 1 else value
        kinds = {"f": "double", "i": value.dtype.name, "u": value.dtype.name, "b": "logical"}
        made = group.create_dataset(
            name, data=value.astype("u1" if value.dtype == bool else value.dtype).T, chunks=True
        )
        made.attrs["MATLAB_class"] = np.bytes_(kinds[value.dtype.kind])

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in tree.items():
            write(file, name, value)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64 HDF5 schema 1.00 .".ljust(124) + b"\0\2IM")
    return path


def check(got):
    np.testing.assert_array_equal(got.t, T)
    np.testing.assert_allclose(got["gyro"], GYRO, rtol=1e-15)
    np.testing.assert_allclose(got["temperature"], RAW * 0.01, rtol=1e-12)


@pytest.mark.parametrize("form", ["-v6", "-v7", "-hdf5"])
@pytest.mark.parametrize("size", [7, 1000])
def test_what_octave_writes(tmp_path, form, size):
    octave(f"{WRITE} save('{form}', 'r.mat', 't', 'imu');", tmp_path)
    check(read(mat(tmp_path / "r.mat"), size))


def test_version_4_of_octave_has_no_structs(tmp_path):
    octave(f"{WRITE} g = imu.gyro'; T = double(imu.temp.raw)'; save('-v4', 'r.mat', 't', 'g', 'T');", tmp_path)
    check(read(mat(tmp_path / "r.mat", "g", "T")))


def test_octave_and_we_read_the_same_of_scipys_file(tmp_path):
    scipy.io.savemat(tmp_path / "r.mat", contents())
    check(read(mat(tmp_path / "r.mat")))
    shown = octave("load r.mat; printf('%.17g ', imu.gyro', double(imu.temp.raw), t);", tmp_path)
    np.testing.assert_array_equal(np.array(shown.split(), float), [*GYRO.ravel(), *RAW, *T])


@pytest.mark.parametrize("size", [7, 1000])
@pytest.mark.parametrize("turned", [False, True])
def test_either_way_round_in_every_version(tmp_path, turned, size):
    gyro, column = (GYRO.T, T[None]) if turned else (GYRO, T[:, None])
    tree = {"t": column, "g": gyro, "T": RAW[None] if turned else RAW[:, None]}
    scipy.io.savemat(tmp_path / "5.mat", tree)
    scipy.io.savemat(tmp_path / "7.mat", tree, do_compression=True)
    scipy.io.savemat(tmp_path / "4.mat", tree, format="4")
    write_73(tmp_path / "73.mat", tree)
    for name in ("5", "7", "4", "73"):
        check(read(mat(tmp_path / f"{name}.mat", "g", "T"), size))


def test_structs_of_version_73(tmp_path):
    check(read(mat(write_73(tmp_path / "r.mat", contents()))))


def test_three_samples_of_three_axes_are_rows(tmp_path):
    square = np.arange(9.0).reshape(3, 3)
    scipy.io.savemat(tmp_path / "r.mat", {"t": np.arange(3.0), "g": square, "T": np.ones(3)})
    np.testing.assert_array_equal(read(mat(tmp_path / "r.mat", "g", "T"))["gyro"], square)


def test_without_time_stamps(tmp_path):
    scipy.io.savemat(tmp_path / "r.mat", {"g": GYRO.T, "T": RAW})
    got = read(mat(tmp_path / "r.mat", "g", "T", time=None, interval="0.5 s"))
    np.testing.assert_array_equal(got["gyro"], GYRO)
    np.testing.assert_array_equal(got.t, T - 100)


def opaque(name, kind):
    """Return a variable as MATLAB saves an object (class 17, mxOPAQUE) in version 5."""

    def element(number, content):
        return struct.pack("<II", number, len(content)) + content + bytes(-len(content) % 8)

    handle = np.array([0xDD000000, 2, 1, 1, 1, 1], "<u4").tobytes()
    inner = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    body = element(6, struct.pack("<II", 17, 0)) + element(1, name) + element(1, b"MCOS") + element(1, kind)
    return element(14, body + element(14, inner + element(6, handle)))


OBJECT = (
    r"variable 'tt' is an object of class timetable, .* was expected; save it as a struct or as arrays: in MATLAB, "
)


@pytest.mark.parametrize("path", ["tt", "tt.gyro"])
def test_objects_of_matlab(tmp_path, path):
    scipy.io.savemat(tmp_path / "5.mat", contents())
    with (tmp_path / "5.mat").open("ab") as file:
        file.write(opaque(b"tt", b"timetable"))
    with h5py.File(write_73(tmp_path / "73.mat", contents()), "a") as file:
        file["tt"] = np.array([[0xDD000000, 2, 1, 1, 1, 1]], np.uint32)
        file["tt"].attrs.update({"MATLAB_class": np.bytes_("timetable"), "MATLAB_object_decode": np.int32(3)})
        file.create_group("#refs#")
    for name in ("5.mat", "73.mat"):
        check(read(mat(tmp_path / name)))  # what is beside it can be read
        with pytest.raises(BadValue, match=OBJECT):
            read(mat(tmp_path / name, path))


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("imu", r"variable 'imu' is a struct, an array was expected; name 'imu.gyro'"),
        ("many", r"variable 'many' is an array of 2 structs, an array of numbers was expected"),
        ("many.a", r"variable 'many' is an array of 2 structs, a struct was expected"),
        ("cell", r"variable 'cell' is a cell array, an array of numbers"),
        ("text", r"variable 'text' is text, "),
        ("complex", r"variable 'complex' is complex, "),
        ("sparse", r"variable 'sparse' is a sparse matrix, "),
        (
            "short",
            r"variable 'short' has shape \(1, 9\), \(50, axes\) or \(axes, 50\) was expected as 't' has 50 values",
        ),
        ("cube", r"variable 'cube' has shape \(50, 3, 2\), \(50, axes\)"),
        ("t.x", r"variable 't' is an array, a struct was expected"),
    ],
)
def test_variables_that_are_no_numbers(tmp_path, path, message):
    many = np.zeros((1, 2), dtype=[("a", "O")])
    cell = np.array([1, "a"], dtype=object)
    more = {"text": "abc", "complex": T + 1j, "sparse": scipy.sparse.csc_matrix(np.eye(N)), "short": np.zeros(9)}
    scipy.io.savemat(tmp_path / "r.mat", contents(many=many, cell=cell, cube=np.zeros((N, 3, 2)), **more))
    with pytest.raises(BadValue, match=message):
        read(mat(tmp_path / "r.mat", path))


def test_a_struct_of_version_73(tmp_path):
    with pytest.raises(BadValue, match=r"variable 'imu' is a struct, an array was expected; name 'imu.gyro'"):
        read(mat(write_73(tmp_path / "r.mat", contents()), "imu"))


def test_time_is_a_vector(tmp_path):
    scipy.io.savemat(tmp_path / "r.mat", contents())
    with pytest.raises(
        BadValue, match=r"variable 'imu.gyro' has shape \(50, 3\), a vector was expected for channel time"
    ):
        read(mat(tmp_path / "r.mat", time={"path": "imu.gyro", "unit": "s"}))


def test_what_there_is_is_listed(tmp_path):
    scipy.io.savemat(tmp_path / "5.mat", contents())
    for path in (tmp_path / "5.mat", write_73(tmp_path / "73.mat", contents())):
        message = r"has no variable 'imu.gyros' for channel gyro, it has .*imu.gyro, imu.temp.raw.*; did you mean"
        with pytest.raises(MissingChannel, match=message):
            read(mat(path, "imu.gyros"))


def test_damaged_and_foreign_files(tmp_path):
    scipy.io.savemat(tmp_path / "r.mat", contents(), do_compression=True)
    whole = {
        "r.mat": (tmp_path / "r.mat").read_bytes(),
        "73.mat": write_73(tmp_path / "73.mat", contents()).read_bytes(),
    }
    for name, content in whole.items():
        for cut in (130, len(content) // 2):
            (tmp_path / name).write_bytes(content[:cut])
            with pytest.raises((UnreadableFile, MissingChannel)):
                read(mat(tmp_path / name))
        for k in range(128, len(content), 61):  # anything else than an error of ours is a defect
            (tmp_path / name).write_bytes(content[:k] + bytes([content[k] ^ 255]) + content[k + 1 :])
            with contextlib.suppress(UnreadableFile, MissingChannel, BadValue):
                read(mat(tmp_path / name))
    octave(f"{WRITE} save('-text', 'own.mat', 't');", tmp_path)
    with pytest.raises(UnreadableFile, match=r"is in a format of Octave's own, a MAT file was expected; save it with"):
        read(mat(tmp_path / "own.mat"))
    for content, message in ((b"t,g\n1,2\n", "is a text file, a file of kind mat was expected; use kind: csv"),
                             (b"\x01\xff\x03\x00" * 50, "is of an unknown format, a file of kind mat")):  # fmt: skip
        (tmp_path / "x.mat").write_bytes(content)
        with pytest.raises(UnreadableFile, match=message):
            read(mat(tmp_path / "x.mat"))
