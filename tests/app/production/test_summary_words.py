"""What is said of a fleet, in sentences."""

from driftlab.production.summary import lines_of


def test_units_that_pass_with_a_hysteresis_are_counted():
    counts = {"units": 3, "done": 3, "failed": 0, "done_now": 3}
    content = {"counts": counts, "failed": {}, "left": [], "kept_without_recordings": [], "limits": {"pass": 3}}
    plain = lines_of(content)
    assert "limits: 3 pass" in plain
    said = "of those that pass a hysteresis or lag is seen in 2 units; no limit is set for it"
    assert said not in plain
    assert said in lines_of({**content, "pass_with_hysteresis": 2})
