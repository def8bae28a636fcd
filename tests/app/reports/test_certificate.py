"""The certificate of a unit: one sheet of A4 whatever stands on it, with the numbers of its JSON, nothing hidden."""

import hashlib
import json
import re
from dataclasses import replace
from functools import cache

import h5py
import numpy as np
import pytest
from browsers import overflow
from typer.testing import CliRunner
from written_configs import GOOD, load

import driftlab
from driftlab.cli import app
from driftlab.errors import ConfigError
from driftlab.evaluation.limits import SIDE, LimitResult, Measured, check_limits
from driftlab.evaluation.measurements import of_map
from driftlab.maps.assessment import MapVerdict
from driftlab.reports.certificate import Certificate, stated, trade_unit
from driftlab.reports.provenance import sheet_of
from driftlab.soak.blocks import brief
from driftlab.storage.json import plain
from driftlab.units import BiasUnit, default_unit
from fusion_plugins.thermal_maps.polynomial import Polynomial

DEG_H = np.deg2rad(1) / 3600
LONG = "Ж" * 119 + "g"
TEXTS = dict.fromkeys((
    "number", "laboratory", "location", "customer", "item", "condition", "received", "performed", "procedure",
    "equipment", "traceability", "environment", "operator", "authorised_by",
), LONG)  # fmt: skip
LIMITS = (
    "limits: {bias_instability: 1 UNIT, residual: 1 UNIT, coast: 1 UNIT, swing: 1 UNIT, hysteresis: 1 UNIT, "
    "noise: 1 UNIT/sqrt(Hz)}"
)
ACCEL = """
filter:
  track: accel
  update_interval: 1 s
  gyro: {noise: 3.2 deg/h/sqrt(Hz), bias: {kind: random_walk, walk: 1e-5 deg/s/sqrt(s)}}
  accel: {noise: 1e-3 m/s^2/sqrt(Hz), bias: {kind: random_walk, walk: 1e-6 m/s^2/sqrt(s)}}
"""


@cache
def assessed(d, size):
    """A map of d axes of such a size, and what was made of its soak."""
    rng = np.random.default_rng(1)
    T = np.interp(np.linspace(0, 1, 1200), [0, 0.5, 1], [-20, 50, -20])
    bias = size * (np.outer(T, [7.0, -11.0, 3.0][:d]) + 30 * rng.normal(size=(1200, d)))
    settings = Polynomial(order=3)
    return MapVerdict(settings.fit(T, bias, {}), settings, brief(T, bias, [0], 10.0))


def certificate(folder, *, sensor="gyro", d=3, texts=None, recordings=1, limits=True):
    """A certificate of a map of d axes, with every quantity and limit."""
    si, shown, size = ("rad/s", "deg/h", DEG_H) if sensor == "gyro" else ("m/s^2", "m/s^2", 1e-4)
    text = (GOOD if sensor == "gyro" else ACCEL) + "serial: CRS-0042\n" + LIMITS.replace("UNIT", shown) * limits
    own = "" if texts is None else f"\ncertificate: {json.dumps(texts, ensure_ascii=False)}\n"
    config = load(folder, text + own)
    verdict = assessed(d, size)
    fitted = verdict.map.noting(channel=sensor, unit=si, axes=tuple("xyz"[:d]), lasted=12000.0)
    value = np.full(d, 0.5 * size)
    more = {n: Measured(value, "xyz"[:d], 0.9 * value, 1.2 * value) for n in ("coast", "noise", "bias_instability")}
    measured = more | of_map(fitted, BiasUnit(si, shown))
    names = [{"name": f"soaks/{LONG}_{k}.h5", "bytes": 5, "sha256": 64 * "a"} for k in range(recordings)]
    sheet = replace(sheet_of(config, []), recordings=names)
    judged = check_limits(config.limits, measured)
    return Certificate("fit-map", config, sheet, judged, measured, fitted, verdict.soak, seconds=12000.0)


def pdf_of(opened, tmp_path, page_text, **shown):
    path = tmp_path / "certificate.html"
    path.write_text(page_text)
    page = opened(path, wait=False, **shown)
    return page.pdf(prefer_css_page_size=True, print_background=True), page


def pages(pdf):
    assert re.search(rb"/MediaBox ?\[0 0 59[45][.\d]* 84[12]", pdf)  # A4, in points
    return len(re.findall(rb"/Type ?/Page\b(?!s)", pdf))


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_it_is_one_sheet(sensor, d, tmp_path, opened):
    for width in (1100, 390) if d == 3 else (1100,):
        pdf, page = pdf_of(opened, tmp_path, certificate(tmp_path, sensor=sensor, d=d).page(), width=width)
        assert pages(pdf) == 1
        assert overflow(page) == 0


def test_it_is_one_sheet_with_all_that_may_stand_on_it(tmp_path, opened):
    whole = certificate(tmp_path, texts=TEXTS, recordings=3).page()
    pdf, page = pdf_of(opened, tmp_path, whole)
    assert pages(pdf) == 1
    small = float(page.evaluate("document.documentElement.style.getPropertyValue('--size')").removesuffix("pt"))
    assert 5.5 < small < 9
    bare = re.sub(r"<script>.*?</script>", "", whole, flags=re.DOTALL).replace("--size, 8pt", "--size, 9pt")
    assert pages(pdf_of(opened, tmp_path, bare)[0]) > 1


def test_it_is_light_where_screens_are_dark(tmp_path, opened):
    _, page = pdf_of(opened, tmp_path, certificate(tmp_path).page(), dark=True)
    ground = "getComputedStyle(document.querySelector('.sheet')).backgroundColor"
    assert page.evaluate(ground) == "rgb(255, 255, 255)"
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.evaluate("getComputedStyle(document.body).color") == "rgb(17, 17, 17)"


def test_every_text_of_the_json_is_on_the_sheet(tmp_path, opened):
    made = certificate(tmp_path, texts={"number": 7, "customer": "A & <b>B</b>"})
    _, page = pdf_of(opened, tmp_path, made.page())
    text = page.locator("body").inner_text()
    content = json.loads(made.text())
    for row in content["bias"]["rows"] + content["bias"]["budget"]["sources"] + content["figures"]:
        assert all(shown in text for shown in row["shown"])
    budget = content["bias"]["budget"]
    assert all(shown in text for shown in (*budget["shown_u"], *budget["shown_U"], *content["not_covered"]))
    for shown in ("A & <b>B</b>", content["identification"], content["rule"], content["verdict"], 64 * "a"):
        assert shown in text
    assert page.locator(".blank").count() == 10  # what only the laboratory knows


def test_the_budget_adds_up_to_the_table(tmp_path):
    content = certificate(tmp_path).content
    budget, rows = content["bias"]["budget"], content["bias"]["rows"]
    for axis, T in enumerate(budget["at_degC"]):
        u = np.sqrt(sum(source["u"][axis] ** 2 for source in budget["sources"]))
        assert budget["u"][axis] == pytest.approx(u)
        (row,) = (row for row in rows if row["temperature_degC"] == T)
        assert row["U"][axis] == pytest.approx(2 * u)
        assert row["U"][axis] == max(row["U"][axis] for row in rows)


def test_the_same_results_have_the_same_identification(tmp_path):
    one, two = (certificate(tmp_path).content for _ in range(2))
    assert one["identification"] == two["identification"]
    rest = {key: value for key, value in one.items() if key not in ("identification", "issued")}
    text = json.dumps(rest, indent=2) + "\n"
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == one["identification"]
    other = certificate(tmp_path, texts={"customer": "B"}).content
    assert other["identification"] != one["identification"]


def test_a_map_that_does_not_say_how_sure_it_is_has_no_u(tmp_path, opened):
    known = certificate(tmp_path)
    made = Certificate("run", known.config, known.sheet, [], {}, known.fitted.noting(error=None))
    assert made.content["bias"]["rows"][0]["U"] == [None] * 3
    _, page = pdf_of(opened, tmp_path, made.page())
    text = page.locator("body").inner_text()
    assert "U not known" in text
    assert "The uncertainty is not known" in text
    assert "No limits are set: no statement of conformity is made." in text
    assert "±" not in text


@pytest.mark.parametrize("row", [
    LimitResult("coast", 1.0, 0.9, 0.2, "x", "undecided", needs="more"),
    LimitResult("coast", 1.0, measured=False, note="too short"),
    LimitResult("swing", 1.0, 0.0, 0.7, "x", "pass", beside="a lag is seen"),
])  # fmt: skip
def test_pass_is_said_of_decided_limits_alone(row, tmp_path):
    good = LimitResult("noise", 1.0, 0.5, 0.1, "x", "pass", note="100 s")
    known = certificate(tmp_path)
    made = Certificate("run", known.config, known.sheet, [good, row], {})
    assert made.content["verdict"].startswith("PASS") == (row.decision == "pass")
    assert ('class="verdict pass"' in made.page()) == (row.decision == "pass")
    unit = default_unit("rad/s")
    assert [LimitResult.from_json(plain(one.as_json(unit))).cells(unit) for one in (good, row)] == [
        one.cells(unit) for one in (good, row)
    ]


def test_a_wide_bias_and_a_narrow_limit_have_units_of_their_own(tmp_path):
    known, size = certificate(tmp_path), np.array([2.0, 3.0, 4.0]) * DEG_H
    wide = {"swing": Measured(3600 * size, "xyz"), "residual": Measured(size, "xyz", size, size)}
    made = Certificate("run", known.config, known.sheet, known.judged, wide)
    assert [one["shown_unit"] for one in made.content["figures"]] == ["deg/s", "deg/h"]
    assert made.content["figures"][0]["shown"] == ["2, U not known", "3, U not known", "4, U not known"]
    assert "<td>1 deg/h</td>" in made.page()


def test_an_axis_that_does_not_show_has_an_upper_limit_alone(tmp_path):
    known, size = certificate(tmp_path), np.array([0.0, 3.0, 0.0]) * DEG_H
    high = np.array([1.04, 3.3, np.inf]) * DEG_H
    found = {"noise": Measured(size, "xyz", 0.9 * size, high), "swing": Measured(size, "xyz", missing="no map")}
    noise, swing = Certificate("run", known.config, known.sheet, [], found).content["figures"]
    assert noise["shown"] == ["≤ 1.0", "3.00 ± 0.36", "not known"]
    assert noise["U"][::2] == [None, None]
    assert noise["at_most"] == [pytest.approx(1.04 * DEG_H), None, None]
    assert (swing["shown"], swing["U"]) == (["not measured: no map"], [None] * 3)


@pytest.mark.parametrize(("value", "uncertainty", "shown"), [
    (12.3456, 0.0996, ("12.35", "0.10")),
    (-0.0004, 0.021, ("0.000", "0.021")),
    (1234.5, 118.0, ("1230", "120")),
    (1.23456e-7, 1.96e-9, ("1.235e-07", "2.0e-09")),
    (5.4321, 7.0, ("5.4", "7.0")),
    (5.43219, float("nan"), ("5.432", "not known")),
    (0.0, 99.6, ("0", "100")),
])  # fmt: skip
def test_uncertainties_have_two_digits_and_values_as_many_decimals(value, uncertainty, shown):
    assert stated(value, uncertainty) == shown


@pytest.mark.parametrize(("si", "largest", "shown"), [
    ("rad/s", 100 * DEG_H, "deg/h"),
    ("rad/s", 7200 * DEG_H, "deg/s"),
    ("m/s^2", 0.3, "mg"),
    ("m/s^2", 12.0, "m/s^2"),
    ("V", 12.0, "V"),
])  # fmt: skip
def test_units_are_those_of_the_trade(si, largest, shown):
    assert trade_unit(si, largest, default_unit(si)).shown == shown


CONFIG = """
serial: 42
source: {kind: hdf5, channels: {time: {path: time}, gyro: {path: gyro}, temperature: {path: temperature}}}
filter:
  align: 60 s
  update_interval: 1 s
  gyro:
    noise: 3.2 deg/h/sqrt(Hz)
    bias: {kind: thermal_derivative, walk: 0.02 deg/h/sqrt(s), map: {kind: polynomial, order: 3, path: map.json}}
  accel: null
limits: {swing: 900 deg/h, coast: 5 deg/h}
certificate: {customer: "=cmd|' /C calc'!A1", performed: 2026-11-20, temperature_uncertainty: 0.3 K}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "unit.yaml").write_text(CONFIG)
    rng, N = np.random.default_rng(0), 3600
    T = np.interp(np.linspace(0, 1, N), [0, 0.5, 1], [-20, 48, -20])
    gyro = DEG_H * (np.outer(T, [1, 0.5, -0.2]) + 1.6 * rng.normal(size=(N, 3)))
    with h5py.File("soak.h5", "w") as file:
        for name, values, unit in (
            ("time", 4.0 * np.arange(N), "s"), ("gyro", gyro, "rad/s"), ("temperature", T, "degC"),
        ):  # fmt: skip
            file[name] = values
            file[name].attrs["unit"] = unit
    return tmp_path


def driven(*args):
    return CliRunner().invoke(app, [str(arg) for arg in args])


def test_fit_map_and_run_write_it(folder, opened):
    done = driven("fit-map", "unit.yaml", "--input", "soak.h5", "--certificate")
    assert done.output.splitlines()[-1] == (
        "written to map.json, map.report.html, map.certificate.html, map.certificate.json"
    )
    made = json.loads((folder / "map.certificate.json").read_text())
    assert (made["item"]["serial"], made["method"]["performed"]) == ("42", "2026-11-20")
    assert made["method"]["map"]["sha256"] == hashlib.sha256((folder / "map.json").read_bytes()).hexdigest()
    assert made["method"]["recordings"][0]["sha256"] == hashlib.sha256((folder / "soak.h5").read_bytes()).hexdigest()
    assert "INCOMPLETE" in made["verdict"]
    truth = DEG_H * np.outer([row["temperature_degC"] for row in made["bias"]["rows"]], [1, 0.5, -0.2])
    error = np.array([row["value"] for row in made["bias"]["rows"]]) - truth
    assert np.mean(np.abs(error) <= np.array([row["U"] for row in made["bias"]["rows"]])) > 0.8

    done = driven("run", "unit.yaml", "--input", "soak.h5", "--out", "out", "--certificate")
    assert done.exit_code == 0, done.output
    run = json.loads((folder / "out" / "certificate.json").read_text())
    assert run["bias"]["rows"] == made["bias"]["rows"]
    assert run["figures"][0]["of"] == "bias at the end, by the filter"
    limit = next(row for row in run["limits"] if row["name"] == "coast")
    figure = next(one for one in run["figures"] if one["name"] == "coast")
    assert max(figure["U"]) >= 2 / SIDE * limit["guard"] * (1 - 1e-9)
    assert run["remarks"][0].startswith("the map was fitted on soak.h5 too")
    page = opened(folder / "out" / "certificate.html", wait=False)
    assert pages(page.pdf(prefer_css_page_size=True)) == 1
    written = json.loads((folder / "out" / "summary.json").read_text())["written"]
    assert {"certificate.html", "certificate.json"} <= set(written)
    again = driven("run", "unit.yaml", "--input", "soak.h5", "--out", "out")
    assert again.exit_code == 0, again.output
    assert not (folder / "out" / "certificate.html").exists()


def test_a_certificate_that_was_filled_in_is_not_replaced(folder):
    driven("fit-map", "unit.yaml", "--input", "soak.h5", "--certificate")
    path = folder / "map.certificate.html"
    path.write_text(path.read_text().replace("received on", "received on Monday"))
    done = driven("fit-map", "unit.yaml", "--input", "soak.h5", "--certificate")
    assert "was changed since `driftlab fit-map` wrote it" in str(done.exception)
    assert "Monday" in path.read_text()


def test_a_program_names_a_place_for_it(folder):
    with pytest.raises(ConfigError, match=r"^certificate: is a file beside the map; give out"):
        driftlab.fit_map("unit.yaml", "soak.h5", certificate=True)
    with pytest.raises(ConfigError, match=r"^certificate: is a file of the results; give out"):
        driftlab.run("unit.yaml", "soak.h5", certificate=True)
    done = driven("fit-map", "unit.yaml", "--input", "soak.h5", "--family", "family.json", "--certificate")
    assert "leave --kind, --select, --compare, --report and --certificate out" in str(done.exception)


@pytest.mark.parametrize(("text", "message"), [
    ("customer: ''", "'' does not fit the sheet; write 1 to 120 characters in one line"),
    (f"customer: {'a' * 121}", "does not fit the sheet"),
    ("customer: ' a'", "does not fit the sheet"),
    ("costumer: A", "customer"),
    ("temperature_uncertainty: 0 K", "must be greater than zero"),
])  # fmt: skip
def test_a_text_that_does_not_fit_is_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        load(tmp_path, f"{GOOD}certificate: {{{text}}}\n")
