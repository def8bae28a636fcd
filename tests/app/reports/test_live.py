"""The page of a live run in a browser, with a status and a history that are made up."""

import time
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest
from browsers import colours, drag, overflow, range_of_x
from playwright.sync_api import expect

from driftlab.live import history as live_watch
from driftlab.live.growing_map import GrowingMapStatus
from driftlab.live.history import LiveHistory, column_names
from driftlab.live.server import Server, serving
from driftlab.live.status import Status
from driftlab.reports.live import live_page

DEG_H = np.pi / 180 / 3600
AXES = ("x", "y", "z")
expect.set_options(timeout=60_000)
GYRO = SimpleNamespace(channel="gyro", axes=AXES, unit="rad/s", shown="deg/h")


class Shown:
    """A page's server, and what it is told."""

    def __init__(self, port=0):
        self.watch, self.status, self.t = LiveHistory(AXES, "raw.h5"), Status(axes=AXES, m=3, sensor=GYRO), 0.0
        html = live_page("bench & <unit>", GYRO, column_names(AXES), device="/dev/ttyUSB0", results="out", serial="7")
        self.server = Server(port, html, self.watch)

    def goes_on(self, seconds, **flags):
        """Updates at 10 Hz."""
        t = self.t + np.arange(1, round(seconds * 10) + 1) / 10
        self.t = float(t[-1])
        names = column_names(AXES)
        rows = np.zeros((len(t), len(names)))
        rows[:, 0], rows[:, names.index("nis")], rows[:, names.index("temperature")] = t, 1.1, 25 + np.sin(t / 60)
        for k in range(3):
            for end in ("", "_low", "_high"):
                rows[:, names.index(f"bias_{k}{end}")] = (k + 1) * 10 * DEG_H + np.cos(t / 9) * DEG_H
            rows[:, names.index(f"sigma_{k}")] = DEG_H
        for name, value in flags.items():
            rows[:, names.index(name)] = value
        for history in self.watch.histories.values():
            history.add(rows)
        now = self.status
        now.phase, now.samples, now.t, now.waiting, now._heard = "listening", len(t), self.t, None, time.monotonic()
        now.bias, now.sigma, now.temperature, now.temperature_rate = (
            np.array([10, 20, 30]) * DEG_H,
            np.full(3, DEG_H),
            25.5,
            0.01,
        )
        now._nis.extend(np.full(50, 3.3))
        self.watch.report(now)


@pytest.fixture
def shown(monkeypatch):
    monkeypatch.setattr(live_watch, "PERIOD", 0.0)
    found = Shown()
    with serving(found.server):
        yield found
        found.server.tabs.clear()


def until(page, true):
    """Wait for what no text says."""
    begun = time.monotonic()
    while not true():
        assert time.monotonic() - begun < 60
        page.wait_for_timeout(100)


def legend(page, chart=0):
    return page.locator("figure.chart").nth(chart).locator(".key").all_inner_texts()


def test_it_shows_what_the_run_says(shown, opened):
    page = opened(shown.server.url, wait=False)
    expect(page.locator("#words")).to_have_text("getting ready")
    expect(page.locator("#empty")).to_be_visible()
    shown.goes_on(120)
    expect(page.locator("#state")).to_have_attribute("data-level", "good")
    expect(page.locator("#words")).to_have_text("at rest")
    expect(page.locator("h1")).to_have_text("bench & <unit>")
    expect(page.locator("p.lead").first).to_have_text("serial 7 · /dev/ttyUSB0")
    for k in range(3):
        expect(page.locator(f"[data-bias='{k}']")).to_have_text(f"{10 * (k + 1)}.00 deg/h")
        expect(page.locator(f"[data-bias='{k}'] + dd")).to_have_text("± 1.00 deg/h, one sigma")
    expect(page.locator("#temperature")).to_have_text("25.50 °C")
    expect(page.locator("#rate")).to_have_text("+0.600 K/min")
    expect(page.locator("#nis")).to_have_text("1.10")
    expect(page.locator("#time")).to_have_text("0:02:00")
    expect(page.locator("#empty")).to_be_hidden()
    assert page.title() == "✓ at rest"
    until(page, lambda: range_of_x(page) == [pytest.approx(0.4, abs=0.1), 120.0])
    assert colours(page) > 5
    assert page.locator("#biases canvas").count() == 3
    labels = page.locator("#figures .label").all_inner_texts()
    assert [text for text in labels if not text.endswith("]")] == [], "each has its unit"
    shown.goes_on(60)
    until(page, lambda: range_of_x(page)[1] == 180.0)


def test_what_was_not_used_and_what_is_missing_is_shaded(shown, opened):
    shown.goes_on(30)
    shown.goes_on(10, moving_high=1.0)
    shown.t += 20.0
    shown.goes_on(10)
    shown.goes_on(10, refused_high=1.0)
    page = opened(shown.server.url, wait=False)
    until(page, lambda: legend(page) == ["± 2 sigma", "least to most", "estimate", "moving", "no data", "refused"])
    shades = page.evaluate("document.querySelector('figure.chart').chart.content.panels[0].shades")
    spans = {shade["text"]: (shade["start"], shade["stop"]) for shade in shades}
    assert spans["moving"] == (pytest.approx(30, abs=0.6), pytest.approx(40, abs=0.6))
    assert spans["no data"] == (pytest.approx(40, abs=0.6), pytest.approx(60, abs=0.6))
    assert spans["refused"] == (pytest.approx(70, abs=0.6), pytest.approx(80, abs=0.6))


def test_silence_moves_on(shown, opened):
    shown.goes_on(30)
    page = opened(shown.server.url, wait=False)
    expect(page.locator("#words")).to_have_text("at rest")
    shown.status._heard = time.monotonic() - 12.2
    shown.status.faults.unavailable = "unplugged, waiting for /dev/ttyUSB0"
    shown.watch.report(shown.status)
    expect(page.locator("#state")).to_have_attribute("data-level", "bad")
    expect(page.locator("#words")).to_have_text("no data for 12 s")
    expect(page.locator("#why")).to_have_text("unplugged, waiting for /dev/ttyUSB0")
    until(page, lambda: range_of_x(page)[1] == pytest.approx(42.0, abs=1.0))
    assert "no data" in legend(page)


def test_it_goes_without_a_mouse_and_a_zoom_stays(shown, opened):
    shown.goes_on(300)
    page = opened(shown.server.url, wait=False)
    until(page, lambda: page.locator("#biases canvas").count() == 3)
    drag(page, 0.25, 0.5)
    until(page, lambda: range_of_x(page)[1] < 200)
    zoomed = range_of_x(page)
    shown.goes_on(10)
    expect(page.locator("#time")).to_have_text("0:05:10")
    page.wait_for_timeout(200)
    assert range_of_x(page) == zoomed
    page.get_by_role("button", name="last minute").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="last minute")).to_have_attribute("aria-pressed", "true")
    until(page, lambda: range_of_x(page) == [pytest.approx(250, abs=1), 310.0])
    page.keyboard.press("Shift+Tab")
    page.keyboard.press("Shift+Tab")
    page.keyboard.press(" ")
    until(page, lambda: range_of_x(page) == [pytest.approx(0.4, abs=0.1), 310.0])


@pytest.mark.parametrize("width", [390, 1900])
@pytest.mark.parametrize("dark", [False, True])
def test_it_fits_a_phone_and_a_bench(shown, opened, width, dark):
    shown.status.faults.add("bytes dropped because the program was slower than the device", 123_456, "after 1,234.5 s")
    shown.goes_on(60)
    page = opened(shown.server.url, width=width, height=1060, dark=dark, wait=False)
    until(page, lambda: page.locator("#others canvas").count() == 5)
    assert overflow(page) == 0
    for tile in page.locator("#numbers > div").all():
        assert tile.evaluate("e => e.scrollWidth <= e.clientWidth"), tile.inner_text()
    expect(page.locator("#lines li")).to_have_text(shown.status.lines())


def test_the_map_that_is_fitted_meanwhile(shown, opened):
    page = opened(shown.server.url, wait=False)
    shown.goes_on(10)
    expect(page.locator("#words")).to_have_text("at rest")
    expect(page.locator("#map")).to_be_hidden()
    shown.status.map = GrowingMapStatus("polynomial", asked=(-20.0, 50.0))
    shown.goes_on(1)
    expect(page.locator("#map")).to_be_visible()
    expect(page.locator("#map figure")).to_be_hidden()
    T = np.linspace(-20, 20, 41)
    seen, asked = (-20.0, 20.0), (-20.0, 50.0)
    sigma = np.abs(T[:, None]) * DEG_H * np.array([1, 2, 3]) / 10 + DEG_H
    shown.status.map = GrowingMapStatus(
        "polynomial", 1000, seen, asked, 0.57, ((20.0, 50.0),), T=T, bias=sigma, sigma=sigma, wanted=3 * DEG_H, why="",
        axes=AXES,
    )  # fmt: skip
    shown.goes_on(1)
    until(page, lambda: page.locator("#map canvas").count() == 3)  # an axis each: none is drawn over another
    expect(page.locator("#map-lines li")).to_have_text(shown.status.map.lines())
    assert legend(page, 2) == ["sigma", "not seen yet"]
    labels = page.locator("#map .panels .label").all_inner_texts()
    assert labels == [f"sigma of the map, gyro {axis} [deg/h]" for axis in AXES]
    assert tuple(range_of_x(page, 2)) == asked


@pytest.mark.parametrize("failed", [False, True])
def test_the_end_is_told_and_stays(shown, opened, failed):
    shown.goes_on(30)
    page = opened(shown.server.url, wait=False)
    expect(page.locator("#words")).to_have_text("at rest")
    shown.watch.end(["what one should know"], "out", failed=failed)
    expect(page.locator("#words")).to_have_text("ended with an error" if failed else "finished")
    expect(page.locator("#how")).to_have_text("The run failed" if failed else "Finished, results are in out")
    expect(page.locator("#found li")).to_have_text(["what one should know"])
    until(page, lambda: not shown.server.tabs)


def test_it_says_when_its_server_is_gone_and_goes_on_with_the_next(monkeypatch, opened):
    monkeypatch.setattr(live_watch, "PERIOD", 0.0)
    with ExitStack() as first:
        shown = Shown()
        first.enter_context(serving(shown.server))
        shown.goes_on(30)
        page = opened(shown.server.url, wait=False)
        expect(page.locator("#words")).to_have_text("at rest")
        shown.server.tabs.clear()
    expect(page.locator("#words")).to_have_text("connection to driftlab lost, trying again")
    expect(page.locator("#state")).to_have_attribute("data-level", "bad")
    again = Shown(shown.server.server_address[1])
    again.goes_on(3600)
    with serving(again.server):
        expect(page.locator("#words")).to_have_text("at rest", timeout=30_000)
        expect(page.locator("#time")).to_have_text("1:00:00")
        page.close()
        again.server.tabs.clear()
    refused = [text for text in opened.problems if "ERR_CONNECTION_RE" in text]  # the browser's own words
    assert refused
    assert opened.problems == refused
    opened.problems.clear()
