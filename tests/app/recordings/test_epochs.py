"""Epochs against what they integrate."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from driftlab.recordings.epochs import epochs
from fusion_core.chunk import Chunk, concatenate


def cut(t, size, **channels):
    """Chunks with what came before them, as the intake gives them."""
    whole = Chunk(t, channels, sensors=frozenset({"gyro"}))
    for k in range(0, len(t), size):
        yield whole.part(k, min(k + size, len(t)))


def test_an_epoch_integrates_its_samples():
    t = np.arange(0, 10.0001, 0.01)
    gyro = np.random.default_rng(0).normal(size=(len(t), 3))
    got = concatenate(list(epochs(cut(t, 400, gyro=gyro, temperature=t), 0.1)))
    assert len(got) == 100
    np.testing.assert_allclose(got.t, np.arange(1, 101) * 0.1)
    np.testing.assert_allclose(got["tau"], 0.1)
    np.testing.assert_allclose(got["gyro"][7], gyro[71:81].mean(axis=0))
    total = np.sum(got["gyro"] * got["tau"][:, None], axis=0)
    np.testing.assert_allclose(total, np.sum(gyro[1:] * 0.01, axis=0))


def test_stamps_since_1970_fall_into_the_same_epochs():
    """Their rounding (0.24 us) must not push a sample over an epoch's edge."""
    t = np.arange(0, 50.0001, 0.01)
    gyro = np.random.default_rng(0).normal(size=(len(t), 3))
    small = concatenate(list(epochs(cut(t, 400, gyro=gyro), 0.1)))
    large = concatenate(list(epochs(cut(t + 1.7e9, 400, gyro=gyro), 0.1)))
    assert len(small) == len(large) == 500
    np.testing.assert_allclose(large["gyro"], small["gyro"], atol=1e-4)


@pytest.mark.parametrize("later", [0.1, 0.01])
def test_a_recording_may_change_its_rate(later):
    t = np.concatenate([np.arange(0, 100, 0.05), np.arange(100, 200, later)])
    got = concatenate(list(epochs(cut(t, 333, gyro=np.ones((len(t), 1))), 1.0)))
    assert got["tau"].sum() == pytest.approx(200, abs=1.5)


def test_a_gap_is_no_ones_time():
    t = np.concatenate([np.arange(0, 5, 0.1), np.arange(300, 305, 0.1)])
    got = concatenate(list(epochs(cut(t, 33, gyro=np.ones((len(t), 1))), 1.0)))
    k = int(np.searchsorted(got.t, 200))
    assert got["tau"].sum() == pytest.approx(4.9 + 4.9)
    assert got.dt[k] > 290
    assert got["tau"][k] <= 1.0 + 1e-9
    np.testing.assert_allclose(got["gyro"], 1.0)


@given(size=st.integers(1, 700), interval=st.sampled_from([0.01, 0.1, 0.25, 3.0]))
@settings(max_examples=30)
def test_epochs_do_not_depend_on_the_chunks(size, interval):
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.choice([0.01, 0.012, 0.5], size=600, p=[0.9, 0.09, 0.01]))
    channels = {"gyro": rng.normal(size=(600, 3)), "temperature": rng.normal(size=600)}
    whole = concatenate(list(epochs(cut(t, 600, **channels), interval)))
    split = concatenate(list(epochs(cut(t, size, **channels), interval)))
    np.testing.assert_array_equal(whole.t, split.t)
    np.testing.assert_array_equal(whole.dt, split.dt)
    for name in whole.channels:
        np.testing.assert_array_equal(whole[name], split[name])


@pytest.mark.parametrize("kind", [np.int64, np.float32, np.float64])
@pytest.mark.parametrize("interval", [0.01, 0.1])
def test_channels_of_any_numbers_are_numbers_of_the_filter(kind, interval):
    """Whether an epoch is a sample or many: compiled loops are of one kind of number, and of one layout."""
    t = np.arange(0, 3, 0.01)
    table = np.stack([np.arange(len(t)), np.arange(len(t))], axis=1).astype(kind)
    got = concatenate(list(epochs(cut(t, 7, gyro=table, temperature=table[:, 0]), interval)))
    for part in (got, *epochs(cut(t, 1, gyro=table, temperature=table[:, 0]), interval)):
        for values in part.channels.values():
            assert values.dtype == np.float64
            assert values.flags.c_contiguous
            assert not values.flags.writeable
    np.testing.assert_allclose(got["temperature"], got["gyro"][:, 0], rtol=1e-12)
    np.testing.assert_allclose(np.diff(got["temperature"])[:-1], interval / 0.01, rtol=1e-6)
