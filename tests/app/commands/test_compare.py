"""The output of `driftlab compare`: the best coast, a table that no terminal cuts, the paper's tables on demand."""

import re

import h5py
import pytest
from typer.testing import CliRunner
from units_at_rest import unit_at_rest

from driftlab.cli import app

CONFIG = """
source:
  kind: hdf5
  channels: {{time: {{path: time, unit: s}}, gyro: {{path: gyro, unit: rad/s}}}}
filter:
  gyro: {{noise: 3.18 deg/h/sqrt(Hz), bias: {{kind: random_walk, walk: {walk} deg/s/sqrt(s)}}}}
"""
NAMES = ["standard_of_twenty_c", "nogapsinthisnametwen", "tczupt-twenty-charac", "four", "five_of_eighteen_x"]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    unit = unit_at_rest(seconds=180, rate=5, walk=2.6e-7)
    with h5py.File(folder / "unit.h5", "w") as file:
        file["time"], file["gyro"] = unit.t, unit.gyro
    for k, name in enumerate(NAMES):
        (folder / f"{name}.yaml").write_text(CONFIG.format(walk=f"{k + 1}e-5"))
    return folder


@pytest.fixture
def printed(bench, monkeypatch):
    def printed(count, *, columns=80, paper=False):
        monkeypatch.setenv("COLUMNS", str(columns))
        paths = [bench / f"{name}.yaml" for name in NAMES[:count]]
        more = ["--paper"] if paper else []
        done = CliRunner().invoke(app, ["compare", *map(str, paths), "--input", str(bench / "unit.h5"), *more])
        assert done.exit_code == 0, done.output
        return done.stdout

    return printed


@pytest.mark.parametrize(("count", "tables"), [(3, 1), (4, 1), (5, 2)])
def test_80_columns_hold_any_number_of_configs(printed, count, tables):
    text = printed(count)
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert text.count("┏") == tables
    assert text.count("[deg/h]") == count


def test_where_not_even_one_fits_no_number_is_cut(printed):
    text = printed(2, columns=20)
    assert text.count("┏") == 2
    assert "…" not in text
    assert all(re.search(r"│ +\d+\.\d\d │$", line) for line in text.splitlines() if "prediction, 1 min" in line)


def test_the_sentence_stands_above_and_the_decisive_row_first(printed):
    lines = printed(2).splitlines()
    assert lines[0].startswith("On this one recording ")
    first = next(line for line in lines if line.startswith("│"))
    assert re.match(r"│ prediction, to the end +│ +rms +│", first)


def test_the_paper_s_tables_are_printed_when_they_are_asked_for(printed):
    assert not re.search(r"table \d", printed(2))
    text = printed(2, paper=True)
    for number in ("table 5", "table 6", "table 7", "tables 8, 9", "tables 10, 11", "table 12"):
        assert f"({number})" in " ".join(text.split())
    assert text.count("[rad/s]") == 2 * 5
