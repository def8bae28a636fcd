"""Memories in one soak: seen with their size, never by chance, or said to be undecided. Made in plain NumPy."""

import json

import numpy as np
import pytest
from loop_cases.signatures import dragged, late

from driftlab.maps.hysteresis import memory as module
from driftlab.maps.hysteresis.memory import memory_of
from driftlab.soak.blocks import brief
from driftlab.soak.temperature import between_steps, soak_temperature
from fusion_core.thermal.thermometer import steps_of

DT = 10.0
TURNS = {"once": [-20, 50, -20], "twice": [-20, 50, -20, 50, -20], "room": [25, -20, 50, -20, 25]}


def temperature(profile, hours):
    x = np.linspace(0, 1, int(hours * 3600 / DT))
    if profile == "sines":
        return 15 - 35 * np.cos(6 * np.pi * x)
    if profile == "stairs":
        levels = np.concatenate([np.arange(-20, 51, 10), np.arange(40, -21, -10)])
        return late(levels[np.minimum((x * len(levels)).astype(int), len(levels) - 1)].astype(float), 300, DT)
    turns = TURNS[profile]
    return late(np.interp(x, np.linspace(0, 1, len(turns)), turns), 480, DT)


def curve(T):
    u = (T - 15) / 35
    return np.stack([300 * u + 100 * u**2 - 80 * u**3, 60 * u**3 - 200 * u, 50 * u + 90 * u**2], axis=1)


def memory(T, kind, size):
    """Return what is added on one axis, with a difference of `size` between up and down at most."""
    if kind == "play":
        return size * (T - dragged(T, 8.0)) / 8
    if kind == "step":
        way = np.sign(T - dragged(T, 0.6))
        return size * way / 2
    added = T - late(T, 600, DT)
    return size * added / np.ptp(added)


def judged(seed, profile="room", hours=6.0, kind="", size=0.0, walk=0.03, white=10.0):
    """Judge three axes in deg/h; walk in deg/h/sqrt(s), white in deg/h/sqrt(Hz)."""
    rng = np.random.default_rng(seed)
    T = temperature(profile, hours)
    bias = curve(late(T, 400, DT)) if kind == "lag" else curve(T)
    if kind and kind != "lag":
        bias = bias + memory(T, kind, size)[:, None] * [1.0, -2 / 3, 0.0]
    bias = bias + np.cumsum(walk * np.sqrt(DT) * rng.normal(size=bias.shape), axis=0)
    bias += white / np.sqrt(DT) * rng.normal(size=bias.shape)
    return memory_of(brief(T + 0.003 * rng.normal(size=len(T)), bias, [0], DT))


@pytest.mark.parametrize("profile", ["room", "twice", "sines", "stairs"])
@pytest.mark.parametrize(("kind", "effect"), [("play", "hysteresis"), ("step", "hysteresis"), ("relax", "relaxation")])
def test_a_memory_is_seen_with_its_kind_and_its_size(profile, kind, effect):
    found = judged(1, profile, kind=kind, size=24.0)
    assert found.answer == "seen"
    assert effect in found.kinds
    if kind != "relax":  # whose difference at one temperature is less than that over time
        np.testing.assert_allclose(np.abs(found.size[:2]), [24, 16], atol=4 * found.sigma[:2].max())
    assert found.size[0] * found.size[1] < 0
    assert found.sigma.max() < 4
    assert abs(found.size[2]) < 4 * found.sigma[2]


@pytest.mark.parametrize("profile", ["once", "room", "sines", "stairs"])
def test_a_lag_of_a_bent_curve_is_seen(profile):
    found = judged(2, profile, kind="lag")
    assert found.answer == "seen"
    assert "thermal_lag" in found.kinds


def test_a_lag_that_the_free_curve_of_temperature_has_taken_in_part_is_seen_nonetheless():
    """Up and down once, the time of a lag as long as features of the curve: fitted to temperature, they are gone."""
    T = temperature("once", 4.0)
    u = (late(T, 1800, DT) - 15) / 35
    bias = np.stack([9 * np.sin(4 * u), -9 * np.tanh(4 * u), 0 * u], axis=1)
    rng = np.random.default_rng(9)
    bias = bias + np.cumsum(0.03 * np.sqrt(DT) * rng.normal(size=bias.shape), axis=0)
    found = memory_of(brief(T, bias + 10 / np.sqrt(DT) * rng.normal(size=bias.shape), [0], DT))
    assert found.answer == "seen"
    assert "thermal_lag" in found.kinds


def test_a_part_of_the_curve_that_follows_late_is_seen_beside_a_part_that_does_not():
    """The curve that is fitted to temperature is that of the part that does not: its lag shows nothing."""
    T = temperature("room", 8.0)
    u = (late(T, 600, DT) - 15) / 35
    rng = np.random.default_rng(9)
    bias = curve(T) + 10 * np.stack([np.cos(3 * u), np.sin(4 * u), 0 * u], axis=1)
    bias = bias + np.cumsum(0.03 * np.sqrt(DT) * rng.normal(size=bias.shape), axis=0)
    found = memory_of(brief(T, bias + 10 / np.sqrt(DT) * rng.normal(size=bias.shape), [0], DT))
    assert found.answer == "seen"
    assert found.evidence > 20
    assert "thermal_lag" in found.kinds


@pytest.mark.parametrize("profile", ["once", "room"])
def test_a_lag_without_any_noise_is_seen(profile):
    T = temperature(profile, 4.0)
    assert memory_of(brief(T, curve(late(T, 400, DT)), [0], DT)).answer == "seen"


def test_a_walk_is_taken_for_none():
    """20 soaks; of more it is `benchmarks/memory_in_one_soak.py` that tells."""
    answers = []
    for seed in range(20):
        profile = ["once", "twice", "room", "sines", "stairs"][seed % 5]
        found = judged(100 + seed, profile, hours=(2.0, 6.0)[seed % 2], walk=(0.01, 0.03, 0.1, 0.3)[seed // 5])
        answers.append(found.answer)
    assert answers.count("seen") == 0
    assert answers.count("undecided") <= 6


@pytest.mark.parametrize("profile", ["room", "sines"])
def test_none_larger_is_said_of_what_would_have_been_seen(profile):
    """Memories as large as what is denied: none of these is denied."""
    most = judged(7, profile).none_larger_than
    for seed, kind in enumerate(("play", "step", "relax")):
        assert judged(8 + seed, profile, kind=kind, size=most.max()).answer == "seen"


def beside_a_level_axis(seed, planted):
    """Return the verdict on a steep axis and one that does not go with the temperature but for a play of `planted`."""
    rng = np.random.default_rng(seed)
    T = temperature("once", 10.0)
    bias = np.stack([120 * np.tanh((T - 18) / 3), memory(T, "play", planted)], axis=1)
    bias += np.cumsum(0.02 * np.sqrt(DT) * rng.normal(size=bias.shape), axis=0)
    return memory_of(brief(T, bias + 4 / np.sqrt(DT) * rng.normal(size=bias.shape), [0], DT))


@pytest.mark.parametrize("seed", range(3))
def test_an_axis_that_hardly_moves_takes_no_limit_from_the_others(seed):
    """What is denied of it is more than it moves in all, and would be seen all the same."""
    found = beside_a_level_axis(seed, 0.0)
    assert found.answer == "none"
    assert np.all(found.none_larger_than < 40)
    assert beside_a_level_axis(seed + 3, found.none_larger_than[1]).answer == "seen"


def test_where_no_axis_moves_as_much_as_would_be_seen_none_is_denied():
    rng = np.random.default_rng(1)
    T = temperature("once", 0.5)
    bias = np.cumsum(0.5 * np.sqrt(DT) * rng.normal(size=(len(T), 2)), axis=0)
    found = memory_of(brief(T, bias + 4 / np.sqrt(DT) * rng.normal(size=bias.shape), [0], DT))
    assert found.answer == "undecided"
    assert "larger than all that the bias does here" in found.why
    assert np.all(np.isinf(found.none_larger_than))


@pytest.mark.parametrize(
    ("turns", "why"),
    [([0, 60], "only ever warms"), ([60, 0], "only ever cools"), ([0, 60, 55], "share too few temperatures")],
)
def test_where_no_memory_can_be_told_that_is_said(turns, why):
    T = np.interp(np.linspace(0, 1, 5000), np.linspace(0, 1, len(turns)), turns)
    found = memory_of(brief(T, np.random.default_rng(0).normal(size=(5000, 2)), [0], DT))
    assert found.answer == "undecided"
    assert why in found.why
    assert json.loads(json.dumps(found.as_json(), allow_nan=False))["none_larger_than"] == [None, None]


def test_a_steady_drift_and_a_jump_between_recordings_are_none():
    rng = np.random.default_rng(3)
    T = temperature("once", 6.0)
    bias = rng.normal(size=(len(T), 2)) + np.linspace(0, 200, len(T))[:, None]
    assert memory_of(brief(T, bias, [0], DT)).answer == "none"
    bias[len(T) // 2 :] += 100.0
    divided = memory_of(brief(T, bias, [0, len(T) // 2], DT))
    assert divided.answer != "seen", "up in one recording, down in another, and a turn-on between: who could say"
    assert "jumped" in memory_of(brief(T, bias, [0], DT)).why, "in one recording it is not to be overlooked"


@pytest.mark.parametrize("profile", ["once", "twice", "sines", "stairs"])
def test_what_settles_with_time_alone_is_neither_taken_for_a_memory_nor_denied(profile):
    """Shapes that no effect has: creep as the logarithm of time, and as its inverse. Half an hour later it is none."""
    for settled in (lambda h: 1 - np.log1p(h / 0.05) / np.log1p(6 / 0.05), lambda h: 1 / (1 + h / 0.3)):
        rng = np.random.default_rng(5)
        T = temperature(profile, 6.0)
        bias = curve(T) + np.outer(settled(np.arange(len(T)) * DT / 3600), [0.0, 60.0, 0.0])
        bias = bias + np.cumsum(0.03 * np.sqrt(DT) * rng.normal(size=bias.shape), axis=0)
        found = memory_of(brief(T, bias + 10 / np.sqrt(DT) * rng.normal(size=bias.shape), [0], DT))
        assert found.answer == "undecided"
        assert "settles after the start" in found.why
        assert np.all(np.isinf(found.none_larger_than))
        assert abs(found.size[1]) > 10, "what is between up and down, for the budget of the map"


def test_a_memory_beside_what_settles_is_seen():
    rng = np.random.default_rng(6)
    T = temperature("twice", 8.0)
    bias = curve(T) + (memory(T, "play", 24.0) + 30 * np.exp(-np.arange(len(T)) * DT / 2400))[:, None] * [1.0, 0.5, 0]
    found = memory_of(brief(T, bias + 10 / np.sqrt(DT) * rng.normal(size=bias.shape), [0], DT))
    assert found.answer == "seen"
    assert "hysteresis" in found.kinds


def test_a_lag_of_less_than_a_minute_is_not_taken_for_a_memory_and_not_denied():
    """A thermometer that is read some seconds before the sensor looks like it."""
    T = temperature("room", 4.0)
    bias = curve(late(T, 25, DT)) + 10 / np.sqrt(DT) * np.random.default_rng(5).normal(size=(len(T), 3))
    found = memory_of(brief(T, bias, [0], DT))
    assert found.answer == "undecided"
    assert "less than a minute" in found.why


def test_a_lens_is_seen_beside_a_sharp_bend():
    """Its loop is closed at both ends and widest in the middle, as of many plays side by side."""
    T = np.interp(np.linspace(0, 1, 7200), [0, 0.5, 1], [-20, 48, -20])
    rng = np.random.default_rng(6)
    bias = 60 * np.tanh((T - 31) / 3) + 15 * np.sin(np.pi * (T + 20) / 68) * np.sign(np.gradient(T))
    bias = bias + np.cumsum(0.04 * rng.normal(size=7200)) + 1.6 * rng.normal(size=7200)
    found = memory_of(brief(T, bias[:, None], [0], 4.0))
    assert found.answer == "seen"
    assert abs(abs(found.size[0]) - 30) < 3 * found.sigma[0]


@pytest.mark.recordings
@pytest.mark.parametrize(("name", "answer"), [("lagging", "seen"), ("control", "undecided")])
def test_a_measured_resistor_that_lags_is_seen_and_its_control_is_not(recordings, name, answer):
    rows = np.genfromtxt(recordings / "data" / "oven_resistors" / f"{name}.csv", delimiter=",", names=True)
    ramp = rows[:9300]
    assert memory_of(brief(ramp["oven"], ramp["ppm"][:, None], [0], 1.0)).answer == answer
    oven, ppm = (rows[key][: len(rows) // 5 * 5].reshape(-1, 5).mean(axis=1) for key in ("oven", "ppm"))
    assert memory_of(brief(oven, ppm[:, None], [0], 5.0)).answer == answer


def test_no_size_is_signed_that_is_within_its_uncertainty(monkeypatch):
    monkeypatch.setattr(module, "CLEAR", 1000.0)
    found = judged(1, kind="play", size=24.0)
    assert found.answer == "undecided"
    assert "within its uncertainty" in found.why
    assert np.isinf(found.none_larger_than).all()


@pytest.mark.parametrize("bend", [4.0, 1.0])
def test_a_sharp_bend_without_noise_is_no_memory(bend):
    T = temperature("room", 6.0)
    bias = np.tanh((T - 31) / bend)[:, None] * [60.0, -30.0] + 0.02 * np.random.default_rng(4).normal(size=(len(T), 2))
    assert memory_of(brief(T, bias, [0], DT)).answer != "seen"
    assert memory_of(brief(T, np.zeros((len(T), 1)), [0], DT)).answer != "seen"


def test_a_walk_over_what_was_not_recorded_is_no_memory():
    """Up to the hot third and down from it; without their times the samples seem to follow one another."""
    t = np.arange(0, 6 * 3600, DT)
    kept, T, answers = np.abs(t / t[-1] - 0.5) > 0.13, temperature("once", 6.0), []
    for seed in (0, 9, 10, 11):
        rng = np.random.default_rng([seed, 20])
        walk, white = (rng.normal(size=(len(T), 3)) for _ in range(2))
        bias = curve(T) + np.cumsum(0.03 * np.sqrt(DT) * walk, axis=0) + 2 / np.sqrt(DT) * white
        answers.append([memory_of(brief(T[kept], bias[kept], [0], DT, times)) for times in (t[kept], None)])
    assert all(timed.evidence < np.log(100) < untimed.evidence for timed, untimed in answers)


def read_in_steps(seed, profile, step, rounded, play=0.0):
    """Judge a soak of 5 h at 1 Hz whose thermometer rounds to a step in K."""
    rng = np.random.default_rng(seed)
    t = np.arange(18_000.0)
    levels = np.repeat([-20.0, -5, 10, 25, 40, 55, 40, 25, 10, -5, -20], 1637)[: len(t)]
    T = {
        "triangle": 57.3 - 78 * np.abs(t / 9000 - 1),
        "sines": 18.3 - 39 * np.cos(4 * np.pi * t / 18_000),
        "stairs": late(levels + 0.9, 300, 1.0),
    }[profile]
    bias = curve(T) + play * (T - dragged(T, 8.0))[:, None] / 8 * [1.0, -2 / 3, 0.0]
    bias += np.cumsum(0.03 * rng.normal(size=bias.shape), axis=0) + 10 * rng.normal(size=bias.shape)
    readings = rounded(T / step) * step
    smooth, steps = soak_temperature(t, readings, steps_of(readings))
    return memory_of(brief(smooth, bias, [0], 1.0, t, between_steps(t, smooth, readings, steps)))


@pytest.mark.parametrize("rounded", [np.round, np.floor])
@pytest.mark.parametrize("profile", ["triangle", "sines", "stairs"])
@pytest.mark.parametrize("step", [0.5, 2.0, 5.0])
def test_the_steps_of_a_thermometer_are_no_memory(step, profile, rounded):
    """Between two steps it does not show where the temperature is, as at a turn or on a hold."""
    assert not any(read_in_steps(seed, profile, step, rounded).answer == "seen" for seed in range(3))


def test_a_memory_is_seen_with_a_coarse_thermometer():
    """What a step of 5 K hides at a single turn may be a jump of the bias there: it is not denied."""
    found = read_in_steps(0, "triangle", 2.0, np.round, play=30.0)
    assert found.answer == "seen"
    assert abs(found.size[0] - 30) < 3 * found.sigma[0]
    assert read_in_steps(0, "triangle", 5.0, np.round, play=30.0).why.startswith("up and down differ as where the bias")


def test_a_thermometer_that_is_too_coarse_is_the_reason_of_no_verdict():
    assert "thermometer" in read_in_steps(0, "stairs", 5.0, np.round).why


@pytest.mark.parametrize("size", [10.0, 30.0])
def test_a_bias_that_jumps_once_is_no_memory(size):
    """At the turn of a temperature that goes up and comes down once, it is one between up and down as well."""
    whys = []
    for seed, when in enumerate(np.linspace(0.2, 0.8, 13)):
        rng = np.random.default_rng(seed)
        T = temperature("once", 5.0)
        bias = curve(T) + size * (np.arange(len(T)) > when * len(T))[:, None] * [1.0, -0.6, 0.3]
        bias += np.cumsum(0.03 * np.sqrt(DT) * rng.normal(size=bias.shape), axis=0)
        bias += 10 / np.sqrt(DT) * rng.normal(size=bias.shape)
        found = memory_of(brief(T, bias, [0], DT))
        assert found.answer != "seen"
        whys.append(found.why if "jumped after" in found.why else "")
    hours = [float(why.split("after ")[1].split(" h")[0]) for why in whys if why]
    times = [5 * when for why, when in zip(whys, np.linspace(0.2, 0.8, 13), strict=True) if why]
    assert hours == pytest.approx(times, abs=0.05)
    assert size < 30 or whys[6]  # at the turn
