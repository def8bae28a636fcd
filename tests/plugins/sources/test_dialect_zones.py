"""Dates with an offset from UTC, as loggers write them over a change of the clock."""

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import polars as pl
import pytest

from fusion_plugins.sources.dialect import numbers_of, seconds_of

FORM = "%Y-%m-%dT%H:%M:%S"
CHANGES = {"spring": (datetime(2026, 3, 29, 1, tzinfo=UTC), 1), "autumn": (datetime(2026, 10, 25, 1, tzinfo=UTC), 2)}


@pytest.mark.parametrize("season", CHANGES)
@pytest.mark.parametrize("write", [datetime.isoformat, lambda moment: moment.strftime(f"{FORM}.5%z")])
def test_a_change_of_the_clock_is_no_gap_and_no_step_back(season, write):
    change, before = CHANGES[season]
    moments = [change + timedelta(seconds=k) for k in range(-5, 5)]
    zones = [timezone(timedelta(hours=before if moment < change else 3 - before)) for moment in moments]
    texts = [write(moment.astimezone(zone)) for moment, zone in zip(moments, zones, strict=True)]
    np.testing.assert_allclose(np.diff(numbers_of(texts, FORM)), 1)


@pytest.mark.parametrize(
    ("zone", "ahead"), [("Z", 0), (" UTC", 0), ("+05:30", 5.5), ("-03:30", -3.5), ("-0030", -0.5), ("", 0)]
)
def test_an_offset_is_taken_off(zone, ahead):
    (found,) = seconds_of(pl.Series([f"2026-07-01T12:00:00{zone}"]), FORM)
    assert found == datetime(2026, 7, 1, 12, tzinfo=UTC).timestamp() - 3600 * ahead
