"""`fit-map --family` and `plan --family`: a map that other commands read, and what is said of it."""

import json
from pathlib import Path

import family as example
import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import driftlab
from driftlab.cli import app
from driftlab.errors import ConfigError
from driftlab.family.band_calibration import measure_bands
from driftlab.family.file import save_family
from driftlab.family.mixed_model import fit_family
from driftlab.family.unit_information import UnitInformation
from driftlab.soak.blocks import SoakRows

ERRORS = (Path(__file__).parents[3] / "docs" / "reference" / "errors.md").read_text()
CONFIG = Path(example.__file__).with_name("family.yaml").read_text()
EARTH = example.EARTH * np.array([np.cos(example.LATITUDE), 0.0, np.sin(example.LATITUDE)])
AXES = ("x", "y", "z")


def soaked(unit):
    """Return what a whole soak of 1 h, a row each 20 s, says."""
    found = example.soak(unit, 1.0, dt=20.0)
    rows = SoakRows(found["time"], found["temperature"], found["gyro"] - EARTH, np.full(len(found["time"]), 20.0), {})
    return UnitInformation.of(unit.name, AXES, [rows], unit.noise * example.DEG_H, unit.walk * example.DEG_H, 2.5)


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A folder with a family of three lots, a unit that was soaked short, and one of it that was not."""
    folder = tmp_path_factory.mktemp("line")
    units = [(soaked(unit), unit.lot) for unit in example.deal(60, seed=11, lots=3)]
    family = fit_family(units)
    save_family(folder / "family.json", family.model_copy(update={"bands": measure_bands(family, units)}))
    unit = example.deal(1, seed=12)[0]
    example.write(folder / "short.h5", example.soak(unit, 0.5, part=0.4))
    example.write(folder / "whole.h5", example.soak(unit, 0.5, seed=1))
    (folder / "unit.yaml").write_text(CONFIG)
    return folder, unit


@pytest.fixture(autouse=True)
def here(line, monkeypatch):
    monkeypatch.chdir(line[0])


def run(*args):
    return CliRunner().invoke(app, list(map(str, args)))


def test_the_map_is_of_the_whole_range_and_every_command_reads_it(line):
    unit = line[1]
    done = run("fit-map", "unit.yaml", "--input", "short.h5", "--family", "family.json", "--out", "map.json", "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["domain"][0] <= -20 < 60 <= said["domain"][1]
    assert said["judged"]["soaked_degC"] == pytest.approx([-20, 12], abs=0.2)
    T = np.linspace(-20, 60, 81)
    assert run("export", "csv_table", "map.json", "--out", "map.csv").exit_code == 0
    table = pl.read_csv("map.csv", comment_prefix="#")
    at = table.columns[0]
    found = np.stack([np.interp(T, table[at], table[name]) for name in table.columns[1:4]], axis=1)
    truth = unit.bias(T)
    scale = np.abs(truth).max() / np.abs(found).max()
    assert found * (scale if scale > 100 else 1) == pytest.approx(truth, abs=6 * max(said["judged"]["sigma"]["worst"]))
    (line[0] / "mapped.yaml").write_text(CONFIG.replace("map: {kind: spline}", "map: {kind: spline, path: map.json}"))
    checked = run("check", "mapped.yaml")
    assert checked.exit_code == 0
    assert "curve known to" in checked.output
    ran = run("run", "mapped.yaml", "--input", "whole.h5", "--out", "out", "--json")
    assert ran.exit_code == 0, ran.output


def test_it_says_what_the_soak_told_and_what_the_family_adds():
    done = run("fit-map", "unit.yaml", "--input", "short.h5", "--family", "family.json", "--lot", "L09")
    assert done.exit_code == 0
    for words in ("good to", "its own soak saw -20 to 12", "the family of 60 units", "left out of the family"):
        assert words in done.stdout
    assert "lot L09: is not one of the family's (L00, L01, L02); taken as unknown" in done.stdout + done.stderr


def test_a_plan_says_what_to_soak():
    done = run("plan", "unit.yaml", "--family", "family.json", "--hours", 2, "--lag", "1 min", "--sigma", "8 deg/h",
               "--out", "plan", "--json")  # fmt: skip
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    held = json.loads(Path("plan/plan.json").read_text())
    assert held.pop("written")
    assert found == held
    assert found["target"]["reached"]
    assert found["profile"]["sigma"] <= found["target"]["sigma"] < found["profile"]["without_family"]
    assert sorted(path.name for path in Path("plan").iterdir()) == ["plan.json", "report.html", "setpoints.csv"]
    again = driftlab.plan("unit.yaml", 2, family="family.json", lag="1 min")
    assert again.summary["tried"] == found["tried"]
    with pytest.raises(ConfigError, match="leave after and effects out"):
        driftlab.plan("unit.yaml", family="family.json", effects=("hysteresis",))


@pytest.mark.parametrize("more", [("--family", "family.json", "--kind", "spline"), ("--lot", "L07")])
def test_what_does_not_go_together_is_refused_in_the_words_of_the_reference(more):
    done = run("fit-map", "unit.yaml", "--input", "short.h5", *more)
    assert isinstance(done.exception, ConfigError)
    assert f"\n    driftlab: {done.exception}\n" in ERRORS


def test_from_python_it_is_the_command_s_map():
    done = run("fit-map", "unit.yaml", "--input", "short.h5", "--family", "family.json", "--lot", "L01",
               "--out", "by_command.json")  # fmt: skip
    assert done.exit_code == 0, done.output
    found = driftlab.fit_map("unit.yaml", "short.h5", family="family.json", lot="L01", out="by_python.json")
    maps = [json.loads(Path(name).read_text()) for name in ("by_command.json", "by_python.json")]
    for one in maps:
        del one["record"]["provenance"]["fitted_at"], one["record"]["provenance"]["written"]  # its time, and SHA-256
    assert maps[0] == maps[1]
    assert found["bias"].shape == found["own_sigma"].shape == (len(found["temperature"]), 3)
    with pytest.raises(ConfigError, match=r"^family: gives a spline"):
        driftlab.fit_map("unit.yaml", "short.h5", family="family.json", compare=True)
    with pytest.raises(ConfigError, match=r"^lot: is of a unit that has a family"):
        driftlab.fit_map("unit.yaml", "short.h5", lot="L01")
