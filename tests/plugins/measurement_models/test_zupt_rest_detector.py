"""Motion is what the sensors show: none on days at rest, and all of it within a second."""

from itertools import pairwise

import numpy as np
import pytest
from epochs_at_rest import ACCEL_NOISE, DEG_H, GYRO_NOISE, epochs_at_rest
from hypothesis import given, settings
from hypothesis import strategies as st

from driftlab.config import Config
from driftlab.filtering.segment import RunLog, Stretches
from fusion_core.thermal.rate_estimators import with_rate
from fusion_plugins.measurement_models.rest_detector import FORGET

DT = 0.1
CONFIG = Config.model_validate(
    {
        "latitude": "40.9 deg",
        "heading": "0 deg",
        "filter": {
            "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}},
            "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}},
            "rest": {"realign_after": "20 s"},
        },
    }
)


def detector_of(chunk):
    """Return the detector that a run has after its alignment on the first minute."""
    minute = chunk.part(0, int(np.searchsorted(chunk.t, chunk.t[0] + 60)))
    return CONFIG.filter.detector(CONFIG.filter.aligned(minute, CONFIG.site))


def look(chunk):
    still, out, _ = detector_of(chunk).look(chunk, detector_of(chunk).start())
    return still, out


def regular(hours):
    return np.arange(1, int(hours * 3600 / DT) + 1) * DT


# at rest


@pytest.mark.parametrize("noisier", [1.0, 3.0, 1 / 3])
def test_a_day_at_rest_is_still_whatever_noise_was_declared(noisier):
    for seed in range(3):
        still, out = look(epochs_at_rest(regular(4), DT, seed=seed, noisier=noisier))
        assert np.all(still)
        assert not np.any(out)


@pytest.mark.parametrize("per_kelvin", [10, 100])
def test_a_thermal_ramp_is_no_motion(per_kelvin):
    """2 K/min up and down, on a curve of 10 and of 100 deg/h/K: 0.3 and 3.3 deg/h a second."""
    t = regular(2)
    T = 30 * np.abs((t / 1800) % 2 - 1) * 2
    assert np.abs(np.gradient(T, t)).max() == pytest.approx(2 / 60, rel=1e-6)
    still, _ = look(epochs_at_rest(t, DT, bias=(per_kelvin * DEG_H * T)[:, None] * [1, -1, 0.5]))
    assert np.all(still)


@pytest.mark.parametrize(("slope", "pace"), [(22, 1.0), (100, 5.0)])
@pytest.mark.parametrize("step", [0.0, 0.01])
def test_a_steep_curve_of_a_fog_is_no_motion_where_the_temperature_is_known(slope, pace, step):
    """At 2e-7 rad/s/sqrt(Hz), in ramps with sharp corners; without a temperature it is motion."""
    noise, t = 2e-7, regular(1.0)
    corners = np.interp(t, np.arange(0, 3601, 300), np.cumsum([0, 1, 0, -1, 1, 0, 0, -1, 0, 1, -1, 1, 0]) * 5 * pace)
    rng = np.random.default_rng(1)
    bias = slope * DEG_H * (corners + 3 * np.log(np.cosh((corners - 3) / 12)))
    gyro = bias[:, None] * [1, -0.7, 0.2] + rng.normal(size=(len(t), 3)) * noise / np.sqrt(DT)
    T = np.round(corners / step) * step if step else corners
    chunk = epochs_at_rest(t, DT).having(gyro=gyro)
    gyros = {"noise": f"{noise} rad/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-9 rad/s/sqrt(s)"}}
    model = Config.model_validate({"filter": {**CONFIG.filter.model_dump(mode="json"), "gyro": gyros}}).filter
    detector = model.detector(model.aligned(chunk.part(0, 600), CONFIG.site))
    rated, _ = with_rate(chunk.having(temperature=T), model.temperature_rate, None)
    still, _, _ = detector.look(rated, detector.start())
    assert np.mean(still) > 0.97
    turned = rated.having(gyro=gyro + ((t > 1000) & (t < 1006))[:, None] * 2e-4)
    seen, _, _ = detector.look(turned, detector.start())
    assert not np.any(seen[(t > 1000.5) & (t < 1006)])
    blind, _, _ = detector.look(chunk, detector.start())
    assert np.mean(blind) < 0.9


@pytest.mark.parametrize("steps", [0.5, 1.0, 3.0])
def test_a_quantised_sensor_is_no_motion(steps):
    """Readings in steps of up to three times the noise of one."""
    gyro, accel = (steps * noise / np.sqrt(DT) for noise in (GYRO_NOISE, ACCEL_NOISE))
    t = regular(2)
    drift = 2 * DEG_H * np.sin(t / 300)[:, None]  # from one step to the next
    still, _ = look(epochs_at_rest(t, DT, bias=drift, gyro_step=gyro, accel_step=accel))
    assert np.all(still)


@pytest.mark.parametrize(
    ("burst", "every"), [(5.0, 300.0), (20.0, 45.0), (5.0, 15.0)], ids=["rare", "near the limit", "often"]
)
def test_gaps_and_bursts_are_no_motion(burst, every):
    """The bias goes on over the gaps, by 2 K/min on 10 deg/h/K."""
    t = regular(4)
    t = t[(t < 60) | (t % every <= burst)]
    dt = np.diff(t, prepend=t[0] - DT)
    tau = np.minimum(dt, DT)
    bias = 10 * DEG_H * (30 * np.abs((t / 1800) % 2 - 1) * 2)[:, None] * [1, -1, 0.5]
    still, _ = look(epochs_at_rest(t, tau, bias=bias))
    assert np.all(still)


def test_epochs_of_any_length_are_alike():
    """Jitter, and epochs that a gap has left a tenth of."""
    rng = np.random.default_rng(4)
    tau = rng.choice([0.01, 0.1, 0.11, 1.0], p=[0.1, 0.5, 0.3, 0.1], size=60_000)
    still, _ = look(epochs_at_rest(np.cumsum(tau), tau, seed=4))
    assert np.all(still)


def test_after_a_long_gap_the_bias_may_be_anywhere():
    t = regular(0.1)
    t[1800:] += FORGET + 5
    chunk = epochs_at_rest(t, DT, bias=np.where(t < 180.05, 0.0, 0.5)[:, None])
    assert np.all(look(chunk)[0])
    t[1800:] -= 10  # a gap that is too short for that
    chunk = epochs_at_rest(t, DT, bias=np.where(t < 180.05, 0.0, 0.5)[:, None])
    still, _ = look(chunk)
    assert not still[1800]


# motion


def disturbed(seconds, gyro=lambda s: 0 * s, accel=lambda s: 0 * s, gyro_axis=0, accel_axis=0):
    """Return 400 s of epochs; from 200 s on, for so many seconds, with what comes on top (s counts from there)."""
    t = regular(400 / 3600)
    chunk = epochs_at_rest(t, DT)
    rate, force = chunk["gyro"].copy(), chunk["accel"].copy()
    moved = (t > 200) & (t <= 200 + seconds)
    rate[moved, gyro_axis] += gyro(t[moved] - 200)
    force[moved, accel_axis] += accel(t[moved] - 200)
    return chunk.having(gyro=rate, accel=force), moved


MOTIONS = {
    "shaken": (5.0, lambda s: np.deg2rad(2) * np.sin(2 * np.pi * 3.1 * s), lambda s: 0.3 * np.sin(2 * np.pi * 3.1 * s)),
    "turned slowly": (10.0, lambda s: np.deg2rad(1) + 0 * s, lambda s: 0 * s),
    "shaken slowly": (20.0, lambda s: 8e-4 * np.sin(2 * np.pi * 0.4 * s), lambda s: 0 * s),
    "pushed": (3.0, lambda s: 0 * s, lambda s: 0.05 + 0 * s),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_motion_is_seen_within_a_second_and_ends_when_it_ends(motion):
    chunk, moved = disturbed(*MOTIONS[motion])
    still, _ = look(chunk)
    seen = np.flatnonzero(~still)
    first, last = np.flatnonzero(moved)[[0, -1]]
    assert first <= seen[0] <= first + 1.0 / DT
    assert last <= seen[-1] <= last + 2.5 / DT  # the mean of a second comes to rest, and a second of holding on
    assert len(seen) == seen[-1] - seen[0] + 1, "one motion, without a break"


def test_a_tilt_that_only_the_accelerometers_see_is_motion():
    """By 5 mrad: 0.049 m/s^2 more on one axis."""
    chunk, _ = disturbed(200.0, accel=lambda s: 9.8 * np.minimum(5e-3, 5e-3 * s), accel_axis=1)
    still, out = look(chunk)
    seen = np.flatnonzero(~still)
    assert 2000 <= seen[0] <= 2010
    assert set(np.flatnonzero(np.any(out, axis=0))) == {4}
    # another attitude, and nothing moves: still again after realign_after
    assert 19 <= DT * (seen[-1] - 2000) <= 25
    assert np.all(still[2260:])


def test_a_unit_that_was_turned_over_is_still_again():
    """Turned for 3 s; up is down, and the Earth rate about each axis another."""
    chunk, _ = disturbed(3.0, gyro=lambda s: np.pi / 3 + 0 * s)
    t, force, rate = chunk.t, chunk["accel"].copy(), chunk["gyro"].copy()
    force[t > 201.5] *= -1
    rate[t > 203] += 8 * DEG_H
    still, _ = look(chunk.having(accel=force, gyro=rate))
    seen = np.flatnonzero(~still)
    assert 2000 <= seen[0] <= 2010
    assert 203 + 19 <= t[seen[-1]] <= 203 + 25
    assert len(seen) == seen[-1] - seen[0] + 1


def test_a_unit_that_keeps_moving_is_never_taken_for_still():
    chunk, moved = disturbed(150.0, gyro=lambda s: 0.02 * np.sin(2 * np.pi * 0.7 * s))
    still, _ = look(chunk)
    assert not np.any(still[moved][10:])


@pytest.mark.parametrize(
    ("place", "name"),
    [({"gyro": lambda s: 0.01 + 0 * s, "gyro_axis": 2}, "gyro z"), ({"accel": lambda s: 0.1 + 0 * s}, "accel x")],
)
def test_the_sensor_and_axis_that_saw_it_are_named(place, name):
    chunk, _ = disturbed(4.0, **place)
    detector, journal = detector_of(chunk), RunLog()
    still, out, _ = detector.look(chunk, detector.start())
    journal.moving.note(chunk.t, ~still, out, [" ".join(axis) for axis in detector.axes])
    assert journal.moving.worst() == [name]
    ((start, stop),) = journal.moving.spans
    assert start == pytest.approx(200.1, abs=0.3)
    assert stop == pytest.approx(205.0, abs=1.0)


def test_one_axis_without_accelerometers_is_watched():
    sections = {"gyro": {**CONFIG.filter.gyro.model_dump(mode="json"), "bias": {
        "kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)", "axes": ["z"]}}, "accel": None}  # fmt: skip
    settings = Config.model_validate({"filter": sections})
    chunk, _ = disturbed(4.0, gyro=lambda s: 0.01 + 0 * s)
    chunk = chunk.having(gyro=np.ascontiguousarray(chunk["gyro"][:, :1]))
    detector = settings.filter.detector(settings.filter.aligned(chunk.part(0, 600), settings.site))
    still, out, _ = detector.look(chunk, detector.start())
    assert detector.axes == (("gyro", "z"),)
    assert out.shape == (len(chunk), 1)
    assert 40 <= np.sum(~still) <= 65


# laws


@given(cuts=st.lists(st.integers(1, 4000), max_size=12), seed=st.integers(0, 3))
@settings(max_examples=25)
def test_any_split_gives_the_same_flags_to_the_last_bit(cuts, seed):
    chunk, _ = disturbed(*MOTIONS[list(MOTIONS)[seed]])
    t = chunk.t.copy()
    t[1000:] += 3.0
    t[3300:] += 50.0
    chunk = epochs_at_rest(t, DT).having(gyro=chunk["gyro"], accel=chunk["accel"])
    detector = detector_of(chunk)
    whole, out, memory = detector.look(chunk, detector.start())
    edges = [0, *sorted(set(cuts) - {0, len(t)}), len(t)]
    part_memory, parts, journals = detector.start(), [], [Stretches(), Stretches()]
    names = [" ".join(axis) for axis in detector.axes]
    journals[0].note(t, ~whole, out, names)
    for start, stop in pairwise(edges):
        part = chunk.part(start, stop)
        before = part_memory.copy()
        found, part_out, after = detector.look(part, part_memory)
        np.testing.assert_array_equal(part_memory, before)  # what goes in is left as it was
        part_memory = after
        parts.append(found)
        journals[1].note(part.t, ~found, part_out, names)
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_array_equal(part_memory, memory)
    assert journals[0] == journals[1]
