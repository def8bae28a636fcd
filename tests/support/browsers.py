"""A page in a browser, as a reader opens it: Chromium without a window and without a network."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tools import tool

NAMES = ("chromium", "chromium-browser", "google-chrome")
HERE = ("file:", "data:", "blob:", "http://127.0.0.1", "http://localhost", "http://[::1]")


@contextmanager
def started() -> Iterator:
    """Yield a browser."""
    from playwright.sync_api import sync_playwright

    path = tool(*NAMES)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


class Opened:
    """Opens pages, and keeps what went wrong on them: `problems` holds what must not be there at the end."""

    def __init__(self, browser) -> None:
        self.browser, self.contexts, self.problems = browser, [], []

    def __call__(
        self, where: str | Path, *, width: int = 1100, height: int = 1400, dark: bool = False, wait: bool = True
    ):
        """Return a page: of a file, or of an address on this machine; with `wait`, once its charts are drawn."""
        context = self.browser.new_context(
            viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light"
        )
        self.contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(60_000)
        page.on("console", lambda m: self.problems.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("request", lambda r: None if r.url.startswith(HERE) else self.problems.append(f"asked for {r.url}"))
        page.goto(Path(where).resolve().as_uri() if isinstance(where, Path) else where)
        if wait:
            page.wait_for_function(
                "[...document.querySelectorAll('figure.chart')].every(f => f.querySelector('canvas'))"
            )
        return page

    def close(self) -> None:
        """Close every page, and fail where one complained."""
        for context in self.contexts:
            context.close()
        assert not self.problems, self.problems


def overflow(page) -> int:
    """Return by how many pixels a page is wider than its window."""
    return page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")


def assert_nothing_is_cut_in_silence(page) -> None:
    """Assert that whatever scrolls sideways is announced, above it and in sight."""
    silent = page.evaluate(
        """() => [...document.querySelectorAll('body *')].filter((box) => box.clientWidth > 0
          && box.scrollWidth > box.clientWidth + 1 && box.checkVisibility()
          && ['auto', 'scroll', 'hidden'].includes(getComputedStyle(box).overflowX)
          && !box.closest('figure.chart') && getComputedStyle(box).clipPath === 'none'
          && !(box.previousElementSibling?.matches('.hint') && box.previousElementSibling.offsetHeight > 0))
          .map((box) => `${box.tagName} ${box.className} ${box.textContent.slice(0, 40)}`)"""
    )
    assert not silent


def assert_fits_on_paper(page) -> None:
    """Assert that nothing is wider than a sheet of A4 between its margins, else all of it is printed smaller."""
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert overflow(page) == 0


def assert_drawn_everywhere(opened, where: Path, figures: int) -> None:
    """Assert that a page fits its window and draws its figures: on a desk and on a phone, in light and dark."""
    for width, dark in ((1100, False), (390, False), (1100, True)):
        shown = opened(where, width=width, dark=dark)
        assert overflow(shown) == 0
        assert_nothing_is_cut_in_silence(shown)
        assert shown.locator("figure.chart").count() == figures
        shown.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
        shown.wait_for_function("driftlab.charts.every((c) => c.plots.every((p) => p.width === c.width()))")
        assert overflow(shown) == 0
        assert all(colours(shown, k) > 5 for k in range(figures))
        ground = shown.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (ground == "rgb(255, 255, 255)") is not dark


def range_of_x(page, chart: int = 0) -> list[float]:
    """Return what the x axis of a chart shows: from, to."""
    return page.evaluate(
        """k => { const x = document.querySelectorAll('figure.chart')[k].chart.plots[0].scales.x;
        return [x.min, x.max]; }""",
        chart,
    )


def drag(page, start: float, stop: float, chart: int = 0) -> None:
    """Drag over a chart's first panel, from one share of its width to another."""
    panel = page.locator("figure.chart").nth(chart).locator(".u-over").first
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + start * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + stop * box["width"], middle, steps=5)
    page.mouse.up()


def colours(page, chart: int = 0) -> int:
    """Return how many colours a chart's panels are drawn in: one where nothing is drawn."""
    return page.evaluate(
        """k => { const seen = new Set();
        for (const c of document.querySelectorAll('figure.chart')[k].querySelectorAll('canvas')) {
          const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
          for (let i = 0; i < d.length; i += 4) if (d[i + 3] > 200) seen.add((d[i] << 16) | (d[i + 1] << 8) | d[i + 2]);
        }
        return seen.size; }""",
        chart,
    )
