"""The report of a loop is in the unit of the sensor that it is about."""

from types import SimpleNamespace

import numpy as np
import pytest

from driftlab.evaluation.scores import HORIZONS, Scores
from driftlab.filtering.segment import RunLog
from driftlab.identification.result import Outcome
from driftlab.reports.explain import _cells, _decisive, prediction_chart
from driftlab.units import BiasUnit


def outcome(unit, value):
    """Return one of a single axis, whose errors halve."""
    t = np.arange(200.0)
    curve = np.full((200, 1), value)
    errors = [np.array([size]) for size in (value, value / 2)]
    journal, overview = RunLog(alignments=[SimpleNamespace(dt=1.0)]), SimpleNamespace(first_row=0.0)
    runs = tuple(SimpleNamespace(overview=overview, yardsticks=scores(one), journal=journal) for one in errors)
    return Outcome("day.h5", unit, t, None, curve, curve, curve, curve, curve, runs)


def scores(error):
    """Return those of errors (1,) over every horizon, and of a deviation as large."""
    each = dict.fromkeys(HORIZONS, error)
    return Scores(("x",), error, error, each, each, {}, {}, 0.0)


RATE = outcome(BiasUnit("rad/s", "deg/h"), np.deg2rad(3.0) / 3600)
HELD = outcome(BiasUnit("1", "ppm"), 3e-6)


@pytest.mark.parametrize("found", [RATE, HELD], ids=["deg/h", "ppm"])
def test_errors_are_shown_in_the_sensors_unit(found):
    rows = _cells(found)
    assert [row[0] for row in rows][:2] == ["prediction, to the end", "  its sigma"]
    assert [row[0] for row in rows][-2:] == ["bias, all", "bias, first 30 s"]
    for label, before, after, change in rows:
        assert (float(before[0]), float(after[0])) == (3.0, 1.5)
        assert change == ("" if label.startswith(" ") else "-50")


def test_the_decisive_sentence_says_what_the_change_does():
    assert _decisive(RATE) == "the error of the prediction to the end falls by 50 %: 3 to 1.5 deg/h rms"
    assert "falls by 50 %: 3 to 1.5 ppm rms" in _decisive(HELD)


@pytest.mark.parametrize(("found", "unit"), [(RATE, "deg/h"), (HELD, "ppm")])
def test_charts_say_the_sensors_unit(found, unit):
    labels = [panel.label for panel in prediction_chart(found, ["resistance"]).panels]
    assert labels == [f"bias resistance [{unit}]", f"error resistance [{unit}]"]


def test_a_chart_shows_the_sensors_numbers():
    panel = prediction_chart(HELD, ["resistance"]).panels[0]
    np.testing.assert_allclose(panel.lines[0].y, 3.0)


def test_where_nothing_was_added_one_model_is_drawn_and_not_the_same_twice():
    both = {line.name for panel in prediction_chart(RATE, ["x"]).panels for line in panel.lines}
    assert both == {"measured", "before, ± 2σ", "after, ± 2σ"}
    one = {line.name for panel in prediction_chart(RATE, ["x"], changed=False).panels for line in panel.lines}
    assert one == {"measured", "declared, ± 2σ"}
