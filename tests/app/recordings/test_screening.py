"""Stuck and saturated sensors are left out and reported, whatever the chunks are."""

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from driftlab.config import Config, with_recording
from driftlab.recordings.epochs import _means
from driftlab.recordings.screening import STUCK, _repeats, _suspect, read
from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import Source
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.faults import Faults

N = 2000


class Made(Source):
    """A source that gives arrays made here."""

    kind: Literal["made"] = "made"

    def chunks(self, size, faults):
        rng = np.random.default_rng(0)
        gyro, accel = rng.normal(size=(N, 3)) * 1e-3, rng.normal(size=(N, 3)) * 0.01 + [0, 0, 9.8]
        gyro[300:450, 1] = gyro[299, 1]  # 151 equal samples with the one before
        gyro[600 : 600 + STUCK - 2, 0] = 0.5e-3  # not long enough to be stuck
        gyro[1000:1003, 2] = [5.3, -5.3, 5.2]  # beyond 300 deg/s = 5.236 rad/s, 99.9 % of it is 5.2308
        for k in range(0, N, size):
            rows = slice(k, k + size)
            still = np.ones(N)  # a temperature that stands still is not stuck
            channels = {"gyro": gyro[rows], "accel": accel[rows], "temperature": still[rows]}
            yield Chunk(np.arange(N)[rows] * 0.01, channels)


def config(limit="300 deg/s"):
    bias = {"kind": "random_walk", "walk": "1 deg/h/sqrt(s)"}
    loaded = Config.model_validate({"filter": {"gyro": {"noise": "1 deg/h/sqrt(Hz)", "range": limit, "bias": bias}}})
    return loaded.model_copy(update={"source": Made()})


def test_stuck_and_saturated_rows_are_left_out_and_reported():
    faults = Faults()
    got = concatenate(list(read(config(), faults)))
    left_out = np.setdiff1d(np.arange(N), np.rint(got.t * 100).astype(int))
    stuck = np.arange(299 + STUCK - 1, 450)
    assert left_out.tolist() == [*stuck, 1000, 1001]
    first, second = faults.lines()
    assert first.startswith(f"rows where gyro is stuck, left out: {len(stuck)} (first y at {stuck[0] / 100} s, ")
    assert second.startswith("rows where gyro is saturated, left out: 2 (first z at 10.0 s, value 5.3 in SI")


def test_a_row_counts_once_on_however_many_axes_it_is_stuck():
    class Frozen(Made):
        def chunks(self, size, faults):
            for chunk in super().chunks(size, faults):
                rows = chunk.t < 15.0
                yield chunk.having(gyro=np.where(rows[:, None], 0.25, chunk["gyro"]))

    faults = Faults()
    frozen = config().model_copy(update={"source": Frozen()})
    got = concatenate(list(read(frozen, faults, rows=70)))
    left_out = N - len(got)
    assert faults.lines() == [f"rows where gyro is stuck, left out: {left_out} (first x at 0.99 s, value 0.25 in SI)"]


def test_a_range_in_the_wrong_unit_leaves_nothing_and_says_so():
    with pytest.raises(EmptyRecording, match=r"made: every row is left out \(.*saturated.*\); check the units"):
        list(read(config(limit="1e-6 deg/s"), Faults()))


def test_without_a_range_nothing_is_saturated():
    faults = Faults()
    list(read(config(limit=None), faults))
    alone, stuck = faults.lines()
    assert alone.startswith("readings of gyro z alone between others far off: 1 (first -5.3 rad/s at 10.01 s)")
    assert "stuck" in stuck


@given(size=st.integers(1, 500))
@settings(max_examples=20)
def test_the_chunks_do_not_matter(size):
    one, other = Faults(), Faults()
    whole, split = concatenate(list(read(config(), one))), concatenate(list(read(config(), other, rows=size)))
    np.testing.assert_array_equal(whole.t, split.t)
    assert one.lines() == other.lines()


def test_names_that_the_program_uses_itself_are_refused(monkeypatch):
    made = Made.chunks
    monkeypatch.setattr(
        Made, "chunks", lambda self, size, faults: (c.having(tau=c.t) for c in made(self, size, faults))
    )
    with pytest.raises(ConfigError, match="channel 'tau': the program uses this name itself; rename it"):
        next(read(config(), Faults()))


@pytest.mark.recordings
def test_no_measured_recording_is_taken_for_stuck(recordings):
    for unit in "abcde":
        channels = {name: {"path": name} for name in ("time", "gyro", "accel", "temperature")}
        path = str(recordings / "blind" / unit / "holdout.h5")
        faults = Faults()
        source = {"kind": "hdf5", "path": path, "channels": channels}
        chunks = list(read(Config.model_validate({"source": source}), faults))
        assert sum(map(len, chunks)) > 50_000
        assert faults.lines() == []


@given(seed=st.integers(0, 2**32 - 1), first=st.booleans(), level=st.sampled_from([1.0, 2.5, 1e9]))
@settings(max_examples=60)
def test_the_quick_look_for_suspects_equals_the_plain_one(seed, first, level):
    """Few values, so that they repeat; also one that is not a number, which equals nothing."""
    rng = np.random.default_rng(seed)
    values = rng.choice([0.0, 1.0, 2.0, np.nan], p=[0.96, 0.02, 0.01, 0.01], size=(400, 2))
    before = None if first else Chunk(np.zeros(1), {"gyro": np.zeros((1, 2))})
    chunk = Chunk(np.arange(400.0), {"gyro": values}, before)
    carried = np.zeros(2) if first else np.array([STUCK - 20.0, 3.0])
    last = np.full(2, np.nan) if first else np.zeros(2)
    runs, leaps, rails = np.empty(2), np.empty(2), np.tile([-np.inf, 0.0, -np.inf, 0.0], (2, 2, 1))
    suspect = _suspect(values, last, carried, runs, level, rails, leaps)
    repeats = _repeats(chunk, "gyro", carried)
    assert suspect == bool(np.any(repeats >= STUCK) or np.any(np.abs(values) >= level))
    np.testing.assert_array_equal(runs, repeats[-1])
    np.testing.assert_array_equal(leaps, np.nanmax(np.abs(np.diff(values, axis=0, prepend=last[None])), axis=0))


@given(seed=st.integers(0, 2**32 - 1), epochs=st.integers(1, 20))
@settings(max_examples=30)
def test_means_over_epochs_are_weighted_averages(seed, epochs):
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.sort(rng.choice(np.arange(1, 100), epochs - 1, replace=False))]).astype(np.int64)
    values, weights = rng.normal(size=(100, 3)), rng.uniform(0.1, 1, 100)
    parts = np.split(np.arange(100), starts[1:])
    found, total = np.empty((epochs, 3)), np.array([weights[part].sum() for part in parts])
    _means(values, weights, starts, total, found)
    expected = [np.average(values[part], axis=0, weights=weights[part]) for part in parts]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("recording", "expected"),
    [
        ("x.h5", ("x.h5", 100.0, 200.0)),
        ("x.h5::", ("x.h5", 100.0, 200.0)),
        ("x.h5::3:", ("x.h5", 3.0, None)),
        ("x.h5:::4", ("x.h5", None, 4.0)),
        ("x.h5:::", ("x.h5", None, None)),
    ],
)
def test_a_part_that_is_written_takes_the_place_of_the_configs(recording, expected):
    channels = {"time": {"path": "time", "unit": "s"}}
    source = {"kind": "hdf5", "start": "100 s", "stop": "200 s", "channels": channels}
    source = with_recording(Config.model_validate({"source": source}), recording).source
    assert (str(source.path), source.start, source.stop) == expected


class Timed(Source):
    """A source whose samples have the times that a test gives."""

    kind: Literal["timed"] = "timed"
    t: tuple[float, ...] = ()

    def chunks(self, size, faults):
        t = np.array(self.t)
        for k in range(0, len(t), size):
            yield Chunk(t[k : k + size], {"gyro": np.random.default_rng(k).normal(size=(len(t[k : k + size]), 3))})


@pytest.mark.parametrize("rows", [7, 1000, 65_536])
def test_long_gaps_are_noted_where_they_are(rows):
    t = 1.7e9 + np.arange(900.0) / 2
    t[100:] += 4.0  # not long enough
    t[300:] += 5000.0
    t[600:] += 1e12
    faults = Faults()
    source = config().model_copy(update={"source": Timed(t=tuple(t))})
    assert sum(map(len, read(source, faults, rows))) == 900
    assert faults.lines() == [
        "gaps of more than 5 s, predicted across: 2 "
        "(first at 153.5 s (t = 1700000153.5 s in the file), 1e+12 s in all, "
        "the longest 1e+12 s at 5303.5 s)"
    ]
    pause = config().model_copy(update={"source": Timed(t=(*np.arange(0, 20, 0.01), *np.arange(260, 280, 0.01)))})
    list(read(pause, faults := Faults(), rows))
    assert faults.lines() == ["gaps of more than 1 s, predicted across: 1 (first at 19.99 s, 240.01 s long)"]
    seldom = config().model_copy(update={"source": Timed(t=tuple(np.arange(900.0) * 1200))})
    list(read(seldom, faults := Faults(), rows))
    assert faults.found == {}, "as far apart as all others"


def test_a_thermometer_is_looked_at_once_its_rows_have_been_passed_on_also_where_no_more_are_asked_for():
    class Kelvin(Made):
        def chunks(self, size, faults):
            for chunk in super().chunks(size, faults):
                yield chunk.having(temperature=chunk["temperature"] + 300)

    faults = Faults()
    rows = read(config().model_copy(update={"source": Kelvin()}), faults)
    assert len(next(rows)) > 1000
    assert faults.doubts == []
    rows.close()
    (doubt,) = faults.doubts
    assert "looks like kelvin" in doubt
