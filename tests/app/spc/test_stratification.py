"""Figures by chamber: the test against scipy's, chambers that differ, and lines in which none does."""

import numpy as np
import pytest
from lines import SPREAD, line
from scipy import stats

from driftlab.spc.line import line_of
from driftlab.spc.stratification import LEAST, differences, kruskal_wallis


def of_chambers(records, chambers):
    """Return the records with the chamber of each."""
    return [one.model_copy(update={"more": {"chamber": name}}) for one, name in zip(records, chambers, strict=True)]


def dealt(count, seed, names="ABC"):
    return np.random.default_rng([seed, count, 7]).choice(list(names), count)


def found(records, **more):
    return {(one.quantity, one.axis): one for one in line_of(records, None, **more).differences}


@pytest.mark.parametrize("ties", [False, True])
def test_the_test_is_scipys(ties):
    rng = np.random.default_rng(3)
    values, groups = rng.normal(size=60), rng.integers(0, 3, 60)
    values = np.round(values * 2) if ties else values
    expected = stats.kruskal(*(values[groups == g] for g in range(3))).pvalue
    assert kruskal_wallis(values, groups) == pytest.approx(expected, rel=1e-10)
    assert kruskal_wallis(np.ones(9), np.repeat([0, 1, 2], 3)) == 1.0
    assert kruskal_wallis(np.arange(6.0), np.repeat([0, 1], 3)) == pytest.approx(1 / 20)  # of 20 arrangements


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
        assert f"of the {one.units} units of B" in said


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
