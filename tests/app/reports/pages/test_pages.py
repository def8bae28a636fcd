"""Abilities of every page, in a browser: figures that are drawn, zoomed, read, switched and printed."""

from pathlib import Path

import jinja2
import numpy as np
import pytest
from browsers import colours, drag, overflow, range_of_x

from driftlab.reports import pages
from driftlab.reports.charts import LOOKS, SERIES, Chart, Line, Panel, Rule, Shade, content, series
from driftlab.reports.pages import embedded, environment, interactive, looks, prose, quoted

BODY = """{% extends "base.html" %}{% block title %}charts{% endblock %}{% block body %}<h1>Charts</h1>
{% for chart in charts %}<h2>{{ chart.title }}</h2>{{ interactive(chart) }}{% endfor %}
<table><thead><tr>{% for k in range(20) %}<th>column {{ k }} [deg/h]</th>{% endfor %}</tr></thead>
<tbody><tr>{% for k in range(20) %}<td>value {{ k }}</td>{% endfor %}</tr></tbody></table>{% endblock %}"""
NASTY = "</script><script>document.title = 'broken'</script>"


def bias_chart(name="estimate"):
    t = np.linspace(0, 4, 800)
    T = 20 + 5 * t
    estimate = Line(t, np.sin(t), name, "estimate", np.sin(t) - 0.2, np.sin(t) + 0.2)
    coast = Line(t[100:], np.cos(t[100:]), "coast", "coast", style="dashed")
    first = Panel((estimate, coast), "bias x [deg/h]", (Shade(1, 2, "refused"),), (Rule(1.5, "limit"),))
    second = Panel((Line(t, T, "temperature", "temperature"),), "temperature [°C]")
    return Chart((first, second), "time [h]", "Bias", "what it is")


def log_chart():
    tau = np.logspace(0, 4, 30)
    points = Line(tau, tau**-0.5, "Allan", low=tau**-0.5 / 2, high=tau**-0.5 * 2, style="points")
    return Chart((Panel((points,), "deviation [deg/h]", log=True),), "averaging time [s]", "Allan", log=True)


@pytest.fixture
def written(tmp_path, monkeypatch) -> Path:
    """Write a page of charts, as a template of the package."""
    package = jinja2.PackageLoader("driftlab.reports", "pages")
    both = jinja2.ChoiceLoader([jinja2.DictLoader({"charts.html": BODY}), package])
    monkeypatch.setattr(environment(), "loader", both)
    path = tmp_path / "charts.html"
    pages.write_page(path, "charts", charts=[bias_chart(), log_chart(), bias_chart(NASTY)])
    return path


def test_a_page_holds_all_it_needs(written, opened):
    shown = opened(written)
    assert shown.title() == "charts"  # no name of a line is taken for a part of the page
    assert shown.locator("figure.chart").count() == 3
    assert all(colours(shown, k) > 5 for k in range(3))
    assert written.stat().st_size < 400_000


def test_a_drag_zooms_all_panels_and_a_double_click_shows_all_again(written, opened):
    shown = opened(written)
    assert range_of_x(shown) == [0, 4]
    drag(shown, 0.25, 0.5)
    low, high = range_of_x(shown)
    assert low == pytest.approx(1.0, abs=0.1)
    assert high == pytest.approx(2.0, abs=0.1)
    both = shown.evaluate(
        "document.querySelector('figure.chart').chart.plots.map(p => [p.scales.x.min, p.scales.x.max])"
    )
    assert both[0] == pytest.approx(both[1], abs=0.02)
    shown.locator(".u-over").first.dblclick()
    assert range_of_x(shown) == [0, 4]


def test_keys_zoom_and_move(written, opened):
    shown = opened(written)
    shown.locator(".panels").first.focus()
    shown.keyboard.press("+")
    assert range_of_x(shown) == [1, 3]
    shown.keyboard.press("ArrowRight")
    assert range_of_x(shown) == [1.5, 3.5]
    shown.keyboard.press("Escape")
    assert range_of_x(shown) == [0, 4]


def test_what_is_under_the_cursor_is_said_with_its_band(written, opened):
    shown = opened(written)
    panel = shown.locator(".u-over").first
    box = panel.bounding_box()
    shown.mouse.move(box["x"] + box["width"] / 2, box["y"] + 20)
    said = shown.locator(".read").first.inner_text()
    value, low, high = 0.909, 0.709, 1.109  # sin(2), and 0.2 about it
    words = said.replace("(", " ").replace(")", " ").replace(",", " ").split()
    numbers = [float(word) for word in words if word.replace(".", "").replace("-", "").isdigit()]
    assert numbers[:4] == pytest.approx([2, value, low, high], abs=0.01)


def test_a_line_can_be_switched_off_and_on(written, opened):
    shown = opened(written)
    before = colours(shown)
    key = shown.locator("figure.chart").first.get_by_role("button", name="coast")
    key.click()
    assert key.get_attribute("aria-pressed") == "false"
    without = colours(shown)
    assert without < before
    key.click()
    assert colours(shown) == before


@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_all_of_it_in_its_width(written, opened, dark):
    shown = opened(written, width=390, height=800, dark=dark)
    assert overflow(shown) == 0
    ground = shown.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (ground == "rgb(255, 255, 255)") is not dark


def test_a_table_that_is_wider_than_a_phone_is_cards_there_and_a_table_on_paper(written, opened):
    shown = opened(written, width=390, height=800)
    last = shown.locator("td").last
    assert shown.evaluate("document.querySelector('table').scrollWidth <= innerWidth")
    assert last.bounding_box()["x"] + last.bounding_box()["width"] <= 390
    assert last.evaluate("cell => getComputedStyle(cell, '::before').content") == '"column 19 [deg/h]"'
    shown.emulate_media(media="print")
    assert last.evaluate("cell => getComputedStyle(cell, '::before').content") == "none"
    assert last.evaluate("cell => getComputedStyle(cell).display") == "table-cell"


def test_on_paper_it_is_light_and_as_wide_as_the_paper(written, opened):
    shown = opened(written, dark=True)
    shown.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert shown.evaluate("document.documentElement.dataset.theme") == "light"
    assert shown.evaluate("document.querySelector('canvas').parentElement.clientWidth") == 680
    shown.evaluate("dispatchEvent(new Event('afterprint'))")
    assert shown.evaluate("document.documentElement.dataset.theme") is None


def test_numbers_that_are_none_are_gaps_and_equal_times_are_there_once():
    t = np.arange(3.0)
    lines = (Line(t, np.array([1, np.nan, np.inf]), "a"), Line(t.copy(), t, "b"))
    found = content(Chart((Panel(lines, "y [1]"),), "t [s]"))
    assert found["x"] == [[0, 1, 2]]
    assert found["panels"][0]["lines"][0]["y"] == [1, None, None]


@pytest.mark.parametrize("scale", [1e-25, 1e-9, 1.0, 1e15, 1e25])
def test_numbers_of_a_chart_are_those_that_their_texts_are_read_as(scale):
    # halves are the middle of two numbers, powers of ten the end of one number of digits
    drawn, halves = np.random.default_rng(1).standard_normal(2000), np.arange(-2e6, 2e6, 12345.5)
    values = np.concatenate([drawn, halves, 10.0 ** np.arange(-9, 9), np.nextafter(1e-5, [0, 1]), [0.0, -0.0]]) * scale
    found = content(Chart((Panel((Line(values, values, "a"),), "y"),), "x"))
    for digits, numbers in ((9, found["x"][0]), (6, found["panels"][0]["lines"][0]["y"])):
        assert list(map(repr, numbers)) == [repr(float(f"{value:.{digits}g}")) for value in values]


def test_text_in_json_cannot_end_its_script():
    assert "<" not in embedded({"name": NASTY})
    assert "<script>document.title" not in interactive(bias_chart(NASTY))


def test_text_in_a_style_is_itself_and_cannot_end_it(opened, tmp_path):
    text = 'SN "0412" \\ </style>;é'
    path = tmp_path / "quoted.html"
    path.write_text(f"<meta charset='utf-8'><style>p::before {{ content: {quoted(text)} }}</style><p></p>", "utf-8")
    shown = opened(path, wait=False).evaluate("getComputedStyle(document.querySelector('p'), '::before').content")
    assert shown == '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def test_each_role_can_be_told_from_the_ground_in_light_and_dark():
    def luminance(colour):
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
        return np.dot([0.2126, 0.7152, 0.0722], linear)

    for role, look in LOOKS.items():
        least = 1.9 if look.width > 2 else 3.0  # of graphics, by WCAG 2; a broad line is seen before
        assert 1.05 / (luminance(look.light) + 0.05) > least, role
        assert (luminance(look.dark) + 0.05) / (luminance("#15171a") + 0.05) > 3.0, role


def test_no_config_of_a_comparison_has_the_colour_of_the_temperature():
    compared = {series(k) for k in range(SERIES)}
    for ground in ("light", "dark"):
        seen = [getattr(LOOKS[role], ground) for role in (*compared, "temperature")]
        assert len(set(seen)) == len(seen)


def test_the_looks_of_a_page_are_those_of_the_roles():
    assert looks()["estimate"]["light"] == LOOKS["estimate"].light


def test_commands_in_a_sentence_are_code_and_nothing_else_is_markup():
    assert (
        str(prose("run `driftlab explain <b>`, or ` wait")) == "run <code>driftlab explain &lt;b&gt;</code>, or ` wait"
    )
    assert str(prose(NASTY)) == "&lt;/script&gt;&lt;script&gt;document.title = &#39;broken&#39;&lt;/script&gt;"
