"""The page of a comparison in a browser: what one decides from comes first, and a config can be switched off."""

import hashlib
import shutil

import h5py
import pytest
from browsers import colours, overflow
from units_at_rest import unit_at_rest

from driftlab.commands.compare import compare
from driftlab.commands.fit_map import fit_map
from driftlab.config import Config
from driftlab.evaluation.comparison import verdict
from driftlab.evaluation.scores import over_axes
from driftlab.reports.charts import LOOKS
from driftlab.reports.compare import bias_chart, error_chart

LIMITS = ({"serial": "SN <7>", "limits": {"coast": "500 deg/h"}}, {"limits": {"coast": "1e-3 deg/h"}}, {})
NAMES = ("slow", "walks<fast>", "constant")
PIXELS = """(colour) => { let n = 0;
const [r, g, b] = [1, 3, 5].map(k => parseInt(colour.slice(k, k + 2), 16));
for (const c of document.querySelectorAll('figure.chart')[0].querySelectorAll('canvas')) {
  const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
  for (let i = 0; i < d.length; i += 4)
    n += d[i + 3] > 200 && Math.abs(d[i] - r) + Math.abs(d[i + 1] - g) + Math.abs(d[i + 2] - b) < 12;
} return n; }"""


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    path = tmp_path_factory.mktemp("compare") / "unit.h5"
    unit = unit_at_rest(seconds=700, rate=5, walk=2.6e-7, temperature=lambda t: 20 + t / 50)
    unit.gyro[1500:1550, 1] += 0.05 * (-1.0) ** (unit.t[1500:1550] * 5)
    with h5py.File(path, "w") as file:
        file["time"], file["gyro"], file["temperature"] = unit.t, unit.gyro, unit.temperature

    def config(bias, limits):
        gyro = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": bias}
        units = (("time", "s"), ("gyro", "rad/s"), ("temperature", "degC"))
        channels = {name: {"path": name, "unit": shown} for name, shown in units}
        source = {"kind": "hdf5", "path": str(path), "channels": channels}
        return Config.model_validate({"source": source, "filter": {"gyro": gyro}, **limits})

    walks = [{"kind": "random_walk", "walk": f"{walk} deg/s/sqrt(s)"} for walk in (1.5e-5, 5e-5)]
    return compare(dict(zip(NAMES, map(config, [*walks, {"kind": "constant"}], LIMITS), strict=True)))


@pytest.fixture(scope="module")
def found(result):
    return result.found


@pytest.fixture(scope="module")
def written(result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page") / "compared"
    result.save(folder)
    return folder / "report.html"


def test_the_sentence_the_bars_and_the_decisive_row_come_first(written, found, opened):
    shown = opened(written)
    assert shown.locator(".verdict").first.inner_text() == verdict(found)
    bars = shown.locator("table.coasts tbody").first
    assert bars.locator("th").first.inner_text().startswith("to the end (11 min)")
    lengths = [bar.bounding_box()["width"] for bar in bars.locator(".bar").all()]
    errors = [over_axes(c.yardsticks.coast["to the end"]) for c in found.values()]
    assert [length / max(lengths) for length in lengths] == pytest.approx([e / max(errors) for e in errors], abs=0.02)
    ticks = [tick.bounding_box()["x"] for tick in bars.locator(".tick").all()]
    sigmas = [over_axes(c.yardsticks.coast_sigma["to the end"]) for c in found.values()]
    begin = bars.locator(".bar").first.bounding_box()["x"]
    assert [(x - begin) / max(lengths) for x in ticks] == pytest.approx([s / max(errors) for s in sigmas], abs=0.02)
    row = shown.locator("h2:has-text('Error') ~ table tbody tr").first
    assert row.inner_text().split()[:5] == ["prediction,", "to", "the", "end", "x"]


def test_each_config_has_its_limits_and_its_hash(written, result, opened):
    shown = opened(written)
    said = [line.inner_text().split(" limit")[0] for line in shown.locator(".verdict").all()[1:]]
    assert said == ["slow: PASS: 1 of 1", "walks<fast>: FAIL: prediction over 10 min (rms) (0 of 1"]
    assert shown.locator("table.limits").count() == 2
    assert "SN <7>" in shown.locator("p.lead").first.inner_text()
    sheet = shown.locator("table.sheet").inner_text()
    for name, config in result.configs.items():
        assert f"config {name}" in sheet
        assert hashlib.sha256(config.as_yaml().encode()).hexdigest() in sheet
    assert sheet.count("recording\t") == 1
    assert result.lines()[1].startswith("slow: PASS")
    limits = result.summary["configs"]["walks<fast>"]["limits"]
    assert [row["verdict"] for row in limits] == ["fail"]
    assert "limits" not in result.summary["configs"]["constant"]


def test_a_click_hides_a_config_wherever_it_is(written, opened):
    shown = opened(written)
    colour = LOOKS["series:1"].light
    before = shown.evaluate(PIXELS, colour)
    assert before > 100
    key = shown.locator("figure.chart").first.get_by_role("button", name="walks<fast>")
    assert key.count() == 1  # estimate and coast of all axes
    key.click()
    assert shown.evaluate(PIXELS, colour) == 0
    key.click()
    assert shown.evaluate(PIXELS, colour) == before


def test_estimate_and_coast_under_the_cursor_are_told_apart(written, opened):
    shown = opened(written)
    panel = shown.locator(".u-over").first
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()
    shown.mouse.move(box["x"] + box["width"] / 2, box["y"] + 20)
    said = shown.locator(".read").first.inner_text()
    assert "slow, line " in said
    assert "slow, dashed " in said


def test_the_paper_s_tables_are_folded_away_and_opened_in_print(written, opened):
    shown = opened(written)
    table = shown.get_by_text("Rms error, nominal (table 6)")
    assert not table.is_visible()
    shown.locator("summary").click()
    assert table.is_visible()
    assert colours(shown, 2) > 5  # drawn although it was hidden when the page was opened
    shown.reload()
    shown.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert table.is_visible()


@pytest.mark.parametrize(("width", "dark"), [(1100, True), (390, False), (390, True)])
def test_it_is_as_wide_as_its_window(written, opened, width, dark):
    assert overflow(opened(written, width=width, dark=dark)) == 0


def test_charts_show_what_was_estimated_and_where_it_moved(found):
    chart = bias_chart(found)
    assert [panel.label for panel in chart.panels] == [*(f"bias {a} [deg/h]" for a in "xyz"), "temperature [°C]"]
    assert {line.name for line in chart.panels[0].lines} == {"30 s average, reference", *NAMES}
    moved = [shade for shade in chart.panels[0].shades if shade.text == "moved"]
    assert moved
    assert min(s.start for s in moved) == pytest.approx(300 / 60, abs=0.1)  # min, as x
    assert max(s.stop for s in moved) == pytest.approx(310 / 60, abs=0.2)
    line = next(line for line in error_chart(found).panels[2].lines if line.name == "constant")
    curves = found["constant"].overview.curves
    factor = found["constant"].sensor.factor
    assert line.y == pytest.approx((curves["coast"] - curves["reference"])[:, 2] * factor, nan_ok=True)
    assert line.high == pytest.approx(2 * curves["coast_sigma"][:, 2] * factor, nan_ok=True)


def test_a_map_is_not_recommended_by_the_recording_that_it_was_fitted_on(tmp_path):
    unit_at_rest(seconds=900, rate=2, temperature=lambda t: 20 + t / 50).write(tmp_path / "soak.h5")
    shutil.copy(tmp_path / "soak.h5", tmp_path / "day.h5")
    units = (("time", "s"), ("gyro", "rad/s"), ("temperature", "degC"))
    source = {"kind": "hdf5", "channels": {name: {"path": name, "unit": unit} for name, unit in units}}

    def config(recording, **of_map):
        bias = {"kind": "thermal_derivative", "walk": "1e-5 deg/s/sqrt(s)", "map": {"kind": "polynomial", **of_map}}
        gyro = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": bias if of_map else {"kind": "constant"}}
        read = {**source, "path": str(tmp_path / recording)}
        return Config.model_validate({"source": read, "filter": {"gyro": gyro}})

    fit_map(config("soak.h5", order=3), tmp_path / "soak.h5").save(tmp_path / "map.json")
    said = []
    for recording in ("soak.h5", "day.h5"):
        both = {"mapped": config(recording, path=str(tmp_path / "map.json")), "constant": config(recording)}
        compared = compare(both)
        compared.save(tmp_path / recording.partition(".")[0])
        page = (tmp_path / recording.partition(".")[0] / "report.html").read_text()
        said.append((any("the map was fitted on soak.h5" in line for line in compared.lines()),
                     "compare on another recording: the map of mapped was fitted on one of this name" in page,
                     "run with" in page))  # fmt: skip
    assert said == [(True, True, False), (False, False, True)]
