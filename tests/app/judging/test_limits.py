"""Limits are held against what was measured; what is not known never passes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from driftlab.declared_limits import Limits
from driftlab.judging.limits import MEASURED_BY, NAMES, Measured, judge, verdict
from driftlab.units import RATE, BiasUnit

AXES = ("x", "y", "z")
values = st.lists(st.floats(1e-9, 1e3), min_size=3, max_size=3).map(np.array)


def one(found, limit=1.0):
    (row,) = judge(Limits(coast=limit), {"coast": found})
    return row


def known(value, reach):
    value, reach = np.asarray(value, float), np.asarray(reach, float)
    return Measured(value, AXES, value - reach, value + reach, "ten minutes")


@given(values, st.floats(1e-9, 1e3))
def test_the_worst_axis_decides(found, limit):
    row = one(Measured(found, AXES), limit)
    assert row.verdict == ("pass" if max(found) <= limit else "fail")
    assert row.measured == max(found)
    assert found[AXES.index(row.axis)] == max(found)
    assert row.sure is None  # nothing is said of how sure they are


@given(values, values, st.floats(1e-9, 1e3))
def test_a_verdict_is_sure_where_every_value_of_the_interval_gives_it(found, reach, limit):
    row = one(known(found, reach), limit)
    assert row.sure == ((max(found - reach) <= limit) == (max(found + reach) <= limit))
    assert row.words == (row.verdict if row.sure else f"{row.verdict}, within its uncertainty")


def test_sigma_is_a_quarter_of_the_interval_of_the_worst_axis():
    row = one(known([0.1, 0.5, 0.2], [9, 0.2, 9]))
    assert row.sigma == pytest.approx(0.1)
    assert not row.sure  # other axes may be beyond
    assert "0.5 ± 0.1 ppm" in row.cells(BiasUnit("1", "1"))[2].replace(" 1", " ppm")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_is_not_known_of_one_axis_has_no_verdict(bad, axis):
    found = np.full(3, 1e-3)
    found[axis] = bad
    row = one(Measured(found, AXES, found, found))
    assert row.verdict == "not measured"
    assert AXES[axis] in row.note
    assert np.isnan(row.measured)


def test_no_verdict_without_an_axis_or_where_a_reason_is_given():
    assert one(Measured(np.zeros(0), ())).verdict == "not measured"
    row = one(Measured(np.full(3, 1e-3), AXES, missing="the recording is too short"))
    assert (row.verdict, row.note) == ("not measured", "the recording is too short")


def test_what_does_not_show_is_judged_by_its_upper_limit():
    row = one(Measured(np.array([0.0, 0.2, 0.3]), AXES, np.zeros(3), np.array([0.8, 0.3, 0.4])))
    assert (row.verdict, row.axis, row.measured, row.at_most, row.sure) == ("pass", "x", 0.8, True, True)
    assert row.cells(RATE)[2].startswith("≤ ")
    row = one(Measured(np.array([0.0, 0.2, 0.3]), AXES, np.zeros(3), np.array([3.0, 0.3, 0.4])))
    assert row.verdict == "not measured"
    assert row.note == "x does not show above the other noise, and may be up to 3 times the limit; record longer"
    row = one(Measured(np.array([0.0, 0.2, 2.0]), AXES, np.zeros(3), np.array([3.0, 0.3, 2.2])))
    assert (row.verdict, row.axis, row.measured) == ("fail", "z", 2.0)  # whatever x is
    assert one(Measured(np.zeros(3), AXES)).verdict == "not measured"


def test_what_is_not_measured_here_names_the_command_that_does():
    rows = judge(Limits(**dict.fromkeys(NAMES, 1.0)), {})
    assert {row.name for row in rows} == set(NAMES) == set(MEASURED_BY) == set(Limits.model_fields)
    for row in rows:
        assert row.note == f"not measured here: `{MEASURED_BY[row.name]}` does"
    assert verdict(rows).startswith("INCOMPLETE: 0 of 5 limits kept; not measured: bias instability, ")


def test_only_what_is_set_is_judged():
    assert judge(None, {"coast": known([1, 1, 1], [0, 0, 0])}) == []
    assert judge(Limits(), {}) == []
    assert verdict([]) == ""


def test_all_limits_in_a_line():
    good, bad, near = known([0.5] * 3, [0.1] * 3), known([2.0] * 3, [0.1] * 3), known([0.95] * 3, [0.1] * 3)
    limits = Limits(coast=1.0, swing=1.0)
    assert verdict(judge(limits, {"coast": good, "swing": good})) == "PASS: 2 of 2 limits kept"
    assert verdict(judge(limits, {"coast": good, "swing": near})) == (
        "PASS: 2 of 2 limits kept; within its uncertainty: swing of the map"
    )
    assert verdict(judge(limits, {"coast": bad, "swing": good})) == "FAIL: coast, rms over 10 min (1 of 2 limits kept)"
    assert verdict(judge(limits, {"coast": good})).startswith("INCOMPLETE: 1 of 2 limits kept; not measured: swing")
    assert verdict(judge(limits, {"coast": bad})).startswith("FAIL: coast")


def test_a_row_is_shown_in_the_unit_of_the_sensor():
    (row,) = judge(Limits(noise=1e-6), {"noise": Measured(np.array([5e-7]), ("r",), stands_on="here")})
    assert row.cells(BiasUnit("1", "ppm"))[1:4] == ["1 ppm/sqrt(Hz)", "0.5 ppm/sqrt(Hz)", "r"]
    assert row.as_json(BiasUnit("1", "ppm"))["unit"] == "1/sqrt(Hz)"
