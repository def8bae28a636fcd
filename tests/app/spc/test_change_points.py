"""Steps as steps, trends as trends, neither as neither: of white noise, and of units that resemble their neighbours."""

import numpy as np
import pytest
from lines import SPREAD, TYPICAL, line
from scipy.signal import lfilter

from driftlab.spc.change_points import course_of
from driftlab.spc.charts import in_control
from driftlab.spc.line import line_of

ALPHA = 0.003  # of a chart, as of 18 charts together 0.05


def drawn(n, phi, count, seed):
    """Return values (count, n) of one deviation whose neighbours have the autocorrelation phi."""
    white = np.random.default_rng([seed, n, int(10 * phi)]).normal(size=(count, n + 100))
    return (lfilter([1], [1, -phi], white) * np.sqrt(1 - phi**2))[:, 100:]


def courses(values, alpha=ALPHA):
    return [course_of(x, in_control(x, np.zeros(len(x))).sigma(np.zeros(len(x))), alpha) for x in values]


def share(found, kind):
    """Return the share of courses that are steps, a trend or neither."""
    called = ["trend" if one.slope is not None else "steps" if one.steps else "neither" for one in found]
    return called.count(kind) / len(called)


@pytest.mark.parametrize(
    ("n", "phi", "most"),
    [(60, 0.0, 0.01), (200, 0.0, 0.01), (200, 0.6, 0.015), (200, 0.8, 0.02), (60, 0.6, 0.05)],
)
def test_what_has_neither_has_neither(n, phi, most):
    """Steps alone, as of white noise, would be found in half of the lines with an autocorrelation of 0.6."""
    found = courses(drawn(n, phi, 200, 1))
    assert share(found, "neither") >= 1 - most - 2 * np.sqrt(most / 200)
    assert np.mean([one.phi for one in found]) == pytest.approx(phi, abs=0.05 if n == 200 else 0.15)


@pytest.mark.parametrize(
    ("n", "phi", "size", "least"),
    [(60, 0.0, 2.0, 0.85), (200, 0.0, 1.5, 0.95), (200, 0.3, 2.0, 0.9), (200, 0.6, 3.0, 0.9)],
)
def test_a_step_is_a_step(n, phi, size, least):
    at = 2 * n // 5
    found = courses(drawn(n, phi, 60, 2) + size * (np.arange(n) >= at))
    assert share(found, "steps") >= least
    places = [one.steps[0].at for one in found if len(one.steps) == 1]
    assert len(places) >= 0.8 * least * 60
    assert np.median(np.abs(np.array(places) - at)) <= 3


@pytest.mark.parametrize(
    ("n", "phi", "size", "least"),
    [(60, 0.0, 4.0, 0.85), (200, 0.0, 2.0, 0.85), (200, 0.3, 4.0, 0.9), (200, 0.6, 5.0, 0.85)],
)
def test_a_trend_is_a_trend(n, phi, size, least):
    found = courses(drawn(n, phi, 60, 3) + size * np.linspace(0, 1, n))
    assert share(found, "trend") >= least
    rise = [2 * one.slope[1] for one in found if one.slope is not None]
    assert np.mean(rise) == pytest.approx(size, rel=0.15)


def test_odd_units_and_what_does_not_vary_make_no_course():
    values = drawn(100, 0.0, 50, 4)
    values[:, [20, 21, 70]] += 12
    assert share(courses(values), "neither") == 1.0
    assert course_of(np.ones(40), np.zeros(40), ALPHA).steps == ()
    assert course_of(np.arange(6.0), np.ones(6), ALPHA).slope is None  # too few


def test_a_line_whose_units_resemble_their_neighbours_is_said_to_be_so():
    z = drawn(200, 0.7, 1, 5)[0] + 0.0
    wandering = [("noise", "x", k, k + 1, float(value)) for k, value in enumerate(2 * z)]
    found = line_of(line(200, 5, planted=wandering), None)
    charts = {(chart.quantity, chart.axis): chart for chart in found.controls}
    chart = charts["noise", "x"]
    assert chart.changes == ()
    assert chart.trend is None
    assert 0.3 < chart.phi < 0.8  # half of it is white
    (said,) = [one for one in found.sentences if one.startswith("Units resemble those before them")]
    assert f"x noise {chart.phi:.2g}" in said
    assert "y noise" not in said
    assert chart.as_json(found)["autocorrelation"] == chart.phi
    assert not any("resemble" in one for one in line_of(line(200, 5), None).sentences)


def test_the_ends_of_a_trend_are_those_of_its_line():
    drift = [("noise", "x", k, k + 1, 4 * k / 199) for k in range(200)]
    found = line_of(line(200, 2, planted=drift), None)
    chart = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    first, last = (
        np.log(v / np.deg2rad(1) * 3600 / TYPICAL["noise"]) / SPREAD["noise"] for v in vars(chart.trend).values()
    )
    assert (first, last) == (pytest.approx(0, abs=0.5), pytest.approx(4, abs=0.5))
