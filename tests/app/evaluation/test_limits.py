"""Limits are held against what was measured; what is not known never passes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from driftlab.config import Limits
from driftlab.evaluation.limits import (
    EXIT,
    MEASURED_BY,
    NAMES,
    Measured,
    check_limits,
    least_kept,
    outcome,
    verdict,
    verdict_of_units,
    worst,
)
from driftlab.units import RATE, BiasUnit

AXES = ("x", "y", "z")
values = st.lists(st.floats(1e-9, 1e3), min_size=3, max_size=3).map(np.array)


def one(found, limit=1.0):
    (row,) = check_limits(Limits(coast=limit), {"coast": found})
    return row


def known(value, reach):
    value, reach = np.asarray(value, float), np.asarray(reach, float)
    return Measured(value, AXES, value - reach, value + reach, "ten minutes")


@given(values, values, st.floats(1e-9, 1e3))
def test_value_and_guard_decide(found, reach, limit):
    row = one(known(found, reach), limit)
    high, low = found + reach, found - reach
    expected = "pass" if max(high) <= limit else "fail" if max(low) > limit else "undecided"
    assert row.decision == row.verdict == expected
    k = AXES.index(row.axis)
    assert row.value == found[k]
    assert row.guard == pytest.approx(reach[k], rel=1e-6, abs=1e-9)
    beyond = {"pass": row.value + row.guard - limit, "fail": limit - row.value + row.guard}
    if row.decision == "undecided":
        assert row.value - row.guard <= limit * (1 + 1e-6)
        assert row.value + row.guard >= limit * (1 - 1e-6)
        assert row.needs
    else:
        assert beyond[row.decision] <= 1e-6 * max(found[k], limit)
        assert row.needs == ""


def test_guards_may_differ_between_the_sides():
    found = Measured(np.array([1.0]), ("x",), np.array([0.9]), np.array([1.5]), seconds=3600.0)
    row = one(found, 1.2)
    assert (row.decision, row.guard) == ("undecided", pytest.approx(0.5))
    row = one(found, 0.95)
    assert (row.decision, row.guard) == ("undecided", pytest.approx(0.1))
    assert one(found, 0.85).decision == "fail"


def test_a_value_without_uncertainty_is_undecided():
    row = one(Measured(np.array([1e-3, 0.5, 0.1]), AXES))
    assert (row.verdict, row.value, row.needs) == ("undecided", 0.5, "its uncertainty is not known")
    assert np.isnan(row.guard)


def test_what_is_undecided_says_how_long_it_takes():
    found = Measured(np.array([0.9]), ("x",), np.array([0.7]), np.array([1.1]), seconds=7200.0)
    row = one(found)
    assert row.needs == "about 6 h more would decide it, if x stays below the limit by as much"  # half the guard
    assert row.more == pytest.approx(3 * 7200)
    near = Measured(np.array([0.999]), ("x",), np.array([0.7]), np.array([1.1]), seconds=7200.0)
    assert one(near).needs == "no longer recording would decide it: x is too near to the limit"
    stiff = Measured(np.array([0.9]), ("x",), np.array([0.7]), np.array([1.1]), otherwise="take a looser map")
    assert (one(stiff).needs, np.isnan(one(stiff).more)) == ("take a looser map", True)


def test_the_guard_stands_beside_the_value():
    row = one(known([0.1, 0.5, 0.2], [0.1, 0.2, 0.1]))
    assert "0.50 ± 0.20 ppm" in row.cells(BiasUnit("1", "1"))[2].replace(" 1", " ppm")
    assert row.as_json(BiasUnit("1", "1"))["sigma"] == pytest.approx(0.2 / 1.645)
    for value, guard, text in (
        (333.31, 18.9, "333 ± 19"),
        (11.03, 6.02, "11.0 ± 6.0"),
        (0.60934, 0.0561, "0.609 ± 0.056"),
    ):
        assert one(known([value, 0, 0], [guard, 0, 0])).cells(BiasUnit("1", "1"))[2] == f"{text} 1"


def test_a_value_beyond_its_own_limits_has_a_guard():
    """A soak that wandered more than its law lets expect is not known exactly."""
    found = Measured(np.array([0.9, 0.1, 0.1]), AXES, np.array([0.5, 0.1, 0.1]), np.array([0.8, 0.1, 0.1]))
    row = one(found)
    assert (row.verdict, row.guard) == ("undecided", pytest.approx(0.4))
    found = Measured(np.array([1.1, 0.1, 0.1]), AXES, np.array([1.2, 0.1, 0.1]), np.array([1.5, 0.1, 0.1]))
    assert (one(found).verdict, one(found).guard) == ("undecided", pytest.approx(0.4))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_is_not_known_of_one_axis_has_no_verdict(bad, axis):
    found = np.full(3, 1e-3)
    found[axis] = bad
    row = one(Measured(found, AXES, found, found))
    assert row.verdict == "not measured"
    assert AXES[axis] in row.note
    assert np.isnan(row.value)
    assert (row.decision, row.measured) == ("undecided", False)


def test_no_verdict_without_an_axis_or_where_a_reason_is_given():
    assert one(Measured(np.zeros(0), ())).verdict == "not measured"
    row = one(Measured(np.full(3, 1e-3), AXES, missing="the recording is too short"))
    assert (row.verdict, row.note) == ("not measured", "the recording is too short")


def test_what_does_not_show_is_judged_by_its_upper_limit():
    row = one(Measured(np.array([0.0, 0.2, 0.3]), AXES, np.zeros(3), np.array([0.8, 0.3, 0.4])))
    assert (row.verdict, row.axis, row.value, row.guard, row.at_most) == ("pass", "x", 0.0, 0.8, True)
    assert row.as_json(RATE)["measured"] == 0.8
    assert row.cells(RATE)[2].startswith("≤ ")
    row = one(Measured(np.array([0.0, 0.2, 0.3]), AXES, np.zeros(3), np.array([3.0, 0.3, 0.4]), seconds=3600.0))
    assert row.verdict == "undecided"
    assert row.needs == "about 8 h more would decide it, if x stays below the limit by as much"
    row = one(Measured(np.array([0.0, 0.2, 2.0]), AXES, np.zeros(3), np.array([3.0, 0.3, 2.2])))
    assert row.verdict == "undecided"  # z may be within
    row = one(Measured(np.array([0.0, 0.2, 2.0]), AXES, np.array([0, 0, 1.8]), np.array([3.0, 0.3, 2.2])))
    assert (row.verdict, row.axis, row.value) == ("fail", "z", 2.0)  # whatever x is
    assert one(Measured(np.zeros(3), AXES)).verdict == "undecided"


def test_what_is_not_measured_here_names_the_command_that_does():
    rows = check_limits(Limits(**dict.fromkeys(NAMES, 1.0)), {})
    assert {row.name for row in rows} == set(NAMES) == set(MEASURED_BY) == set(Limits.model_fields)
    for row in rows:
        assert row.note == f"`{MEASURED_BY[row.name]}` measures it"
    assert verdict(rows).startswith("INCOMPLETE: 0 of 8 limits kept; not measured: bias instability, ")


def test_only_what_is_set_is_judged():
    assert check_limits(None, {"coast": known([1, 1, 1], [0, 0, 0])}) == []
    assert check_limits(Limits(), {}) == []
    assert verdict([]) == ""


def test_all_limits_in_a_line():
    good, bad, near = known([0.5] * 3, [0.1] * 3), known([2.0] * 3, [0.1] * 3), known([0.95] * 3, [0.1] * 3)
    limits = Limits(coast=1.0, swing=1.0)
    assert verdict(check_limits(limits, {"coast": good, "swing": good})) == "PASS: 2 of 2 limits kept"
    assert verdict(check_limits(limits, {"coast": good, "swing": near})) == (
        "UNDECIDED: 1 of 2 limits kept; undecided: swing of the map"
    )
    assert (
        verdict(check_limits(limits, {"coast": bad, "swing": good}))
        == "FAIL: prediction over 10 min (rms) (1 of 2 limits kept)"
    )
    assert verdict(check_limits(limits, {"coast": good})).startswith(
        "INCOMPLETE: 1 of 2 limits kept; not measured: swing"
    )
    assert verdict(check_limits(limits, {"coast": bad})).startswith("FAIL: prediction")
    lines = ["PASS: 2 of", "FAIL: x", "UNDECIDED: 1 of", "INCOMPLETE: 0 of"]
    assert [outcome(line) for line in lines] == ["pass", "fail", "undecided", "unknown"]
    assert [EXIT[outcome(line)] for line in lines] == [0, 1, 3, 3]


def test_of_several_recordings_each_limit_is_said_as_the_worst_of_them_has_it():
    """The recording with the largest error of the prediction may keep a limit that another exceeds."""
    limits = Limits(coast=1.0, noise=1.0)
    first = {"coast": known([0.9] * 3, [0.01] * 3), "noise": known([0.1] * 3, [0.01] * 3)}
    second = {"coast": known([0.3] * 3, [0.01] * 3), "noise": known([2.0] * 3, [0.01] * 3)}
    rows = {row.name: row for row in least_kept(check_limits(limits, one) for one in (first, second))}
    assert (rows["coast"].verdict, rows["coast"].value) == ("pass", 0.9)
    assert (rows["noise"].verdict, rows["noise"].value) == ("fail", 2.0)
    assert least_kept([[], []]) == []


def test_a_unit_is_said_to_be_what_its_worst_limit_is():
    order = ["pass", "undecided", "not measured", "fail"]
    for k, word in enumerate(order):
        assert worst([{"verdict": said} for said in order[: k + 1]]) == word
    assert worst([]) is None


def test_units_are_counted_with_the_limits_that_decide():
    def unit(**verdicts):
        return [{"name": name, "verdict": said} for name, said in verdicts.items()]

    units = [
        unit(noise="pass", coast="pass"), unit(noise="fail", coast="fail"), unit(noise="pass", coast="fail"),
        unit(noise="undecided", coast="fail"), unit(noise="undecided", coast="pass"), [],
        unit(noise="pass", coast="not measured"),
    ]  # fmt: skip
    assert verdict_of_units(units) == (
        "limits: 1 pass; 3 fail (prediction over 10 min (rms) 3, white noise 1); 1 undecided (white noise 1); "
        "1 not measured (prediction over 10 min (rms) 1)"
    )
    assert verdict_of_units([unit(noise="fail")]) == "limits: 0 pass; 1 fail (white noise 1)"
    assert verdict_of_units([[], []]) == ""


def test_a_row_is_shown_in_the_unit_of_the_sensor():
    (row,) = check_limits(Limits(noise=1e-6), {"noise": Measured(np.array([5e-7]), ("r",), stands_on="here")})
    assert row.cells(BiasUnit("1", "ppm"))[1:4] == ["1 ppm/sqrt(Hz)", "0.5 ppm/sqrt(Hz)", "r"]
    assert row.as_json(BiasUnit("1", "ppm"))["unit"] == "1/sqrt(Hz)"
