"""Figures by chamber: the test against scipy's, chambers that differ, and lines in which none does."""

import numpy as np
import pytest
from lines import SPREAD, line
from scipy import stats

from driftlab.spc.line import line_of
from driftlab.spc.stratification import LEAST, aligned, differences, stratified_p


def of_chambers(records, chambers):
    """Return the records with the chamber of each."""
    return [one.model_copy(update={"more": {"chamber": name}}) for one, name in zip(records, chambers, strict=True)]


def dealt(count, seed, names="ABC"):
    return np.random.default_rng([seed, count, 7]).choice(list(names), count)


def found(records, **more):
    return {(one.quantity, one.axis): one for one in line_of(records, None, **more).differences}


@pytest.mark.parametrize("ties", [False, True])
def test_of_one_block_the_test_is_kruskal_and_wallis(ties):
    rng = np.random.default_rng(3)
    values, groups = rng.normal(size=60), rng.integers(0, 3, 60)
    values = np.round(values * 2) if ties else values
    expected = stats.kruskal(*(values[groups == g] for g in range(3))).pvalue
    assert stratified_p(values, groups, np.zeros(60, dtype=int)) == pytest.approx(expected, rel=1e-10)
    assert stratified_p(np.ones(9), np.repeat([0, 1, 2], 3), np.zeros(9, dtype=int)) == 1.0


@pytest.mark.parametrize("size", [2, 3, 5])
def test_its_level_holds_in_small_blocks(size):
    """By dealing out the groups of each block anew: as often below 5 and 1 % as they say."""
    rng, blocks = np.random.default_rng(size), np.repeat(np.arange(60 // size), size)
    p = []
    for _ in range(2000):
        values = aligned(rng.standard_t(4, 60 // size)[blocks] * 5 + rng.normal(size=len(blocks)), blocks)
        order = np.lexsort([rng.random(len(blocks)), blocks])
        p.append(stratified_p(values, np.resize([0, 1], len(blocks))[order], blocks))
    for level in (0.05, 0.01):
        assert np.mean(np.array(p) < level) <= level + 3.3 * np.sqrt(level / len(p))
    assert np.mean(np.array(p) < 0.05) > 0.02


def test_a_chamber_whose_units_are_noisier_is_named_with_its_size():
    for seed in range(3):
        chambers = dealt(60, seed)
        planted = [("noise", axis, k, k + 1, 3.0) for axis in "xyz" for k in np.flatnonzero(chambers == "B")]
        report = line_of(of_chambers(line(60, seed, planted=planted), chambers), None)
        assert {(one.quantity, one.axis) for one in report.differences} == {("noise", axis) for axis in "xyz"}
        one = report.differences[0]
        assert (one.column, one.group, one.units) == ("chamber", "B", np.sum(chambers == "B"))
        assert one.value / one.others == pytest.approx(np.exp(3 * SPREAD["noise"]), rel=0.1)
        said = next(text for text in report.sentences if text.startswith("Noise of x differs by chamber (p = "))
        assert f"in the {one.units} units of B" in said


@pytest.mark.parametrize("law", ["normal", "heavy", "skew"])
def test_chambers_alike_are_not_said_to_differ(law):
    """Of ten lines, each dealt to chambers twenty times."""
    reports = [line_of(line(60, seed, law=law), None) for seed in range(10)]
    deals = [(report, {"chamber": dealt(60, seed)}) for report in reports for seed in range(20)]
    false = sum(bool(differences(*deal)) for deal in deals)
    assert 0 < false <= stats.binom.isf(1e-3, len(deals), 0.05)


def test_what_lots_have_of_their_own_is_not_a_chambers():
    """Each lot in one chamber, lots off by a deviation and more: of two lots a chamber nothing can be said."""

    def lots(seed, count):
        rng = np.random.default_rng([seed, 5])
        planted = [("noise", "x", 12 * k, 12 * (k + 1), rng.normal() * 3) for k in range(count)]
        records = line(12 * count, seed, lots=count, planted=planted)
        return of_chambers(records, np.repeat(np.array(list("AB") * count)[:count], 12))

    assert not any(found(lots(seed, 4)) for seed in range(4))
    false = sum(("noise", "x") in found(lots(seed, 16)) for seed in range(10))
    assert false <= 1


@pytest.mark.parametrize("mixed", [4, 10, 16])
def test_lots_of_one_chamber_and_of_several_are_not_taken_together(mixed):
    """Nothing is planted; the first lots have units of A and B, each of the others is of A or C alone."""
    false = 0
    for seed in range(10):
        rng = np.random.default_rng([seed, 8])
        chambers = [*rng.choice(["A", "B"], 6 * mixed), *np.repeat(rng.choice(["A", "C"], 20 - mixed), 6)]
        false += bool(found(of_chambers(line(120, seed, lots=20), chambers)))
    assert false <= 2


def test_pairs_in_a_lot_do_not_alarm():
    false = sum(bool(found(of_chambers(line(60, seed, lots=30), np.resize(["A", "B"], 60)))) for seed in range(12))
    assert false <= 2


def test_a_change_of_the_line_is_no_chambers():
    """A and B in turn, then C and D, and the line moves between."""
    planted = [("noise", "x", 60, 120, 2.0)]
    chambers = [*np.resize(["A", "B"], 60), *np.resize(["C", "D"], 60)]
    false = sum(bool(found(of_chambers(line(120, seed, lots=1, planted=planted), chambers))) for seed in range(6))
    assert false <= 1


def test_size_and_sign_are_those_within_lots():
    """A is higher by 1.3 in each lot, and B is in the lots that are high."""
    rng = np.random.default_rng(2)
    chambers = np.array([rng.choice(["A", "B"], p=[0.8, 0.2] if k < 60 else [0.2, 0.8]) for k in range(120)])
    step = np.log(1.3) / SPREAD["noise"]
    planted = [("noise", "x", 60, 120, 8.0)] + [("noise", "x", k, k + 1, step) for k in np.flatnonzero(chambers == "A")]
    one = found(of_chambers(line(120, 3, lots=6, planted=planted), chambers))[("noise", "x")]
    ratio = one.value / one.others
    assert (ratio if one.group == "A" else 1 / ratio) == pytest.approx(1.3, rel=0.1)


def test_chambers_are_compared_within_lots_that_have_several():
    """Lots are off by far more than the chamber, which is seen all the same."""
    for seed in range(3):
        rng = np.random.default_rng([seed, 6])
        chambers = dealt(80, seed, "AB")
        planted = [("residual", "y", 10 * k, 10 * (k + 1), rng.normal() * 10) for k in range(8)]
        planted += [("residual", "y", k, k + 1, 2.5) for k in np.flatnonzero(chambers == "A")]
        seen = found(of_chambers(line(80, seed, lots=8, planted=planted), chambers))
        assert set(seen) == {("residual", "y")}


def test_a_line_that_moved_when_the_chamber_changed_is_not_blamed_on_it():
    planted = [("noise", axis, 40, 80, 6.0) for axis in "xyz"]
    assert not found(of_chambers(line(80, 1, lots=1, planted=planted), np.repeat(["A", "B"], 40)))


def test_few_units_of_a_chamber_are_not_compared():
    chambers = np.array(["A"] * 60)
    chambers[:: 60 // (LEAST - 1)] = "B"
    assert not found(of_chambers(line(60, 2), chambers))


def test_a_column_of_names_is_no_group():
    records = [one.model_copy(update={"more": {"remark": f"r{k}"}}) for k, one in enumerate(line(60, 2))]
    assert not found(records)


def test_columns_that_are_asked_for():
    records = [one.model_copy(update={"hours": 2.0 + k % 2}) for k, one in enumerate(line(60, 4, planted=[]))]
    figures = line(60, 4, planted=[("noise", "z", k, k + 1, 4.0) for k in range(0, 60, 2)])
    records = [a.model_copy(update={"figures": b.figures}) for a, b in zip(records, figures, strict=True)]
    assert not found(records)
    assert {
        (one.column, one.quantity, one.axis) for one in line_of(records, None, by=["hours", "lot"]).differences
    } == {("hours", "noise", "z")}
