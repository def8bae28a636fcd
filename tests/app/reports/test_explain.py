"""The report of a loop is in the unit of the sensor that it is about."""

import numpy as np
import pytest

from driftlab.identification.result import Outcome, figures
from driftlab.reports.explain import _cells, _decisive, prediction_chart
from driftlab.units import BiasUnit


def outcome(unit, suffix, value):
    """Return one of a single axis, whose errors halve."""
    t = np.arange(200.0)
    curve = np.full((200, 1), value)
    before, after = (
        {
            "t": {"first_row_s": 0.0},
            f"coast_rmse{suffix}": {"to the end": [size]},
            f"coast_sigma{suffix}": {"to the end": [size]},
            f"filter_rmse{suffix}": {"whole": [size]},
        }
        for size in (value, value / 2)
    )
    return Outcome("day.h5", unit, t, None, curve, curve, curve, curve, curve, (before, after), ())


RATE = outcome(BiasUnit("rad/s", "deg/h"), "_rad_s", np.deg2rad(3.0) / 3600)
HELD = outcome(BiasUnit("1", "ppm"), "", 3e-6)


@pytest.mark.parametrize("found", [RATE, HELD], ids=["deg/h", "ppm"])
def test_errors_are_shown_in_the_sensors_unit(found):
    rows = _cells(found)
    assert [row[0] for row in rows] == ["coast, to the end", "  its sigma", "filter, all"]
    for label, before, after, change in rows:
        assert (float(before[0]), float(after[0])) == (3.0, 1.5)
        assert change == ("" if label.startswith(" ") else "-50")


def test_the_decisive_sentence_says_what_the_change_does():
    assert _decisive(RATE) == "the error of the prediction to the end falls by 50 %: 3 to 1.5 deg/h rms"
    assert "falls by 50 %: 3 to 1.5 ppm rms" in _decisive(HELD)


def test_errors_of_a_summary_are_found_by_either_name():
    assert figures(RATE.summaries[0], "coast_rmse")["to the end"] == [np.deg2rad(3.0) / 3600]
    assert figures(HELD.summaries[0], "coast_rmse")["to the end"] == [3e-6]


@pytest.mark.parametrize(("found", "unit"), [(RATE, "deg/h"), (HELD, "ppm")])
def test_charts_say_the_sensors_unit(found, unit):
    labels = [panel.label for panel in prediction_chart(found, ["resistance"]).panels]
    assert labels == [f"bias resistance [{unit}]", f"error resistance [{unit}]"]


def test_a_chart_shows_the_sensors_numbers():
    panel = prediction_chart(HELD, ["resistance"]).panels[0]
    np.testing.assert_allclose(panel.lines[0].y, 3.0)
