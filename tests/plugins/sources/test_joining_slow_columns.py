"""Columns that few rows of a table have, as ordinary loggers write them."""

from io import StringIO

import numpy as np
import pytest

from fusion_core.chunk import Chunk, concatenate
from fusion_core.faults import Faults, usable
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.joining import bridged

RATE, ROWS = 100.0, 6000
CHANNELS = {
    "time": {"path": "t", "unit": "s"},
    "gyro": {"path": ["gx", "gy", "gz"], "unit": "rad/s"},
    "accel": {"path": ["ax", "ay", "az"], "unit": "m/s^2"},
    "temperature": {"path": "T", "unit": "degC"},
    "voltage": {"path": "U", "unit": "V"},
}


def unit():
    """Samples of a unit in SI: gyro of noise, the others on straight lines of the time."""
    t = np.arange(ROWS) / RATE
    gyro = np.random.default_rng(3).normal(0, 1e-3, (ROWS, 3))
    accel = np.column_stack([0.01 * t, -0.02 * t, 9.8 + 0.03 * t])
    return Chunk(t, {"gyro": gyro, "accel": accel, "temperature": 20 + t / 5, "voltage": 5 - t / 100})


def only(values, read):
    """Return values with NaN where they are not read."""
    return np.where(read.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)


def every(rows, first=0):
    return np.arange(ROWS) % rows == first


def chunks(rows, size):
    return [rows.part(k, k + size) for k in range(0, len(rows), size)]


def slow(accel, temperature, voltage):
    rows = unit()
    read = {"accel": accel, "temperature": temperature, "voltage": voltage}
    return rows.having(**{name: only(rows[name], flags) for name, flags in read.items()})


@pytest.mark.parametrize("size", [1, 37, 1000, ROWS])
def test_each_slow_channel_is_drawn_between_its_own_readings_however_the_rows_are_cut(size):
    """Beyond the first and the last one it holds, for one and a half intervals."""
    truth, rows = unit(), slow(every(10), every(50, 7), every(400, 130))
    parts = list(bridged(chunks(rows, size), size, faults := Faults()))
    assert max(map(len, parts)) <= size
    got = concatenate(parts)
    np.testing.assert_array_equal(got["gyro"], truth["gyro"])
    for name, first, last in (("accel", 0, 5990), ("temperature", 7, 5957), ("voltage", 130, 5730)):
        expected = truth[name][np.clip(np.arange(ROWS), first, last)]
        np.testing.assert_allclose(got[name], expected, rtol=0, atol=1e-9)
    said = "of 6,000 rows, every {} s; it is interpolated in time between them, over {} s at most"
    assert faults.lines() == [
        f"accel has a reading in 600 {said.format(0.1, 0.1)}",
        f"temperature has a reading in 120 {said.format(0.5, 0.5)}",
        f"voltage has a reading in 15 {said.format(4, 4)}",
    ]


@pytest.mark.parametrize("size", [1, 37, ROWS])
def test_a_hole_in_one_slow_channel_is_left_and_the_others_are_drawn(size):
    hole = (np.arange(ROWS) > 2000) & (np.arange(ROWS) < 4000)
    got = concatenate(bridged(chunks(slow(every(10) & ~hole, every(50), every(400)), size), size, faults := Faults()))
    lacking = np.isnan(got["accel"])
    assert np.all(lacking.any(axis=1) == lacking.all(axis=1))
    assert np.flatnonzero(lacking[:, 0]).tolist() == list(range(2016, 3985))
    assert not np.isnan(got["temperature"]).any()
    assert faults.lines()[0].endswith("over 0.1 s at most; gaps of more than 1 s are left as they are")


def test_a_missing_axis_is_drawn_and_the_measured_ones_stay():
    rows = slow(every(10), every(1), every(1))
    accel = rows["accel"].copy()
    accel[500, 1] = np.nan
    got = concatenate(bridged([rows.having(accel=accel)], ROWS, Faults()))
    np.testing.assert_array_equal(got["accel"][500, [0, 2]], accel[500, [0, 2]])
    assert got["accel"][500, 1] == pytest.approx(unit()["accel"][500, 1])


@pytest.mark.parametrize("size", [1, 37, ROWS])
def test_a_gyro_with_empty_cells_is_left_as_it_is(size):
    """Others that have a number in its rows are no slow channels, wherever it begins."""
    rows = unit()
    rows = rows.having(gyro=only(rows["gyro"], every(10) & (np.arange(ROWS) > 100)))
    got = concatenate(bridged(chunks(rows, size), size, faults := Faults()))
    for name in rows.channels:
        np.testing.assert_array_equal(got[name], rows[name])
    assert not faults.found


@pytest.mark.parametrize("size", [1, 37, ROWS])
def test_sensors_in_rows_of_their_own_come_to_those_of_the_gyro(size):
    """The noise of accelerometers that are as fast stays what it is: each row takes the sample that is nearest."""
    accel = np.random.default_rng(4).normal(0, 0.02, (ROWS, 3))
    t = np.arange(ROWS) / RATE
    gyro, temperature = unit()["gyro"], 20 + t[::100] / 5
    order = np.argsort(np.concatenate([t, t + 0.003, t[::100] + 0.001]), kind="stable")
    nan = np.full((ROWS, 3), np.nan)
    both = {
        "gyro": np.concatenate([gyro, nan, nan[::100]])[order],
        "accel": np.concatenate([nan, accel, nan[::100]])[order],
        "temperature": np.concatenate([nan[:, 0], nan[:, 0], temperature])[order],
    }
    rows = Chunk(np.concatenate([t, t + 0.003, t[::100] + 0.001])[order], both)
    got = concatenate(bridged(chunks(rows, size), size, faults := Faults()))
    np.testing.assert_array_equal(got.t, t)
    np.testing.assert_array_equal(got["gyro"], gyro)
    np.testing.assert_array_equal(got["accel"], accel)
    note = "accel has a reading in 6,000 of 12,060 rows, every 0.01 s; each row takes the nearest of them"
    assert faults.lines()[0] == note


def test_without_a_gyro_the_rows_are_those_of_the_first_channel():
    """Its noise is the sensor's, so that nothing is drawn through it."""
    rows = unit()
    read = {"resistance": only(rows["voltage"], every(10)), "supply": only(rows["voltage"], every(50))}
    rows = Chunk(rows.t, {**read, "temperature": rows["temperature"]})
    got = concatenate(bridged([rows], ROWS, faults := Faults()))
    np.testing.assert_array_equal(got["resistance"], read["resistance"])
    np.testing.assert_allclose(got["supply"][:5951], unit()["voltage"][:5951])
    assert [line.split()[0] for line in faults.lines()] == ["supply"]


@pytest.mark.parametrize(("separator", "empty"), [(",", ""), (";", ""), (",", "NaN"), ("\t", "n/a")])
@pytest.mark.parametrize("apart", [10, 50, 1000])
def test_no_row_of_a_loggers_text_is_lost(tmp_path, separator, empty, apart):
    """The first value of the thermometer is missing, and some others are; at the ends it may hold for no more."""
    some = (np.random.default_rng(5).random(ROWS) < 0.9) | (np.arange(ROWS) < apart)
    rows = slow(every(10, 3), every(apart, apart - 1) & some, every(1))
    table = np.column_stack([rows.t, rows["gyro"], rows["accel"], rows["temperature"], rows["voltage"]])
    file = StringIO()
    np.savetxt(file, table, "%.9g", separator, header="t gx gy gz ax ay az T U".replace(" ", separator), comments="")
    path = tmp_path / "log.csv"
    path.write_text(file.getvalue().replace("nan", empty))
    source = Csv.model_validate({"path": path, "separator": separator, "channels": CHANNELS})
    got = concatenate(usable(source.chunks(999, Faults()), faults := Faults(), "log"))
    assert len(got) == ROWS
    assert not faults.found
    inner = slice(apart - 1, ROWS - apart)
    for name in ("accel", "temperature", "voltage"):
        np.testing.assert_allclose(got[name][inner], unit()[name][inner], atol=1e-6)


def test_rows_of_a_thermometer_alone_are_none_also_beside_a_column_that_says_what_is_valid():
    """A reading that is marked as not valid is none."""
    rows, alone = unit(), every(10, 4)
    cells = {name: only(rows[name], ~alone) for name in ("gyro", "accel", "voltage")}
    cells |= {"temperature": only(rows["temperature"], alone), "valid": np.ones(ROWS)}
    cells["temperature"][1004], cells["valid"][1004] = 90.0, 0.0
    faults = Faults()
    found = concatenate(list(bridged(chunks(rows.having(**cells), 1000), 1000, faults)))
    np.testing.assert_array_equal(found.t, rows.t[~alone])
    np.testing.assert_allclose(found["temperature"], rows["temperature"][~alone], atol=0.3)


def test_rows_without_a_number_are_counted():
    rows, alone, lost = unit(), every(10, 4), np.arange(ROWS) // 50 == 33
    cells = {name: only(rows[name], ~alone & ~lost) for name in ("gyro", "accel", "voltage")}
    faults = Faults()
    table = rows.having(**cells, temperature=only(rows["temperature"], alone))
    found = concatenate(list(bridged(chunks(table, 1000), 1000, faults)))
    assert len(found) == np.sum(~alone & ~lost)
    (count,) = (fault.count for what, fault in faults.found.items() if what.startswith("rows without a number"))
    assert count == np.sum(lost & ~alone)
