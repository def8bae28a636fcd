"""Samples in memory as a source: chunks of any size are the same samples, and a hash tells them from others."""

import numpy as np
import polars as pl
import pytest

from driftlab.storage.in_memory import InMemoryName, in_memory_name
from fusion_core.chunk import Chunk, concatenate
from fusion_core.errors import BadValue
from fusion_core.faults import Faults, usable

T = np.arange(10) / 5
DATA = {"time": (T, "s"), "gyro": (np.arange(30.0).reshape(10, 3), "rad/s"), "supply": (T, "mV")}


def whole(source, size=100):
    return concatenate(source.chunks(size, Faults()))


@pytest.mark.parametrize("size", range(1, 13))
def test_any_size_of_chunk_gives_the_same_samples(size):
    parts = list(in_memory_name(DATA).chunks(size, Faults()))
    assert max(map(len, parts)) <= size
    joined = concatenate(parts)
    np.testing.assert_array_equal(joined.t, T)
    np.testing.assert_array_equal(joined["gyro"], DATA["gyro"][0])


def test_samples_in_si_are_not_copied():
    source = in_memory_name(DATA)
    assert np.shares_memory(next(source.chunks(5, Faults()))["gyro"], DATA["gyro"][0])


def test_units_are_converted_to_si():
    np.testing.assert_allclose(whole(in_memory_name(DATA))["supply"], T * 1e-3, rtol=1e-12)
    minutes = in_memory_name({**DATA, "time": (T, "min")})
    np.testing.assert_allclose(whole(minutes).t, 60 * T)


def test_one_axis_is_a_column_of_one():
    assert whole(in_memory_name({"time": (T, "s"), "gyro": (T, "deg/s")}))["gyro"].shape == (10, 1)
    assert whole(in_memory_name({"time": (T, "s"), "temperature": (T[:, None], "degC")}))["temperature"].shape == (10,)


def test_the_hash_is_of_names_and_values_not_of_units_or_order():
    same = in_memory_name({"supply": (T * 1000, "uV"), "time": (T, "s"), "gyro": DATA["gyro"]}, title="another")
    values = whole(same)["supply"]
    assert InMemoryName(in_memory_name({**DATA, "supply": (values, "V")})).identity() == InMemoryName(same).identity()
    hashes = {
        in_memory_name(data).sha256
        for data in (
            DATA,
            {**DATA, "time": (T + 1e-9, "s")},
            {**DATA, "supply": (T, "uV")},
            {"time": DATA["time"], "gyro": DATA["gyro"], "other": DATA["supply"]},
        )
    }
    assert len(hashes) == 4


def test_columns_of_a_frame_are_channels_and_axes():
    frame = pl.DataFrame({"gyro_z [deg/s]": T, "time [s]": T, "gyro_x [deg/s]": -T, "supply voltage [mV]": T})
    found = whole(in_memory_name(frame))
    np.testing.assert_allclose(np.rad2deg(found["gyro"]), np.stack([-T, T], axis=1))
    np.testing.assert_allclose(found["supply voltage"], T / 1000)


def test_what_is_given_may_be_read_only_and_of_any_order():
    gyro = np.asfortranarray(DATA["gyro"][0])
    gyro.flags.writeable = False
    found = whole(in_memory_name({"time": (T, "s"), "gyro": (gyro, "rad/s")}))["gyro"]
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, gyro)


@pytest.mark.parametrize("title", ["data", "bench 3"])
def test_a_held_recording_is_its_name(title):
    name = InMemoryName(in_memory_name(DATA, title=title))
    assert (name, name.source.name) == (title, title)


MISSING = np.arange(10) == 3
X = np.arange(10.0)


def _frame(module, values):
    library = pytest.importorskip(module)
    return library.DataFrame({"time [s]": T, "gyro_x [rad/s]": values, "gyro_y [rad/s]": X})


def _with_null(values):
    return [None if missing else value for value, missing in zip(values.tolist(), MISSING, strict=True)]


@pytest.mark.parametrize(
    "data",
    [
        lambda: {"time": (T, "s"), "gyro": (np.ma.array(X, mask=MISSING), "rad/s")},
        lambda: {"time": (T, "s"), "gyro": (np.ma.array(X.astype(int), mask=MISSING), "rad/s")},
        lambda: {"time": (np.ma.array(T, mask=MISSING), "s"), "gyro": (X, "rad/s")},
        lambda: Chunk(T, {"gyro": np.ma.array(np.stack([X, X], 1), mask=np.stack([MISSING, 0 * MISSING], 1))}),
        lambda: _frame("polars", _with_null(X)),
        lambda: _frame("polars", _with_null(X.astype(int))),
        lambda: _frame("pandas", _with_null(X)),
        lambda: _frame("pandas", _with_null(X)).convert_dtypes(),
    ],
)
def test_what_is_masked_or_null_is_a_row_left_out_and_counted(data):
    faults = Faults()
    got = concatenate(usable(in_memory_name(data()).chunks(4, faults), faults, "data"))
    np.testing.assert_array_equal(got["gyro"][:, 0], X[~MISSING])
    (line,) = faults.lines()
    assert "left out: 1 (first" in line


def test_a_list_with_none_in_it_is_refused_by_name():
    with pytest.raises(BadValue, match="channel gyro is of type object, numbers were expected"):
        in_memory_name({"time": (T, "s"), "gyro": (_with_null(X), "rad/s")})


@pytest.mark.parametrize(("unit", "given"), [("s", np.array), ("ns", np.array), ("ms", pl.Series), ("us", pl.Series)])
def test_time_stamps_with_a_date_are_seconds(unit, given):
    """Of 1 January 2026, 1,767,225,600 s after 1970; what is no time is missing."""
    stamps = np.datetime64("2026-01-01", unit) + np.timedelta64(3, "s").astype(f"timedelta64[{unit}]") * np.arange(4)
    stamps[2] = np.datetime64("NaT")
    t = in_memory_name({"time": given(stamps), "gyro": (np.zeros(4), "rad/s")})._samples.t
    np.testing.assert_array_equal(t, 1_767_225_600.0 + np.array([0, 3, np.nan, 9]))
