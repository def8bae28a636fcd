"""Charts of lots against the published tables of constants and Montgomery's piston rings, and moving ranges."""

import numpy as np
import pytest
from lines import TYPICAL, line, record
from scipy import stats

from driftlab.family.record import Figure
from driftlab.spc.capability import D2
from driftlab.spc.charts import D4
from driftlab.spc.line import line_of
from driftlab.spc.subgroups import c4, factors, lots_of, within

# Montgomery, Introduction to Statistical Quality Control, 7th ed., appendix VI; ASTM MNL 7 and AIAG SPC have the same
TABLE = {
    2: (0.7979, 2.659, 0.0, 3.267), 3: (0.8862, 1.954, 0.0, 2.568), 4: (0.9213, 1.628, 0.0, 2.266),
    5: (0.9400, 1.427, 0.0, 2.089), 6: (0.9515, 1.287, 0.030, 1.970), 7: (0.9594, 1.182, 0.118, 1.882),
    8: (0.9650, 1.099, 0.185, 1.815), 9: (0.9693, 1.032, 0.239, 1.761), 10: (0.9727, 0.975, 0.284, 1.716),
    15: (0.9823, 0.789, 0.428, 1.572), 20: (0.9869, 0.680, 0.510, 1.490), 25: (0.9896, 0.606, 0.565, 1.435),
}  # fmt: skip

# the same, table 6.3: inside diameters of piston rings less 74 mm, in um, 25 samples of five
RINGS = np.array([
    [30, 2, 19, -8, 8], [-5, -8, 1, 11, 4], [-12, 24, 21, 5, 2], [2, -4, -7, 15, 9], [-8, 7, 15, -11, 14],
    [9, -6, -3, -15, -7], [-5, 6, -6, 0, 5], [-15, 3, -7, 15, -12], [8, -5, 9, 5, 4], [-2, 0, -10, 7, -5],
    [-6, -2, -6, -5, -10], [4, 0, 7, 0, -4], [-17, 2, -2, -3, 12], [6, -33, -6, 0, -16], [12, 14, -2, -1, 7],
    [0, -16, 5, -2, -4], [-6, 12, -14, 5, 7], [6, 10, 18, 3, 0], [-16, 2, 3, 5, -3], [0, 10, 13, 20, 3],
    [-18, 1, 15, 5, -4], [4, -1, -10, 6, 9], [10, -11, -10, 9, 14], [15, 8, -7, 0, 10], [-18, -16, -5, 17, 13],
]) / 1.0  # fmt: skip


@pytest.mark.parametrize("n", TABLE)
def test_the_constants_are_those_of_the_tables(n):
    found = (c4(n), *factors(n))
    assert found == pytest.approx(TABLE[n], abs=6e-4)


def test_the_constants_of_moving_ranges_are_those_of_the_tables():
    assert (round(D2, 3), round(D4 / D2, 3), round(3 / D2, 2)) == (1.128, 3.267, 2.66)  # d2, D4, E2 of two units


def test_limits_of_the_piston_rings_are_those_of_the_book():
    names = np.repeat([f"{k:02d}" for k in range(25)], 5)
    sigma = within(np.full(25, 5), RINGS.std(axis=1, ddof=1))
    assert c4(5) * sigma == pytest.approx(9.4, abs=0.05)  # s-bar 0.0094 mm
    points = lots_of(names, RINGS.ravel() - RINGS.mean(), np.full(125, 20.0))  # whatever neighbours vary by
    assert RINGS.mean() == pytest.approx(1.2, abs=0.05)  # 74.001
    for (name, of_lot), rings in zip(points, RINGS, strict=True):
        n, mean, low, high, s, s_low, s_high = of_lot
        assert (name, n) == (names[5 * int(name)], 5)
        assert mean == pytest.approx(rings.mean() - RINGS.mean())
        assert (low, high) == pytest.approx((-13.4, 13.4), abs=0.1)  # 73.988 and 74.014
        assert s == pytest.approx(rings.std(ddof=1))
        assert (s_low, s_high) == pytest.approx((0, 19.6), abs=0.1)  # 0.0196


def test_lots_of_different_sizes_have_limits_of_their_own_about_one_sigma():
    rng = np.random.default_rng(0)
    sizes = rng.integers(2, 30, size=400)
    names = np.repeat(np.arange(400), sizes).astype(str)
    points = lots_of(names, rng.normal(size=len(names)), np.ones(len(names)))
    table = np.array([of_lot for _, of_lot in points])
    assert table[:, 3] * np.sqrt(sizes) == pytest.approx(np.full(400, 3.0), rel=0.03)
    out = np.abs(table[:, 1]) > table[:, 3]
    uneven = (table[:, 4] > table[:, 6]) | (table[:, 4] < table[:, 5])
    assert np.mean(out) < 0.012  # 0.0027, of 400
    assert np.mean(uneven) < 0.02  # s has a longer tail: 0.004 of five units


def test_a_lot_with_odd_units_widens_no_limits_and_shows_in_its_deviation():
    rng = np.random.default_rng(1)
    x, names = rng.normal(size=200), np.repeat([f"L{k}" for k in range(10)], 20)
    before = dict(lots_of(names, x, np.ones(200)))
    x[45] += 25
    after = dict(lots_of(names, x, np.ones(200)))
    for name, was in before.items():
        now = after[name]
        assert now[[2, 3, 5, 6]] == pytest.approx(was[[2, 3, 5, 6]], rel=0.1)
        assert (now[4] > now[6]) == (name == "L2")
        assert abs(now[1]) < now[3]  # its mean is not moved by one unit


def test_lots_that_are_mixed_along_the_line_are_judged_by_their_own_spread():
    """Neighbours of different lots differ more than units of one lot: their range is no measure of a lot."""
    rng = np.random.default_rng(2)
    lots = np.arange(200) % 4
    values = TYPICAL["noise"] * np.exp(0.05 * rng.normal(size=200) + 0.3 * (lots == 3))
    records = []
    for k, (lot, value) in enumerate(zip(lots, values, strict=True)):
        one = record(k, {name: np.full(3, 1.0) for name in TYPICAL}, f"L{lot}")
        noise = Figure(value=(float(value) * 1e-6,) * 3, sigma=(None,) * 3)
        records.append(one.model_copy(update={"figures": {**one.figures, "noise": noise}}))
    chart = next(chart for chart in line_of(records, None).controls if (chart.quantity, chart.axis) == ("noise", "x"))
    assert [lot.deviation for lot in chart.lots] == pytest.approx([0.05] * 4, rel=0.3)
    assert not any(lot.uneven for lot in chart.lots)
    assert {lot.name for lot in chart.lots if lot.out} >= {"L3"}
    assert [lot.name for lot in chart.lots] == ["L0", "L1", "L2", "L3"]


def test_a_lot_of_one_unit_has_a_mean_alone():
    records = [*line(40, 3, lots=2), record(40, {name: np.full(3, 1e-6) for name in TYPICAL}, "alone")]
    for chart in line_of(records, None).controls:
        *others, alone = chart.lots
        assert np.isnan([alone.deviation, alone.deviation_low, alone.deviation_high]).all()
        assert not alone.uneven
        assert {"s", "s_low", "s_high"}.isdisjoint(alone.as_json())
        assert all("s" in lot.as_json() for lot in others)


def test_units_without_lots_that_repeat_have_no_deviation_at_all():
    names = np.array([f"L{k}" for k in range(12)])
    points = lots_of(names, np.random.default_rng(0).normal(size=12), np.full(12, 1.0))
    assert [of_lot[3] for _, of_lot in points] == pytest.approx([3.0] * 12)  # by what neighbours vary


def test_moving_ranges_of_a_line_in_control_are_beyond_as_often_as_those_of_normal_values():
    ranges = np.concatenate([chart.ranges for seed in range(4) for chart in line_of(line(1000, seed), None).controls])
    assert np.mean(ranges) == pytest.approx(D2, rel=0.02)
    assert np.mean(ranges > D4) == pytest.approx(2 * stats.norm.sf(D4 / np.sqrt(2)), rel=0.15)  # one in 109
    jump = line_of(line(100, 6, planted=[("noise", "x", 40, 41, 9.0)]), None)
    chart = next(chart for chart in jump.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    assert {39, 40} <= set(np.flatnonzero(chart.ranges > D4))  # there and back


def test_a_chart_is_told_in_json_with_its_changes_lots_and_units():
    found = line_of(line(200, 3, planted=[("noise", "x", 120, 200, 3.0)]), None)
    chart = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    told = chart.as_json(found)
    (change,) = told["changes"]
    assert change["unit"] == found.units[chart.changes[0].at]
    assert change["unit_95"][0] <= change["unit"] <= change["unit_95"][1]
    assert (told["unit"], told["scale"], told["units"], told["trend"]) == ("rad/s/sqrt(Hz)", "log", 200, None)
    assert told["low"] < told["centre"] < told["high"]
    assert len(told["lots"]) == 10
    assert all(lot["low"] < lot["high"] and lot["s_low"] < lot["s"] < lot["s_high"] for lot in told["lots"])
    assert [lot["out"] for lot in told["lots"]] == [False] * 6 + [True] * 4
