"""Logs of ArduPilot vehicles, cell for cell as pymavlink's DFReader reads them; old ones, and damaged ones."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from dataflash_writer import (
    BARO,
    CODES,
    DSF,
    IMU,
    MESSAGES,
    MSG,
    Format,
    formats,
    imu_rows,
    parameters,
    record,
    rows,
    write_log,
)
from pymavlink import DFReader
from recordings_on_disk import read

from fusion_core.errors import EmptyRecording, FusionError, MissingChannel, TimeBackwards, UnitConflict, UnreadableFile
from fusion_core.faults import Faults, usable
from fusion_core.testing import check_plugin
from fusion_plugins.sources.dataflash import DataFlash, scan
from fusion_plugins.sources.dataflash.log import FEW, plausible

CHANNELS = {
    "time": {"path": "IMU.TimeUS"},
    "gyro": {"path": ["IMU.GyrX", "IMU.GyrY", "IMU.GyrZ"]},
    "accel": {"path": ["IMU.AccX", "IMU.AccY", "IMU.AccZ"]},
    "temperature": {"path": "IMU.T"},
}
SIZES = {letter: np.dtype(code).itemsize for letter, code in CODES.items()}


def at_rest(N=300, imus=1, t0=20.0):
    rng = np.random.default_rng(3)
    t = t0 + np.arange(N) / 25
    return t, [(rng.normal(size=(N, 3)), rng.normal(size=(N, 3)), 20 + k + t / 100) for k in range(imus)]


def log(path, N=300, imus=1, **more):
    t, units = at_rest(N, imus)
    return write_log(path, t, units, {"AHRS_ORIENTATION": 0}, **more)


def oracle(path, name):
    """Return the rows of a message by pymavlink."""
    reader, found = DFReader.DFReader_binary(str(path)), []
    try:
        while (message := reader.recv_match(type=name)) is not None:
            found.append(message)
    finally:
        reader.close()
    return found


@pytest.fixture(autouse=True)
def _closed(monkeypatch):
    """DFReader leaves its file open where it is not told to close it."""
    close = lambda self: (self.data_map.close(), self.filehandle.close())  # noqa: E731
    monkeypatch.setattr(DFReader.DFReader_binary, "close", close, raising=False)


def test_rows_are_those_of_pymavlink(tmp_path):
    path = log(tmp_path / "l.bin", imus=3)
    found = oracle(path, "IMU")
    for k in range(3):
        got = read(DataFlash(path=path, imu=k, channels=CHANNELS, compensated="keep"), size=71)
        theirs = [m for m in found if k == m.I]
        np.testing.assert_array_equal(got.t, [m.TimeUS * 1e-6 for m in theirs])
        np.testing.assert_array_equal(got["gyro"], [(m.GyrX, m.GyrY, m.GyrZ) for m in theirs])
        np.testing.assert_array_equal(got["accel"], [(m.AccX, m.AccY, m.AccZ) for m in theirs])
        np.testing.assert_array_equal(got["temperature"], [m.T for m in theirs])


def test_every_letter_of_a_format(tmp_path):
    rng = np.random.default_rng(8)
    letters = [letter for letter in CODES if letter not in "nNZa"]
    every = Format(200, "EVRY", "Q" + "".join(letters[:15]), "TimeUS," + ",".join(f"F{k}" for k in range(15)))
    labels = ",".join(f"F{k}" for k in range(len(letters) - 15))
    rest = Format(201, "REST", "QanNZ" + "".join(letters[15:]), f"TimeUS,A,N4,N16,N64,{labels}")
    N, body = 20, formats([every, rest], units=False)
    for message in (every, rest):
        table = rows(message, {}, N)
        for name, letter in zip(message.labels.split(","), message.letters, strict=True):
            code = np.dtype(CODES[letter]).base
            if code.kind in "iu":
                limits = np.iinfo(code)
                table[name] = rng.integers(limits.min, limits.max, table[name].shape, dtype=code, endpoint=True)
            elif code.kind == "f":
                table[name] = rng.normal(size=N).astype(code)
        table["TimeUS"] = 1_000_000 * np.arange(1, N + 1)
        body += table.tobytes()
    path = tmp_path / "l.bin"
    path.write_bytes(body)
    for message in (every, rest):
        theirs = oracle(path, message.name)
        for name, letter in zip(message.labels.split(",")[1:], message.letters[1:], strict=True):
            if letter in "nNZ":
                continue
            of = {"time": {"path": f"{message.name}.TimeUS"}, "some": {"path": f"{message.name}.{name}"}}
            got = read(DataFlash(path=path, channels=of))["some"]
            expected = [m._elements[m.fmt.colhash[name]] if letter in "aM" else getattr(m, name) for m in theirs]
            if letter == "a":
                expected = [np.frombuffer(e, "<i2") if isinstance(e, bytes) else e for e in expected]
            expected = np.array(expected, float)
            np.testing.assert_array_equal(got, expected % 256 if letter == "M" else expected, err_msg=letter)


def test_the_laws_of_a_source(tmp_path):
    path = log(tmp_path / "l.bin", imus=2, changes=[(25.0, "INS_GYROFFS_X", 0.1)])
    check_plugin(DataFlash, [DataFlash(path=path, channels=CHANNELS), DataFlash(path=path, channels=CHANNELS, imu=1)])


def test_units_are_the_logs_own(tmp_path):
    t = np.arange(10.0)
    other = replace(IMU, units="s#kkkooo--O--zz", multipliers="F-CCC000--B--00")
    path = tmp_path / "l.bin"
    values = np.arange(30.0).reshape(10, 3)
    body = imu_rows(t, [(values, values, t)]).tobytes()
    path.write_bytes(formats([other if m is IMU else m for m in MESSAGES]) + body)
    got = read(DataFlash(path=path, channels=CHANNELS))
    np.testing.assert_allclose(got["gyro"], values * 1e-3 * np.pi / 180, rtol=1e-12)
    np.testing.assert_array_equal(got["accel"], values)
    np.testing.assert_allclose(got["temperature"], t / 100, rtol=1e-7)
    with pytest.raises(UnitConflict, match=r"in 'deg/s' by the config and in '0\.001 deg/s' by the file"):
        read(DataFlash(path=path, channels=CHANNELS | {"gyro": {"path": "IMU.GyrX", "unit": "deg/s"}}))


def test_other_streams_are_joined_in_time(tmp_path):
    t, units = at_rest(N=500)
    body = formats() + parameters({"AHRS_ORIENTATION": 0})
    imu = imu_rows(t, units)
    for k in range(500):
        body += imu[k : k + 1].tobytes()
        if k % 25 == 3:
            for which in (0, 1):
                body += record(BARO, TimeUS=round(t[k] * 1e6), I=which, Temp=round(100 * (30 + which + t[k] / 10)))
    path = tmp_path / "l.bin"
    path.write_bytes(body)
    for name, shift in (("BARO.Temp", 0), ("BARO[1].Temp", 1)):
        got = read(DataFlash(path=path, channels=CHANNELS | {"temperature": {"path": name}}))
        inside = slice(3, 478)
        np.testing.assert_allclose(got["temperature"][inside], 30 + shift + t[inside] / 10, atol=0.006)


OLD = {
    "3.2": Format(131, "IMU", "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "3.3": Format(132, "IMU", "QffffffIIfBB", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,ErrG,ErrA,Temp,GyHlt,AcHlt"),
    "4.0": Format(133, "IMU", "QffffffIIfBBHH", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
}


@pytest.mark.parametrize("version", list(OLD))
def test_logs_of_earlier_vehicles(tmp_path, version):
    """IMU and IMU2 were messages of their own, the temperature was called Temp, and units stood nowhere."""
    first = OLD[version]
    second = Format(first.type + 50, "IMU2", first.letters, first.labels)
    t, units = at_rest(N=50, imus=2)
    body = formats([first, second], units=False)
    tables = []
    for message, (gyro, accel, T) in zip((first, second), units, strict=True):
        columns = {"TimeUS": np.rint(t * 1e6), "TimeMS": np.rint(t * 1e3), "T": T, "Temp": T}
        for j, axis in enumerate("XYZ"):
            columns |= {f"Gyr{axis}": gyro[:, j], f"Acc{axis}": accel[:, j]}
        tables.append(rows(message, {k: v for k, v in columns.items() if k in message.labels.split(",")}, 50))
    for k in range(50):
        body += tables[0][k].tobytes() + tables[1][k].tobytes()
    path = tmp_path / "l.bin"
    path.write_bytes(body)
    of = dict(CHANNELS)
    if version == "3.2":
        with pytest.raises(
            MissingChannel, match=r"l\.bin: IMU has no temperature, as in logs before Copter 3\.3; set .*BARO\.Temp"
        ):
            read(DataFlash(path=path, channels=of))
        del of["temperature"]
    for k, (gyro, accel, T) in enumerate(units):
        got = read(DataFlash(path=path, imu=k, channels=of))
        np.testing.assert_allclose(got.t, t, atol=6e-4 if version == "3.2" else 1e-9)
        np.testing.assert_array_equal(got["gyro"], gyro.astype(np.float32))
        np.testing.assert_array_equal(got["accel"], accel.astype(np.float32))
        if "temperature" in of:
            np.testing.assert_array_equal(got["temperature"], T.astype(np.float32))
    named = read(DataFlash(path=path, channels=of | {"gyro": {"path": ["IMU[1].GyrX", "IMU2.GyrY", "IMU2.GyrZ"]}}))
    np.testing.assert_array_equal(named["gyro"], units[1][0].astype(np.float32))
    with pytest.raises(MissingChannel, match=r"has no IMU 2, it has IMU 0 \(50 rows, 25 Hz.*\), IMU 1 \(.*; set imu"):
        read(DataFlash(path=path, imu=2, channels=of))


def test_rows_without_a_clock(tmp_path):
    """Up to Copter 3.1 the message IMU had no time: the interval is then the user's."""
    old = Format(131, "IMU", "ffffff", "GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    _, [(gyro, _, _)] = at_rest(N=50)
    columns = {f"Gyr{axis}": gyro[:, j] for j, axis in enumerate("XYZ")}
    path = tmp_path / "l.bin"
    path.write_bytes(formats([old], units=False) + rows(old, columns, 50).tobytes())
    of = {name: CHANNELS[name] for name in ("gyro", "accel")}
    got = read(DataFlash(path=path, channels=of, interval=0.02), size=7)
    np.testing.assert_array_equal(got["gyro"], gyro.astype(np.float32))
    assert got.t[-1] == pytest.approx(0.98)
    with pytest.raises(MissingChannel, match=r"has no IMU 1, it has IMU 0 \(50 rows\)"):
        read(DataFlash(path=path, channels=of, interval=0.02, imu=1))


def test_letters_of_times_to_come(tmp_path):
    """Fields after an unknown letter cannot be read, those before it can, and all other messages."""
    t, units = at_rest(N=20)
    new = struct.pack("<3sBB4s16s64s", b"\xa3\x95\x80", 210, 20, b"NEW", b"QxB", b"TimeUS,What,Ever")
    body = formats() + new
    for k, row in enumerate(imu_rows(t, units)):
        body += b"\xa3\x95\xd2" + struct.pack("<Q", round(t[k] * 1e6)) + bytes(9) + row.tobytes()
    path = tmp_path / "l.bin"
    path.write_bytes(body)
    got, faults = used(path)
    np.testing.assert_allclose(got, t, atol=1e-9)
    assert not any("no records" in line for line in faults.lines())
    of = {"time": {"path": "NEW.TimeUS"}, "some": {"path": "NEW.Ever"}}
    with pytest.raises(MissingChannel, match=r"has no message field 'NEW\.Ever'"):
        read(DataFlash(path=path, channels=of))


# ------------------------------------------------------------------ damaged logs


def used(path, **more):
    faults = Faults()
    chunks = usable(DataFlash(path=path, channels=CHANNELS, **more).chunks(64, faults), faults, str(path))
    t = np.concatenate([chunk.t for chunk in chunks])
    return t, faults


def test_a_log_that_is_cut_is_read_to_its_last_whole_row(tmp_path):
    whole = log(tmp_path / "l.bin").read_bytes()
    path = tmp_path / "cut.bin"
    for lost in range(1, 2 * IMU.length, 7):
        path.write_bytes(whole[:-lost])
        t, faults = used(path)
        missing = -(-lost // IMU.length)
        assert len(t) == 300 - missing
        left = missing * IMU.length - lost
        note = f"bytes of a last record that is cut or damaged, skipped: {left} "
        assert (note in " ".join(faults.lines()) + " ") == (left > 0)


@pytest.mark.parametrize("fill", [b"\0", b"\xff"])
def test_a_tail_that_was_never_written(tmp_path, fill):
    whole = log(tmp_path / "l.bin").read_bytes()
    path = tmp_path / "cut.bin"
    path.write_bytes(whole[:-20] + fill * 4096)
    t, faults = used(path)
    assert len(t) == 299
    text = " ".join(faults.lines())
    assert "bytes at the end that were never written (loss of power), skipped: 4096" in text
    assert f"cut or damaged, skipped: {IMU.length - 20}" in text


def test_bytes_between_records_are_skipped_and_counted(tmp_path):
    rng = np.random.default_rng(11)
    whole = log(tmp_path / "l.bin").read_bytes()
    begin = len(whole) - 300 * IMU.length
    garbage = rng.integers(0, 256, 1000, dtype=np.uint8).tobytes() + b"\xa3\x95\x8a" + b"\xa3\x95"
    place = begin + 100 * IMU.length
    path = tmp_path / "l2.bin"
    path.write_bytes(whole[:place] + garbage + whole[place:])
    t, faults = used(path)
    assert len(t) == 300
    assert f"bytes of the log that are no records, skipped: {len(garbage)} (first at byte {place})" in faults.lines()
    path.write_bytes(whole[:place] + garbage + whole[place:] + bytes(100))  # and a last row that is whole
    t, faults = used(path)
    assert len(t) == 300
    assert any(
        line.startswith("bytes at the end that were never written (loss of power), skipped: 100 ")
        for line in faults.lines()
    )


@pytest.mark.parametrize("seed", range(6))
def test_overwritten_sectors_make_no_rows(tmp_path, seed):
    """Whatever is read of a damaged log was in the undamaged one, but for the time of a row that passes for whole."""
    rng = np.random.default_rng(seed)
    path = log(tmp_path / "l.bin", N=2000)
    good, values = used(path)[0], read(DataFlash(path=path, channels=CHANNELS))
    data = np.frombuffer(path.read_bytes(), np.uint8).copy()
    head = len(data) - 2000 * IMU.length
    for begin in rng.integers(head, len(data) - 512, 5):
        data[begin : begin + 512] = rng.integers(0, 256, 512)
    path.write_bytes(data.tobytes())
    t, faults = used(path)
    assert set(t.tolist()) <= set(good.tolist())
    left = read(DataFlash(path=path, channels=CHANNELS))
    places = np.searchsorted(good, left.t)
    for name in ("gyro", "accel", "temperature"):
        np.testing.assert_array_equal(left[name], values[name][places])
    assert 2000 - 5 * 13 <= len(t) < 2000
    assert any("no records" in line for line in faults.lines())


@pytest.mark.parametrize("seed", range(4))
def test_no_damage_is_a_defect_of_the_program(tmp_path, seed):
    """Bytes changed, lost, repeated anywhere, descriptions and parameters among them: rows, or an error for users."""
    rng = np.random.default_rng(seed)
    whole = np.frombuffer(log(tmp_path / "l.bin", N=200, imus=2).read_bytes(), np.uint8)
    path, ends = tmp_path / "d.bin", []
    for _ in range(60):
        data = whole.copy()
        for _ in range(rng.integers(1, 20)):
            a, n = rng.integers(0, len(data) if rng.random() < 0.5 else 4500), rng.integers(1, 60)
            data = [
                lambda d=data, a=a, n=n: np.r_[d[:a], rng.integers(0, 256, n, np.uint8), d[a + n :]],
                lambda d=data, a=a, n=n: np.delete(d, slice(a, a + n)),
                lambda d=data, a=a, n=n: np.r_[d[:a], d[n : 3 * n], d[a:]],
            ][rng.integers(3)]()
        path.write_bytes(data[: rng.integers(1000, len(data))].tobytes())
        try:
            ends.append(len(used(path)[0]))
        except FusionError as error:
            ends.append(type(error))
    assert any(isinstance(end, int) for end in ends)


def test_rows_with_a_damaged_time_are_left_out(tmp_path):
    t, units = at_rest(400)
    table = imu_rows(t, units)
    for k, us in ((50, 2**60), (51, 7), (200, 2**40), (300, 0), (399, 2**50)):
        table["TimeUS"][k] = us
    path = tmp_path / "l.bin"
    path.write_bytes(formats() + parameters({"AHRS_ORIENTATION": 0}) + table.tobytes())
    got, faults = used(path)
    np.testing.assert_allclose(got, np.delete(t, [50, 51, 200, 300, 399]), atol=1e-9)
    assert any(line.startswith("rows with a damaged time stamp, left out: 5 ") for line in faults.lines())


def test_a_clock_that_began_anew_is_refused(tmp_path):
    t, units = at_rest(100)
    path = tmp_path / "l.bin"
    body = imu_rows(t, units).tobytes()
    path.write_bytes(formats() + parameters({"AHRS_ORIENTATION": 0}) + body + body)
    with pytest.raises(TimeBackwards, match=r"time runs backwards by 3\.96 s at 0\.0 s .*l\.bin:::3\.959$"):
        used(path)
    assert len(used(path, stop=3.959)[0]) == 99


@pytest.mark.parametrize("damaged", [False, True])
def test_places_and_pieces_change_no_value(tmp_path, monkeypatch, damaged):
    """A log of any length is read in pieces, and one of 2 GB has places of 64 bits."""
    path = log(tmp_path / "l.bin", imus=2)
    if damaged:
        data = bytearray(path.read_bytes())
        at = data.index(struct.pack("<Q", 25_000_000))  # the time of a row in the middle, which goes back
        data[at : at + 8] = bytes(8)
        path.write_bytes(data)
    found = []
    for some, short in ((scan.ROWS, scan.SHORT), (7, scan.SHORT), (scan.ROWS, 0)):
        monkeypatch.setattr(scan, "ROWS", some)
        monkeypatch.setattr(scan, "SHORT", short)
        faults = Faults()
        got = read(DataFlash(path=path, channels=CHANNELS), size=71, faults=faults)
        found.append((got.t, got["gyro"], got["accel"], got["temperature"], faults.lines()))
    assert any("damaged time stamp" in line for line in found[0][-1]) == damaged
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(one, same)


def test_which_time_stamps_are_plausible():
    t = np.arange(50.0)
    assert plausible(t).all()
    assert plausible(np.concatenate([t, t])).all()  # nothing is damaged: a clock that began anew
    gap = np.concatenate([t, 1e6 + t])
    assert plausible(gap).all()
    for k in (0, 25, 49):
        for wrong in (-1e9, 1e12):
            bad = t.copy()
            bad[k] = wrong
            assert np.flatnonzero(~plausible(bad)).tolist() == [k]
    run = t.copy()
    run[20 : 20 + FEW] = 1e9
    assert np.flatnonzero(~plausible(run)).tolist() == list(range(20, 20 + FEW))
    assert plausible(np.repeat(t, 2)).all()
    assert plausible(np.empty(0)).tolist() == []
    assert plausible(np.array([3.0])).tolist() == [True]


def test_what_the_logger_dropped_is_told(tmp_path):
    t, units = at_rest(100)
    body = formats() + parameters({"AHRS_ORIENTATION": 0}) + imu_rows(t, units).tobytes()
    for second, dropped in ((30, 0), (31, 12), (32, 37)):
        body += record(DSF, TimeUS=second * 1_000_000, Dp=dropped)
    path = tmp_path / "l.bin"
    path.write_bytes(body)
    _, faults = used(path)
    assert "messages that the vehicle could not log (DSF.Dp): 37 (first by t = 31.000 s)" in faults.lines()


def test_a_description_that_changes(tmp_path):
    """Two logs of different vehicles in one file: what the second calls IMU is not read as the first's."""
    path = log(tmp_path / "l.bin", N=100)
    t, _ = at_rest(20, t0=100.0)
    other = Format(IMU.type, "ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw")
    table = rows(other, {"TimeUS": np.rint(t * 1e6)}, 20)
    path.write_bytes(path.read_bytes() + formats([other], units=False) + table.tobytes())
    got, faults = used(path)
    assert len(got) == 100
    assert any(
        line.startswith("rows of IMU behind another description of it, left out: 20 ") for line in faults.lines()
    )


def test_a_description_with_a_wrong_length(tmp_path):
    """Records are then taken as long as their fields."""
    t, units = at_rest(100)
    head = bytearray(formats() + parameters({"AHRS_ORIENTATION": 0}))
    place = head.index(b"IMU\0QB")
    assert head[place - 1] == IMU.length
    head[place - 1] = IMU.length + 3
    path = tmp_path / "l.bin"
    path.write_bytes(bytes(head) + imu_rows(t, units).tobytes())
    got, _ = used(path)
    np.testing.assert_allclose(got, t, atol=1e-9)


# ------------------------------------------------------------------ files that are none, or lack something


def test_files_of_another_kind(tmp_path):
    path = tmp_path / "l.bin"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(UnreadableFile, match="is an HDF5 file, a file of kind dataflash was expected"):
        read(DataFlash(path=path, channels=CHANNELS))
    path.write_bytes(struct.pack("<40I", *range(40)))
    with pytest.raises(UnreadableFile, match="is of an unknown format"):
        read(DataFlash(path=path, channels=CHANNELS))
    path.write_bytes(b"\xa3\x95\x80" + bytes(50))
    with pytest.raises(UnreadableFile, match=r"describes no message \(FMT\); it is cut at its beginning"):
        read(DataFlash(path=path, channels=CHANNELS))
    path.write_bytes(b"")
    with pytest.raises(UnreadableFile, match="is empty"):
        read(DataFlash(path=path, channels=CHANNELS))


def test_a_message_that_the_log_lacks(tmp_path):
    path = tmp_path / "l.bin"
    path.write_bytes(formats() + b"".join(record(MSG, TimeUS=k, Message=b"x") for k in range(5)))
    with pytest.raises(
        MissingChannel, match=r"has no message 'IMU' for 'IMU\.TimeUS', it has MSG \(5 rows\); set LOG_BIT"
    ):
        read(DataFlash(path=path, channels=CHANNELS))
    path = log(tmp_path / "l2.bin", N=10)
    for wrong, text in (
        ("IMU.Gyrx", r"has no message field 'IMU.Gyrx' for channel x, .*did you mean 'IMU\.Gyr.'\?"),
        ("IMV.GyrX", r"has no message 'IMV' for 'IMV.GyrX', it has IMU \(10 rows\).*did you mean 'IMU'\?"),
        ("IMU[4].T", r"has no IMU 4, it has IMU 0 \(10 rows.*correct the number in the path"),
        ("T", "has no message field 'T' for channel x"),
        ("MSG.Message", "has no message field 'MSG.Message'"),
    ):
        with pytest.raises(MissingChannel, match=text):
            read(DataFlash(path=path, channels=CHANNELS | {"x": {"path": wrong}}))


def test_a_log_without_rows(tmp_path):
    path = log(tmp_path / "l.bin", N=1)
    with pytest.raises(EmptyRecording):
        read(DataFlash(path=path, channels=CHANNELS, start=5.0))
