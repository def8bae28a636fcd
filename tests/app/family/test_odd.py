"""Odd units: p-values that are honest whatever the law, chosen at the rate that is promised, with reasons that hold."""

from __future__ import annotations

import re

import numpy as np
import other_families as made
import pytest
from numpy.testing import assert_allclose

from driftlab.family import comparing
from driftlab.family.model import fit_family
from driftlab.family.null import Null, scores, standardised
from driftlab.family.odd import Odd, chosen, find_odd, in_words, simes
from driftlab.family.odd_lots import find_odd_lots
from driftlab.family.shapes import Shapes
from driftlab.family.soaked import Rows, Soaked
from driftlab.units import RATE, BiasUnit

SIZE = 1e-4


def found(units: list[made.Made], seed: int, d: int = 1, **options: object) -> dict[str, tuple[Odd, ...]]:
    axes = ("x", "y", "z")[:d]
    pairs = [(unit.soaked(seed, axes), unit.lot) for unit in units]
    records = [unit.record(seed, axes) for unit in units]
    return find_odd(fit_family(pairs), pairs, records, **options)  # type: ignore[arg-type]


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
        u, _, _ = standardised(x, np.zeros(600))
        p = Null.of(u, 600).p(u)
        assert np.all(p[:20] < 1e-3)
        low.append(np.mean(p[20:] < 0.01))
    assert 0.0 <= np.mean(low) < 0.02


def test_the_width_is_what_units_have_beside_their_own_sigma() -> None:
    rng = np.random.default_rng(6)
    sigma = rng.uniform(0.5, 2.0, size=4000)
    u, centre, width = standardised(3.0 + np.hypot(1.0, sigma) * rng.normal(size=4000), sigma)
    assert_allclose([centre, width], [3.0, 1.0], atol=0.15)
    assert_allclose(np.std(u), 1.0, atol=0.05)


def test_scores_of_gaussian_columns_are_the_values_and_of_heavy_ones_less() -> None:
    rng = np.random.default_rng(7)
    z = rng.normal(size=(400, 3))
    z[:, 2] = rng.standard_t(3, size=400)
    found = scores(z)
    inner = np.abs(z) < 2
    assert np.max(np.abs(found - z)[:, :2][inner[:, :2]]) < 0.35
    far = np.argmax(np.abs(z[:, 2]))
    assert np.abs(found[far, 2]) < 0.75 * np.abs(z[far, 2])


def test_simes_and_the_choice_of_units_are_those_of_statsmodels() -> None:
    from statsmodels.stats.multitest import multipletests

    rng = np.random.default_rng(8)
    p = rng.uniform(size=(300, 6))
    p[:20, 2] *= 1e-5
    of_unit = np.array([np.min(multipletests(row, method="fdr_bh")[1]) for row in p])
    assert_allclose(simes(p), of_unit)
    assert np.array_equal(np.any(chosen(p), axis=1), multipletests(of_unit, alpha=0.05, method="fdr_bh")[0])
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
    odd = found(units, 23)
    assert sum(units[int(name)].lot == "L4" for name in odd) <= 1
    records = [unit.record(23, ("x",)) for unit in units]
    family = fit_family([(unit.soaked(23, ("x",)), unit.lot) for unit in units])
    told = find_odd_lots(family, records)
    assert {(one.lot, one.what) for one in told} == {("L4", "shape"), ("L4", "noise")}
    assert re.search(r"lot L4: noise of x is 1\.[6-9]\d* times", " ".join(one.sentence for one in told))


def test_the_reason_is_said_in_the_unit_that_is_shown() -> None:
    units = made.deal("polynomial", 60, 24, size=SIZE)
    units[7].curve[:, 0] += 2 * SIZE * np.exp(-(((made.GRID - 41) / 6) ** 2))
    odd = found(units, 24, shown=RATE)["0007"]
    height = 2 * SIZE * RATE.factor
    said = re.fullmatch(
        r"unit 0007: gyro x bends at (\d+) degC as none of the others \((\S+) deg/h, the family's spread there "
        r"is \S+\); noise and walk as the family",
        in_words("0007", odd),
    )
    assert said is not None
    assert abs(float(said[1]) - 41) < 5
    assert 0.75 < float(said[2]) / height < 1.25
    ppm = found(units, 24, shown=BiasUnit("1", "ppm"))["0007"]
    assert " ppm, " in ppm[0].sentence


def test_new_units_are_held_against_a_family_that_has_not_seen_them() -> None:
    units = made.plant(made.deal("polynomial", 140, 25, size=SIZE), 0.1, 25)
    old = [unit for unit in units[:100] if not unit.odd]
    family = fit_family([(unit.soaked(25, ("x",)), unit.lot) for unit in old])
    new = [(unit.soaked(25, ("x",)), "unheard of") for unit in units[100:]]
    odd = find_odd(family, new, [unit.record(25, ("x",)) for unit in units[100:]], fitted=False)
    assert {unit.name for unit in units[100:] if unit.odd} <= set(odd)
    assert len(odd) <= sum(bool(unit.odd) for unit in units[100:]) + 1


def test_an_axis_that_is_wider_than_the_others_has_no_odd_units_for_that():
    rng, false = np.random.default_rng(5), 0
    for _ in range(10):
        u = np.minimum(rng.normal(size=(100, 3)), 0.5)  # two axes are never much above the usual
        u[:, 2] = rng.normal(size=100)
        false += int(np.sum(comparing._p("walk", u) < 1e-4))
    assert false <= 2
    u[7, 0] = 6.0
    assert comparing._p("walk", u)[7, 0] < 1e-4


def test_a_bend_is_looked_for_where_the_unit_was_soaked() -> None:
    """What a curve does in a gap of its soak nobody knows: a height there is no bend."""
    units = made.deal("together", 60, 24, size=SIZE)
    family = fit_family([(unit.soaked(24, ("x",)), unit.lot) for unit in units])
    units[7].curve[:, 0] += 3 * SIZE * np.exp(-(((made.GRID - 10) / 6) ** 2))
    pieces = []
    for rows in units[7].soaked(24, ("x",)).recordings:
        kept = (rows.T < 2) | (rows.T > 18)
        for part in np.split(np.arange(len(kept)), np.flatnonzero(np.diff(kept)) + 1):
            if kept[part[0]]:
                pieces.append(Rows(rows.t[part], rows.T[part], rows.bias[part], rows.span[part], {}))
    gap = Soaked.of("0007", ("x",), pieces, units[7].noise, units[7].walk, 2.5)
    bend = Shapes(family, fitted=True).bend(gap, units[7].lot, 0)
    assert not 4.5 < bend.T < 15.5
    assert 2 * bend.spread < abs(bend.height) < 3 * SIZE
