"""Parquet files that polars writes, against what it reads back, and against the same numbers in memory."""

import contextlib
from datetime import UTC, date, datetime, time, timedelta

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings_on_disk import read

from fusion_core.errors import BadValue, MissingChannel, UnitError, UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.parquet import Parquet

ROWS = 1000
RNG = np.random.default_rng(1)
GYRO, TEMPERATURE = RNG.normal(size=(ROWS, 3)), 20 + RNG.normal(size=ROWS)
TIME = 1000 + 0.01 * np.arange(ROWS)


def parquet(path, frame, gyro="gyro", time=None, **more):
    frame.write_parquet(path, row_group_size=more.pop("row_group_size", 300))
    channels = {"time": time or {"path": "t", "unit": "s"}, "gyro": {"path": gyro, "unit": "rad/s"}, **more}
    return Parquet(path=path, channels=channels)


def frame(**more):
    struct = [{"gyro": dict(zip("xyz", row, strict=True)), "T": T} for row, T in zip(GYRO, TEMPERATURE, strict=True)]
    return pl.DataFrame({
        "t": TIME, "gx": GYRO[:, 0], "gy": GYRO[:, 1], "gz": GYRO[:, 2], "imu": struct, "list": GYRO.tolist(),
        "array": pl.Series(GYRO.tolist(), dtype=pl.Array(pl.Float64, 3)), "a.b": GYRO[:, 0], **more,
    })  # fmt: skip


@pytest.mark.parametrize("path", [("gx", "gy", "gz"), ("imu.gyro.x", "imu.gyro.y", "imu.gyro.z"), "list", "array"])
@pytest.mark.parametrize("size", [7, 100_000])
def test_columns_fields_lists_and_arrays(tmp_path, path, size):
    temperature = {"path": "imu.T", "unit": "degC"}
    got = read(parquet(tmp_path / "r.parquet", frame(), path, temperature=temperature), size)
    np.testing.assert_array_equal(got.t, TIME)
    np.testing.assert_array_equal(got["gyro"], GYRO)
    np.testing.assert_array_equal(got["temperature"], TEMPERATURE)


def test_a_column_may_have_a_point_in_its_name(tmp_path):
    got = read(parquet(tmp_path / "r.parquet", frame(), "a.b"))
    np.testing.assert_array_equal(got["gyro"][:, 0], GYRO[:, 0])


@given(
    st.lists(st.integers(-(2**40), 2**40), min_size=2, max_size=20, unique=True),
    st.sampled_from(["ms", "us", "ns"]),
    st.sampled_from([pl.Datetime, pl.Duration]),
    st.booleans(),
)
def test_times_are_seconds_whatever_their_unit(tmp_path_factory, ticks, unit, kind, aware):
    ticks = sorted(ticks)
    dtype = pl.Datetime(unit, "Europe/Rome") if aware and kind is pl.Datetime else kind(unit)
    table = pl.DataFrame({"t": pl.Series(ticks).cast(pl.Int64).cast(kind(unit)).to_frame("t")["t"]})
    if aware and kind is pl.Datetime:
        table = table.with_columns(pl.col("t").dt.replace_time_zone("UTC").dt.convert_time_zone("Europe/Rome"))
    assert table.schema["t"] == dtype
    path = tmp_path_factory.mktemp("times") / "r.parquet"
    got = read(parquet(path, table.with_columns(gyro=pl.lit(1.0)), time={"path": "t"}))
    np.testing.assert_allclose(got.t, np.array(ticks) / {"ms": 1e3, "us": 1e6, "ns": 1e9}[unit], rtol=1e-15)


def test_other_times(tmp_path):
    for values, expected in (
        ([date(1970, 1, 2), date(2026, 1, 1)], [86400, datetime(2026, 1, 1, tzinfo=UTC).timestamp()]),
        ([time(0, 0, 1, 500_000), time(1)], [1.5, 3600]),
        ([timedelta(seconds=1), timedelta(days=1)], [1, 86400]),
    ):
        table = pl.DataFrame({"t": values, "gyro": [0.0, 1.0]})
        got = read(parquet(tmp_path / "r.parquet", table, time={"path": "t"}))
        np.testing.assert_array_equal(got.t, expected)


def test_integers_need_a_unit_and_a_scale_is_one(tmp_path):
    table = pl.DataFrame({"t": [0, 10, 20], "gyro": pl.Series([-32768, 0, 32767], dtype=pl.Int16)})
    source = parquet(tmp_path / "r.parquet", table, time={"path": "t", "unit": "ms"})
    counts = {**source.channels, "gyro": {"path": "gyro", "unit": "0.5 rad/s"}}
    got = read(Parquet(path=source.path, channels=counts))
    np.testing.assert_array_equal(got["gyro"][:, 0], [-16384, 0, 16383.5])
    np.testing.assert_array_equal(got.t, [0, 0.01, 0.02])
    with pytest.raises(UnitError, match="channel time has no unit"):
        read(Parquet(path=source.path, channels={**source.channels, "time": {"path": "t"}}))


def test_a_null_is_a_missing_value(tmp_path):
    table = frame(n=[None] * 500 + [1.0] * 500).with_columns(
        array=pl.when(pl.col("t") < 1002).then(None).otherwise(pl.col("array")),
        list=pl.when(pl.col("t") < 1007).then(None).otherwise(pl.col("list")),
        gx=pl.when(pl.col("t") < 1003).then(None).otherwise(pl.col("gx")),
        imu=pl.when(pl.col("t") < 1001).then(None).otherwise(pl.col("imu")),
    )
    missing = {"list": 700, "array": 200, "gx": 300, "imu.gyro.y": 100, "n": 500}
    for path, rows in missing.items():
        got = read(parquet(tmp_path / "r.parquet", table, path), 50)["gyro"]
        assert np.all(np.isnan(got[:rows])), path
        assert not np.any(np.isnan(got[rows:])), path


def test_only_the_rows_that_are_asked_for(tmp_path):
    source = parquet(tmp_path / "r.parquet", frame(), "gx")
    part = Parquet(path=source.path, channels=source.channels, start="2 s", stop="3 s")
    got = read(part, 13)
    np.testing.assert_array_equal(got.t, TIME[200:300])
    next(source.chunks(5, Faults()))  # and then no more: the file is closed, nothing is left running


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("text", r"column 'text' is String, numbers were expected; name another column, or write it as numbers"),
        ("imu", r"column 'imu' is Struct.*, numbers were expected; name a field of it, e.g. 'imu.gyro.x'"),
        ("ragged", r"column 'ragged' has lists of 1 to 2 values, lists of one length were expected; write one"),
        ("words", r"column 'words' is List\(String\), numbers were expected"),
        ("cube", r"column 'cube' is Array\(Float64, shape=\(2, 2\)\), numbers were expected"),
    ],
)
def test_columns_that_are_no_numbers(tmp_path, path, message):
    table = frame(
        text=["a"] * ROWS,
        ragged=[[1.0]] * 9 + [[1.0, 2.0]] * (ROWS - 9),
        words=[["a"]] * ROWS,
        cube=pl.Series([[[1.0, 2.0]] * 2] * ROWS, dtype=pl.Array(pl.Float64, (2, 2))),
    )
    with pytest.raises(BadValue, match=message):
        read(parquet(tmp_path / "r.parquet", table, path))


def test_what_there_is_is_listed(tmp_path):
    with pytest.raises(MissingChannel, match=r"has no column 'imu.gyr.x' .* imu.gyro.x, .*; did you mean 'imu.gyro.x'"):
        read(parquet(tmp_path / "r.parquet", frame(), "imu.gyr.x"))


def test_damaged_and_foreign_files(tmp_path):
    source = parquet(tmp_path / "r.parquet", frame(), "gx")
    whole = source.path.read_bytes()
    for content, message in (
        (whole[: len(whole) // 2], "is cut short or damaged"),
        (whole[:3], "is cut short or damaged"),
        (b"PAR1" + bytes(100), "is cut short or damaged"),
        (b"t,gx\n1,2\n", "is a text file, a file of kind parquet was expected; use kind: csv"),
    ):
        source.path.write_bytes(content)
        with pytest.raises(UnreadableFile, match=message):
            read(source)
    for k in range(4, len(whole), 997):  # anything else than an error of ours is a defect
        source.path.write_bytes(whole[:k] + bytes([whole[k] ^ 255]) + whole[k + 1 :])
        with contextlib.suppress(UnreadableFile, MissingChannel, BadValue):
            read(source)
