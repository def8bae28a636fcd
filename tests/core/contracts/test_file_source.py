"""Abilities that every kind of file has from its base."""

import gzip
from typing import Literal

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from recordings_on_disk import AXES, DEG, KINDS, TIME, G, channels, columns, read, text, write

from fusion_core.chunk import concatenate
from fusion_core.contracts import plugin
from fusion_core.errors import (
    BadValue,
    ConfigError,
    EmptyRecording,
    MissingChannel,
    TimeBackwards,
    UnitError,
    UnreadableFile,
)
from fusion_core.faults import Faults, usable
from fusion_core.host.registry import registry
from fusion_plugins.sources import csv as csv_module
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.hdf5 import Hdf5


@pytest.fixture(params=KINDS, ids=lambda kind: kind.model_fields["kind"].default)
def kind(request):
    return request.param


@pytest.fixture
def recording(kind, tmp_path):
    path = write(kind, tmp_path / "recording", columns())
    return kind(path=path, channels=channels())


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


def test_all_kinds_give_the_same_bits(tmp_path):
    a, *others = (read(k(path=write(k, tmp_path / k.__name__, columns()), channels=channels())) for k in KINDS)
    for b in others:
        np.testing.assert_array_equal(a.t, b.t)
        assert a.channels.keys() == b.channels.keys()
        for name in a.channels:
            np.testing.assert_array_equal(a[name], b[name])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
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
        ("voltage", "Vlot", r"channel voltage: unit 'Vlot' is not known; write it like 'hPa'"),
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
    noun = {"hdf5": "data set", "mat": "variable"}.get(kind.model_fields["kind"].default, "column")
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
    with pytest.raises(EmptyRecording, match=r"r: has (column|data set|variable)s and no rows"):
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
        (b"PAR1" + bytes(100), "is a Parquet file, "),
        (b"ULog\x01\x12\x35\x01" + bytes(100), r"is a PX4 log \(ULog\), "),
        (b"\xa3\x95\x80\x80" + bytes(100), r"is an ArduPilot log \(DataFlash\), "),
        (b"#ROSBAG V2.0\n" + bytes(100), "is a ROS 1 bag, "),
        (b"\x89MCAP0\r\n" + bytes(100), "is an MCAP file, "),
        (b"SQLite format 3\0" + bytes(100), "is an SQLite database, as in a ROS 2 bag, "),
        (b"MATLAB 5.0 MAT-file" + bytes(100), "is a MAT file, "),
    ],
)
def test_other_formats(kind, tmp_path, content, message):
    if content.startswith(kind.signatures):
        message = "is cut short or damaged"
    with pytest.raises(UnreadableFile, match=message):
        read(kind(path=text(tmp_path, content), channels=TIME))


def test_what_is_advised_is_the_source_that_is_installed(monkeypatch, tmp_path):
    """A kind of file that a plugin brings is named by messages from the moment that the plugin is there."""
    path = text(tmp_path, b"\x07ACME" + bytes(100))
    with pytest.raises(UnreadableFile, match=r"of an unknown format, a file of kind hdf5 was expected; check the path"):
        read(Hdf5(path=path, channels=TIME))

    class Acme(Csv):
        signatures = (b"\x07ACME",)
        kind: Literal["acme"] = "acme"

    monkeypatch.setattr(plugin, "_ORIGINS", {**plugin._ORIGINS, Acme: plugin.Origin("sources", "acme", "1")})
    for kind in KINDS:
        name = kind.model_fields["kind"].default
        with pytest.raises(UnreadableFile, match=f"is a file of kind acme, .* {name} was expected; use kind: acme"):
            read(kind(path=path, channels=TIME))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind is not Csv])
def test_every_kind_reads_a_gzip_archive_and_names_it(tmp_path, kind):
    plain = write(kind, tmp_path / "plain", columns())
    packed = text(tmp_path, gzip.compress(plain.read_bytes()), "packed.gz")
    expected = read(kind(path=plain, channels=channels()))
    np.testing.assert_array_equal(read(kind(path=packed, channels=channels()))["gyro"], expected["gyro"])
    packed = text(tmp_path, gzip.compress(b"t,g\n0,1\n"), "packed.gz")
    with pytest.raises(UnreadableFile, match=f"^{packed}: is a text file, a file of kind .*; use kind: csv"):
        read(kind(path=packed, channels=channels()))
    whole = gzip.compress(plain.read_bytes())
    with pytest.raises(UnreadableFile, match=r"packed\.gz: is cut short or damaged"):
        read(kind(path=text(tmp_path, whole[: len(whole) // 2], "packed.gz"), channels=channels()))


def test_each_kind_names_the_other(tmp_path):
    registry()  # whose sources are those that advice can name
    path = write(Csv, tmp_path / "a.csv", columns())
    with pytest.raises(UnreadableFile, match="is a text file, a file of kind hdf5 was expected; use kind: csv"):
        read(Hdf5(path=path, channels=TIME))
    path = write(Hdf5, tmp_path / "a.h5", columns())
    with pytest.raises(UnreadableFile, match="is an HDF5 file, a file of kind csv was expected; use kind: hdf5"):
        read(Csv(path=path, channels=TIME))
    with pytest.raises(UnreadableFile, match="is of an unknown format"):
        read(Hdf5(path=text(tmp_path, b"\1\2\0\3" * 50), channels=TIME))
