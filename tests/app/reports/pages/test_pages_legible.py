"""Charts that one value does not squash, and axes, hints and limits that stand where a reader looks."""

import jinja2
import numpy as np
import pytest
from browsers import assert_nothing_is_cut_in_silence

from driftlab.reports import pages
from driftlab.reports.charts import LOOKS, Chart, Line, Panel, axis_panels, without_spikes

BODY = """{% extends "base.html" %}{% block title %}wide{% endblock %}{% block body %}
<pre>{{ text }}</pre>{{ interactive(chart) }}
<script type="application/json" id="units">["0001\\n2026-03-01", "0002\\n2026-03-02"]</script>
{% endblock %}"""


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Return a function that writes a page with a text of some length, and a chart over two units with dates."""
    package = jinja2.PackageLoader("driftlab.reports", "pages")
    both = jinja2.ChoiceLoader([jinja2.DictLoader({"wide.html": BODY}), package])
    monkeypatch.setattr(pages.environment(), "loader", both)

    def write(text):
        line = Line(np.array([1.0, 2.0]), np.array([3.0, 4.0]), "unit", style="points")
        chart = Chart((Panel((line,), "noise [deg/h]"),), "unit", named="units")
        pages.write_page(tmp_path / "wide.html", "wide", text=text, chart=chart)
        return tmp_path / "wide.html"

    return write


def test_what_scrolls_sideways_says_so_and_what_fits_does_not(written, opened):
    wide = opened(written("key: " + "value " * 40), width=390)
    assert_nothing_is_cut_in_silence(wide)
    assert wide.locator(".hint").count() == 1
    wide.emulate_media(media="print")
    assert not wide.locator(".hint").is_visible()
    assert opened(written("key: value"), width=390).locator(".hint").count() == 0


def test_a_unit_under_an_axis_has_its_date_below_and_in_the_reading(written, opened):
    shown = opened(written("-"))
    assert shown.evaluate("document.querySelector('figure.chart').chart.label(2)") == "0002\n2026-03-02"
    box = shown.locator(".u-over").bounding_box()
    shown.mouse.move(box["x"] + 2, box["y"] + 20)
    assert "unit 0001, 2026-03-01 ·" in shown.locator(".read").inner_text()


@pytest.mark.parametrize("count", [20, 200, 5000])
def test_one_value_far_off_does_not_squash_the_others(count):
    values = np.sin(np.arange(count))
    values[count // 2] = 1e4
    assert without_spikes(values) == pytest.approx((-1, 1), abs=0.1)
    (panel,) = axis_panels(("x",), lambda k: [Line(np.arange(count), values, "bias")], "bias", "deg/h", legibly=True)
    assert panel.span[1] < 2
    assert panel.label == "bias x [deg/h], spikes of 1e+04 to 1e+04 are cut"


def test_what_lasts_is_drawn_whole():
    values = np.zeros(1000)
    values[:50] = np.linspace(300, 0, 50)  # a twentieth of the time
    values += 0.1 * np.cos(np.arange(1000))
    assert without_spikes(values) == (values.min(), values.max())
    (panel,) = axis_panels(("x",), lambda k: [Line(np.arange(1000), values, "bias")], "bias", "deg/h", legibly=True)
    assert panel.label == "bias x [deg/h]"


def test_limits_are_paler_and_thinner_than_what_they_limit():
    def contrast(role):
        red, green, blue = (int(LOOKS[role].light[k : k + 2], 16) for k in (1, 3, 5))
        return 255 - (0.2126 * red + 0.7152 * green + 0.0722 * blue)

    for role in ("estimate", "data", "alarm"):
        assert contrast("limit") <= contrast(role)
    assert LOOKS["limit"].width < min(LOOKS[role].width for role in ("estimate", "error", "alarm"))
