"""Readings that no sensor gives are doubts; those of ordinary sensors, coarse ones and steady ones are none."""

from types import SimpleNamespace

import numpy as np
import pytest

from driftlab.recordings.plausibility import ALONE, Copies, Lone, Rails, Rounding, Thermometer, alone
from driftlab.recordings.screening import _suspect
from fusion_core.chunk import Chunk
from fusion_core.faults import Faults

N, DT = 40_000, 0.1
RNG = np.random.default_rng(0)
RAMP = 20 + 30 * np.sin(np.arange(N) * DT / 1500)


def doubts(T, size=7000, dt=DT):
    """Return the doubts of temperatures (N,), which come in chunks of `size`."""
    faults = Faults(first_row=0.0)
    thermometer, t = Thermometer(faults), np.arange(len(T)) * dt
    for start in range(0, len(T), size):
        thermometer.look(Chunk(t[start : start + size], {"temperature": T[start : start + size]}))
    thermometer.flush()
    return faults.doubts


def held(T, start, stop):
    return np.where((np.arange(N) >= start) & (np.arange(N) < stop), T[start], T)


NOISY = RAMP + 0.01 * RNG.normal(size=N)
ORDINARY = {
    "fine": NOISY,
    "fine, without noise": RAMP,
    "steps of 0.06 K": np.rint(NOISY * 16) / 16,
    "steps of 1 K": np.rint(NOISY),
    "steps of 2 K": np.rint(NOISY / 2) * 2,
    "read once a second": np.repeat(NOISY[::10], 10),
    "read once a minute": np.repeat(NOISY[::600], 600)[:N],
    "steps of 0.06 K, then steady": np.rint(16 * (20 + 30 * np.exp(-np.arange(N) * DT / 400))) / 16,
    "frozen": np.full(N, 21.5),
    "another chip that warms fast": 25 + 20 * (1 - np.exp(-np.arange(N) * DT / 30)) + 0.01 * RNG.normal(size=N),
}


@pytest.mark.parametrize("T", ORDINARY.values(), ids=ORDINARY)
@pytest.mark.parametrize("size", [313, N])
def test_an_ordinary_thermometer_is_in_no_doubt(T, size):
    assert doubts(T, size) == []


@pytest.mark.parametrize("size", [1, 7000, N])
def test_a_stuck_one_is_named_where_it_begins(size):
    rows = 20_000 if size > 1 else 3_000
    (text,) = doubts(held(NOISY, rows, N)[: rows + 1_500], size)
    assert f"from {rows * DT:.1f} s on" in text
    assert f"{NOISY[rows]:.6g} °C" in text


def test_one_that_is_read_once_a_second_is_stuck_later():
    (text,) = doubts(np.repeat(held(NOISY, 2_000, N)[:4_000], 10), dt=DT)
    assert "in more than 10 rows" in text


@pytest.mark.parametrize(("T", "word"), [
    (np.where(np.arange(N) > 9_000, NOISY + 3, NOISY), "jumps"),
    (held(NOISY, 0, 20_000), "jumps"),
    (NOISY + 273.15, "kelvin"),
])  # fmt: skip
def test_jumps_and_kelvin_are_named(T, word):
    (text,) = doubts(T)
    assert word in text


@pytest.mark.parametrize("size", [1, 7, 313, 1_000, 3_000])
@pytest.mark.parametrize("rows", [[9_000], [998, 999, 1_000], range(900, N, 1_700), [999, 5_000, 9_999, 20_001]])
def test_readings_that_stand_alone_are_named_and_counted(rows, size):
    """Whatever the chunks are; two in a row are none, and a jump there and back."""
    faults, T, rows = Faults(first_row=0.0), NOISY.copy(), list(rows)
    T[rows] = -60.0
    thermometer = Thermometer(faults)
    for k in range(0, N, size):
        thermometer.look(Chunk(np.arange(k, min(k + size, N)) * DT, {"temperature": T[k : k + size]}))
    thermometer.flush()
    text, *more = faults.doubts
    if 999 in rows and 1_000 in rows:
        assert "jumps from" in text
    else:
        assert not more
        assert f"is -60 °C at {rows[0] * DT:.1f} s, alone between" in text
        assert faults.found[ALONE].count == len(rows)


@pytest.mark.parametrize("size", [1, 313, 3_000])
@pytest.mark.parametrize(("shown", "word"), [
    (NOISY - 273.15, "-253.1"),  # degC read as K
    (np.arange(N) * 1.0, "451"),  # the time
    (np.where(np.arange(N) > 2_000, NOISY + 5e-4 * (np.arange(N) - 2_000) ** 2, NOISY), "450"),
])  # fmt: skip
def test_temperatures_that_no_soak_has_are_named_where_they_begin(shown, word, size):
    (text,) = [text for text in doubts(shown[:3_500], size, dt=10.0) if "is soaked" in text]
    assert word in text


def below_zero(T, size):
    faults = Faults(first_row=0.0)
    parts = [T[k : k + size] for k in range(0, len(T), size)]
    chunks = [Chunk(np.arange(len(part)) * DT, {"temperature": part}) for part in parts]
    assert list(Thermometer(faults).along(chunks)) == chunks
    return faults.doubts


@pytest.mark.parametrize("size", [7, N])
def test_readings_below_absolute_zero_that_change_are_in_doubt_and_what_stands_for_no_reading_is_not(size):
    (text,) = below_zero(NOISY - 310, size)
    assert text.startswith("temperature changes below absolute zero")
    for absent in (-999.0, -1e30, np.nan, np.inf):
        assert below_zero(np.where(np.arange(N) % 3, NOISY, absent), size) == []
    assert below_zero(np.where(RNG.random(N) < 1e-3, -1000 * RNG.random(N), NOISY), size) == []  # torn lines


def test_time_in_another_unit_is_named():
    (text,) = doubts(NOISY, dt=DT / 1000)
    assert "source.channels.time.unit" in text


def test_an_axis_that_copies_another_is_named_once():
    values = RNG.normal(size=(N, 3))
    values[:, 2] = values[:, 0]
    faults = Faults()
    copies = Copies(faults)
    for start in range(0, N, 999):
        part = values[start : start + 999]
        copies.look(Chunk(np.arange(len(part)) * DT, {"gyro": part}), "gyro", None)
    assert faults.doubts == ["gyro z shows what gyro x shows, row by row; correct source.channels.gyro.path"]


def test_axes_that_are_alike_for_a_while_or_stand_still_are_no_copies():
    values = np.zeros((N, 3))
    values[:, 2] = RNG.normal(size=N)
    values[:, 0] = np.where(np.arange(N) < 50, values[:, 2], 1.0)
    faults = Faults()
    Copies(faults).look(Chunk(np.arange(N) * DT, {"gyro": values}), "gyro", None)
    assert faults.doubts == []


def ends(values, size=999):
    """Return the doubts of readings (N, 1) that come in chunks."""
    faults, rails, one = Faults(rows=len(values)), Rails("gyro", None, 1), np.empty(1)
    for start in range(0, len(values), size):
        part = values[start : start + size]
        _suspect(part, np.full(1, np.nan), np.zeros(1), one, np.inf, rails.table, np.empty(1))
    rails.judge(faults)
    return faults.doubts


NOISE = RNG.normal(size=(N, 1))
READINGS = {
    "fine": NOISE,
    "steps of one sigma": np.rint(NOISE),
    "steps of a third": np.rint(NOISE * 3),
    "steps of a fortieth": np.rint(NOISE * 40),
    "steps of two sigma, on a curve": np.rint(NOISE / 2 + RAMP[:, None] / 10),
    "a curve without noise": RAMP[:, None],
    "a fifth is zero": np.where(np.arange(N)[:, None] % 5, NOISE, 0.0),
}


@pytest.mark.parametrize("values", READINGS.values(), ids=READINGS)
def test_steps_and_curves_are_no_end_of_a_range(values):
    assert ends(values) == []


@pytest.mark.parametrize("sign", [1, -1])
def test_an_axis_at_the_end_of_its_range_is_named(sign):
    (text,) = ends(np.minimum(NOISE, 1.5) * sign)
    which = "largest" if sign > 0 else "smallest"
    assert text.startswith(
        f"gyro x shows exactly {1.5 * sign} in SI, its {which} reading, in {np.sum(NOISE >= 1.5)} rows"
    )


def rounded(values, dt, noise):
    """Return the doubts of readings (N,) of a gyro whose declared noise has this density."""
    faults, sensor = Faults(), SimpleNamespace(axes="x", unit="rad/s", noise=np.array([noise]))
    rounding = Rounding("gyro", sensor, 1)
    for start in range(0, N, 9_999):
        part = values[start : start + 9_999, None]
        rounding.look(Chunk(np.arange(len(part)) * dt, {"gyro": part}))
    rounding.judge(faults)
    return faults.doubts


@pytest.mark.parametrize("rate", [1, 100])
@pytest.mark.parametrize("step", [0.5, 1.0, 2.0, 2.75, 4.5, 8.0])
def test_steps_that_noise_does_not_average_out_are_named(rate, step):
    """The error of a mean is that of a million readings, at values all over one step."""
    bias = np.linspace(0.0, step, 20)[:, None]
    off = np.max(np.abs(np.mean(np.rint((bias + RNG.normal(size=(20, 50_000))) / step) * step, axis=1) - bias[:, 0]))
    values = np.rint((NOISE[:, 0] + 10 * np.sin(np.arange(N) / 6000)) / step) * step
    found = rounded(values, 1 / rate, 1 / np.sqrt(rate))
    assert bool(found) is bool(off > np.sqrt(2) / np.sqrt(60 * rate))
    for text in found:
        stated = float(text.partition("off by up to ")[2].split()[0])
        assert 0.7 * off < stated < 1.4 * off


STEADY = {
    "a curve": RAMP,
    "noise": NOISE[:, 0],
    "single precision": NOISE[:, 0].astype(np.float32).astype(float),
    "nothing": np.zeros(N),
    "steps below the declared noise": np.rint(RAMP),
    "a file of six digits": np.rint(RAMP * 1e6) / 1e6,
}


@pytest.mark.parametrize("values", STEADY.values(), ids=STEADY)
def test_values_without_steps_or_with_small_ones_are_in_no_doubt(values):
    assert rounded(values, DT, 5.0) == []


def of_holds(x, size=N):
    """Return the doubts about readings (N, 3) that are held, and the notes on how often they come."""
    faults, looks, t = Faults(first_row=0.0), Rounding("gyro", None, 3), np.arange(len(x)) * DT
    for start in range(0, len(x), size):
        looks.look(Chunk(t[start : start + size], {"gyro": x[start : start + size]}))
    looks.judge(faults)
    return faults.doubts, [line for line in faults.lines(doubts=False) if "each reading" in line]


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2, 0.3, 0.5, 1.0, 5.0, 100.0])
@pytest.mark.parametrize("ramp", [0.0, 1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("walk", [0.0, 0.01])
def test_what_rounds_to_steps_is_not_held(noise, ramp, walk):
    """However long it shows one reading: noise of a part of a step repeats it as long as the bias stands."""
    rng = np.random.default_rng(1)
    moved = np.cumsum(walk * rng.normal(size=(N, 3)) + ramp, axis=0) + np.array([0.0, 0.3, 0.5])
    assert of_holds(np.rint(moved + noise * rng.normal(size=(N, 3))), 7000) == ([], [])


@pytest.mark.parametrize("rounded", [True, False])
@pytest.mark.parametrize(("times", "apart"), [(12, 12), (30, 300), (90, 90), (90, 95)])
def test_an_axis_that_is_held_is_a_doubt(rounded, times, apart):
    rng, i = np.random.default_rng(2), np.arange(N)
    x = 20 * rng.normal(size=(N, 3)) + 1e-2 * i[:, None]
    x[:, 2] = x[i - np.where(i % apart < times, i % apart, 0), 2]
    doubts, _ = of_holds(np.rint(x) if rounded else x)
    assert len(doubts) == 1
    assert doubts[0].startswith("gyro z shows the very same reading up to ")


@pytest.mark.parametrize("steps", [20, 200, 2000])
@pytest.mark.parametrize("rows", [5_000, 200_000])
def test_rows_that_come_ten_times_as_fast_as_readings_are_a_note(steps, rows):
    values = np.repeat(np.round(np.random.default_rng(steps).normal(size=(rows // 10, 3)) * steps), 10, axis=0)
    doubts, notes = of_holds(values, 65_536)
    assert doubts == []
    assert [note.partition(":")[0] for note in notes] == ["gyro gives each reading about 10 times"]


def single_readings(x, size):
    """Return the doubts about readings (N, 3) of a gyro, and how many of each axis stand alone."""
    faults, look, t = Faults(first_row=0.0), Lone("gyro", None, 3), np.arange(len(x)) * DT
    last = np.full(3, np.nan)
    for start in range(0, len(x), size):
        part, leaps = x[start : start + size], np.zeros(3)
        _suspect(part, last, np.zeros(3), np.zeros(3), np.inf, np.tile([-np.inf, 0.0, -np.inf, 0.0], (2, 3, 1)), leaps)
        look.look(Chunk(t[start : start + size], {"gyro": part}), leaps, np.inf, faults)
        last = part[-1]
    look.judge(faults)
    return faults.doubts, {what: fault.count for what, fault in faults.found.items() if fault.count}


@pytest.mark.parametrize("size", [999, 7_000, N])
@pytest.mark.parametrize(("every", "far", "doubtful"), [(400, 30.0, True), (400, -3e5, True), (8_000, 30.0, False)])
def test_single_readings_far_off_are_counted_whatever_the_chunks(size, every, far, doubtful):
    rng = np.random.default_rng(3)
    x = rng.normal(size=(N, 3)) + 1e-3 * np.arange(N)[:, None]
    rows = np.arange(every // 2, N, every)
    x[rows, 1] += far
    doubts, counts = single_readings(x, size)
    assert counts == {"readings of gyro y alone between others far off": len(rows)}
    assert [text.partition(":")[0] for text in doubts] == ["gyro y"] * doubtful


def test_a_single_reading_on_the_border_of_two_chunks_is_counted():
    for row in (6_998, 6_999, 7_000, 7_001):
        x = np.random.default_rng(4).normal(size=(N, 3))
        x[row, 2] += 100
        assert single_readings(x, 7_000)[1] == {"readings of gyro z alone between others far off": 1}


def test_gaps_and_few_readings_are_no_trouble():
    x = np.random.default_rng(6).normal(size=500)
    x[[3, 100, 498]], x[105] = 90.0, np.nan
    assert alone(x, 1.0).tolist() == [3, 100, 498]
    assert [len(alone(np.array([0.0, 90.0, 0.0])[:n], 1.0)) for n in range(4)] == [0, 0, 0, 0]


def _in_bursts(rng):
    return rng.normal(size=(N, 3)) * np.where(np.arange(N) // 3_000 % 3 == 1, 100.0, 1.0)[:, None]


SCATTERED = {
    "noise": lambda rng: rng.normal(size=(N, 3)),
    "noise of tails, Student's of 5": lambda rng: rng.standard_t(5, size=(N, 3)),
    "bursts of noise": _in_bursts,
    "coarse steps": lambda rng: np.rint(0.2 * rng.normal(size=(N, 3))),
    "steps of the level": lambda rng: rng.normal(size=(N, 3)) + 200 * (np.arange(N) // 500 % 2)[:, None],
    "a tone near half the sampling rate": lambda rng: (
        500 * np.sin(3.1 * np.arange(N))[:, None] + rng.normal(size=(N, 3))
    ),
    "nothing": lambda rng: np.zeros((N, 3)),
}


@pytest.mark.parametrize("kind", SCATTERED)
def test_noise_motion_and_steps_are_no_single_readings(kind):
    doubts, counts = single_readings(SCATTERED[kind](np.random.default_rng(5)), 7_000)
    assert doubts == []
    assert sum(counts.values()) <= (20 if "tails" in kind else 4 if "bursts" in kind else 0)
