import numpy as np
import pytest
from turned_units import matrix_of, tumble, turntable

import driftlab
from driftlab.commands.triad_map import show_triad_map

GYRO = {"noise": "1 deg/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1 deg/s/sqrt(s)"}}
WALK = {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)"}
TERMS = "bias,scale,misalignment"


def rows_of(table):
    return [line.split(",") for line in table.splitlines()[1:]]


def fitted(folder, t, y, T, rows, **more):
    """The result of a turntable with rows (start, stop, axis, rate) of its table."""
    head = "start [s],stop [s],axis,rate [deg/s]"
    (folder / "table.csv").write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")
    config = {
        "latitude": "0 deg",
        "filter": {"gyro": {"noise": "8e-5 rad/s/sqrt(Hz)", "bias": WALK}},
        "stimulus": {"kind": "rate_table", "segments": str(folder / "table.csv")},
        "limits": {"scale": "500000 ppm"},
    }
    data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    return driftlab.fit_map(config, data, terms=TERMS, **more)


def spinning_up(seed, tau):
    """A turntable that comes to its rate as 1 - exp(-t / tau) from the start of each segment on."""
    t, y, T, table = turntable(seed, [-20.0, 20.0, 60.0])
    for start, stop, axis, rate in rows_of(table):
        own = (t >= float(start) - 1e-6) & (t < float(stop) - 1e-6)
        y[own, "xyz".index(axis)] -= np.deg2rad(float(rate)) * np.exp(-(t[own] - float(start)) / tau)
    return t, y, T, rows_of(table)


@pytest.mark.parametrize("tau", [0.5, 1.0, 3.0])
def test_a_table_that_still_spins_up_is_in_doubt_and_no_limit_passes(tmp_path, tau):
    """The scale factor is off by (tau / 14 s) exp(-2 s / tau), and by nothing that its residuals show."""
    made = fitted(tmp_path, *spinning_up(0, tau))
    first = made.lines()[0]
    assert (
        "in doubt: 18 of 18 segments or placements (1, 2, 3, 4, 5, ...) are not steady: in the first quarter" in first
    )
    assert "larger stimulus.settle, or correct start and stop" in first
    assert made.limits[0].verdict == "undecided"


def test_a_table_that_has_spun_up_before_it_is_looked_at_passes(tmp_path):
    assert fitted(tmp_path, *spinning_up(0, 0.1)).limits[0].verdict == "pass"


def test_times_that_are_late_are_in_doubt_with_axis_and_time(tmp_path):
    t, y, T, table = turntable(1, [0.0, 40.0])
    rows = rows_of(table)
    rows[3][:2] = (f"{float(v) + 1.0:.3f}" for v in rows[3][:2])
    made = fitted(tmp_path, t, y, T, rows, out=tmp_path / "map.json", certificate=True)
    first = made.lines()[0]
    assert "1 of 12 segments or placements (4) is not steady" in first
    assert "4 (middle at 65.0 s) axis y differs" in first  # of 58 to 72 s
    off = float(first.partition("from the rest by ")[2].split()[0])
    assert off == pytest.approx(-100 * 0.5 / 10.5, rel=0.1)  # a second of slowing down among 10.5 s
    assert made.map.record.provenance["doubt"] in first
    for name in ("report", "certificate"):
        assert "not steady" in (tmp_path / f"map.{name}.html").read_text()


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("temperatures", "hold"), [([-20.0, 20.0, 60.0], 16.0), ([0.0, 15.0, 30.0, 45.0], 6.0)])
def test_a_steady_table_is_in_no_doubt(tmp_path, seed, temperatures, hold):
    t, y, T, table = turntable(seed, temperatures, hold=hold)
    assert fitted(tmp_path, t, y, T, rows_of(table)).faults.doubts == []


def test_a_unit_that_warms_while_it_turns_is_in_no_doubt(tmp_path):
    """A slow ramp: within a segment bias and scale factor move by many times its noise, as the terms say."""
    t, y, _, table = turntable(0, [20.0] * 6, matrix=lambda T: np.zeros((3, 3)))
    T = -10.0 + 60.0 * t / t[-1]
    warm = np.deg2rad(1.0) * (T - 20.0)[:, None] / 40.0 * [1.0, -0.5, 0.3]
    made = fitted(tmp_path, t, y + warm, T, rows_of(table))
    within = np.ptp(warm[:160, 0])
    assert within > 10 * made.fit.noise[0]
    assert made.faults.doubts == []


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        (lambda rows: [*rows[:4], [*rows[4][:3], -float(rows[4][3])], *rows[5:]], "the sign of its rate or axis"),
        (lambda rows: [*rows[:2], [*rows[2][:2], "z", rows[2][3]], *rows[3:]], "its axis: it turns about y"),
        (lambda rows: [[*row[:3], np.deg2rad(float(row[3]))] for row in rows], "the unit of the rate"),
    ],
    ids=["sign", "axis", "unit"],
)
def test_a_row_that_the_recording_contradicts_is_named_with_its_cause(tmp_path, capsys, wrong, cause):
    t, y, T, table = turntable(0, [-20.0, 20.0, 60.0])
    made = fitted(tmp_path, t, y, T, wrong(rows_of(table)), out=tmp_path / "map.json")
    first, *others = made.lines()
    assert first.startswith("in doubt: ")
    assert f"correct {cause}" in first
    assert not any("add segments" in line for line in others)
    show_triad_map(made, {})
    assert "to use it" not in (said := capsys.readouterr().out)
    assert "no term of scale factor and misalignment is known: the map is of no use" in said


@pytest.mark.parametrize("jump", [0.0, 3e-3])
def test_terms_that_jump_between_temperatures_leave_more_than_noise_and_the_verdict_says_so(tmp_path, jump):
    """A step of M at 30 degC, which no polynomial of order 3 meets at seven temperatures."""
    temperatures = [-20.0, -5.0, 10.0, 25.0, 35.0, 50.0, 65.0]
    t, y, T, table = turntable(0, temperatures, hold=8.0, matrix=lambda T: matrix_of(T) + jump * (T > 30.0))
    made = fitted(tmp_path, t, y, T, rows_of(table))
    said = [line for line in made.verdict() if "as noise within them makes: they contradict one another" in line]
    assert len(said) == (jump > 0)
    assert len(made.faults.doubts) == (jump > 0)
    assert {row.verdict for row in made.limits} <= ({"undecided", "fail", "not measured"} if jump else {"pass"})


@pytest.mark.parametrize("late", [0.0, 0.5])
def test_a_placement_whose_times_are_late_is_in_doubt(tmp_path, late):
    t, y, T = tumble(0, [-20.0, 20.0, 60.0])  # a second of handling, five at rest
    quiet = np.random.default_rng(0).normal(0, 1e-3, y.shape)
    starts = 6.0 * np.arange(54) + 1.0
    starts[7] += late
    (tmp_path / "placed.csv").write_text(
        "start [s],stop [s]\n" + "".join(f"{start:.2f},{start + 5:.2f}\n" for start in starts)
    )
    accel = {"noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 m/s^2/sqrt(s)"}}
    config = {
        "filter": {"gyro": GYRO, "accel": accel, "track": "accel"},
        "stimulus": {"kind": "tumble", "gravity": "9.80665 m/s^2", "placements": str(tmp_path / "placed.csv")},
    }
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (quiet, "rad/s"), "temperature": (T, "degC")}
    doubts = driftlab.fit_map(config, data, terms=TERMS).faults.doubts
    assert [text[:45] for text in doubts] == ["1 of 54 segments or placements (8) is not ste"] * (late > 0)


def test_a_table_of_two_rates_says_nothing_of_rates(tmp_path):
    """Of one rate alone the verdict says that no other is tested."""
    t, y, T, table = turntable(0, [-20.0, 0.0, 20.0, 40.0, 60.0], hold=8.0)
    rows = rows_of(table)
    alone = fitted(tmp_path, t, y, T, rows).verdict()
    for k, row in enumerate(rows):
        if k % 3 == 0:
            own = (t >= float(row[0]) - 1e-6) & (t < float(row[1]) - 1e-6)
            y[own] /= 2
            row[3] = str(float(row[3]) / 2)
    both = fitted(tmp_path, t, y, T, rows).verdict()
    assert [any("at other rates is not tested" in line for line in lines) for lines in (alone, both)] == [True, False]
