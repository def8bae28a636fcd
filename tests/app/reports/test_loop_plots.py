"""The loop's figures: margins are fixed beforehand, and no label may be cut."""

from dataclasses import fields

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from driftlab.loop.gates import Evidence
from driftlab.loop.least_squares import Term
from driftlab.loop.left_out import Part
from driftlab.loop.outcome import Outcome
from driftlab.loop.predicted import LeftOut, to_show
from driftlab.loop.state import Trial, name_of
from driftlab.loop.verdict import Finding, Verdict
from driftlab.reports.loop_plots import (
    AFTER,
    BEFORE,
    bias_figure,
    error_figure,
    left_out_figure,
    loop_figure,
    ratio_figure,
)
from driftlab.units import BiasUnit
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.interaction import Interaction

AXES = ("x", "y", "z")
RATE = BiasUnit("rad/s", "deg/h")
DEG_H = np.rad2deg(3600.0)
FIRST = {"t": {"first_row_s": 0.0}}


def trial(effect, ratio):
    figures = dict.fromkeys((field.name for field in fields(Evidence)), 1.0)
    evidence = Evidence(**figures | {"ratio": ratio})
    return Trial((Term(effect),), evidence, np.ones((3, 6)), 0.0, passes=False, reason="too little")


def verdict(count):
    """Return one with names from short to very long, wide letters among them; the first is added."""
    long = [Interaction(channels=(f"WMWM_pump_{k}_temperature", "MWMWMW_voltage")) for k in range(count - 1)]
    first, *others = (trial(effect, 0.1 + 5 * k / count) for k, effect in enumerate((Channel(channel="i"), *long)))
    finding = Finding(first, 0, first.term.effect, (), ())
    return Verdict("explained", (finding,), tuple(others), (), (), ())


def inside(figure, labels):
    """Return how many labels there are, all of them within the figure."""
    FigureCanvasAgg(figure).draw()
    width, height = figure.bbox.size
    seen = 0
    for label in labels(figure):
        if label.get_text():
            box = label.get_window_extent()
            seen += 1
            assert 0 <= box.x0 < box.x1 <= width, label.get_text()
            assert 0 <= box.y0 < box.y1 <= height, label.get_text()
    return seen


@pytest.mark.parametrize("count", [1, 2, 20])
def test_every_ratio_has_its_name(count):
    found = verdict(count)
    names = {name_of(one.term.effect) for one in (found.findings[0].trial, *found.rejected)}

    def labels(figure):
        (panel,) = figure.axes
        ticks = [label for label in panel.get_yticklabels() if label.get_text() in names]
        return (*ticks, panel.xaxis.label)

    assert inside(ratio_figure(found), labels) == count + 1


def test_a_ratio_is_that_of_errors_and_what_was_added_is_blue():
    (panel,) = ratio_figure(verdict(2)).axes
    bars = panel.patches
    assert bars[0].get_width() == pytest.approx(np.sqrt(0.1))
    from matplotlib.colors import to_rgba

    assert [bar.get_facecolor() for bar in bars] == [to_rgba(AFTER), to_rgba(BEFORE)]


def outcome(d=3, n=500, temperature=True):
    rng = np.random.default_rng(0)
    t = np.arange(n) * 10.0
    curves = [rng.normal(size=(n, d)) * 1e-5 for _ in range(3)]
    sigma = np.full((n, d), 1e-6)
    T = 20 + np.sin(t / 500) if temperature else None
    return Outcome("h.h5", RATE, t, T, *curves, sigma, 2 * sigma, (FIRST, FIRST), ())


@pytest.mark.parametrize("axes", [("x",), AXES])
@pytest.mark.parametrize(
    ("draw", "temperature"),
    [(bias_figure, True), (bias_figure, False), (error_figure, True), (error_figure, False), (loop_figure, True)],
)
def test_curves_of_a_holdout_are_labelled(draw, temperature, axes):
    def labels(figure):
        return [label for panel in figure.axes for label in (panel.xaxis.label, panel.yaxis.label)]

    assert inside(draw(outcome(len(axes), temperature=temperature), axes), labels) > len(axes)


def test_the_bias_is_drawn_with_two_deviations():
    shown = outcome()
    panel = bias_figure(shown, AXES).axes[0]
    measured, before, after = panel.get_lines()
    np.testing.assert_allclose(measured.get_ydata(), shown.reference[:, 0] * DEG_H)
    np.testing.assert_allclose(before.get_ydata(), shown.before[:, 0] * DEG_H)
    np.testing.assert_allclose(after.get_ydata(), shown.after[:, 0] * DEG_H)
    band = panel.collections[1].get_paths()[0].vertices[:, 1]
    assert band.max() >= np.max(shown.after[:, 0] + 2 * shown.after_sigma[:, 0]) * DEG_H * (1 - 1e-9)


def left(name, train, start, stop):
    t = np.arange(stop - start) * 20.0
    rng = np.random.default_rng(start)
    part = Part(0, slice(start, stop), stop - start > 50, (), (), slice(start, start + 2))
    return LeftOut(name, train, part, t, *(rng.normal(size=(len(t), 3)) * 1e-5 for _ in range(2)))


def test_what_was_left_out_is_shown_whole_where_it_was():
    """Of a training recording the whole, of a single one its parts, of the calibration nothing."""
    several = [left("soak", False, 0, 90), left("day", True, 100, 200), left("day", True, 100, 150)]
    assert to_show(several) == {"day": [several[1]]}
    fifths = [left("day", True, start, start + 20) for start in range(0, 100, 20)]
    assert to_show(fifths) == {"day": fifths}


@pytest.mark.parametrize("parts", [1, 5])
def test_the_errors_of_what_was_left_out_are_drawn(parts):
    figure = left_out_figure([left("day", True, 30 * k, 30 * k + 30) for k in range(parts)], AXES, RATE)
    assert [len(panel.get_lines()) for panel in figure.axes] == [2 * parts + 1] * 3

    def labels(figure):
        return [label for panel in figure.axes for label in (panel.xaxis.label, panel.yaxis.label)]

    assert inside(figure, labels) == 4
