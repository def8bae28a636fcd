"""The columns of `units.parquet`: documented where a user looks, and in the file itself."""

import json
from pathlib import Path

import polars as pl
import pytest

from driftlab.family.partitions import ScratchFolder
from driftlab.family.record import Figure, UnitRecord
from driftlab.production.fleet_folder import StoredUnits
from driftlab.production.tables import COLUMNS, _Table, all_columns, frame_of, join_tables, rows_of
from driftlab.production.unit_folders import UnitPlace
from fusion_core.errors import UnreadableFile

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "output_files.md").read_text()


def record(unit, **more):
    return UnitRecord(key="k", unit=unit, state="done", axes=("x", "y"), bias_unit="rad/s", **more)


@pytest.fixture
def written(tmp_path):
    def write(*records, more=()):
        path = tmp_path / "units.parquet"
        parts = [tmp_path / f"part-{k}" for k in range(len(records))]
        for one, part in zip(records, parts, strict=True):
            frame_of(rows_of(one), more).write_parquet(part)
        join_tables(path, parts, more, {"SI": "rad/s"})
        return path

    return write


@pytest.mark.parametrize("name", COLUMNS)
def test_every_column_is_documented_with_its_unit(name):
    column = COLUMNS[name]
    assert f"| `{name}` | {column.unit or '–'} | {column.meaning} |" in PAGE


def test_a_file_says_what_its_columns_are(written):
    path = written(record("1"))
    said = pl.read_parquet_metadata(path)
    assert said["SI"] == "rad/s"
    described = json.loads(said["columns"])
    assert list(described) == pl.read_parquet(path).columns == list(COLUMNS)
    assert described["noise"] == {"unit": "SI/sqrt(Hz)", "meaning": COLUMNS["noise"].meaning}


def test_numbers_are_those_of_the_record_to_the_last_bit(written):
    values = (0.1 + 0.2, 1.0000000000000002e-7)
    figures = {
        "noise": Figure(value=values, sigma=(None, 5e-324)),
        "coast_1min": Figure(value=(None, 1.0), sigma=values),
    }
    rows = pl.read_parquet(written(record("1", figures=figures, map_sigma=(3.0, float("nan")))))
    assert rows["axis"].to_list() == ["x", "y"]
    assert rows["noise"].to_list() == list(values)
    assert rows["noise_sigma"].to_list() == [None, 5e-324]
    assert rows["coast_1min"].to_list() == [None, 1.0]
    assert rows["coast_1min_sigma"].to_list() == list(values)
    assert rows["map_sigma"].to_list() == [3.0, None]  # not a number is not known


def test_limits_and_the_loop_are_one_word_and_their_names(written):
    limits = [{"name": "noise", "verdict": "pass"}, {"name": "residual", "verdict": "fail"}]
    loop = {"verdict": "explained", "effects": [{"kind": "hysteresis"}]}
    found = [
        record("1", limits=limits, loop=loop),
        record("2", limits=limits[:1], loop={"why_not": "no holdout"}),
        record("3"),
    ]
    rows = pl.read_parquet(written(*found)).filter(axis="x")
    assert rows["limits"].to_list() == ["fail", "pass", None]
    assert rows["limits_failed"].to_list() == [["residual"], [], []]
    assert rows["loop"].to_list() == ["explained", "no holdout", None]
    assert rows["effects"].to_list() == [["hysteresis"], [], None]


def test_a_manifest_s_own_columns_stand_behind_the_date_and_none_is_lost(written):
    rows = pl.read_parquet(written(record("1", more={"chamber": "K2", "key": "7"}), more=("chamber", "key")))
    at = rows.columns.index("date")
    assert rows.columns[at + 1 : at + 3] == ["chamber", "manifest_key"]
    assert rows.row(0, named=True)["manifest_key"] == "7"
    assert rows.row(0, named=True)["key"] == "k"


def test_the_schema_is_the_same_whatever_is_in_it(written):
    done = pl.read_parquet_schema(written(record("1")))
    failed = UnitRecord(key="", unit="1", state="failed", error="no file")
    assert pl.read_parquet_schema(written(failed)) == done
    assert len(done) == len(all_columns(()))


def test_a_unit_whose_record_is_gone_is_named(tmp_path):
    folders = UnitPlace(tmp_path, b"")
    units = StoredUnits(folders, ("0007",), ("",))
    with pytest.raises(UnreadableFile, match=r"units/0007: has no record any more; give the same command again"):
        _Table(folders, ScratchFolder(tmp_path), None, (), ()).write(units, [False], [None], [None], [None], ["part"])
