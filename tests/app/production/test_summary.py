"""The progress of a fleet, in words."""

import io
import time

import pytest

from driftlab.production import summary
from driftlab.production.summary import Stage, fleet_progress


def test_the_end_is_estimated_from_what_was_done():
    begun = time.monotonic() - 100
    assert Stage("units", total=50, done=10, begun=begun).left() == pytest.approx(400, rel=0.01)
    assert (
        Stage("units", total=50, done=10, failed=2, begun=begun).text() == "units: 10 of 50 units, 2 failed, 400 s left"
    )
    assert Stage("units", total=5000, done=2, begun=begun).text() == "units: 2 of 5,000 units"  # too few to say
    assert Stage("units", total=50, done=50, begun=begun).text() == "units: 50 of 50 units"
    assert Stage("the family").text() == "the family"


def test_a_log_gets_a_line_now_and_then(monkeypatch):
    told, now = io.StringIO(), [1000.0]
    monkeypatch.setattr(summary.sys, "stderr", told)
    monkeypatch.setattr(summary.time, "monotonic", lambda: now[0])
    stage = Stage("units", total=1000, begun=1000.0)
    with fleet_progress() as show:
        for _ in range(1000):
            now[0] += 0.125  # which no sum of rounds
            stage.done += 1
            show(stage)
        now[0] += 100
    lines = told.getvalue().splitlines()
    assert lines == [
        "units: 240 of 1,000 units, 95 s left",
        "units: 480 of 1,000 units, 65 s left",
        "units: 720 of 1,000 units, 35 s left",
        "units: 960 of 1,000 units, 5 s left",
    ]
