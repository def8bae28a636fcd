"""The report of a loop is in the unit of the sensor that it is about."""

import numpy as np
import pytest

from driftlab.loop.outcome import Outcome
from driftlab.loop.record import figures
from driftlab.reports.loop import _cells
from driftlab.reports.loop_plots import bias_figure, error_figure
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
    for _, before, after, change in _cells(found):
        assert (float(before[0]), float(after[0]), change) == (3.0, 1.5, "-50 %")


def test_errors_of_a_summary_are_found_by_either_name():
    assert figures(RATE.summaries[0], "coast_rmse")["to the end"] == [np.deg2rad(3.0) / 3600]
    assert figures(HELD.summaries[0], "coast_rmse")["to the end"] == [3e-6]


@pytest.mark.parametrize("draw", [bias_figure, error_figure])
@pytest.mark.parametrize(("found", "unit"), [(RATE, "deg/h"), (HELD, "ppm")])
def test_figures_say_the_sensors_unit(draw, found, unit):
    panel = draw(found, ["resistance"]).axes[0]
    assert panel.get_ylabel().endswith(f"resistance [{unit}]")


def test_a_figure_shows_the_sensors_numbers():
    panel = bias_figure(HELD, ["resistance"]).axes[0]
    np.testing.assert_allclose(panel.get_lines()[0].get_ydata(), 3.0)
