"""Yield and Pareto by hand, the chance of a difference against Fisher's exact test and against lines without one."""

import json

import numpy as np
import pytest
from lines import TYPICAL, record
from scipy import stats

from driftlab.spc import yields
from driftlab.spc.yields import ALPHA, chance, reasons, yields_of


def unit(k, *verdicts, error="", lot="L0", **more):
    """Return a unit with verdicts on noise, residual and prediction in turn, or one that failed."""
    names = ("noise", "residual", "coast")
    limits = [{"name": name, "verdict": verdict} for name, verdict in zip(names, verdicts, strict=False)]
    made = record(k, {name: np.full(3, 1.0) for name in TYPICAL}, lot)
    state = {"state": "failed", "error": error, "figures": {}, "domain": None, "hours": 0.0} if error else {}
    return made.model_copy(update={"limits": [] if error else limits, "more": more, **state})


SOME = [
    *[unit(k, "pass", "pass", chamber="A") for k in range(14)],
    *[unit(k, "fail", "pass", chamber="A") for k in (14, 15)],
    unit(16, "fail", "undecided", chamber="B", lot="L1"),
    unit(17, "pass", "undecided", chamber="B", lot="L1"),
    unit(18, error="units/0018/soak.h5: no HDF5 file; write it again", chamber="B", lot="L1"),
    unit(19, error="units/0019/soak.h5: no HDF5 file; write it again", chamber="", lot="L1"),
]


def test_yield_and_reasons_of_the_whole():
    found = yields_of(SOME, ["0003", "0016", "gone"])
    whole = found.whole
    assert (whole.units, whole.accepted, whole.odd) == (20, 14, 2)
    assert list(whole.reasons.values()) == [3, 2, 2]
    assert list(whole.reasons)[:2] == ["noise above limit", "residual undecided"]
    assert found.covered == (3, 4, 6)  # one has two of them
    interval = stats.binomtest(14, 20).proportion_ci(method="exact")
    assert whole.interval == pytest.approx((interval.low, interval.high))
    share, why = "70 % (95 %: 45.7 to 88.1 %)", "noise above limit (3), residual undecided (2)"
    assert found.sentences()[0].startswith(f"yield: 14 of 20 units, {share}; 1 undecided; not accepted: {why}")


def test_a_unit_in_doubt_is_undecided_and_its_doubt_is_its_reason():
    said = "gyro y shows exactly 0.25 rad/s, its largest reading, in 720 rows: as at the end of its range; set it"
    doubt = "in doubt: gyro y shows exactly … rad/s, its largest reading, in … rows: as at the end of its range"
    units = [unit(0), unit(1), unit(2, "undecided", "undecided"), unit(3, "fail", "undecided"), unit(4, "undecided")]
    units = [*units[:1], *(one.model_copy(update={"doubts": [said]}) for one in units[1:4]), units[4]]
    assert [reasons(one) for one in units] == [
        [], [doubt], [doubt], [doubt, "noise above limit"], ["noise undecided"]
    ]  # fmt: skip
    told = yields_of(units, by=["lot"])
    assert (told.whole.accepted, told.whole.undecided) == (1, 3)  # one fails, whatever it is in doubt for
    assert told.as_json()["undecided"] == told.as_json()["by"]["lot"]["groups"][0]["undecided"] == 3


def test_errors_that_differ_in_names_and_numbers_are_one_reason():
    a, b = (reasons(one) for one in SOME[-2:])
    assert a == b
    assert a == ["not calibrated: no HDF… file"]
    other = unit(3, error="a/b.h5: time goes back by 0.3 s at row 17")
    assert reasons(other) == reasons(unit(4, error="c/d.h5: time goes back by 12 s at row 1,000")) != a
    assert reasons(unit(0, "pass", "pass")) == reasons(unit(0)) == []


def test_groups_by_a_column_of_the_manifest_and_of_the_table():
    found = yields_of(SOME, ["0016"], ["chamber", "lot", "date", "chamber"])
    by = {one.name: one for one in found.by["chamber"]}
    assert {name: (one.units, one.accepted, one.odd) for name, one in by.items()} == {
        "A": (16, 14, 0), "B": (3, 0, 1), "not known": (1, 0, 0),
    }  # fmt: skip
    assert by["A"].reasons == {"noise above limit": 2}
    assert [one.name for one in found.by["lot"]] == ["L0", "L1"]
    assert len(found.by["date"]) == 20  # a day each
    assert found.differs("lot")
    assert not found.differs("date")
    (said,) = [said for said in found.sentences() if said.startswith("yield differs by lot (p ")]
    assert said.endswith(": L1 0 % (95 %: 0 to 60.2 %), L0 87.5 % (95 %: 61.7 to 98.4 %)")
    said = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert said["by"]["chamber"]["groups"][0]["chamber"] == "A"
    assert said["by"]["chamber"]["groups"][0]["yield"] == 14 / 16
    assert (said["units"], said["accepted"], said["judged"]) == (20, 14, True)


def test_a_million_reasons_take_no_square_of_time():
    units = [unit(k, error=f"{chr(97 + k % 26)}{chr(97 + k // 26)} is broken") for k in range(676)] * 20
    found = yields_of(units)
    assert len(found.whole.reasons) == 676
    assert found.covered[:2] == (20, 40)
    assert found.covered[-1] == len(units) == found.whole.units


def test_many_numbers_are_told_in_quarters():
    units = [unit(k, "pass" if k < 60 else "fail", torque=f"{k / 10}") for k in range(80)]
    found = yields_of(units, by=["torque", "hours"])
    assert [(one.name, one.units, one.accepted) for one in found.by["torque"]] == [
        ("0 to 1.9", 20, 20), ("2 to 3.9", 20, 20), ("4 to 5.9", 20, 20), ("6 to 7.9", 20, 0),
    ]  # fmt: skip
    assert [one.units for one in found.by["hours"]] == [80]
    assert found.p["hours"] == 1.0
    assert (found.titled("hours"), found.titled("torque")) == ("hours [h]", "torque")
    with_names = [unit(k, "pass", bench=f"{k}" if k else "none") for k in range(40)]
    assert len(yields_of(with_names, by=["bench"]).by["bench"]) == 40  # names, not numbers


def test_without_limits_every_unit_that_was_calibrated_is_accepted():
    found = yields_of([unit(0), unit(1), unit(2, error="x")])
    assert (found.whole.accepted, found.judged) == (2, False)
    assert yields_of([unit(0)]).sentences() == []


@pytest.mark.parametrize(
    ("units", "accepted"), [((30, 25), (29, 18)), ((8, 9), (8, 4)), ((40, 40), (36, 35)), ((3, 50), (1, 48))]
)
def test_the_chance_of_a_difference_is_the_hypergeometric_one_for_two_groups(units, accepted):
    """Of the tables of the same margins those are further off whose share is further from the common one."""
    (n, m), (a, b) = units, accepted
    law = stats.hypergeom(n + m, a + b, n)
    k = np.arange(max(0, a + b - m), min(n, a + b) + 1)
    far = np.abs(k - (a + b) * n / (n + m)) >= abs(a - (a + b) * n / (n + m)) - 1e-9
    assert chance(units, accepted) == pytest.approx(np.sum(law.pmf(k)[far]), abs=0.015)


def test_of_many_groups_there_are_fewer_draws_in_parts(monkeypatch):
    units = np.full(60, 20)
    accepted = np.random.default_rng(1).binomial(20, 0.9, size=60)
    whole = chance(units, accepted)
    monkeypatch.setattr(yields, "CELLS", 30_000)  # as of 20,000 groups
    assert chance(units, accepted) == pytest.approx(whole, abs=0.05)
    assert chance(units, np.where(np.arange(60) < 6, 0, 20)) == pytest.approx(1e-3)  # of 999


def test_lines_without_a_difference_say_one_in_twenty_times():
    rng = np.random.default_rng(3)
    p = np.array([chance([20] * 5, rng.binomial(20, 0.9, size=5)) for _ in range(400)])
    assert np.mean(p < ALPHA) == pytest.approx(0.05, abs=0.03)
    differs = 0
    for _ in range(60):
        verdicts = np.where(rng.random(100) < 0.1, "fail", "pass").tolist()
        units = [unit(k, one, a=str(k % 3), b=str(k % 4), c=str(k % 5)) for k, one in enumerate(verdicts)]
        found = yields_of(units, by=["a", "b", "c"])
        differs += any(found.differs(column) for column in "abc")
    assert differs <= 8  # 0.05 of 60; P(9 or more) = 0.003


def test_what_all_or_no_unit_does_is_no_difference():
    assert chance([5, 5], [5, 5]) == chance([5, 5], [0, 0]) == chance([10], [4]) == 1.0
    assert chance([100, 100], [100, 0]) == pytest.approx(1e-4)


def test_a_unit_in_doubt_of_which_nothing_was_measured_is_undecided():
    doubted = unit(0, "not measured", "not measured").model_copy(update={"doubts": ("gyro y is stuck",)})
    assert yields_of([doubted]).whole.undecided == 1
    failed = unit(0, "not measured", "fail").model_copy(update={"doubts": ("gyro y is stuck",)})
    assert yields_of([failed]).whole.undecided == 0


def test_units_that_limits_accept_and_that_stand_out_are_said():
    found = yields_of([unit(k, "pass", "pass") for k in range(4)], odd=["0000", "0001", "0003"])
    assert found.whole.accepted_odd == found.as_json()["accepted_odd"] == 3
    assert found.sentences() == ["accepted units that stand out: 3 of 4; limits do not see why"]
