"""The page and the certificate of a triad's terms: readable everywhere, and right about units that are simulated."""

import json
import re

import numpy as np
import pytest
from browsers import overflow
from turned_units import matrix_of, sensor_frame, tumble, turntable

import driftlab

TERMS = "bias,scale,misalignment"
GYRO = {
    "noise": "8e-5 rad/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)"},
    "calibration": {"kind": "polynomial"},
}  # fmt: skip
ACCEL = {
    "noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 m/s^2/sqrt(s)"},
    "calibration": {"kind": "polynomial"},
}  # fmt: skip
COLD_TO_HOT = [-20.0, 20.0, 60.0]
LONG = "Ж" * 119 + "g"
TEXTS = dict.fromkeys((
    "number", "laboratory", "location", "customer", "item", "condition", "received", "performed", "procedure",
    "equipment", "traceability", "environment", "operator", "authorised_by",
), LONG)  # fmt: skip


def turned(folder, seed=0, temperatures=COLD_TO_HOT, more=None, **how):
    """A gyro on a turntable: what `fit-map` makes of it, saved with its certificate."""
    t, y, T, table = turntable(seed, temperatures, **how)
    (folder / "table.csv").write_text(table)
    stimulus = {"kind": "rate_table", "segments": str(folder / "table.csv")}
    config = {"serial": "T-1", "latitude": "0 deg", "filter": {"gyro": GYRO}, "stimulus": stimulus, **(more or {})}
    data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    return driftlab.fit_map(config, data, terms=TERMS, out=folder / "map.json", certificate=True)


def tumbled(folder, seed=0, temperatures=COLD_TO_HOT, more=None):
    """An accelerometer in a tumble, the same way."""
    t, y, T = tumble(seed, temperatures)
    config = {
        "filter": {"track": "accel", "gyro": GYRO, "accel": ACCEL},
        "stimulus": {"kind": "tumble", "gravity": "9.80665 m/s^2"}, **(more or {}),
    }  # fmt: skip
    still = np.random.default_rng(seed).normal(0, 1e-3, y.shape)
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (still, "rad/s"), "temperature": (T, "degC")}
    return driftlab.fit_map(config, data, terms=TERMS, out=folder / "map.json", certificate=True)


def content(folder):
    return json.loads((folder / "map.certificate.json").read_text())


@pytest.mark.parametrize("made", [turned, tumbled])
def test_the_page_begins_with_the_result_and_what_it_means(opened, tmp_path, made):
    result = made(tmp_path)
    for width, dark in ((1280, False), (390, True)):
        page = opened(tmp_path / "map.report.html", width=width, dark=dark)
        assert overflow(page) <= 0
    assert page.locator("h2").first.inner_text() == "Terms"
    free = int(result.fit.free[3:].sum())
    said = page.inner_text(".verdict")
    assert f"{free} of {free} terms of scale factor and misalignment are known" in said
    sigma = np.max(result.fit.sigma(result.fit.grid), axis=0)
    size, motion = (360, "a turn of 360 deg") if made is turned else (1e4, "a change of velocity by 10 m/s")
    along, alone = re.search(r"within ([\d.]+) .*up to ([\d.]+) \S+ of it", page.inner_text(".use")).groups()
    assert motion in page.inner_text(".use")
    assert float(along) == pytest.approx(2 * size * max(sigma[[3, 7, 11]]), rel=0.01)
    truth = np.abs([matrix_of(T) if made is turned else sensor_frame(matrix_of(T)) for T in np.linspace(-20, 60, 99)])
    assert float(alone) == pytest.approx(size * np.max(truth), rel=0.02)
    assert page.locator("figure.chart").count() == 3


def test_what_the_stimulus_does_not_tell_stands_on_page_and_certificate(opened, tmp_path):
    turned(tmp_path, axes=range(2), more={"limits": {"scale": "2 %"}})
    page = opened(tmp_path / "map.report.html")
    assert page.locator("h2").first.inner_text() == "Not observable"
    assert (
        "scale z: not observable, and taken as zero, since no segment turns about z; add segments"
        in page.inner_text("ul")
    )
    assert "6 of 9 terms" in page.locator(".verdict").nth(1).inner_text()
    assert "count as 1 % or 10 mrad" in page.inner_text(".use")
    signed = content(tmp_path)
    assert signed["verdict"].startswith("INCOMPLETE")
    assert signed["limits"][0]["note"] == "not observable by the stimulus: zz"
    shown = [row["shown"] for row in signed["matrix"]["rows"]]
    assert {row[8] for row in shown} == {"not observable"}
    assert "not observable" not in {row[0] for row in shown}
    assert any("terms xz, yz, zz of M" in text for text in signed["not_covered"])


@pytest.mark.parametrize("made", [turned, tumbled])
def test_a_certificate_of_all_terms_is_one_sheet_of_a4(opened, tmp_path, made):
    limits = {"scale": "2 %", "misalignment": "20 mrad"}
    temperatures = [-40.0, 0.0, 40.0, 80.0, 120.0]
    made(tmp_path, temperatures=temperatures, more={"certificate": TEXTS, "limits": limits})
    page = opened(tmp_path / "map.certificate.html", wait=False)
    assert len(re.findall(rb"/Type\s*/Page\b", page.pdf(prefer_css_page_size=True, print_background=True))) == 1
    assert overflow(opened(tmp_path / "map.certificate.html", wait=False, width=390)) <= 0
    signed, text = content(tmp_path), page.inner_text("body")
    for table in (signed["bias"], signed["matrix"]):
        free = [k for k, one in enumerate(table.get("terms", 3 * [{"free": True}])) if one["free"]]
        for row in [*(one["shown"] for one in table["rows"]), table["budget"]["shown_U"]]:
            assert all(row[k] in text for k in free)


@pytest.mark.parametrize(("made", "frame"), [(turned, lambda M: M), (tumbled, sensor_frame)])
def test_certified_uncertainties_hold_on_simulated_units(tmp_path, made, frame):
    """Of terms with U at k = 2, 95 % are within; of 5 units the scatter of that share is some 4 points."""
    inside = []
    for seed in range(200, 205):
        made(tmp_path, seed)
        table = content(tmp_path)["matrix"]
        free = [k for k, term in enumerate(table["terms"]) if term["free"]]
        for row in table["rows"]:
            truth = frame(matrix_of(row["temperature_degC"])).ravel()
            off = (np.array(row["value"]) - truth) / row["U"]
            inside.append(np.abs(off)[free])
        budget = table["budget"]
        u = np.array([source["u"] for source in budget["sources"]])
        np.testing.assert_allclose(2 * np.sqrt(np.sum(u**2, axis=0))[free], np.array(budget["U"])[free])
    assert 0.85 < np.mean(np.array(inside) < 1) < 0.995
    assert 0.55 < np.mean(np.array(inside) < 0.5) < 0.85


def test_limits_of_terms_pass_fail_or_are_undecided(tmp_path):
    M = np.abs([matrix_of(T) for T in np.linspace(-20, 60, 99)])
    scale = np.max(M[:, range(3), range(3)])
    verdicts = {}
    for factor in (0.9, 1.0, 1.1):
        more = {"limits": {"scale": f"{1e6 * scale * factor} ppm", "misalignment": f"{8.5 * factor} mrad"}}
        result = turned(tmp_path, more=more)
        verdicts[factor] = [row.decision for row in result.limits]
    assert verdicts == {0.9: ["fail", "pass"], 1.0: ["undecided", "pass"], 1.1: ["pass", "pass"]}
    assert result.exit_status == 0
    assert result.limits_verdict == "PASS: 2 of 2 limits kept"
    assert result.limits[0].cells(result.unit)[1].endswith(" ppm")
    assert result.limits[0].value == pytest.approx(scale, rel=2e-3)
