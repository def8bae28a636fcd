"""Notes on alarms: they stay with the same alarm, and with no other."""

import pytest
from lines import record

from driftlab.errors import ConfigError
from driftlab.family.outliers import Outlier
from driftlab.spc.acknowledgements import (
    Alarm,
    basis_of,
    checked,
    in_force,
    known_notes,
    new_notes,
    of_outlier,
)

ALARMS = {"0021": [Alarm("x noise 5.67 deg/h", "x noise 5.67 deg/h, limits 1.58 to 2.42")], "0043": [Alarm("z", "z")]}
BASIS = {"0021": "a", "0043": "b"}


def noted(unit="0021", note="cable replaced"):
    return new_notes({unit: note}, "anna", ALARMS, BASIS)


def test_a_note_has_author_time_and_reasons_and_is_in_force():
    (note,) = noted()
    assert (note.unit, note.note, note.by, note.basis) == ("0021", "cable replaced", "anna", "a")
    assert note.reasons == ["x noise 5.67 deg/h, limits 1.58 to 2.42"]
    assert note.at.endswith("+00:00")
    assert in_force([note], ALARMS, BASIS) == {"0021": note}
    assert known_notes({"acknowledgements": [note.model_dump()]}, "--out F") == [note]


def test_limits_that_move_leave_it_and_another_reason_opens_the_unit_again():
    notes = noted()
    moved = {"0021": [Alarm("x noise 5.67 deg/h", "x noise 5.67 deg/h, limits 1.60 to 2.40")]}
    assert "0021" in in_force(notes, moved, BASIS)
    more = {"0021": [*moved["0021"], Alarm("y walk 1 deg/h", "y walk 1 deg/h, limits 0 to 0.5")]}
    assert in_force(notes, more, BASIS) == {}
    assert in_force(notes, {"0021": [Alarm("x noise 5.9 deg/h", "")]}, BASIS) == {}
    both = [*notes, *new_notes({"0021": "seen"}, "ben", more, BASIS)]
    assert in_force(both, more, BASIS)["0021"].by == "ben"
    assert in_force(notes, {}, {}) == {}


def test_another_soak_and_another_family_open_it_again():
    soak = {"calibration": [{"name": "a.h5", "sha256": "1"}]}
    again = {"calibration": [{"name": "a.h5", "sha256": "2"}]}
    moved = {"calibration": [{"name": "elsewhere/a.h5", "sha256": "1"}]}
    own = basis_of(record(0, {}, recordings=soak), "f")
    assert own == basis_of(record(0, {}, recordings=moved), "f")
    assert own != basis_of(record(0, {}, recordings=again), "f")
    assert own != basis_of(record(0, {}, recordings=soak), "g")
    assert in_force(noted(), ALARMS, {**BASIS, "0021": "another"}) == {}


def test_an_outlier_is_known_by_its_own_value_and_a_curve_by_its_kind():
    def about(what, value):
        return of_outlier(Outlier("u", what, "x", 0.0, value, None, "a sentence", ())).about

    assert about("noise", 1.0) != about("noise", 1.1)
    assert about("shape", 1.0) == about("shape", 1.1) != about("level", 1.0)


@pytest.mark.parametrize(
    ("notes", "operator", "said"),
    [
        ({"0022": "n"}, "anna", "--acknowledge 0022: no unit is called so"),
        ({"0021": ""}, "anna", "--acknowledge 0021: '' is no note of one line"),
        ({"0021": "a\x1b[31m"}, "anna", r"--acknowledge 0021: 'a\x1b[31m' is no note of one line"),
        ({"0021": "x" * 2000}, "anna", "is no note of one line"),
        ({"0021": "n"}, "\n", r"--operator '\x0a': is no name of one line"),
    ],
)
def test_what_is_no_note_is_refused(notes, operator, said):
    with pytest.raises(ConfigError) as refused:
        checked(notes, operator, ["0021"])
    assert said in str(refused.value)


def test_the_account_signs_where_nobody_is_named(monkeypatch):
    monkeypatch.setenv("LOGNAME", "carla")
    assert checked({"0021": "n"}, None, ["0021"]) == "carla"
    assert checked({}, None, []) == ""


def test_notes_of_another_version_are_refused():
    with pytest.raises(ConfigError, match="acknowledgements as this version does not know them"):
        known_notes({"acknowledgements": [{"unit": 1}]}, "--out F")
