"""Records in brief: what charts, tests and the page read of a record is that of its file."""

import tracemalloc

import numpy as np
from lines import line

from driftlab.family.record import FIGURES, Figure, UnitRecord
from driftlab.family.unit_records import HELD, UnitRecords, figure_of, figures_in
from driftlab.spc.line import line_of
from driftlab.spc.yields import yields_of

FAILED = UnitRecord(
    key="", unit="f", lot="L1", date="2026-01-02", more={"chamber": "K1"}, state="failed", error="no HDF5"
)
FAIL = {"name": "noise", "verdict": "fail", "beside": True}


def done(k):
    rng = np.random.default_rng(k)
    figures = {name: Figure(value=(rng.normal(), None, 0.0), sigma=(0.1, None, 0.1)) for name in ("noise", "soaks")}
    return UnitRecord(
        key=f"{k:x}", unit=f"u{k}", lot="L0", state="done", channel="gyro", bias_unit="rad/s", axes=("x", "y", "z"),
        domain=(-10.0, 40.5) if k else None, hours=2.1, samples=7200, seconds=0.3, driftlab="1.2", figures=figures,
        limits=[{**FAIL, "value": 3.0}, {"name": "coast", "verdict": "pass"}],
        verdict=["a sentence"], notes=["another"],
    )  # fmt: skip


def test_a_record_in_brief_has_what_it_is_read_for():
    records = UnitRecords()
    given = [done(0), FAILED, done(1)]
    for record in given:
        records[record.unit] = record
    found = records.of([record.unit for record in given])
    assert [record.unit for record in found] == ["u0", "f", "u1"]
    for brief, whole in zip(found, given, strict=True):
        for name in ("key", "unit", "lot", "date", "more", "state", "error", "channel", "bias_unit", "axes", "domain",
                     "hours", "samples", "seconds", "driftlab"):  # fmt: skip
            assert getattr(brief, name) == getattr(whole, name), name
        (value, sigma), (known, own) = brief.table(HELD, 3), whole.table(HELD, 3)
        assert np.array_equal(value, known, equal_nan=True)
        np.testing.assert_allclose(sigma, own, rtol=2.0**-24)
    assert found[0].limits == [
        {"name": "noise", "verdict": "fail", "beside": True},
        {"name": "coast", "verdict": "pass"},
    ]
    assert found[0].figures["noise"].value[1] is None
    assert found[0].figures["noise"].value[2] == 0.0
    assert [record.unit for record in found.in_state("done")] == ["u0", "u1"]
    assert [record.unit for record in found.in_state("failed")] == ["f"]
    assert [record.unit for record in found[1:]] == ["f", "u1"]
    assert figures_in(found) == figures_in(given) == {"noise", "soaks"}
    for name in ("noise", "soaks", "walk"):
        (value, sigma), (known, own) = figure_of(found, name, 3), figure_of(given, name, 3)
        assert value.shape == (3, 3)
        assert np.array_equal(value, known, equal_nan=True)
        np.testing.assert_allclose(sigma, own, rtol=2.0**-24)


def in_single_precision(record):
    """A record whose deviations are rounded as one in brief has them."""
    figures = {
        name: Figure(value=figure.value, sigma=tuple(np.float32(figure.sigma).tolist()))
        for name, figure in record.figures.items()
    }
    return record.model_copy(update={"figures": figures})


def test_the_line_and_its_yield_are_the_same_by_records_in_brief():
    whole, records = [*map(in_single_precision, line(60, 2))], UnitRecords()
    for record in whole:
        records[record.unit] = record
    brief = records.of([record.unit for record in whole])
    one, other = (line_of(of, None) for of in (whole, brief))
    assert one.sentences == other.sentences
    assert [chart.as_json(one) for chart in one.controls] == [chart.as_json(other) for chart in other.controls]
    assert yields_of(whole, ["0003"], ["lot", "date"]) == yields_of(brief, ["0003"], ["lot", "date"])


def test_a_record_in_brief_takes_less_than_600_bytes():
    records, count = UnitRecords(), 2000
    figures = {name: Figure(value=(1.0, 2.0, 3.0), sigma=(0.1, 0.2, 0.3)) for name in FIGURES}
    records["first"] = done(1)
    tracemalloc.start()
    try:
        for k in range(count):
            records[f"{k:07d}"] = done(1).model_copy(update={"key": f"{k:064x}", "figures": figures})
        taken = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert taken / count < 600
