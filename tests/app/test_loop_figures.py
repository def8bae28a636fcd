"""The loop's figures: margins are fixed beforehand, and no label may be cut."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from driftlab.loop.plots import collinearity_figure, score_figure
from driftlab.loop.state import name_of
from driftlab.loop.verdict import Trial, Verdict
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.interaction import Interaction


def verdict(count):
    """Return one with names from short to very long, wide letters among them."""
    long = [Interaction(channels=(f"WMWM_pump_{k}_temperature", "MWMWMW_voltage")) for k in range(count - 1)]
    trials = tuple(Trial(effect, 3.0, 20.0, "too little") for effect in (Channel(channel="i"), *long))
    names = tuple(name_of(trial.effect) for trial in trials)
    return Verdict("nothing_missing", (), trials, (), {}, (), names, np.eye(count))


@pytest.mark.parametrize("count", [1, 2, 20])
@pytest.mark.parametrize("draw", [score_figure, collinearity_figure])
def test_every_label_lies_within_the_figure(draw, count):
    found = verdict(count)
    figure = draw(found)
    FigureCanvasAgg(figure).draw()
    width, height = figure.bbox.size
    seen = 0
    for panel in figure.axes:
        ticks = [
            label for label in (*panel.get_xticklabels(), *panel.get_yticklabels()) if label.get_text() in found.names
        ]
        for label in (*ticks, panel.xaxis.label, panel.yaxis.label):
            if label.get_text():
                box = label.get_window_extent()
                seen += 1
                assert 0 <= box.x0 < box.x1 <= width, label.get_text()
                assert 0 <= box.y0 < box.y1 <= height, label.get_text()
    assert seen > count
