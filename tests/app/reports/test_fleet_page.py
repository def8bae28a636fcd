"""The page of a fleet in a browser: what it says, its table, its size, without a network."""

import json
from dataclasses import replace

import numpy as np
import pytest
from browsers import assert_drawn_everywhere, assert_fits_on_paper, overflow
from lines import AXES, DEG_H, line

from driftlab.config import Limits
from driftlab.evaluation.limits import verdict_of_units
from driftlab.family.outliers import Outlier
from driftlab.family.record import FIGURES, Figure, RepeatedSoak, figure_name
from driftlab.reports import fleet as fleet_rows
from driftlab.reports import line_charts
from driftlab.reports.fleet import write_fleet_report
from driftlab.reports.fleet_charts import FleetOverview, SharedEffectRow, percentiles
from driftlab.reports.line_charts import control_charts
from driftlab.spc.acknowledgements import new_notes, of_outlier
from driftlab.spc.gauge_study import gauge_study
from driftlab.spc.line import line_of
from driftlab.spc.sentences import in_tables
from driftlab.spc.yields import yields_of
from driftlab.units import RATE

LIMITS = Limits.model_validate({"noise": "2.6 deg/h/sqrt(Hz)"})
T = np.linspace(-20, 60, 41)
MEAN = 100 * np.tanh(np.tile(T, (3, 1)) / 30) * DEG_H
NASTY = "</script><script>document.title = 'broken'</script>"


def fleet(count, seed=0, failed=(), odd=(), **more):
    """Return an overview of units, some of which failed or are odd."""
    records = line(count, seed, planted=[("noise", "x", count * 3 // 5, count, 3.0)])
    for k, one in enumerate(records):
        noise = max(one.figures["noise"].value)
        judged = [{"name": "noise", "verdict": "fail" if noise > LIMITS.noise else "pass"}]
        records[k] = one.model_copy(update={"limits": judged, "more": {"chamber": "AB"[k % 2]}})
    for k in failed:
        gone = {
            "state": "failed",
            "error": f"no file of unit {k}; {NASTY}",
            "figures": {},
            "domain": None,
            "limits": [],
        }
        records[k] = records[k].model_copy(update=gone)
    done = [k for k in range(count) if k not in failed]
    rng = np.random.default_rng(seed)
    curves = rng.normal(size=(len(done), 3, 1)) * 60 * DEG_H + MEAN
    why = {
        f"{k:04d}": (Outlier(f"{k:04d}", "shape", "z", 1e-6, 1.0, 41.0, "z bends at 41 degC", ("noise",)),) for k in odd
    }
    known = {
        "title": "line", "records": records, "unit": RATE, "line": line_of(records, LIMITS), "T": T,
        "curves": curves.astype(np.float32), "drawn": [f"{k:04d}" for k in done], "mean": MEAN,
        "odd": why, "links": {unit: f"units/{unit}/page/report.html" for unit in why},
    }  # fmt: skip
    return FleetOverview(**{**known, **more})


@pytest.fixture(scope="module")
def overview():
    effect = SharedEffectRow("hysteresis", "hysteresis: 2.1 deg/h a K", "deg/h/K", (("L00", 12, "x", 2.1, 0.2),))
    return fleet(120, failed=(7, 30), odd=(11, 45), effects=(effect,), remarks=("a remark",))


@pytest.fixture(scope="module")
def path(overview, tmp_path_factory):
    path = tmp_path_factory.mktemp("fleet") / "report.html"
    write_fleet_report(path, overview)
    return path


def cells(shown, column):
    """Return the texts of a column of the rows that are drawn."""
    heads = shown.locator(".rows th button").all_inner_texts()
    return shown.eval_on_selector_all(
        ".rows tbody tr:not(.gap)", "(rows, k) => rows.map((row) => row.cells[k].textContent)", heads.index(column)
    )


def test_it_says_what_the_fleet_is(path, overview, opened):
    shown = opened(path)
    text = shown.locator("body").inner_text()
    (first, *rest), tables = overview.line.sentences, in_tables(overview.line)
    assert not set(rest) <= tables
    for said in (
        "120 units: 118 done, 2 failed", "2 odd", first, *(one for one in rest if one not in tables),
        "z bends at 41 degC; noise as the family",
        "no file of unit 7", "hysteresis: 2.1 deg/h a K", "a remark", "240.0 h",
        verdict_of_units(one.limits for one in overview.records).capitalize(),
    ):  # fmt: skip
        assert said in text
    assert shown.locator(".verdict.fail").inner_text().startswith("Limits: ")
    assert shown.title() == "line"  # no text of a file is taken for a part of the page
    rows = [row for row in overview.line.capability if row.quantity == "noise"]
    assert {row.trusted for row in rows} == {True, False}  # x, which has changed, is not normal over the whole line
    for row in rows:
        said = f"({row.cpk_low:.2f} to {row.cpk_high:.2f})\t{row.ppk:.2f} (" if row.trusted else f"none: {row.why_not}"
        assert said in text


def test_all_of_it_is_drawn_on_a_desk_and_on_a_phone(path, opened):
    assert_drawn_everywhere(opened, path, figures=2 + 5 + 1 + 5)


def test_every_panel_and_every_figure_has_its_unit(path, opened):
    shown = opened(path)
    labels = shown.locator(".panels .label").all_text_contents()
    assert len(labels) == 7 + 2 * 15 + 6 + 5 * 6  # values and moving ranges, against the limit, lots
    assert all("[" in label for label in labels if label != "units measured")
    shown.select_option("#columns", "all")
    heads = shown.locator(".rows th button").all_inner_texts()
    figures = [head for head in heads if head.split()[0] in map(figure_name, FIGURES)]
    assert len(figures) == 15
    assert all(head.endswith("]") for head in figures)


def test_rows_sort_by_number_and_back_and_what_is_not_known_is_last(path, overview, opened):
    shown = opened(path)
    column = "noise [deg/h/sqrt(Hz)]"
    button = shown.get_by_role("button", name=column)
    worst = sorted(max(one.figures["noise"].value) / DEG_H for one in overview.records if one.figures)
    for direction, expected in (("ascending", worst), ("descending", worst[::-1])):
        button.click()
        assert button.locator("..").get_attribute("aria-sort") == direction
        found = [float(text) for text in cells(shown, column)]
        assert found == pytest.approx(expected[: len(found)], rel=6e-4)
    shown.evaluate("document.querySelector('.rows').scrollTop = 1e6")
    shown.wait_for_function("[...document.querySelectorAll('.rows tbody tr')].at(-2).textContent.includes('–')")
    assert cells(shown, column)[-2:] == ["–", "–"]


def test_names_sort_as_one_counts(opened, tmp_path):
    records = [one.model_copy(update={"unit": f"u{k}"}) for k, one in zip((10, 9, 1, 2), line(4), strict=True)]
    path = tmp_path / "report.html"
    write_fleet_report(path, fleet(4, records=records, drawn=[], odd={}, line=line_of([], None)))
    shown = opened(path)
    shown.get_by_role("button", name="unit", exact=True).click()
    assert cells(shown, "unit") == ["u1", "u2", "u9", "u10"]


def test_rows_are_filtered_by_lot_state_verdict_and_text(path, overview, opened):
    shown = opened(path)
    count = shown.locator("#count")
    assert count.inner_text() == "120 of 120 units"
    shown.select_option("#state", "odd")
    assert cells(shown, "unit") == ["0011", "0045"]
    shown.select_option("#state", "failed")
    assert cells(shown, "unit") == ["0007", "0030"]
    shown.select_option("#state", "")
    shown.select_option("#lot", label="L03")
    assert set(cells(shown, "lot")) == {"L03"}
    assert count.inner_text() == "12 of 120 units"
    shown.select_option("#lot", "")
    shown.select_option("#verdict", label="fail")
    failing = sum(row.get("verdict") == "fail" for one in overview.records for row in one.limits)
    assert count.inner_text() == f"{failing} of 120 units"
    shown.select_option("#verdict", "")
    shown.fill("#find", "BENDS AT 41")
    assert cells(shown, "unit") == ["0011", "0045"]


def test_units_link_to_their_pages(path, opened):
    shown = opened(path)
    hrefs = shown.eval_on_selector_all(".reasons a", "found => found.map((a) => a.getAttribute('href'))")
    assert hrefs == ["units/0011/page/report.html", "units/0045/page/report.html"]
    assert shown.locator(".rows a").first.get_attribute("href") == hrefs[0]


def test_the_cursor_names_the_unit(path, opened):
    shown = opened(path)
    panel = shown.locator("figure.chart").nth(2).locator(".u-over").first
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()
    shown.mouse.move(box["x"] + box["width"] / 2, box["y"] + 20)
    said = shown.locator(".read").nth(2).inner_text()
    assert said.startswith(("unit 005", "unit 006"))


def test_on_paper_its_table_ends(path, opened):
    shown = opened(path)
    shown.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert shown.locator(".rows tbody tr").count() == 120
    shown.evaluate("dispatchEvent(new Event('afterprint'))")
    assert shown.locator(".rows tbody tr").count() < 80


def test_five_thousand_units_open_in_three_megabytes(opened, tmp_path):
    path = tmp_path / "report.html"
    write_fleet_report(path, fleet(5000, failed=range(0, 5000, 100), odd=range(50, 5000, 100)))
    assert path.stat().st_size < 3.2e6
    shown = opened(path, width=390)
    assert overflow(shown) == 0
    assert shown.locator("#count").inner_text() == "5,000 of 5,000 units"
    assert shown.locator(".rows tbody tr").count() < 80
    shown.evaluate("document.querySelector('.rows').scrollTop = 28 * 2500")
    shown.wait_for_function("[...document.querySelectorAll('.rows tbody td')].some((td) => td.textContent === '2500')")


def test_of_many_units_the_page_has_the_names_of_those_that_are_drawn_and_the_places_of_others(
    monkeypatch, opened, tmp_path
):
    for name, most in (("MAX_NAMES", 50), ("MAX_POINTS", 40), ("MAX_RANGES", 40), ("LIMITS", 10), ("TICKS", 5)):
        monkeypatch.setattr(line_charts, name, most)
    path = tmp_path / "report.html"
    write_fleet_report(path, fleet(300))
    shown = opened(path)
    names = json.loads(shown.locator("#units-of-the-line").text_content())
    chart = "driftlab.charts.find((one) => one.content.named === 'units-of-the-line')"
    drawn = shown.evaluate(
        f"{chart}.content.x[{chart}.content.panels[0].lines.find((one) => one.style === 'points').x]"
    )
    assert {str(round(k) - 1) for k in drawn} < set(names)
    assert len(names) < 200
    assert names["99"].startswith("0099"), "the unit at place 100, under the axis"
    (other, *_) = set(range(300)) - set(map(int, names))
    said = [shown.evaluate(f"{chart}.called({k})") for k in (100, other + 1, 1.5, 301)]
    assert said == [names["99"], str(other + 1), "", ""]


def test_of_more_units_the_table_has_the_odd_the_failed_and_an_even_sample(monkeypatch, opened, tmp_path):
    monkeypatch.setattr(fleet_rows, "ROWS", 50)
    path = tmp_path / "report.html"
    write_fleet_report(path, fleet(300, failed=(3, 200), odd=(10, 299)))
    shown = opened(path)
    content = json.loads(shown.locator("#table-of-units").text_content())
    units = [int(unit) for unit in content["unit"]]
    assert {3, 10, 200, 299} < set(units)
    assert units == sorted(units)
    steps = np.diff([unit for unit in units if unit not in (3, 10, 200, 299)])
    assert len(units) <= 54
    assert steps.max() <= steps.min() + 3
    assert f"{300 - len(units)} units are left out here" in shown.locator("body").inner_text()


@pytest.mark.parametrize("count", [1, 10])
def test_few_units_have_a_page(opened, tmp_path, count):
    path = tmp_path / "report.html"
    write_fleet_report(path, fleet(count))
    shown = opened(path)
    assert shown.locator("figure.chart").count() == (13 if count == 10 else 1)  # of one unit no differences
    assert shown.locator("#count").inner_text() == f"{count} of {count} units"


def test_yield_reasons_and_groups_are_on_the_page_and_fit_a_phone(opened, tmp_path):
    found = fleet(300, failed=(7, 30), odd=(11, 45))
    told = yields_of(found.records, found.odd, ["chamber", "lot", "date"])
    path = tmp_path / "report.html"
    write_fleet_report(path, replace(found, yields=told))
    for width in (1100, 390):
        shown = opened(path, width=width)
        text = shown.locator("body").inner_text()
        assert overflow(shown) == 0
        assert "keeps every limit, with its uncertainty. None of them is in doubt." in text
        assert f"{told.whole.accepted} of 300 units are accepted: {100 * told.whole.share:.3g} % (" in text
        assert "noise above limit" in shown.locator(".pareto").inner_text()
        counts = shown.eval_on_selector_all(".pareto tbody tr", "rows => rows.map((row) => row.cells[1].textContent)")
        assert counts == [str(count) for count in told.whole.reasons.values()]
        rows = shown.locator(".yields").first.locator("tbody tr").all_inner_texts()
        assert [row.split()[:4] for row in rows] == [
            [one.name, str(one.accepted), "of", str(one.units)] for one in told.by["chamber"]
        ]
        assert "The yield differs by lot (p ≤ 0.0001 by chance)" in text  # the noise has changed
        assert "No difference by chamber is seen" in text
        bar, stroke = (shown.locator(f".yields .track {tag}").first.bounding_box() for tag in "bu")
        assert bar["x"] < stroke["x"] + 2 <= bar["x"] + bar["width"] + 4
        assert shown.locator(".yields").last.locator("tbody tr").count() == 180  # of 300 days, 20 before them
        assert "100 more are in fleet.json" in shown.locator("body").text_content()


def test_units_that_nobody_judged_are_not_said_to_be_fine(tmp_path):
    found = fleet(6, failed=(), odd=())
    for judged, said in ((False, "6 done, 0 failed; whether any is odd was not judged"), (True, "0 failed; 0 odd")):
        write_fleet_report(tmp_path / "report.html", replace(found, judged=judged))
        assert said in (tmp_path / "report.html").read_text()


def test_gauge_study_and_notes_are_on_the_page_and_fit_the_sheet(opened, tmp_path):
    found, rng = fleet(40, odd=(3, 11)), np.random.default_rng(1)
    records = []
    for one in found.records[:12]:
        usual = np.array(one.figures["noise"].value)
        figures = [{"noise": Figure(value=tuple(usual * f), sigma=(None,) * 3)} for f in 1 + 0.02 * rng.normal(size=2)]
        repeats = [RepeatedSoak(name=f"{k}.h5", place=k, figures=own) for k, own in enumerate(figures)]
        records.append(one.model_copy(update={"repeats": repeats}))
    why = [of_outlier(outlier) for outlier in found.odd["0003"]]
    notes = new_notes({"0003": NASTY}, "anna", {"0003": why}, {"0003": ""})
    path = tmp_path / "report.html"
    whole = replace(found, gauge=gauge_study(records, LIMITS), acknowledged={"0003": notes[0]}, notes=notes)
    write_fleet_report(path, whole)
    shown = opened(path, width=688)
    text = shown.locator("body").inner_text()
    assert "2 of 40 units are odd, 1 of them acknowledged." in shown.locator(".verdict").last.inner_text()
    assert f"{NASTY} (anna, " in text
    assert shown.title() != "broken"
    first, second = (shown.locator(f"#{name} ~ table").first.inner_text() for name in ("odd", "acknowledged"))
    assert "0011" in first
    assert "0003" not in first
    assert "0003" in second
    rows = shown.locator("#gauge ~ table").first.locator("tbody tr").all_inner_texts()
    assert [row.split()[:4] for row in rows] == [["noise", axis, "[deg/h/sqrt(Hz)]", "12"] for axis in AXES]
    assert_fits_on_paper(shown)


def test_a_fleet_of_which_all_failed_has_a_page(opened, tmp_path):
    path = tmp_path / "report.html"
    nothing = {"drawn": [], "curves": np.zeros((0, 3, 41), dtype=np.float32), "mean": None}
    write_fleet_report(path, fleet(3, failed=(0, 1, 2), line=line_of([], None), **nothing))
    shown = opened(path)
    assert "3 units: 0 done, 3 failed" in shown.locator("body").inner_text()
    assert cells(shown, "state") == ["failed"] * 3


def test_on_paper_no_table_is_wider_than_the_sheet(path, opened):
    assert_fits_on_paper(opened(path, width=688))


def test_the_headline_has_the_odd_units_of_the_list_below(opened, tmp_path):
    calm = fleet(40, odd=(3, 11), remarks=())
    records = line(40, 1)
    calm = replace(calm, records=records, line=line_of(records, LIMITS))
    write_fleet_report(tmp_path / "calm.html", calm)
    shown = opened(tmp_path / "calm.html")
    headline = shown.locator(".verdict").last.inner_text()
    assert headline.startswith("2 of 40 units are odd. ")
    assert "No change of the line" in headline  # that alone would say that nothing is to be looked at
    assert "odd units back" in shown.locator("p.use").inner_text()


def test_a_unit_far_off_leaves_the_scale_to_the_others_and_its_value_in_the_label(overview):
    records = line(60, 2)
    figure = records[20].figures["noise"]
    far = figure.model_copy(update={"value": tuple(15 * value for value in figure.value)})
    records[20] = records[20].model_copy(update={"figures": {**records[20].figures, "noise": far}})
    (chart,) = [chart for chart in control_charts(line_of(records, LIMITS)) if chart.title.startswith("White noise")]
    values = np.array([one.figures["noise"].value for k, one in enumerate(records) if k != 20]) * RATE.factor
    for k, panel in enumerate(chart.panels[::2]):  # between them the moving ranges
        assert panel.span[1] < 2 * values[:, k].max()
        assert panel.label.endswith(f"beyond the axis: {records[20].unit} at {far.value[k] * RATE.factor:.3g}")
        (beyond,) = [one for one in panel.lines if one.name == "beyond three sigma"]
        assert beyond.y[beyond.x == 21] == pytest.approx(panel.span[1], rel=1e-3)  # at the edge of the axis
        assert panel.span[1] > values[:, k].max()


def test_half_of_the_units_are_in_the_narrow_band():
    curves = np.random.default_rng(0).normal(size=(400, len(AXES), 5)).astype(np.float32)
    low, _, half, _, high = percentiles(curves)
    assert np.mean((curves >= low) & (curves <= high)) == pytest.approx(0.9, abs=0.01)
    assert np.mean(curves <= half) == pytest.approx(0.5, abs=0.01)


def test_a_badly_measured_unit_does_not_squeeze_the_chart_of_the_others():
    found = line_of(line(60), LIMITS)
    control = next(chart for chart in found.controls if (chart.quantity, chart.axis) == ("noise", "x"))
    value, own = control.figures()
    wide = replace(control, figures=lambda: (value, np.where(control.at == 30, 10 * control.sigma, own)))
    (chart,) = control_charts(replace(found, controls=(wide,)))
    low, high = chart.panels[0].span
    usual = [*map(np.median, control.limits), *control.value, *np.concatenate(control.ewma[1:])]
    reach = (min(usual) / DEG_H, max(usual) / DEG_H)
    assert low < reach[0] < reach[1] < high
    assert high - low < 1.2 * (reach[1] - reach[0])


def test_what_units_share_is_said_once_and_its_sizes_have_a_row_a_lot(path, opened, tmp_path):
    lots = tuple((f"L{k:02d}", 12, axis, k + 0.5, 0.25) for k in range(30) for axis in AXES)
    effect = SharedEffectRow("hysteresis", "hysteresis: in all lots", "deg/h/K", lots)
    page = tmp_path / "report.html"
    write_fleet_report(page, fleet(40, effects=(effect,)))
    shown = opened(page, width=390)
    assert shown.locator("body").inner_text().count("hysteresis: in all lots") == 1
    part = shown.locator("#effects ~ details").first
    assert part.get_attribute("open") is None  # of so many lots it is long
    part.locator("summary").click()
    rows = part.locator("tbody tr").all_inner_texts()
    assert len(rows) == 30
    assert rows[3].split("\t") == ["L03", "12", *["3.5 ± 0.25"] * 3]
    assert overflow(shown) == 0


def test_long_names_are_told_apart_on_a_phone_and_under_the_charts(opened, tmp_path):
    def name(k):
        return f"rack-07-slot-{k:04d}-serial-2026-{k:04d}"

    records = [one.model_copy(update={"unit": name(k)}) for k, one in enumerate(line(40))]
    told = fleet(5, odd=(2,)).odd["0002"][0]
    odd = {name(k): (replace(told, unit=name(k)),) for k in (3, 17)}
    path = tmp_path / "report.html"
    drawn = [name(k) for k in range(40)]
    found = fleet(40, records=records, drawn=drawn, line=line_of(records, LIMITS))
    write_fleet_report(path, replace(found, odd=odd))
    shown = opened(path, width=390)
    assert overflow(shown) == 0
    reason = shown.locator(".reasons td").first
    assert reason.bounding_box()["x"] + reason.bounding_box()["width"] <= 390
    said = shown.evaluate("driftlab.charts.find((one) => one.content.named === 'units-of-the-line').label(18)")
    said = said.split("\n")[0]
    assert said == "…l-2026-0017"  # the unit at place 18, by what no other unit has
    lefts = shown.eval_on_selector_all(
        ".rows td.left:first-child", "(all) => all.map((a) => getComputedStyle(a).position)"
    )
    assert set(lefts) == {"static"}  # a long name that stays in place would hide the figures


def test_of_one_axis_all_figures_stand_side_by_side_at_once(opened, tmp_path):
    records = []
    for one in line(12):
        figures = {
            name: figure.model_copy(update={"value": figure.value[:1], "sigma": figure.sigma[:1]})
            for name, figure in one.figures.items()
        }
        records.append(one.model_copy(update={"axes": ("resistance",), "figures": figures}))
    path = tmp_path / "report.html"
    write_fleet_report(path, fleet(12, records=records, drawn=[], odd={}, line=line_of(records, None)))
    shown = opened(path)
    heads = [head.split()[0] for head in shown.locator(".rows th button").all_inner_texts()]
    names = list(map(figure_name, FIGURES))
    assert [head for head in heads if head in names] == names
    box, table = shown.locator(".rows").bounding_box(), shown.locator(".rows table").bounding_box()
    assert box["height"] < table["height"] + 40  # twelve rows need no window for twenty
