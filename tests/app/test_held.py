"""A resistor at a constant input through every command: each table, page and JSON is in ppm."""

import io
import json
import re
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from driftlab import cli
from driftlab.config import load_config
from driftlab.live.screen import screen
from driftlab.live.status import Status
from fusion_core.errors import ConfigError

ROOT = Path(__file__).parent.parent.parent
DATA = ROOT / "examples" / "data" / "oven_resistors" / "lagging.csv"
DECLARED = ROOT / "examples" / "02_oven_resistor" / "declared.yaml"
PPM = 1e-6
WRONG = re.compile(r"deg/h|rad/s|rad_s|\brad\b|gyro|Earth|[Hh]eading|resistance resistance")


class Bench:
    """A folder with a config whose map is fitted, and the commands."""

    def __init__(self, folder, capsys):
        self.folder, self.capsys = folder, capsys

    def driftlab(self, *args):
        """Run a command and return what it prints."""
        cli.app([*map(str, args)], standalone_mode=False)
        return self.capsys.readouterr().out

    def page(self, *parts):
        """Return the text of a page or a figure."""
        return unescape(self.folder.joinpath(*parts).read_text())


@pytest.fixture
def bench(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    text = DECLARED.read_text().replace("outside: clamp", "outside: clamp, path: map.json")
    (tmp_path / "held.yaml").write_text(text)
    (tmp_path / "quiet.yaml").write_text("extends: held.yaml\nfilter: {noise: 0.02 ppm/sqrt(Hz)}\n")
    found = Bench(tmp_path, capsys)
    found.fitted = found.driftlab("fit-map", "held.yaml", "--input", f"{DATA}::0:9300")
    return found


def right(*texts):
    """Assert that each has a ppm, and nothing of a gyro."""
    for text in texts:
        assert "ppm" in text
        assert not WRONG.search(text), WRONG.search(text)
    return True


def test_fit_map_and_check_speak_of_ppm(bench):
    record = json.loads((bench.folder / "map.json").read_text())["record"]
    assert (record["channel"], record["unit"], record["axes"]) == ("resistance", "1", ["resistance"])
    shown = re.search(r"residual resistance: +(\S+) ppm \(rms", bench.fitted)
    assert float(shown[1]) * PPM == pytest.approx(record["residual"][0], rel=1e-3)
    assert re.search(r"good to \S+ ppm between 25 and 35 °C \(1 sigma", bench.fitted)
    assert "hysteresis or lag: up and down differ in resistance by" in bench.fitted  # its author names a lag
    checked = bench.driftlab("check", "held.yaml", "--input", DATA)
    assert right(bench.fitted, checked)
    assert "map polynomial: of the resistance in ppm" in checked


def test_run_is_in_ppm_in_the_terminal_on_the_page_and_in_the_json(bench):
    printed = bench.driftlab("run", "quiet.yaml", "--input", f"{DATA}::9300:18300", "--out", "run")
    summary = json.loads((bench.folder / "run" / "summary.json").read_text())
    page = bench.page("run", "report.html")
    assert right(printed, page)
    assert summary["unit"] == "1"
    assert not [key for key in summary if WRONG.search(key)]
    coast = summary["coast_rmse"]["to the end"][0]
    assert 0.1 * PPM < coast < 2 * PPM
    shown = re.search(r"prediction, to the end │ resistance │ +(\S+) │", printed)
    assert float(shown[1]) * PPM == pytest.approx(coast, rel=1e-3)
    assert "<th>resistance [ppm]</th></tr>" in page
    assert "bias resistance [ppm]" in page  # of the figure
    assert "<h2>Bias of the resistance</h2>" in page
    (note,) = [line for line in printed.splitlines() if "white noise" in line]
    assert re.search(
        r"resistance: white noise is not as declared \(measured / declared: \S+\); set filter\.noise", note
    )


def test_a_refused_update_names_the_channel_once(bench):
    rows = DATA.read_text().splitlines()
    for k in range(400, 404):
        t, value, *rest = rows[k].split(",")
        rows[k] = ",".join([t, str(float(value) + 50), *rest])
    (bench.folder / "spike.csv").write_text("\n".join(rows[:1800]) + "\n")
    printed = bench.driftlab("run", "held.yaml", "--input", "spike.csv", "--out", "run")
    assert "refused although nothing moved" in printed
    assert "because of resistance; the model does not fit there" in " ".join(printed.split())
    assert right(printed)


def test_compare_disturbs_and_judges_in_ppm(bench):
    args = ("compare", "held.yaml", "quiet.yaml", "--input", f"{DATA}::0:4000")
    printed = bench.driftlab(*args, "--out", "compared", "--paper")
    page, content = bench.page("compared", "report.html"), json.loads(bench.driftlab(*args, "--json"))
    assert right(printed, page)
    assert "Time to within 0.1 ppm, 1 ppm at the start" in " ".join(printed.split())
    assert re.match(r"On this one recording .* ppm, .* the sigma", " ".join(printed.split()))
    assert "resistance [ppm]" in page
    # five times 0.2 ppm, what the first config declares, for both
    assert (content["unit"], content["initial_error"], content["threshold"]) == pytest.approx(("1", 1e-6, 1e-7))
    assert not WRONG.search(json.dumps(content))
    for config in content["configs"].values():
        assert config["coast_rmse"]["1 min"][0] < PPM
        assert config["initial_error"]["rmse_first_30_s"][0] > 0.2 * PPM


def test_configs_of_different_sensors_are_not_compared(bench):
    other = "extends: held.yaml\nsource: {channels: {probe: {path: ambient, unit: ppm}}}\nfilter: {channel: probe}\n"
    (bench.folder / "other.yaml").write_text(other)
    with pytest.raises(ConfigError, match="different sensors \\(held: resistance in 1, other: probe in 1\\)"):
        bench.driftlab("compare", "held.yaml", "other.yaml", "--input", DATA)


def test_allan_gives_lines_that_a_config_takes_as_they_are(bench):
    printed = bench.driftlab("allan", "held.yaml", "--input", DATA, "--out", "allan")
    content = json.loads((bench.folder / "allan" / "allan.json").read_text())
    figure = bench.page("allan", "allan.svg")
    assert right(printed, bench.page("allan", "report.html"), figure)
    walk = content["resistance"]["resistance"]["rate_random_walk"]
    assert walk["unit"] == "1/sqrt(s)"
    assert content["curves"]["resistance"]["unit"] == "1"
    assert "deviation of resistance [ppm]" in figure
    (bench.folder / "pasted.yaml").write_text("extends: held.yaml\n" + content["config"])
    pasted = load_config(bench.folder / "pasted.yaml").filter
    assert pasted.tracked.shown == "ppm"
    assert walk["low"] * 0.999 <= pasted.bias.walk <= walk["high"] * 1.001
    # the deviation of neighbours, from its definition
    step = np.diff(np.genfromtxt(DATA, delimiter=",", names=True)["ppm"]) * PPM
    first = content["curves"]["resistance"]["resistance"]["allan"][0]
    assert first == pytest.approx(np.sqrt(np.mean(step**2) / 2), rel=1e-6)


def test_explain_and_its_arrays_are_in_ppm(bench):
    parts = [f"{DATA}::{span}" for span in ("0:9300", "9300:18300", "18300:")]
    flags = ("--calibration", "--train", "--holdout")
    recordings = [item for pair in zip(flags, parts, strict=True) for item in pair]
    printed = bench.driftlab("explain", "held.yaml", *recordings, "--out", "closed")
    assert right(printed, bench.page("closed", "report.html"))
    content = json.loads((bench.folder / "closed" / "loop.json").read_text())
    assert content["unit"] == "1"
    assert content["after"]["coast_rmse"][0] < content["before"]["coast_rmse"][0] < 2 * PPM


def test_a_live_screen_is_in_ppm():
    from rich.console import Console

    sensor = load_config(DECLARED).filter.tracked
    status = Status(samples=10, waiting=None, bias=np.array([3.2e-6]), sigma=np.array([2e-8]), sensor=sensor)
    status.axes = sensor.axes
    console = Console(width=100, file=io.StringIO())
    console.print(screen(status))
    text = console.file.getvalue()
    assert re.search(r"resistance bias +3\.2 ± 0\.02 ppm\s*$", text, re.MULTILINE)
    assert right(text)
    content = status.as_json()
    assert (content["unit"], content["bias"][0], content["sigma"][0]) == ("1", 3.2e-6, 2e-8)
