"""Distributions against limits: counts by numpy, places and bands by the closed forms of order statistics."""

import numpy as np
import pytest
from lines import AXES, DEG_H, line
from scipy import stats

from driftlab.config import Limits
from driftlab.reports.line_charts import limit_charts
from driftlab.spc.line import line_of

LIMITS = Limits.model_validate({"noise": "2.6 deg/h/sqrt(Hz)", "coast": "9 deg/h"})


def panels(records, limits=LIMITS, quantity="noise"):
    """Return the histograms and the probability plots of a quantity, an axis each, and its chart."""
    (chart,) = [one for one in limit_charts(line_of(records, limits)) if one.label.startswith(quantity)]
    return chart.panels[::2], chart.panels[1::2], chart


def named(panel, name):
    (found,) = [one for one in panel.lines if one.name == name]
    return found


def test_each_limited_figure_has_a_histogram_and_a_probability_plot_an_axis():
    found = line_of(line(200, 1), LIMITS)
    charts = limit_charts(found)
    assert [chart.label for chart in charts] == ["noise [deg/h/sqrt(Hz)]", "prediction [deg/h]"]
    for chart in charts:
        assert [panel.label.partition(";")[0].split(", ")[1].split()[1] for panel in chart.panels] == [
            *np.repeat(AXES, 2)
        ]
        assert all("[1]" in panel.label for panel in chart.panels)
    assert limit_charts(line_of(line(200, 1), None)) == []
    assert [shade.start for panel in charts[0].panels for shade in panel.shades] == pytest.approx([2.6] * 6)


def test_a_histogram_has_every_unit_in_its_bin():
    records = line(300, 2)
    for k, panel in enumerate(panels(records)[0]):
        bars = named(panel, "all units")
        assert np.all(np.diff(bars.x) > 0)
        edges = np.concatenate([bars.x[:1], (bars.x[1:-1:2] + bars.x[2::2]) / 2, bars.x[-1:]])
        values = np.array([one.figures["noise"].value[k] for one in records]) / DEG_H
        expected, _ = np.histogram(values, edges)
        assert bars.y[::2].tolist() == bars.y[1::2].tolist() == expected.tolist()
        assert np.sum(expected) == 300
        law = named(panel, "normal law")
        middles = (edges[1:] + edges[:-1]) / 2
        by_law = np.interp(middles, law.x, law.y)  # units of a bin there
        assert np.sum(by_law) == pytest.approx(300, rel=0.02)
        x = np.log(values)
        exact = 300 * np.diff(stats.norm.cdf(np.log(edges), np.mean(x), np.std(x, ddof=1)))
        assert by_law == pytest.approx(exact, abs=0.02 * np.max(exact))


def test_normal_values_lie_on_the_line_and_in_the_band_that_order_statistics_have():
    n = 60
    z = stats.norm.ppf((np.arange(1, n + 1) - 0.375) / (n + 0.25))
    records = line(n, 3)
    values = 2.0 * np.exp(0.1 * z) * DEG_H
    for k, one in enumerate(np.random.default_rng(0).permutation(n)):
        figure = records[k].figures["noise"].model_copy(update={"value": (float(values[one]),) * 3})
        records[k] = records[k].model_copy(update={"figures": {**records[k].figures, "noise": figure}})
    plot = panels(records)[1][0]
    points, law = named(plot, "unit"), named(plot, "normal law")
    assert points.x == pytest.approx(np.sort(values) / DEG_H)
    assert np.interp(points.x, law.x, law.y) == pytest.approx(points.y, abs=0.05)
    # of the first of n values: P(U < u) = 1 - (1 - u)^n
    ends = stats.norm.ppf(1 - np.array([0.975, 0.025]) ** (1 / n))
    assert (law.low[0], law.high[0]) == pytest.approx(ends)
    assert (law.low[-1], law.high[-1]) == pytest.approx(-ends[::-1])
    assert (points.y >= law.low).all()
    assert (points.y <= law.high).all()


def test_what_is_not_normal_leaves_the_band_and_has_no_law_in_the_histogram():
    def outside(plot):
        points, law = named(plot, "unit"), named(plot, "normal law")
        low, high = (np.interp(points.x, law.x, end, left=-np.inf, right=np.inf) for end in (law.low, law.high))
        return np.mean((points.y < low) | (points.y > high))

    tight = Limits.model_validate({"coast": "40 deg/h"})
    good, bad = (panels(line(200, 2, law=law), tight, "prediction") for law in ("normal", "skew"))
    for histograms, plots, _ in (good, bad):
        normal = histograms is good[0]
        assert [any(one.name == "normal law" for one in panel.lines) for panel in histograms] == [normal] * 3
        assert all((outside(plot) < 0.05) == normal for plot in plots)
        assert all(plot.label.endswith("p < 0.0001") != normal for plot in plots)


def test_units_since_a_change_have_bars_and_a_plot_of_their_own():
    (x, y, _), (plot, *_), _ = panels(line(200, 3, planted=[("noise", "x", 120, 200, 3.0)]))
    assert np.sum(named(x, "all units").y[::2]) == 200
    assert np.sum(named(x, "since the last change").y[::2]) == pytest.approx(80, abs=3)
    assert len(named(plot, "unit").x) == pytest.approx(80, abs=3)
    assert not any(one.name == "since the last change" for one in y.lines)


def test_values_far_off_leave_the_bins_to_the_others_and_are_counted():
    (x, *_), (plot, *_), _ = panels(line(100, 4, planted=[("noise", "x", 50, 51, 40.0)]))
    assert "; beyond the axis: 1 at " in x.label
    assert np.sum(named(x, "all units").y[::2]) == 99
    assert max(named(plot, "unit").x) < 5


def test_many_units_are_a_sample_with_all_ends():
    _, (plot, *_), _ = panels(line(3000, 5))
    points = named(plot, "unit")
    assert len(points.x) <= 400
    assert points.y[0] == pytest.approx(stats.norm.ppf(0.625 / 3000.25))
    assert np.all(np.diff(points.y) > 0)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_values_that_do_not_vary_are_one_bar(value):
    records = line(30)
    for k, one in enumerate(records):
        figure = one.figures["noise"].model_copy(update={"value": (value,) * 3})
        records[k] = one.model_copy(update={"figures": {**one.figures, "noise": figure}})
    (x, *_), _, _ = panels(records)
    assert np.max(named(x, "all units").y) == 30
