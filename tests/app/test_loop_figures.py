"""The loop's figures: margins are fixed beforehand, and no label may be cut."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from driftlab.loop.gates import Evidence
from driftlab.loop.least_squares import Term
from driftlab.loop.plots import ratio_figure
from driftlab.loop.state import Trial, name_of
from driftlab.loop.verdict import Verdict
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.interaction import Interaction

TOO_LITTLE = Evidence(0.97, -0.2, 6, 1.1, beside=False, left_out=-3.0, chance=0.2, gain=-12.0, price=4.6)


def verdict(count):
    """Return one with names from short to very long, wide letters among them."""
    long = [Interaction(channels=(f"WMWM_pump_{k}_temperature", "MWMWMW_voltage")) for k in range(count - 1)]
    effects = (Channel(channel="i"), *long)
    trials = [Trial((Term(effect),), TOO_LITTLE, np.ones((3, 6)), 0.0, passes=False, reason="") for effect in effects]
    return Verdict("nothing_missing", (), tuple(trials), (), (), ())


@pytest.mark.parametrize("count", [1, 2, 20])
def test_every_label_lies_within_the_figure(count):
    found = verdict(count)
    names = {name_of(trial.term.effect) for trial in found.rejected}
    figure = ratio_figure(found)
    FigureCanvasAgg(figure).draw()
    width, height = figure.bbox.size
    seen = 0
    for panel in figure.axes:
        ticks = [label for label in (*panel.get_xticklabels(), *panel.get_yticklabels()) if label.get_text() in names]
        for label in (*ticks, panel.xaxis.label, panel.yaxis.label):
            if label.get_text():
                box = label.get_window_extent()
                seen += 1
                assert 0 <= box.x0 < box.x1 <= width, label.get_text()
                assert 0 <= box.y0 < box.y1 <= height, label.get_text()
    assert seen > count
