"""The page of a run, as a quality engineer opens, zooms and prints it."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
from browsers import colours, drag, overflow, range_of_x
from units_at_rest import thermal_bias, unit_at_rest

import driftlab
from driftlab.commands.run import show
from driftlab.evaluation.overview import POINTS, STRETCHES
from driftlab.reports.charts import LOOKS, Clock, content
from driftlab.reports.run import bias_chart, error_chart, event_shades, map_chart, nis_chart, result_sentences
from driftlab.units import RATE

CONFIG = """
serial: CRS-0042
latitude: 40.9 deg
heading: 0 deg
filter:
  gyro:
    noise: 3.18 deg/h/sqrt(Hz)
    bias: {kind: random_walk, walk: 1.5e-4 deg/s/sqrt(s)}
    calibration: {kind: polynomial, order: 3, path: map.json}
  accel:
    noise: 0.05 m/s/sqrt(h)
    bias: {kind: random_walk, walk: 2e-3 m/s/h/sqrt(s)}
limits: {coast: 90 deg/h, residual: 60 deg/h, swing: 2 deg/h, noise: 4 deg/h/sqrt(Hz)}
"""
UNITS = {"gyro": "rad/s", "accel": "m/s^2", "temperature": "degC", "time": "s"}


def samples(seconds, knock=None, seed=0, walk=2.6e-6):
    made = unit_at_rest(
        seconds=seconds, seed=seed, walk=walk, temperature=lambda t: 20 + 10 * np.sin(2 * np.pi * t / 1000)
    )
    if knock is not None:
        made.gyro[knock] += 0.3
    return {"time": made.t, **made.channels()}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return a run of 15 minutes with a knock at 10 minutes, and the folder that it was saved in."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "unit.yaml").write_text(CONFIG)
    driftlab.fit_map(folder / "unit.yaml", samples(1100, seed=1), units=UNITS).save(folder / "map.json")
    found = driftlab.run(folder / "unit.yaml", samples(900, slice(12_000, 12_060)), units=UNITS)
    found.save(folder / "out")
    return found, folder / "out"


@pytest.fixture
def page(run):
    return run[1] / "report.html"


def test_the_summary_has_serial_and_limits(run):
    found, out = run
    summary = json.loads((out / "summary.json").read_text())
    assert summary["serial"] == "CRS-0042"
    rows = {row["name"]: row for row in summary["limits"]}
    assert {name: row["verdict"] for name, row in rows.items()} == {
        "coast": "pass", "residual": "undecided", "swing": "fail", "noise": "pass",
    }  # fmt: skip
    assert found.verdict == "FAIL: swing of the map (2 of 4 limits kept; undecided: residual of the map)"
    for row in rows.values():  # as anybody can check it
        assert row["decision"] == row["verdict"]
        if row["decision"] == "pass":
            assert row["value"] + row["guard"] <= row["limit"]
        if row["decision"] == "fail":
            assert row["value"] - row["guard"] > row["limit"]
    assert rows["residual"]["would_decide"] == "too short a soak to say how sure; record 20 min"
    assert rows["coast"]["measured"] <= max(summary["coast_rmse_rad_s"]["10 min"]) * 1.5  # of all coasts of the run
    assert rows["noise"]["measured"] == pytest.approx(
        max(summary["noise_ratio"]["gyro"]) * np.deg2rad(3.18 / 3600), rel=0.2
    )
    assert rows["coast"]["unit"] == "rad/s"


def test_the_terminal_begins_with_the_verdict(run, capsys):
    found, out = run
    show(found, {"out": out})
    assert capsys.readouterr().out.startswith("FAIL: swing of the map (2 of 4 limits kept")


def test_at_the_top_stand_serial_verdict_and_limits(page, opened):
    shown = opened(page)
    assert "CRS-0042" in shown.locator("p.lead").nth(1).inner_text()
    verdict = shown.locator(".verdict").first
    assert verdict.get_attribute("class") == "verdict fail"
    assert verdict.bounding_box()["y"] < shown.locator("h2").first.bounding_box()["y"]
    assert shown.locator("table.limits td.pass").count() == 2
    undecided = shown.locator("table.limits td.undecided")
    colours = [undecided, shown.locator("table.limits td.fail"), shown.locator("table.limits td.pass").first]
    assert len({one.evaluate("e => getComputedStyle(e).color") for one in colours}) == 3
    assert "at most 5 % of the units" in shown.locator("p.rule").inner_text()
    assert shown.locator("table.limits td.fail").inner_text() == "fail"
    assert shown.locator("table.sheet").get_by_text(re.compile("SHA-256 [0-9a-f]{64}")).count() == 3
    assert "http" not in re.sub(r"https?://www\.w3\.org\S*", "", shown.locator("body").inner_text())


def test_every_figure_is_drawn_and_can_be_zoomed_and_read(page, opened):
    shown = opened(page)
    assert shown.locator("figure.chart").count() == 4
    assert all(colours(shown, k) > 5 for k in range(4))
    for chart in (0, 1):
        low, high = range_of_x(shown, chart)
        drag(shown, 0.4, 0.6, chart)
        near = range_of_x(shown, chart)
        assert near == pytest.approx([low + 0.4 * (high - low), low + 0.6 * (high - low)], abs=0.03 * (high - low))
    box = shown.locator("figure.chart").nth(1).locator(".u-over").first.bounding_box()
    shown.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    said = shown.locator("figure.chart").nth(1).locator(".read").inner_text()
    assert re.search(r"error x \[deg/h\]: .*estimate less reference -?\d.*, prediction less reference -?\d", said)


@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_it_in_its_width(page, opened, dark):
    assert overflow(opened(page, width=390, height=800, dark=dark)) == 0


def test_no_two_entries_of_a_legend_look_alike(run):
    found, _ = run
    for chart in (bias_chart(found.run), error_chart(found.run)):
        bands = {line.name: line.role for panel in chart.panels for line in panel.lines if line.y is None}
        shades = {shade.text: shade.role for shade in event_shades(found.journal, Clock(0.0, 1.0))}
        shades["refused"] = "refused"
        looks = [LOOKS[role] for role in (*bands.values(), *shades.values())]
        for ground in ("light", "dark"):
            assert len({getattr(look, ground) for look in looks}) == len(looks), chart.title


def test_motion_is_shaded_where_it_was(run):
    found, _ = run
    (shade, *_) = bias_chart(found.run).panels[0].shades
    assert (shade.text, shade.role) == ("moved", "moving")
    ((start, stop),) = found.summary["motion_s"]
    assert shade.start == pytest.approx((start - 0.1) / 60, abs=1e-6)  # the update that ends at start began before it
    assert shade.stop == pytest.approx(stop / 60, abs=1e-6)


def test_the_reference_is_broad_and_below_estimate_and_coast(run):
    found, _ = run
    lines = bias_chart(found.run).panels[0].lines
    roles = [line.role for line in lines if line.y is not None]
    assert roles == ["reference", "estimate", "coast"]
    assert [line.style for line in lines if line.y is not None] == ["line", "line", "dashed"]
    np.testing.assert_array_equal(lines[2].y[-1], found.bias[-1, 0] * RATE.factor)


def test_errors_are_those_of_every_row_in_a_scale_of_their_own(run):
    found, _ = run
    chart = error_chart(found.run)
    drawn = {line.name: line for line in chart.panels[2].lines}
    still = found.still.astype(bool) & np.isfinite(found.coast[:, 0])
    windows = [np.mean(found.rate[(abs(found.t - t) < 15 + 1e-9) & found.still.astype(bool), 2])
               for t in found.t[still][::50]]  # fmt: skip
    error = (found.coast[still][::50, 2] - windows) * RATE.factor
    line = drawn["prediction less reference"].y
    assert np.nanmin(line) <= error.min() + 0.05
    assert np.nanmax(line) >= error.max() - 0.05
    low, high = chart.panels[2].span
    assert low <= np.nanmin(line)
    assert np.nanmax(line) <= high
    assert high - low < 2.2 * (np.nanmax(line) - np.nanmin(line)) + 20  # and not by the coast's band


def test_a_page_stays_small(run):
    found, out = run
    for chart in (bias_chart, error_chart):
        for x in content(chart(found.run))["x"]:
            assert len(x) <= POINTS
    assert len(nis_chart(found.overview, found.model.m).panels[0].lines[1].x) <= 2 * STRETCHES
    assert (out / "report.html").stat().st_size < 1.5e6


def test_a_plot_shows_what_the_page_shows(run):
    found, _ = run
    axes = found.plot().axes
    assert [panel.get_ylabel() for panel in axes][3] == "error x [deg/h]"
    estimate = next(line for line in axes[0].get_lines() if line.get_label() == "estimate, ± 2σ")
    dashed = next(line for line in axes[0].get_lines() if line.get_label() == "prediction")
    assert (estimate.get_linestyle(), dashed.get_linestyle()) == ("-", "--")
    assert estimate.get_color() != dashed.get_color()


def printed_lines(path, folder):
    """Return the lines of text of each page of a PDF, from its top to its end."""
    subprocess.run(["pdftotext", "-bbox", str(path), str(folder / "words.html")], check=True)
    pages = (folder / "words.html").read_text().split("<page ")[1:]
    found = []
    for text in pages:
        boxes = re.findall(r'xMin="([\d.]+)" yMin="[\d.]+" xMax="[\d.]+" yMax="([\d.]+)">(.*?)</word>', text)
        words = [(round(float(y)), float(x), word) for x, y, word in boxes]
        rows = groupby(sorted(words), key=lambda word: word[0])
        found.append([" ".join(word for *_, word in row) for _, row in rows])
    return found


@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="pdftotext is not installed")
def test_on_paper_no_heading_is_left_alone_and_there_is_where_to_sign(page, opened, tmp_path):
    shown = opened(page)
    headings = {text.strip() for text in shown.locator("h1, h2, h3").all_inner_texts()}
    shown.pdf(path=tmp_path / "page.pdf", prefer_css_page_size=True)
    pages = printed_lines(tmp_path / "page.pdf", tmp_path)
    assert 3 <= len(pages) <= 10
    every = [line for lines in pages for line in lines]
    assert headings <= set(every)
    for lines in pages:
        assert lines[-1] not in headings
    first = pages[0]
    (signed,) = [k for k, line in enumerate(first) if "measured by checked by date" in line]
    (result,) = [k for k, line in enumerate(first) if line.startswith("Without updates the bias of ")]
    (error,) = [k for k, line in enumerate(first) if line.startswith("prediction, 10 min ")]
    assert result < error < signed  # on the sheet that is signed
    assert "dark / light" not in every


def test_what_is_drawn_over_temperature_has_no_loop_that_the_unit_has_not(run):
    folder = run[1].parent
    made = unit_at_rest(seconds=900, walk=0.0, temperature=lambda t: 11 + 18 * np.abs(t / 300 % 1 - 0.5) * 2)
    found = driftlab.run(folder / "unit.yaml", {"time": made.t, **made.channels()}, units=UNITS)
    chart = map_chart(found.config.maps()[0].load(), found.overview, RATE, ("x", "y", "z"))
    dots = chart.panels[1].lines[0]  # of y, whose bias is straight: a mean over 30 s is on the line, but where T turns
    off = dots.y / RATE.factor - thermal_bias(dots.x)[:, 1]
    # 1.54e-5 rad/s/sqrt(Hz) over 30 s is 2.8e-6, the means about a turn 3e-6; the smoothed temperature makes 4e-5
    assert np.sqrt(np.nanmean((off - np.nanmean(off)) ** 2)) < 8e-6


def test_without_an_axis_that_is_known_as_up_nothing_is_said_of_the_heading(run):
    scores = run[0].overview.yardsticks
    unknown = replace(scores, heading=dict.fromkeys(scores.heading, np.nan))
    without = replace(run[0].run, overview=replace(run[0].overview, yardsticks=unknown))
    assert "turn the heading by" in result_sentences(run[0].run)[1]
    assert "heading" not in result_sentences(without)[1]


def test_the_headline_is_of_all_predictions_as_their_limit_is(run, tmp_path):
    """The bias goes away by 200 deg/h in a quarter of an hour, long after the first prediction."""
    steady = {"seconds": 2600, "rate": 5.0, "walk": 2e-7}
    made = unit_at_rest(**steady, temperature=lambda t: 20 + 9 * np.sin(2 * np.pi * t / 1000))
    made.gyro[:, 1] += np.clip(made.t - 1300, 0, 900) / 900 * np.deg2rad(200 / 3600)
    found = driftlab.run(run[1].parent / "unit.yaml", {"time": made.t, **made.channels()}, units=UNITS)
    result, use = result_sentences(found.run)
    (row,) = [row for row in found.judged if row.name == "coast"]
    assert "4 predictions of 10 min" in row.note
    value = f"{np.max(found.run.measured['coast'].values) * RATE.factor:.2f}"
    first = f"{found.overview.yardsticks.coast['10 min'][1] * RATE.factor:.2f}"
    assert result == (
        f"Without updates the bias of y is predicted over 10 min to {value} deg/h rms of 4 predictions; "
        f"the first is off by {first} deg/h."
    )
    assert re.match(r"the first 10 min without updates turn the heading by \S+ deg; sigma of y over all 4 is ", use)
    found.save(tmp_path / "out")
    (cells,) = re.findall(
        r"<td>prediction, all 4 of 10 min</td><td>(.*?)</td></tr>", (tmp_path / "out" / "report.html").read_text()
    )
    assert cells.split("</td><td>")[1].startswith(f"{value} (")
