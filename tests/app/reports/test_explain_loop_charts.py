"""Figures of the loop: their content, and that a browser and matplotlib draw it."""

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from browsers import colours, overflow

from driftlab.filtering.segment import RunLog
from driftlab.identification.acceptance import FAST, SLOW, CandidateEvidence
from driftlab.identification.cross_validation import LeftOutPart
from driftlab.identification.diagnosis import Diagnosis, Finding
from driftlab.identification.least_squares import Term
from driftlab.identification.result import Outcome
from driftlab.identification.state import LeftOut, Trial, name_of, to_show
from driftlab.reports.explain import MAX_RATIO, NEEDED, bars, left_out_chart, loop_chart, prediction_chart
from driftlab.reports.figures import figure_of
from driftlab.units import BiasUnit
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.interaction import Interaction

AXES = ("x", "y", "z")
RATE = BiasUnit("rad/s", "deg/h")
DEG_H = np.rad2deg(3600.0)
FIRST = SimpleNamespace(first_row=0.0)


def trial(effect, ratio):
    figures = dict.fromkeys((field.name for field in fields(CandidateEvidence)), 1.0)
    evidence = CandidateEvidence(**figures | {"ratio": ratio})
    return Trial((Term(effect),), evidence, np.ones((3, 6)), 0.0, passes=False, reason="too little")


def verdict(count):
    """Return one with names from short to very long, wide letters among them; the first is added."""
    long = [Interaction(channels=(f"WMWM_pump_{k}_temperature", "MWMWMW_voltage")) for k in range(count - 1)]
    first, *others = (trial(effect, 0.1 + 5 * k / count) for k, effect in enumerate((Channel(channel="i"), *long)))
    finding = Finding(first, 0, first.term.effect, (), ())
    return Diagnosis("explained", (finding,), tuple(others), (), (), ())


def test_bars_are_ratios_of_errors_what_was_added_first():
    found = verdict(6)
    first, *others = bars(found)
    assert (first.name, first.added) == (name_of(found.findings[0].effect), True)
    assert [bar.added for bar in others] == [False] * 5
    assert [bar.name for bar in others] == [name_of(t.term.effect) for t in found.rejected]  # from good to bad
    assert first.width == pytest.approx(100 * np.sqrt(0.1) / MAX_RATIO)
    assert first.change == "-68 %"  # sqrt(0.1) = 0.316
    assert [bar.beyond for bar in others] == [bar.width == 100 for bar in others]
    assert [ratio for _, ratio in NEEDED] == [FAST, SLOW]


def outcome(d=3, n=500, temperature=True):
    rng = np.random.default_rng(0)
    t = np.arange(n) * 10.0
    curves = [rng.normal(size=(n, d)) * 1e-5 for _ in range(3)]
    sigma = np.full((n, d), 1e-6)
    T = 20 + np.sin(t / 500) if temperature else None
    run = SimpleNamespace(overview=FIRST, journal=RunLog(alignments=[SimpleNamespace(dt=10.0)]))
    return Outcome("h.h5", RATE, t, T, *curves, sigma, 2 * sigma, (run, run))


def test_bias_and_error_of_each_axis_are_drawn_with_two_deviations():
    shown = outcome()
    bias, error, *_, temperature = prediction_chart(shown, AXES).panels
    assert (bias.label, error.label, temperature.label) == ("bias x [deg/h]", "error x [deg/h]", "temperature [°C]")
    measured, before, after = bias.lines
    np.testing.assert_allclose(measured.y, shown.reference[:, 0] * DEG_H)
    np.testing.assert_allclose(before.y, shown.before[:, 0] * DEG_H)
    np.testing.assert_allclose(after.high - after.low, 4 * shown.after_sigma[:, 0] * DEG_H)
    *bands, old, new = error.lines
    np.testing.assert_allclose(bands[1].high, 2 * shown.after_sigma[:, 0] * DEG_H)
    np.testing.assert_allclose(old.y, (shown.before - shown.reference)[:, 0] * DEG_H)
    np.testing.assert_allclose(new.y, (shown.after - shown.reference)[:, 0] * DEG_H)


def test_no_spike_of_an_error_is_left_out():
    shown = outcome(1, n=50_000)
    k = 12_345
    shown.after[k] = shown.reference[k] + 1e-3
    line = prediction_chart(shown, ("x",)).panels[1].lines[-1]
    assert len(line.x) < 2000
    assert np.max(line.y) == pytest.approx(1e-3 * DEG_H)


def test_what_was_refused_and_what_moved_are_shaded():
    shown = outcome()
    shown.runs[1].journal.refused.spans.append((600.0, 700.0))
    shown.runs[1].journal.moving.spans.append((1200.0, 1300.0))
    chart = prediction_chart(shown, AXES)
    assert chart.label.endswith("[min]")
    for panel in chart.panels:
        refused, moved = panel.shades
        assert (refused.start, refused.stop) == (pytest.approx(590 / 60), pytest.approx(700 / 60))
        assert (moved.role, moved.stop) == ("moving", pytest.approx(1300 / 60))


def test_warming_and_cooling_are_apart_and_before_and_after_share_a_scale():
    shown = outcome(1)
    before, after = loop_chart(shown, ("x",)).panels
    assert before.span == after.span
    for panel, values in ((before, shown.before), (after, shown.after)):
        warming, cooling = panel.lines
        assert (warming.role, cooling.role) == ("warming", "cooling")
        assert np.all(np.diff(warming.x) >= 0)
        assert np.all(np.diff(cooling.x) >= 0)
        together = np.sort(np.concatenate([warming.y, cooling.y]))
        np.testing.assert_allclose(together, np.sort((values - shown.reference)[:, 0] * DEG_H))
    rising = np.gradient(shown.temperature, shown.t) >= 0
    assert len(before.lines[0].x) == np.sum(rising)


def left(name, train, start, stop):
    t = np.arange(stop - start) * 20.0
    rng = np.random.default_rng(start)
    part = LeftOutPart(0, slice(start, stop), stop - start > 50, (), (), slice(start, start + 2))
    return LeftOut(name, train, part, t, *(rng.normal(size=(len(t), 3)) * 1e-5 for _ in range(2)))


def test_what_was_left_out_is_shown_whole_where_it_was():
    """Of a training recording the whole, of a single one its parts, of the calibration nothing."""
    several = [left("soak", False, 0, 90), left("day", True, 100, 200), left("day", True, 100, 150)]
    assert to_show(several) == {"day": [several[1]]}
    fifths = [left("day", True, start, start + 20) for start in range(0, 100, 20)]
    assert to_show(fifths) == {"day": fifths}


@pytest.mark.parametrize("parts", [1, 5])
def test_the_errors_of_what_was_left_out_are_drawn(parts):
    chart = left_out_chart([left("day", True, 30 * k, 30 * k + 30) for k in range(parts)], AXES, RATE)
    assert [len(panel.lines) for panel in chart.panels] == [2 * parts] * 3
    assert len(figure_of(chart).axes) == 3


def test_a_page_shows_charts_and_bars_on_a_phone(tmp_path, opened):
    from driftlab.reports.pages import write_page
    from driftlab.reports.provenance import Sheet

    shown = outcome()
    sheet = Sheet("SN 7", "2026-11-22", "page", "c.yaml", "0" * 64, [], {}, [], [], [], "")
    row = ("prediction, to the end", ["3"] * 3, ["1"] * 3, "-67")
    found = verdict(20)
    evidence = SimpleNamespace(axes=AXES, channel="gyro")
    search = SimpleNamespace(tried=20, evidence=evidence)
    closed = SimpleNamespace(lines=[], search=search, verdict=SimpleNamespace(left=[], experiments=[]))
    write_page(
        tmp_path / "report.html", "explain", closed=closed, word="explained", outcome="pass", meaning="",
        unit="deg/h", known="Earth rate", effects=[], holdouts=[("day.h5", shown)], taught=[], bars=bars(found),
        needed=[(text, 100 * ratio**0.5 / MAX_RATIO) for text, ratio in NEEDED], rejected=[], sheet=sheet,
        config="a: b", decisive=lambda outcome: "it falls", cells=lambda outcome: [row],
        prediction_chart=prediction_chart, loop_chart=loop_chart,
    )  # fmt: skip
    for dark in (False, True):
        page = opened(tmp_path / "report.html", width=390, dark=dark)
        assert overflow(page) <= 0
        assert all(colours(page, k) > 5 for k in range(2))
        widths = page.evaluate("[...document.querySelectorAll('.bars .bar')].map(b => b.getBoundingClientRect().width)")
        track = page.evaluate("document.querySelector('.bars .track').getBoundingClientRect().width")
        np.testing.assert_allclose(widths, [track * bar.width / 100 for bar in bars(found)], atol=1)
        assert "SN 7" in page.inner_text("body")
