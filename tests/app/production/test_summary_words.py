"""The sentences about a fleet."""

from driftlab.production.summary import FleetSummary


def test_units_that_pass_with_a_hysteresis_are_counted():
    counts = {"units": 3, "done": 3, "failed": 0, "done_now": 3}
    plain = FleetSummary(counts=counts, limits={"pass": 3}, acceptance="limits: 3 pass")
    assert "limits: 3 pass" in plain.sentences()
    said = "of those that pass a hysteresis or lag is seen in 2 units; no limit is set for it"
    assert said not in plain.sentences()
    assert said in plain.model_copy(update={"pass_with_hysteresis": 2}).sentences()
