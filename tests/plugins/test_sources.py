import fcntl
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from fusion_core.chunk import concatenate
from fusion_core.errors import (
    BadValue,
    ConfigError,
    EmptyRecording,
    MissingChannel,
    TimeBackwards,
    UnitConflict,
    UnitError,
    UnreadableFile,
)
from fusion_core.faults import Faults, usable
from fusion_plugins.sources import csv as csv_module
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.hdf5 import Hdf5

AXES = ("x", "y", "z")
DEG, G = np.pi / 180, 9.80665
TIME = {"time": {"path": "time", "unit": "s"}}
KINDS = [Csv, Hdf5]


def columns(rows=101):
    rng = np.random.default_rng(5)
    table = {"time": 1000 + 0.5 * np.arange(rows), "temperature": 20 + np.arange(rows) / 8}
    for k, axis in enumerate(AXES):
        table[f"g{axis}"] = rng.normal(size=rows)
        table[f"a{axis}"] = rng.normal(k == 2, 0.01, rows)
    return table | {"ok": (np.arange(rows) % 7 > 0).astype(float), "note": rng.normal(size=rows)}


def write(kind, path, table):
    if kind is Csv:
        pl.DataFrame(table).write_csv(path)
    else:
        with h5py.File(path, "w") as file:
            for name, values in table.items():
                file[name] = values
    return path


def channels(**more):
    return {
        **TIME,
        "gyro": {"path": ["gx", "gy", "gz"], "unit": "deg/s"},
        "accel": {"path": ["ax", "ay", "az"], "unit": "g"},
        "temperature": {"path": "temperature", "unit": "degC"},
        **more,
    }


def read(source, size=1000, faults=None):
    return concatenate(list(source.chunks(size, Faults() if faults is None else faults)))


def text(tmp_path, content, name="r.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def simple(path, unit="rad/s", **more):
    """A CSV with the columns t and g."""
    gyro = {"path": "g", "unit": unit}
    return Csv(path=path, channels={"time": {"path": "t", "unit": "s"}, "gyro": gyro}, **more)


def h5(path, unit=None, attribute=None, name="gyro", values=None, key="unit", **more):
    """An HDF5 file with time and one other channel."""
    values = np.arange(12.0).reshape(4, 3) if values is None else values
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(float(len(values)))
        file["v"] = values
        if attribute is not None:
            file["v"].attrs[key] = attribute
    return Hdf5(path=path, channels={**TIME, name: {"path": "v", "unit": unit}}, **more)


@pytest.fixture(params=KINDS, ids=lambda kind: kind.model_fields["kind"].default)
def kind(request):
    return request.param


@pytest.fixture
def recording(kind, tmp_path):
    path = write(kind, tmp_path / "recording", columns())
    return kind(path=path, channels=channels())


# what is read


def test_si_units_and_layout(recording):
    table, got = columns(), read(recording)
    np.testing.assert_array_equal(got.t, table["time"])
    np.testing.assert_allclose(got["gyro"], np.stack([table[f"g{a}"] for a in AXES], 1) * DEG, rtol=1e-14)
    np.testing.assert_allclose(got["accel"], np.stack([table[f"a{a}"] for a in AXES], 1) * G, rtol=1e-14)
    np.testing.assert_array_equal(got["temperature"], table["temperature"])
    for chunk in recording.chunks(7, Faults()):
        assert chunk.previous is None
        assert len(chunk) <= 7
        for values in (chunk.t, *chunk.channels.values()):
            assert values.dtype == np.float64
            assert values.flags.c_contiguous


def test_csv_and_hdf5_give_the_same_bits(tmp_path):
    a, b = (read(k(path=write(k, tmp_path / k.__name__, columns()), channels=channels())) for k in KINDS)
    np.testing.assert_array_equal(a.t, b.t)
    assert a.channels.keys() == b.channels.keys()
    for name in a.channels:
        np.testing.assert_array_equal(a[name], b[name])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30, deadline=None)
@given(size=st.integers(1, 200), start=st.none() | st.floats(0, 40), block=st.integers(30, 5000))
def test_any_size_gives_the_same_samples(recording, size, start, block):
    source = recording.model_copy(update={"start": start, "stop": 48.0})
    whole = read(source, 10_000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(csv_module, "BLOCK", block)
        split = read(source, size)
    np.testing.assert_array_equal(split.t, whole.t)
    for name in whole.channels:
        np.testing.assert_array_equal(split[name], whole[name])


@pytest.mark.parametrize(
    ("start", "stop", "expected"),
    [
        (None, None, (0, 101)),
        (10, None, (20, 101)),
        (None, 10, (0, 20)),
        (9.9, 20.1, (20, 41)),
        (50, 99, (100, 101)),
    ],
)
def test_range_is_in_seconds_from_the_first_row(recording, start, stop, expected):
    source = recording.model_copy(update={"start": start, "stop": stop})
    np.testing.assert_array_equal(read(source, 9).t, columns()["time"][slice(*expected)])


def test_consecutive_ranges_share_no_row_and_miss_none(recording):
    parts = [recording.model_copy(update={"start": a, "stop": b}) for a, b in [(None, 17.3), (17.3, 30), (30, None)]]
    np.testing.assert_array_equal(np.concatenate([read(p, 8).t for p in parts]), columns()["time"])


def test_name_carries_the_range():
    source = Hdf5(path="ramp.h5", channels=TIME, start="92600 s", stop="184300.125 s")
    assert source.name == "ramp.h5::92600:184300.125"
    assert source.model_copy(update={"stop": None}).name == "ramp.h5::92600:"
    assert Hdf5(path="ramp.h5", channels=TIME).name == "ramp.h5"


def test_interval_takes_the_place_of_time(kind, tmp_path):
    path = write(kind, tmp_path / "r", columns())
    without = {name: channel for name, channel in channels().items() if name != "time"}
    source = kind(path=path, channels=without, interval="20 ms", start="0.1 s")
    np.testing.assert_array_equal(read(source, 7).t, np.arange(5, 101) * 0.02)


def test_valid_is_passed_on_and_then_used(kind, tmp_path):
    path = write(kind, tmp_path / "r", columns())
    source = kind(path=path, channels=channels(valid={"path": "ok"}))
    np.testing.assert_array_equal(read(source)["valid"], columns()["ok"])
    faults = Faults()
    kept = concatenate(list(usable(source.chunks(10, faults), faults, source.name)))
    assert len(kept) == 101 - 15
    assert faults.lines() == ["rows flagged as not valid, left out: 15 (first at 0.0 s (t = 1000.0 s in the file))"]


def test_a_factor_in_the_unit(kind, tmp_path):
    path = write(kind, tmp_path / "r", columns())
    source = kind(path=path, channels={**TIME, "gyro": {"path": "gx", "unit": "0.5 rad/s"}})
    np.testing.assert_array_equal(read(source)["gyro"], columns()["gx"][:, None] * 0.5)


def test_auxiliary_channels(kind, tmp_path):
    path = write(kind, tmp_path / "r", columns())
    more = {
        "second": {"path": "temperature", "unit": "K"},
        "rate": {"path": "gx", "unit": "mm/s"},
        "raw": {"path": "note"},
    }
    got = read(kind(path=path, channels={**TIME, **more}))
    np.testing.assert_allclose(got["second"], columns()["temperature"] - 273.15, rtol=1e-12)
    np.testing.assert_allclose(got["rate"], columns()["gx"] * 1e-3, rtol=1e-14)
    np.testing.assert_array_equal(got["raw"], columns()["note"])


def test_an_auxiliary_channel_in_volt(kind, tmp_path):
    path = write(kind, tmp_path / "r", columns())
    got = read(kind(path=path, channels={**TIME, "voltage": {"path": "note", "unit": "mV"}}))
    np.testing.assert_allclose(got["voltage"], columns()["note"] * 1e-3, rtol=1e-14)


def test_rows_that_run_backwards_are_given_as_they_are(kind, tmp_path):
    table = columns(20) | {"time": np.r_[np.arange(10.0), np.arange(10.0)]}
    source = kind(path=write(kind, tmp_path / "r", table), channels=channels())
    assert len(read(source, 3)) == 20
    with pytest.raises(TimeBackwards, match="runs backwards by 9 s"):
        list(usable(source.chunks(3, Faults()), Faults(), source.name))
    cut = source.model_copy(update={"stop": 9.5})
    assert len(read(cut, 3)) == 20
    np.testing.assert_array_equal(read(source.model_copy(update={"stop": 9}), 3).t, np.arange(9.0))


def test_nan_passes_through(kind, tmp_path):
    table = columns(10)
    table["gy"][3] = np.nan
    got = read(kind(path=write(kind, tmp_path / "r", table), channels=channels()), 4)
    assert np.isnan(got["gyro"]).sum() == 1
    assert np.isnan(got["gyro"][3, 1])


# what a config must say


def test_no_time_and_no_interval(kind):
    with pytest.raises(ValidationError, match=r"neither a time channel nor an interval .*; write time: \{path"):
        kind(path="x", channels={"gyro": {"path": "g", "unit": "deg/s"}})
    with pytest.raises(ValidationError, match="both a time channel and an interval are given; remove one"):
        kind(path="x", channels=TIME, interval="1 s")


@pytest.mark.parametrize(
    ("name", "unit", "message"),
    [
        ("gyro", "m/s", r"channel gyro: unit 'm/s' cannot be converted to rad/s; write a unit like 'deg/s'"),
        ("gyro", "Hz", r"channel gyro: unit 'Hz' cannot be converted to rad/s"),
        ("gyro", "deg", r"channel gyro: unit 'deg' cannot be converted to rad/s"),
        (
            "accel",
            "kg",
            r"channel accel: unit 'kg' cannot be converted to m/s\^2|channel accel: unit 'kg' is not",
        ),
        (
            "temperature",
            "C",
            r"channel temperature: unit 'C' cannot be converted to degC; write a unit like 'degC'",
        ),
        ("gyro", "dge/s", r"channel gyro: unit 'dge/s' is not known; write it like 'deg/s'"),
        ("voltage", "Vlot", r"channel voltage: unit 'Vlot' is not known; write it like '0.1 V'"),
        ("valid", "s", r"channel valid: unit 's' cannot be converted to 1; it has no unit, remove it"),
    ],
)
def test_units_of_the_config(kind, name, unit, message):
    with pytest.raises(ValidationError, match=message):
        kind(path="x", channels={**TIME, name: {"path": "g", "unit": unit}})


def test_no_unit_anywhere(recording):
    source = type(recording)(path=recording.path, channels={**TIME, "gyro": {"path": "gx"}})
    message = r"channel gyro has no unit, neither in the config nor in the file; write unit: deg/s under"
    with pytest.raises(UnitError, match=message):
        read(source)


def test_no_path(kind):
    with pytest.raises(ConfigError, match="no recording is named; write path: FILE under source, or give --input FILE"):
        read(kind(channels=TIME))


@pytest.mark.parametrize(("start", "stop", "word"), [(-1, None, "START is -1 s"), (None, -2.5, "STOP is -2.5 s")])
def test_negative_range(recording, start, stop, word):
    with pytest.raises(ConfigError, match=f"{word}, seconds from the first row were expected; write 0 or more"):
        read(recording.model_copy(update={"start": start, "stop": stop}))


# errors of both kinds of file


def test_missing_channel(kind, recording):
    noun = "column" if kind is Csv else "data set"
    source = kind(path=recording.path, channels={**TIME, "temperature": {"path": "temprature", "unit": "degC"}})
    with pytest.raises(
        MissingChannel,
        match=rf"recording: has no {noun} 'temprature' for channel temperature, it has .*time.*; "
        r"did you mean 'temperature'\?",
    ):
        read(source)
    source = kind(path=recording.path, channels={**TIME, "gyro": {"path": ["gx", "QQQ"], "unit": "deg/s"}})
    with pytest.raises(MissingChannel, match=r"'QQQ' for channel gyro, .*; correct source\.channels\.gyro\.path"):
        read(source)


@pytest.mark.parametrize(("start", "stop"), [(50.25, None), (200, 300), (20, 20), (30, 10), (0.1, 0.2)])
def test_empty_range_says_how_long_the_recording_is(recording, start, stop):
    source = recording.model_copy(update={"start": start, "stop": stop})
    with pytest.raises(EmptyRecording, match=r"recording::.*: has no row in this range, the recording is 50 s long"):
        read(source, 9)


def test_no_rows(kind, tmp_path):
    source = kind(path=write(kind, tmp_path / "r", columns(0)), channels=channels())
    with pytest.raises(EmptyRecording, match=r"r: has (column|data set)s and no rows"):
        read(source)


def test_no_time_stamp_is_a_number(kind, tmp_path):
    table = columns(4) | {"time": np.full(4, np.nan)}
    source = kind(path=write(kind, tmp_path / "r", table), channels=channels(), start="1 s")
    with pytest.raises(EmptyRecording, match="none of 4 time stamps is a number; check the path of channel time"):
        read(source)


def test_four_axes(kind, tmp_path):
    four = {**TIME, "gyro": {"path": ["gx", "gy", "gz", "ax"], "unit": "deg/s"}}
    source = kind(path=write(kind, tmp_path / "r", columns()), channels=four)
    with pytest.raises(BadValue, match="channel gyro has 4 columns, 1 to 3 were expected; name one path an axis"):
        read(source)
    two = {**TIME, "temperature": {"path": ["gx", "gy"], "unit": "degC"}}
    with pytest.raises(BadValue, match="channel temperature has 2 columns, 1 was expected; name one"):
        read(source.model_copy(update={"channels": kind(channels=two).channels}))


def test_files_that_cannot_be_read(kind, tmp_path):
    def source(path):
        return kind(path=path, channels=TIME)

    with pytest.raises(
        UnreadableFile, match=r"nowhere: cannot be read \(No such file or directory\); name an existing"
    ):
        read(source(tmp_path / "nowhere"))
    with pytest.raises(UnreadableFile, match=r"cannot be read \(Is a directory\)"):
        read(source(tmp_path))
    with pytest.raises(UnreadableFile, match=r"is empty \(0 bytes\); nothing was written to it"):
        read(source(text(tmp_path, "")))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b"CDF\x01" + bytes(100),
            "is a NetCDF-3 file, .*; convert it with `nccopy -k nc4 OLD NEW` and use kind: hdf5",
        ),
        (b"PK\x03\x04" + bytes(100), "is a zip archive or a spreadsheet, "),
        (b"\x1f\x8b" + bytes(100), "is a gzip archive, .*; unpack it first"),
        (b"PAR1" + bytes(100), "is a Parquet file, "),
    ],
)
def test_other_formats(kind, tmp_path, content, message):
    with pytest.raises(UnreadableFile, match=message):
        read(kind(path=text(tmp_path, content), channels=TIME))


def test_each_kind_names_the_other(tmp_path):
    path = write(Csv, tmp_path / "a.csv", columns())
    with pytest.raises(UnreadableFile, match="is a text file, a file of kind hdf5 was expected; use kind: csv"):
        read(Hdf5(path=path, channels=TIME))
    path = write(Hdf5, tmp_path / "a.h5", columns())
    with pytest.raises(UnreadableFile, match="is an HDF5 file, a file of kind csv was expected; use kind: hdf5"):
        read(Csv(path=path, channels=TIME))
    with pytest.raises(UnreadableFile, match="is of an unknown format"):
        read(Hdf5(path=text(tmp_path, b"\1\2\0\3" * 50), channels=TIME))


# CSV

GOOD = "t,g,h\n0,1,5\n1,2,6\n2,3,7\n"


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        GOOD[:-1],
        "\ufeff" + GOOD,
        "# made by hand\n# t,g\n\n" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n1", "\n\n# a pause\n1"),
        GOOD + "\n\n",
        '"t","g","h"\n0,"1","a,b"\n1,"2","c"\n2,"3",""\n',
        "t, g, h\n0, 1, x\n1, 2, y\n2, 3, z\n",
        "g,,t\n1,,0\n2,,1\n3,,2\n",
        "h,h,g,t\n0,0,1,0\n0,0,2,1\n0,0,3,2\n",
        "t,g,h\n0,1,\n1,2,\n2,3,\n",
        "t,g,h\n0,1,\n1,2,\n2,3,",
        "t,g\n0,1e0\n1.0,+2\n 2,.3E+1\n",
    ],
)
def test_ways_to_write_the_same_csv(tmp_path, content):
    faults = Faults()
    got = read(simple(text(tmp_path, content)), faults=faults)
    np.testing.assert_array_equal(got.t, [0, 1, 2])
    np.testing.assert_array_equal(got["gyro"], [[1], [2], [3]])
    assert faults.lines() == []


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        "# c\n" + GOOD,
        GOOD.replace("\n", "\r\n"),
        "t,g,h\n0,1,\n1,,\n2,3,\n",
        't,g,h\n0,"1",a\n1,2,b\n',
        "t,g\n0, 1\n1, nan\n",
        "t,g,h\n0,1,5\n# c\n1,2,6\n",
    ],
)
def test_what_is_regular_is_left_to_polars(tmp_path, monkeypatch, content):
    monkeypatch.setattr(csv_module.Text, "_careful", lambda *_: pytest.fail("went the slow road"))
    assert len(read(simple(text(tmp_path, content)))) >= 2


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_separators(tmp_path, separator):
    path = text(tmp_path, GOOD.replace(",", separator))
    assert len(read(simple(path, separator=separator))) == 3
    if separator != ",":
        shown = separator.replace("\t", r"\\t")
        with pytest.raises(
            MissingChannel, match=f"the header has no ',' and is a single column; set separator: \"{shown}\""
        ):
            read(simple(path))


def test_text_of_another_encoding_in_other_columns(tmp_path):
    content = "t,g,T (°C)\n0,1,é\n".encode("latin-1")
    assert len(read(simple(text(tmp_path, content)))) == 1
    named = Csv(
        path=text(tmp_path, "t,T (°C)\n0,5\n".encode("latin-1")),
        channels={"time": {"path": "t", "unit": "s"}, "temperature": {"path": "T (°C)", "unit": "degC"}},
    )
    assert read(named)["temperature"] == [5]
    with pytest.raises(UnreadableFile, match="is not UTF-8 text; save it as UTF-8"):
        read(simple(text(tmp_path, GOOD.encode("utf-16"))))


def test_empty_cells_are_dropped_and_reported_later(tmp_path):
    source = simple(text(tmp_path, "t,g,h\n0,1,\n1,,\n2,3,\n"))
    np.testing.assert_array_equal(read(source)["gyro"], [[1], [np.nan], [3]])
    faults = Faults()
    assert len(concatenate(list(usable(source.chunks(9, faults), faults, "r")))) == 2
    assert faults.lines() == ["rows where gyro is not a finite number, left out: 1 (first at 1.0 s)"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "1,abc,6",
            r"r\.csv: line 4, column 'g': 'abc' is not a number; correct it, or leave the cell empty",
        ),
        ("1,2_0,6", r"line 4, column 'g': '2_0' is not a number"),
        ('1,2,"a\rb"c', None),
        ('1,"2,5",6', r"line 4, column 'g': '2,5' is not a number"),
        ("1e,2,6", r"line 4, column 't': '1e' is not a number"),
        ("1,2", r"line 4 has 2 fields, 3 were expected as in the header; correct or remove the line"),
        ("1,2,6,", r"line 4 has 4 fields, 3 were expected"),
        ("1", r"line 4 has 1 fields?, 3 were expected"),
        ('1,2,"x', None),
    ],
)
@pytest.mark.parametrize("block", [20, 8 << 20])
def test_bad_lines(tmp_path, monkeypatch, line, message, block):
    monkeypatch.setattr(csv_module, "BLOCK", block)
    content = f"# a comment\nt,g,h\n0,1,5\n{line}\n" + "".join(f"{k},3,7\n" for k in range(2, 20))
    source = simple(text(tmp_path, content))
    if message is None:
        assert len(read(source)) == 20
    else:
        with pytest.raises(BadValue, match=message):
            read(source)


def test_a_short_line_and_a_long_one_do_not_make_up_for_each_other(tmp_path):
    with pytest.raises(BadValue, match="line 3 has 2 fields"):
        read(simple(text(tmp_path, "t,g,h\n0,1,5\n1,2\n2,3,7,8\n3,4,9\n")))
    with pytest.raises(BadValue, match="line 3 has 4 fields"):
        read(simple(text(tmp_path, "t,g,h\n0,1,5\n1,2,3,4\n2,3\n3,4,9\n")))


@pytest.mark.parametrize("cut", ["2", "2,", "2,3", '2,3,"no', "\0\0\0"])
def test_torn_last_line(tmp_path, cut):
    faults = Faults()
    got = read(simple(text(tmp_path, "# c\nt,h,g\n0,5,1\n1,6,2\n" + cut)), faults=faults)
    np.testing.assert_array_equal(got["gyro"], [[1], [2]])
    assert faults.lines() == ["torn last line, left out: 1 (first line 5)"]


@pytest.mark.parametrize("cut", ["1e", "-", "0x", "1.2e-", "na"])
def test_last_field_cut_to_something_else_than_a_number(tmp_path, cut):
    faults = Faults()
    assert len(read(simple(text(tmp_path, f"t,g\n0,1\n1,{cut}")), faults=faults)) == 1
    assert faults.lines() == ["torn last line, left out: 1 (first line 3)"]
    with pytest.raises(BadValue, match=f"line 3, column 'g': '{cut}' is not a number"):
        read(simple(text(tmp_path, f"t,g\n0,1\n1,{cut}\n")))


def test_every_cut_of_a_csv_loses_at_most_one_row(tmp_path):
    content = GOOD.encode()
    for n in range(len("t,g,h\n0,1,5\n"), len(content) + 1):
        faults = Faults()
        rows = len(read(simple(text(tmp_path, content[:n])), faults=faults))
        begun = content[:n].count(b"\n") - content[:n].endswith(b"\n")
        assert rows + len(faults.lines()) == begun


def test_headers(tmp_path):
    with pytest.raises(EmptyRecording, match=r"has no header line; write the columns' names in the first line"):
        read(simple(text(tmp_path, "# only\n\n# comments\n")))
    with pytest.raises(EmptyRecording, match="has columns and no rows"):
        read(simple(text(tmp_path, "t,g\n")))
    with pytest.raises(MissingChannel, match=r"has numbers only \(0, 1, \.\.\.\), the columns' names were expected"):
        read(simple(text(tmp_path, "0,1\n1,2\n")))
    with pytest.raises(BadValue, match="has 2 columns 'g', one was expected; rename the others"):
        read(simple(text(tmp_path, "t,g,g\n0,1,2\n")))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(st.lists(st.floats(), min_size=1, max_size=20), st.sampled_from(["{!r}", "{:.17g}", "{:.6f}", '"{!r}"']))
def test_polars_and_the_slow_road_agree(tmp_path, numbers, form):
    lines = ["t,g"] + [f"{k}," + form.format(value) for k, value in enumerate(numbers)]
    path = text(tmp_path, "\n".join(lines) + "\n")
    fast = read(simple(path))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(csv_module.Text, "_fast", lambda *_: None)
        slow = read(simple(path))
    expected = [float(form.format(value).strip('"')) for value in numbers]
    np.testing.assert_array_equal(slow["gyro"][:, 0], expected)
    np.testing.assert_array_equal(fast["gyro"], slow["gyro"])


# HDF5 and NetCDF-4


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
        with pytest.raises(UnreadableFile, match=r"cut\.h5: is cut short or damaged"):
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
        lambda self, path, **rows: asked.append((path, rows["start"])) or real(self, path, **rows),
    )
    source = h5(tmp_path / "r.h5", "deg/s", values=np.zeros((100, 3)), start="50 s", stop="60 s")
    assert len(read(source, 10)) == 10
    assert asked == [("time", k) for k in range(0, 50, 10)] + [("time", 50), ("v", 50), ("time", 60)]


# measured recordings


@pytest.fixture
def data():
    folder = os.environ.get("DRIFTLAB_DATA")
    if not folder:
        pytest.skip("DRIFTLAB_DATA does not name the folder of the measured recordings")
    return Path(folder)


@pytest.mark.recordings
def test_bursts_of_a_cold_test(data):
    path = data / "data/pan_tvc_lsm6dsm/pan_tvc_50hz_bursts.csv"
    own = [f"g{a}_file_rad_s" for a in AXES]
    fields = {
        "time": {"path": "t_s", "unit": "s"},
        "gyro": {"path": own, "unit": "0.5 rad/s"},
        "temperature": {"path": "temp_C", "unit": "degC"},
        "valid": {"path": ["ok_x", "ok_y", "ok_z"]},
    }
    source, faults = Csv(path=path, channels=fields), Faults()
    table = pl.read_csv(path)
    np.testing.assert_array_equal(read(source)["gyro"], table.select(own).to_numpy() * 0.5)
    kept = concatenate(list(usable(source.chunks(100, faults), faults, source.name)))
    assert len(kept) == table.filter((pl.col("ok_x") == 1) & (pl.col("ok_y") == 1) & (pl.col("ok_z") == 1)).height
    np.testing.assert_allclose(kept["gyro"][:1], [[-0.03265, 0.02855, 0.0148]])


@pytest.mark.recordings
def test_a_sweep_without_time(data):
    path = data / "data/rtimulib2_teensy/measurements2.csv"
    fields = {
        "accel": {"path": ["ax_g", "ay_g", "az_g"], "unit": "g"},
        "gyro": {"path": [f"g{a}_rad_s" for a in AXES], "unit": "rad/s"},
        "temperature": {"path": "temp_C", "unit": "degC"},
        "valid": {"path": "ok"},
    }
    got = read(Csv(path=path, channels=fields, interval="1 s"), 1000)
    assert len(got) == 2859
    assert got.t[-1] == 2858
    np.testing.assert_allclose(np.linalg.norm(got["accel"], axis=1).mean(), G, rtol=0.03)


@pytest.mark.recordings
def test_a_soak_in_hdf5_and_cut_short(data, tmp_path):
    path = data / "blind/a/soak.h5"
    names = ("time", "gyro", "accel", "temperature")
    source = Hdf5(path=path, channels={name: {"path": name} for name in names})
    got = read(source, 4096)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(got.t, file["time"][:])
        np.testing.assert_allclose(got["gyro"], file["gyro"][:] * DEG, rtol=1e-14)
        np.testing.assert_allclose(got["accel"], file["accel"][:].astype(float) * G, rtol=1e-14)
    size = path.stat().st_size
    for n in np.linspace(1, size - 1, 40).astype(int):
        cut = shutil.copy(path, tmp_path / "cut.h5")
        os.chmod(cut, 0o600)
        os.truncate(cut, n)
        with pytest.raises(UnreadableFile, match="is cut short or damaged"):
            read(source.model_copy(update={"path": cut}))


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
