"""Odd units: p-values that are honest whatever the law, chosen at the rate that is promised, with reasons that hold."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import other_families as made
import pytest
from numpy.testing import assert_allclose

from driftlab.family.file import load_family, save_family
from driftlab.family.mixed_model import fit_family
from driftlab.family.outlier_tests import CurveStatistics, DeviationShapes
from driftlab.family.outliers import (
    SMALL,
    CurveReasons,
    Outlier,
    _fit,
    _smaller,
    chosen,
    describe,
    find_outliers,
    simes,
)
from driftlab.family.record import UnitRecord
from driftlab.family.repeatability import hysteresis_of, soaks_of
from driftlab.family.tail_law import TailLaw, standardised
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import densities_of
from driftlab.soak.blocks import SoakRows
from driftlab.units import RATE, BiasUnit

SIZE = 1e-4


def found(units: list[made.Made], seed: int, d: int = 1, **options: object) -> dict[str, tuple[Outlier, ...]]:
    axes = ("x", "y", "z")[:d]
    pairs = [(unit.soaked(seed, axes), unit.lot) for unit in units]
    records = [unit.record(seed, axes) for unit in units]
    return find_outliers(fit_family(pairs), pairs, records, **options).odd  # type: ignore[arg-type]


@pytest.mark.parametrize("law", ["gaussian", "student", "skewed", "humps"])
def test_p_values_are_honest_whatever_the_law(law: str) -> None:
    """Of values of the law, with one in thirty far out, about 1 % have p below 1 %, and never many more."""
    low = []
    for seed in range(8):
        rng = np.random.default_rng([5, seed])
        x = {
            "gaussian": rng.normal(size=600),
            "student": rng.standard_t(5, size=600),
            "skewed": np.sqrt(rng.gamma(3.0, size=600)),
            "humps": rng.choice([-1, 1], size=600) + 0.6 * rng.normal(size=600),
        }[law]
        x[:20] += 25.0
        tails = TailLaw.of(x[:, None])
        assert tails is not None
        p = tails.p(x[:, None], upper=False)[:, 0]
        assert np.all(p[:20] < 1e-3)
        low.append(np.mean(p[20:] < 0.01))
    assert 0.0 <= np.mean(low) < 0.02


def test_a_law_that_ends_on_one_side_has_no_heavy_tail_there() -> None:
    """Of log-normal levels one is far below where any can be, and the largest of the others is none of them."""
    low, high = [], []
    for seed in range(12):
        rng = np.random.default_rng([9, seed])
        x = np.exp(0.6 * rng.normal(size=(100, 3)))
        x[0, 0] = -3.5
        tails = TailLaw.of(x)
        assert tails is not None
        p = tails.p(x, upper=False)
        low.append(p[0, 0])
        high.append(p[1:].min())
    assert np.max(low) < 1e-4
    assert np.median(high) > 1e-3


def test_many_odd_units_leave_the_tails_as_they_are():
    """Of 60 units 8 are off by twelve deviations: five are still rare, of a Gaussian law; a heavy one stays heavy."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        x = rng.normal(size=(60, 3))
        x[:8] += 12 * rng.choice([-1, 1], size=(8, 3))
        assert np.all(TailLaw.of(x).p(np.full((1, 3), 5.0), upper=False) < 0.003)
    heavy = [TailLaw.of(np.random.default_rng(seed).standard_t(3, size=(60, 3))).share for seed in range(20)]
    assert np.mean(np.array(heavy)[:, :, :2].sum(axis=2)) > 4 * 0.1  # before the data are seen, 0.1


def test_where_most_values_are_the_same_others_are_judged_by_their_own_deviations() -> None:
    """Of most units a walk does not show: one that shows by a deviation is like them, one by eight is not."""
    x = np.concatenate([np.zeros((12, 1)), [[0.9], [1.2], [1.5], [8.0]]])
    tails = TailLaw.of(x, same=1.0)
    assert tails is not None
    p = tails.p(x, upper=True)[:, 0]
    assert np.all(p[:-1] > 0.04)
    assert p[-1] < 1e-3


@pytest.mark.parametrize(("times", "what"), [(-1.0, "sign"), (-0.45, "scale"), (0.45, "scale")])
def test_a_curve_is_negated_only_where_its_sign_is_all(times: float, what: str) -> None:
    rng, u = np.random.default_rng(31), (made.GRID - 20) / 40
    units = []
    for k in range(40):
        curve = 200 * np.sin(2 * u) + 10 * rng.normal() + 12 * rng.normal() * u + 8 * rng.normal() * np.cos(2 * u)
        units.append(made.Made(f"{k:04d}", "", curve[:, None] / RATE.factor, np.full(1, 2e-5), np.full(1, 1e-7)))
    units[5].curve *= times
    odd = found(units, 31)
    assert [one.what for one in odd["0005"]] == [what]
    assert len(odd) <= 2


def test_the_width_is_what_units_have_beside_their_own_sigma() -> None:
    rng = np.random.default_rng(6)
    sigma = rng.uniform(0.5, 2.0, size=4000)
    u, centre, width = standardised(3.0 + np.hypot(1.0, sigma) * rng.normal(size=4000), sigma)
    assert_allclose([centre, width], [3.0, 1.0], atol=0.15)
    assert_allclose(np.std(u), 1.0, atol=0.05)


def test_units_that_are_the_same_have_no_width_and_no_deviation():
    for values, width in (([2.0, 2.0], 0.0), ([2.0, 2.0, 2.0, 3.0], 1e-20)):
        u, centre, found = standardised(np.array(values), np.zeros(len(values)))
        np.testing.assert_array_equal(u == 0, np.array(values) == 2.0)
        assert centre == 2.0
        assert found <= width


def test_simes_and_the_choice_of_units_are_those_of_statsmodels() -> None:
    from statsmodels.stats.multitest import multipletests

    rng = np.random.default_rng(8)
    p = rng.uniform(size=(300, 6))
    p[:20, 2] *= 1e-5
    of_unit = np.array([np.min(multipletests(row, method="fdr_bh")[1]) for row in p])
    assert_allclose(simes(p), of_unit)
    places, own, reported = chosen(p.__getitem__, len(p))
    assert np.array_equal(places, np.flatnonzero(multipletests(of_unit, alpha=0.05, method="fdr_bh")[0]))
    assert np.array_equal(own, p[places])
    assert np.all(np.any(reported, axis=1))
    p[:, 5] = np.nan
    assert_allclose(simes(p), [np.min(multipletests(row[:5], method="fdr_bh")[1]) for row in p])


@pytest.mark.parametrize(("kind", "halves"), [("polynomial", False), ("together", False), ("polynomial", True)])
def test_planted_units_are_found_and_few_others(kind: str, halves: bool) -> None:
    units = made.plant(made.deal(kind, 150, 21, d=2, lots=3, size=SIZE, halves=halves), 0.06, 21)
    odd = found(units, 21, 2)
    planted = {unit.name: unit for unit in units if unit.odd}
    assert set(planted) <= set(odd)
    assert len(set(odd) - set(planted)) <= 1
    for name, unit in planted.items():
        assert unit.odd in {one.what for one in odd[name]}
        bends = [one for one in odd[name] if one.what == "shape"]
        assert unit.odd != "shape" or abs(bends[0].T - unit.at) < 6.0  # type: ignore[operator]


def test_a_clean_family_has_none() -> None:
    for kind in ("polynomial", "rough"):
        assert len(found(made.deal(kind, 120, 22, size=SIZE), 22)) <= 1


def test_a_shifted_lot_is_no_odd_units() -> None:
    units = made.deal("polynomial", 120, 23, lots=6, size=SIZE)
    for unit in units:
        if unit.lot == "L4":
            unit.curve = unit.curve + 3 * SIZE
            unit.noise = unit.noise * 1.8
    pairs = [(unit.soaked(23, ("x",)), unit.lot) for unit in units]
    judged = find_outliers(fit_family(pairs), pairs, [unit.record(23, ("x",)) for unit in units])
    told = judged.lots
    assert sum(units[int(name)].lot == "L4" for name in judged.odd) <= 1
    assert {(one.lot, one.what) for one in told} == {("L4", "shape"), ("L4", "noise")}
    assert re.search(r"lot L4: noise of x is 1\.[6-9]\d* times", " ".join(one.sentence for one in told))


def test_the_reason_is_said_in_the_unit_that_is_shown() -> None:
    units = made.deal("polynomial", 60, 24, size=SIZE)
    units[7].curve[:, 0] += 2 * SIZE * np.exp(-(((made.GRID - 41) / 6) ** 2))
    odd = found(units, 24, shown=RATE)["0007"]
    height = 2 * SIZE * RATE.factor
    said = re.fullmatch(
        r"unit 0007: gyro x has a local deviation at (\d+) °C as none of the others \((\S+) deg/h, the family's "
        r"spread there is \S+\); noise and walk as the family",
        describe("0007", odd),
    )
    assert said is not None
    assert abs(float(said[1]) - 41) < 5
    assert 0.75 < float(said[2]) / height < 1.25
    ppm = found(units, 24, shown=BiasUnit("1", "ppm"))["0007"]
    assert " ppm, " in ppm[0].sentence


def test_new_units_are_held_against_a_family_that_has_not_seen_them(tmp_path) -> None:
    """Also one alone, also by the family's file."""
    units = made.plant(made.deal("polynomial", 140, 25, size=SIZE), 0.1, 25)
    old = [unit for unit in units[:100] if not unit.odd]
    pairs = [(unit.soaked(25, ("x",)), unit.lot) for unit in old]
    family = fit_family(pairs)
    laws = find_outliers(family, pairs, [unit.record(25, ("x",)) for unit in old]).laws
    file = tmp_path / "family.json"
    save_family(file, family.model_copy(update={"laws": laws}))
    family = load_family(file)
    new = [(unit.soaked(25, ("x",)), "unheard of") for unit in units[100:]]
    records = [unit.record(25, ("x",)) for unit in units[100:]]
    odd = find_outliers(family, new, records, fitted=False).odd
    planted = {unit.name for unit in units[100:] if unit.odd}
    assert planted <= set(odd)
    assert len(odd) <= len(planted) + 1
    alone = [set(find_outliers(family, [one], [own], fitted=False).odd) for one, own in zip(new, records, strict=True)]
    assert planted <= set().union(*alone)
    assert sum(map(len, alone)) <= len(planted) + 1


def test_a_new_unit_is_judged_by_the_part_of_the_range_that_was_soaked() -> None:
    """Of a bend where it has no samples a short soak says nothing; where it has, it says what a whole one would."""
    units = made.plant(made.deal("polynomial", 140, 27, size=SIZE), 0.1, 27)
    old = [unit for unit in units[:100] if not unit.odd]
    pairs = [(unit.soaked(27, ("x",)), unit.lot) for unit in old]
    family = fit_family(pairs)
    family = family.model_copy(
        update={"laws": find_outliers(family, pairs, [unit.record(27, ("x",)) for unit in old]).laws}
    )
    new = [unit for unit in units[100:] if not unit.odd]
    new[4].curve[:, 0] += 0.5 * SIZE * np.exp(-(((made.GRID - 0) / 4) ** 2))
    short = [(unit.soaked(27, ("x",)).between(-20.0, 14.0), unit.lot) for unit in new]
    odd = find_outliers(family, short, [], fitted=False).odd
    assert new[4].name in odd
    assert len(odd) <= 2


def test_too_few_units_to_judge_are_not_passed_in_silence() -> None:
    units = made.deal("polynomial", 5, 26, size=SIZE)
    pairs = [(unit.soaked(26, ("x",)), unit.lot) for unit in units]
    judged = find_outliers(fit_family(pairs), pairs, [])
    assert judged.odd == {}
    assert "5 units are too few" in " ".join(judged.remarks)


LEVEL, SLOPE = 33.0, 20.0  # deg/h, spreads of the units


@pytest.fixture(scope="module")
def gross() -> dict[str, tuple[Outlier, ...]]:
    """A family of 92 ordinary units, with gross errors that a person would make."""
    rng, u = np.random.default_rng(27), (made.GRID - 20) / 40
    mean = np.stack([150 * u - 40, 100 * np.sin(2 * u) + 60, 80 * u**3 - 40 * u], axis=1)
    units = []
    for k in range(97):
        a = rng.normal(size=(3, 3)) * np.array([[LEVEL], [SLOPE], [10.0]])
        curve = mean + np.stack([np.ones_like(u), u, np.cos(2 * u)], axis=1) @ a
        units.append(made.Made(f"{k:04d}", "", curve / RATE.factor, np.full(3, 2e-5), np.full(3, 1e-7)))
    units[92].curve = units[92].curve[:, [1, 0, 2]]
    units[93].curve[:, 1] *= -1
    units[94].curve[:, 0] += 198 / RATE.factor
    units[95].curve[:, 2] += 500 / RATE.factor
    units[96].curve[:, 1] *= 2
    return found(units, 27, 3)


@pytest.mark.parametrize(
    ("unit", "what", "said"),
    [
        ("0092", "swap", "x and y are swapped"),
        ("0093", "sign", "y is negated"),
        ("0094", "level", r"x is off by \d\d\d deg/h: level \(the family's spread is"),
        ("0095", "level", r"z is off by [45]\d\d deg/h: level"),
        ("0096", "scale", r"y is (1\.9|2|2\.0|2\.1)\d* times what is usual: scale"),
    ],
)
def test_gross_errors_are_named_for_what_they_are(
    gross: dict[str, tuple[Outlier, ...]], unit: str, what: str, said: str
) -> None:
    assert set(gross) == {f"{k:04d}" for k in range(92, 97)}
    assert [one.what for one in gross[unit]] == [what]
    assert re.search(said, gross[unit][0].sentence)


@pytest.mark.parametrize("times", [1e-3, -1e-3, np.pi / 180, 0.1])
def test_an_axis_in_another_unit_is_named_with_its_factor(times: float) -> None:
    """Units differ by more than their mean curve: what is next to nothing may be that curve negated, and is not."""
    rng, u = np.random.default_rng(33), (made.GRID - 20) / 40
    units = []
    for k in range(30):
        curve = 40 * np.sin(2 * u) + np.stack([np.ones_like(u), u, np.cos(2 * u)], axis=1) @ (60 * rng.normal(size=3))
        units.append(made.Made(f"{k:04d}", "", curve[:, None] / RATE.factor, np.full(1, 2e-5), np.full(1, 1e-7)))
    family = fit_family([(unit.soaked(33, ("x",)), "") for unit in units[:-1]])
    laws = find_outliers(family, [(unit.soaked(33, ("x",)), "") for unit in units[:-1]], []).laws
    assert laws is not None
    rows = units[-1].soaked(33, ("x",)).recordings
    own = [replace(part, bias=times * part.bias) for part in rows]
    scaled = UnitInformation.of("x", ("x",), own, abs(times) * units[-1].noise, abs(times) * units[-1].walk, 2.5)
    (reason,) = CurveReasons(CurveStatistics(family, fitted=False), laws).of(*family.information_of(scaled), "", (0,))
    assert reason.what == "scale"
    assert 0.3 < reason.times / times < 3.0


@pytest.mark.parametrize("seen", [slice(0, None), slice(3, None)])
def test_the_factor_of_a_small_axis_is_the_likeliest_of_fits_one_by_one(seen: slice) -> None:
    rng = np.random.default_rng(34)
    for times in (*rng.uniform(0.001, 0.24, 20), *rng.uniform(-0.24, -0.001, 20)):
        B, L, c = rng.normal(size=(30, 8)), np.linalg.cholesky(0.4 * np.eye(8) + 0.6), 3 * rng.normal(size=8)
        rows = np.zeros((30, 8))
        rows[:, seen] = 100 * B[:, seen]
        J, level = rows.T @ rows, np.linalg.solve(L, np.ones(8))
        h = times * J @ (c + L @ rng.normal(size=8)) + rows.T @ rng.normal(size=30)
        fits = {t: _fit(J, h, t * c, abs(t) * L, level[:, None] / t)[0] for t in (*SMALL, *-SMALL)}
        assert _smaller(J, h, DeviationShapes(c, L, level, level, level[:, None])) == min(fits, key=fits.__getitem__)


def test_a_unit_that_disagrees_with_itself_is_named() -> None:
    """Two units under one name, and a hysteresis of its own, among units of which one in three was soaked twice."""
    pairs, records = [], []
    units = made.deal("polynomial", 40, 28, size=SIZE)
    for k, unit in enumerate(units):
        rows = list(unit.soaked(28, ("x",)).recordings)
        if k % 3 == 0 or k == 7:
            rows += unit.soaked(29, ("x",)).recordings
        if k == 7:
            rows[1] = units[8].soaked(30, ("x",)).recordings[0]
        if k == 11:
            falls = np.concatenate([np.zeros(180), np.minimum(np.arange(180) / 20, 1)])[:, None]
            rows[0] = replace(rows[0], bias=rows[0].bias + 0.3 * SIZE * falls)
        noise = densities_of(rows, 2.5)
        figures = {"hysteresis": hysteresis_of(rows, noise.white, noise.likely, 2.5), "soaks": soaks_of(rows, 2.5)}
        pairs.append((UnitInformation.of(unit.name, ("x",), rows, noise.white, noise.likely, 2.5), ""))
        records.append(UnitRecord(key="", unit=unit.name, state="done", axes=("x",), figures=figures))
    odd = find_outliers(fit_family(pairs), pairs, records).odd
    assert {name: one[0].what for name, one in odd.items()} == {"0007": "soaks", "0011": "hysteresis"}
    assert "two soaks differ more than one unit can" in odd["0007"][0].sentence
    assert "between warming and cooling" in odd["0011"][0].sentence


def test_no_unit_is_odd_for_what_a_soak_one_way_cannot_show() -> None:
    t = np.arange(60) * 20.0
    rows = SoakRows(t, t / 20.0, np.random.default_rng(3).normal(size=(60, 1)), np.full(60, 20.0), {})
    assert hysteresis_of([rows], np.ones(1), np.zeros(1), 2.5).value == (None,)
    assert soaks_of([rows], 2.5).value == (None,)


@pytest.mark.parametrize("walk", [0.02, 0.005])
def test_two_short_soaks_one_way_of_one_unit_do_not_differ(walk: float) -> None:
    """The walk of a soak that only warms is hidden in its curve, and is there all the same."""
    rng, t = np.random.default_rng(3), np.arange(360) * 10.0
    T = np.interp(t, [600, t[-1]], [10, 50])

    def soak() -> SoakRows:
        wander = np.cumsum(rng.normal(0, walk * np.sqrt(10), (360, 3)), axis=0)
        bias = (4 * T + 0.05 * T**2)[:, None] + wander + rng.normal(0, 2 / np.sqrt(10), (360, 3)) + rng.normal(0, 5, 3)
        return SoakRows(t, T, bias, np.full(360, 10.0), {})

    figures = [soaks_of([soak(), soak()], 2.5) for _ in range(20)]
    sigmas = np.array([one.value for one in figures]) / np.array([one.sigma for one in figures])
    assert np.mean(sigmas > 2) <= 0.05
    assert np.sqrt(np.mean(sigmas**2)) < 1.1


def test_a_bend_is_looked_for_where_the_unit_was_soaked() -> None:
    """A curve is unknown in a gap of its soak: a height there is no bend."""
    units = made.deal("together", 60, 24, size=SIZE)
    family = fit_family([(unit.soaked(24, ("x",)), unit.lot) for unit in units])
    units[7].curve[:, 0] += 3 * SIZE * np.exp(-(((made.GRID - 10) / 6) ** 2))
    pieces = []
    for rows in units[7].soaked(24, ("x",)).recordings:
        kept = (rows.T < 2) | (rows.T > 18)
        for part in np.split(np.arange(len(kept)), np.flatnonzero(np.diff(kept)) + 1):
            if kept[part[0]]:
                pieces.append(SoakRows(rows.t[part], rows.T[part], rows.bias[part], rows.span[part], {}))
    gap = UnitInformation.of("0007", ("x",), pieces, units[7].noise, units[7].walk, 2.5)
    judged = find_outliers(family, [(unit.soaked(24, ("x",)), unit.lot) for unit in units], [])
    assert judged.laws is not None
    reasons = CurveReasons(CurveStatistics(family, fitted=True), judged.laws)
    (bend,) = reasons.of(*family.information_of(gap), units[7].lot, (0,))
    assert abs(bend.off) > 2 * bend.spread


def test_a_unit_whose_thermometer_is_in_kelvin_leaves_the_family_as_it_is_and_is_named() -> None:
    units = made.deal("polynomial", 30, 25, size=SIZE)
    pairs = [(unit.soaked(25, ("x",)), unit.lot) for unit in units]
    (rows,) = pairs[-1][0].recordings
    own = replace(rows, T=rows.T + 273.15)
    elsewhere = UnitInformation.of("kelvin", ("x",), [own], pairs[-1][0].white, pairs[-1][0].walk, 2.5)
    clean, family = fit_family(pairs[:-1]), fit_family([*pairs[:-1], (elsewhere, pairs[-1][1])])
    assert family.knots == clean.knots
    assert np.max(np.abs(family.mu - clean.mu)) < 0.05 * SIZE
    outliers = find_outliers(family, [*pairs[:-1], (elsewhere, pairs[-1][1])], [])
    assert "kelvin" not in outliers.odd
    (line,) = (text for text in outliers.remarks if "kelvin" in text)
    assert "where the family has nothing" in line
