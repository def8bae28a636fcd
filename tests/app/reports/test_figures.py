"""A chart by matplotlib shows what the chart says."""

import numpy as np
from matplotlib.colors import to_hex

from driftlab.reports.charts import LOOKS, Chart, Line, Panel, Rule, Shade
from driftlab.reports.figures import figure_of, svg

T = np.linspace(0, 1, 5)


def test_panels_lines_bands_shades_and_levels_are_there_with_their_labels():
    first = Panel(
        (Line(T, T, "estimate", "estimate", T - 1, T + 1), Line(T, -T, "cost in $", "coast", style="dashed")),
        "bias [deg/h]", (Shade(0.2, 0.4, "refused"),), (Rule(0.5, "limit"),),
    )  # fmt: skip
    second = Panel((Line(T, 1 + T, "points", "data", style="points"),), "deviation [deg/h]", log=True, height=2)
    figure = figure_of(Chart((first, second), "time [h]"))
    upper, lower = figure.axes
    assert [line.get_label() for line in upper.lines[:2]] == ["estimate", r"cost in \$"]
    assert to_hex(upper.lines[0].get_color()) == LOOKS["estimate"].light
    assert [line.get_linestyle() for line in upper.lines[:2]] == ["-", "--"]
    assert upper.lines[2].get_ydata()[0] == 0.5
    assert len(upper.patches) == 1  # what is shaded
    assert len(upper.collections) == 1  # the band
    assert (lower.get_yscale(), upper.get_yscale()) == ("log", "linear")
    assert lower.get_xlabel() == "time [h]"
    heights = [axes.get_position().height for axes in (lower, upper)]
    assert np.isclose(heights[0] / heights[1], 2)
    entries = [text.get_text() for text in upper.get_legend().get_texts()]
    assert set(entries) == {"estimate", r"cost in \$", "refused", "points"}


def test_the_same_chart_is_the_same_file():
    chart = Chart((Panel((Line(T, T, "a"),), "y [1]"),), "x [s]")
    assert svg(figure_of(chart)) == svg(figure_of(chart))
