"""Results of fleets in SQLite and DuckDB: one fleet's rows are replaced, another's stay, and no password is said."""

import sqlite3
import subprocess
import sys

import duckdb
import polars as pl
import pytest
import sqlalchemy
from lines import DEG_H, line

from driftlab.errors import ConfigError, Unwritable
from driftlab.production.database import Database, tables_of
from driftlab.production.tables import frame_of, join_tables, rows_of

NASTY = "x'); DROP TABLE driftlab_units; --"
LIMIT = {"name": "noise", "axis": "x", "value": 2.0 * DEG_H, "guard": 0.1 * DEG_H, "limit": 3 * DEG_H,
         "unit": "rad/s/sqrt(Hz)", "verdict": "pass", "note": ""}  # fmt: skip


def records(count, column="chamber"):
    """Return the records of units, each with a limit and a column of the manifest."""
    return [one.model_copy(update={"limits": [LIMIT], "more": {column: NASTY}}) for one in line(count)]


def tables(folder, units, key="k", **family):
    """Return the tables of a fleet."""
    path = folder / "units.parquet"
    more = dict.fromkeys(name for one in units for name in one.more)
    frame_of((row for one in units for row in rows_of(one, odd=())), more).write_parquet(folder / "part")
    join_tables(path, [folder / "part"], more, {})
    known = {"odd": {"0001": ["x bends", "y bends"]}, "alarms": {"0002": ["z noise 5"]}, **family}
    counts = {"units": len(units), "done": len(units), "failed": 0}
    summary = {"counts": counts, "units_from": "u.csv", "key": key, "family": known}
    return tables_of("line", summary, more, units, path)


@pytest.fixture(params=["sqlite", "duckdb"])
def place(request, tmp_path):
    """URL of a database, and a function that asks it."""
    path = tmp_path / f"line.{request.param}"

    def ask(query):
        if request.param == "duckdb":
            with duckdb.connect(str(path)) as connection:
                return connection.execute(query).fetchall()
        with sqlite3.connect(path) as connection:
            return connection.execute(query).fetchall()

    return f"{request.param}:///{path}", ask


def put(url, fleet, made):
    database = Database(url)
    try:
        database.replace(fleet, made)
    finally:
        database.close()


def test_it_has_what_the_files_have(place, tmp_path):
    url, ask = place
    note = {"0001": {"note": "known <b>", "by": "anna", "at": "2026-01-05T08:00:00+00:00"}}
    units = records(12)
    put(url, "a", tables(tmp_path, units, acknowledged=note))
    table = pl.read_parquet(tmp_path / "units.parquet")
    rows = ask("SELECT unit, axis, noise, chamber, reasons, odd, samples FROM driftlab_units ORDER BY unit, axis")
    assert [row[:4] for row in rows] == table.sort("unit", "axis").select("unit", "axis", "noise", "chamber").rows()
    assert {row[4:] for row in rows} == {("[]", 0, 7200)}
    assert ask("SELECT fleet, name, units, units_from FROM driftlab_fleets") == [("a", "line", 12, "u.csv")]
    alarms = ask("SELECT unit, kind, reason, acknowledged, note, noted_by FROM driftlab_alarms ORDER BY unit, reason")
    assert alarms == [
        ("0001", "odd", "x bends", 1, "known <b>", "anna"),
        ("0001", "odd", "y bends", 1, "known <b>", "anna"),
        ("0002", "out of control", "z noise 5", 0, None, None),
    ]
    assert ask('SELECT count(*), min(value), min("limit"), min(si), min(verdict) FROM driftlab_limits') == [
        (12, LIMIT["value"], LIMIT["limit"], LIMIT["unit"], "pass")
    ]


def test_a_fleet_s_rows_are_replaced_and_no_other_s(place, tmp_path):
    url, ask = place
    put(url, "a", tables(tmp_path, records(12)))
    put(url, "b", tables(tmp_path, records(5)))
    put(url, "a", tables(tmp_path, records(3), key="later"))
    assert ask("SELECT fleet, count(DISTINCT unit) FROM driftlab_units GROUP BY fleet ORDER BY fleet") == [
        ("a", 3), ("b", 5),
    ]  # fmt: skip
    assert ask("SELECT fleet, units, key FROM driftlab_fleets ORDER BY fleet") == [("a", 3, "later"), ("b", 5, "k")]


def test_a_command_that_fails_changes_nothing(place, tmp_path):
    url, ask = place
    put(url, "a", tables(tmp_path, records(12)))
    made = tables(tmp_path, records(3))
    columns, rows = made["driftlab_limits"]

    def broken():
        yield from rows
        raise OSError(28, "disk full")

    with pytest.raises(Unwritable, match="disk full"):
        put(url, "a", {**made, "driftlab_limits": (columns, broken())})
    assert ask("SELECT count(*) FROM driftlab_units") == [(36,)]
    assert ask("SELECT units FROM driftlab_fleets") == [(12,)]


def test_columns_of_another_manifest_are_added(place, tmp_path):
    url, ask = place
    put(url, "a", tables(tmp_path, records(2)))
    for name in ("operator [100 %s]", 'say "no"; DROP TABLE driftlab_units', "Chamber", "LOT", "limit"):
        put(url, name, tables(tmp_path, records(2, name)))
    assert ask("SELECT count(*) FROM driftlab_units") == [(36,)]
    assert ask('SELECT count(*) FROM driftlab_units WHERE "operator [100 %s]" IS NOT NULL') == [(6,)]
    assert ask("SELECT DISTINCT chamber FROM driftlab_units WHERE fleet = 'Chamber'") == [(NASTY,)]
    assert ask("SELECT DISTINCT \"LOT_\" FROM driftlab_units WHERE fleet = 'LOT'") == [(NASTY,)]


def test_a_column_is_spelt_as_the_table_has_it(place, tmp_path):
    """Databases that tell capitals apart, as PostgreSQL, would else have no such column."""
    url, ask = place
    put(url, "a", tables(tmp_path, records(2)))
    written = []

    def note(connection, cursor, statement, *others):
        written.append(statement)

    sqlalchemy.event.listen(sqlalchemy.Engine, "before_cursor_execute", note)
    try:
        put(url, "b", tables(tmp_path, records(2, "CHAMBER")))
    finally:
        sqlalchemy.event.remove(sqlalchemy.Engine, "before_cursor_execute", note)
    (insert,) = [text for text in written if text.startswith("INSERT INTO driftlab_units")]
    assert "chamber" in insert
    assert "CHAMBER" not in "".join(written)
    assert ask("SELECT DISTINCT chamber FROM driftlab_units WHERE fleet = 'b'") == [(NASTY,)]


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("no url secret", "--to: is no URL of a database; write KIND"),
        ("sqlite://line.db?timeout=secret", "--to: is no URL of a database; write KIND"),
        ("nosuch://user:secret@host/line", "--to nosuch://host/line: no package for nosuch is installed"),
        ("postgresql+pg8000://user:secret@host/line", "--to postgresql+pg8000://host/line: needs the package pg8000"),
        ("sqlite:////no/such/folder/line.db?timeout=7", "--to sqlite:////no/such/folder/line.db: cannot be"),
        ("duckdb://user:secret@/line.duckdb", "--to duckdb:///line.duckdb: duckdb takes no such user, password or"),
        ("duckdb:////no/such/folder/secret%2Fline?token=secret", "--to duckdb:////no/such/folder/"),
    ],
)
def test_a_database_that_cannot_be_had_is_said_without_its_password(url, said):
    with pytest.raises((ConfigError, Unwritable)) as refused:
        Database(url)
    assert str(refused.value).startswith(said)
    assert "secret" not in str(refused.value).replace("folder/secret", "")


def test_a_table_of_others_is_left_and_said(place, tmp_path):
    url, ask = place
    put(url, "a", tables(tmp_path, records(2)))
    ask("DROP TABLE driftlab_limits")
    ask("CREATE VIEW driftlab_limits AS SELECT 1 AS one")
    with pytest.raises(Unwritable, match="cannot be written"):
        put(url, "a", tables(tmp_path, records(3)))
    assert ask("SELECT count(*) FROM driftlab_units") == [(6,)]


def test_without_the_package_the_extra_is_named():
    code = "import sys; sys.modules['sqlalchemy'] = None; from driftlab.production.database import Database\n"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}Database('sqlite:///x.db')"], capture_output=True, text=True, check=False
    )
    assert "--to: the package sqlalchemy is not installed, it was expected for databases; pip install" in done.stderr
    assert "pip install 'driftlab[sql]'" in done.stderr
