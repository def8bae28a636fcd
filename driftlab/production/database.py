"""Results of a fleet as tables of a SQL database, by SQLAlchemy: what `driftlab fleet --to URL` writes.

==================  ==================================================================
`driftlab_fleets`   a row a fleet: its `fleet` (the `id` in fleet.json), name, versions, counts
`driftlab_units`    the rows of units.parquet; lists are texts of JSON
`driftlab_alarms`   a row an alarm of a unit: odd, or out of control; with its note
`driftlab_limits`   a row a limit of the config and unit, with its verdict
==================  ==================================================================

Rows of a fleet replace those that it had, and no other's, in one transaction. A column that a table lacks is added.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab import __version__
from driftlab.family.record import UnitRecord
from driftlab.production.tables import all_columns
from fusion_core.errors import ConfigError, Unwritable, check_installed, quote

if TYPE_CHECKING:
    from sqlalchemy import URL, Connection, Engine

AT_ONCE = 500  # rows of a statement
LONGEST = 300  # characters of what a database says of an error
Columns = Mapping[str, str]  # type by name
FLEETS: Columns = {
    "name": "text", "written": "text", "driftlab": "text", "units_from": "text", "config": "text", "key": "text",
    "units": "count", "done": "count", "failed": "count",
}  # fmt: skip
ALARMS: Columns = {
    "unit": "text", "kind": "text", "reason": "text", "acknowledged": "flag", "note": "text", "noted_by": "text",
    "noted_at": "text",
}  # fmt: skip
LIMITS: Columns = {
    "unit": "text", "name": "text", "axis": "text", "value": "number", "guard": "number", "limit": "number",
    "si": "text", "verdict": "text", "note": "text",
}  # fmt: skip
Row = Mapping[str, Any]


class Database:
    """A database that is reached, to which the results of one fleet go.

    Parameters
    ----------
    url : str
        As SQLAlchemy has it: `sqlite:///line.db`, `duckdb:///line.duckdb`, `postgresql://user@host/line`.

    Raises
    ------
    ConfigError
        If it is no such URL, or a package for it is not installed.
    Unwritable
        If it does not answer.
    """

    def __init__(self, url: str) -> None:
        check_installed("--to", "sqlalchemy", "databases", "sql")
        import sqlalchemy

        try:
            parsed = sqlalchemy.make_url(url)
            self.name, self._secrets = place_of(parsed), _secrets(parsed)
            self._engine: Engine = sqlalchemy.create_engine(parsed, hide_parameters=True)
        except sqlalchemy.exc.NoSuchModuleError:
            raise ConfigError(
                f"--to {self.name}: no package for {quote(parsed.drivername)} is installed; pip install "
                "'driftlab[sql]' has duckdb's, SQLAlchemy's pages name others"
            ) from None
        except (sqlalchemy.exc.ArgumentError, ValueError):  # sqlite://line.db: two slashes for three
            raise ConfigError(
                "--to: is no URL of a database; write KIND://USER@HOST/NAME, or sqlite:///FILE.db"
            ) from None
        except ImportError as error:
            raise ConfigError(f"--to {self.name}: needs the package {error.name}; install it") from None
        try:
            with self._errors():
                self._engine.connect().close()
        except TypeError:  # of a driver whose call has no such argument
            raise ConfigError(
                f"--to {self.name}: {quote(parsed.drivername)} takes no such user, password or options; leave them out"
            ) from None

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Raise what the database says as Unwritable, without passwords."""
        from sqlalchemy.exc import SQLAlchemyError

        try:
            yield
        except (SQLAlchemyError, OSError) as error:
            text = str(getattr(error, "orig", None) or error)
            for secret in self._secrets:
                text = text.replace(secret, "***")
            raise Unwritable(
                f"--to {self.name}: cannot be written ({quote(' '.join(text.split()), LONGEST)}); mend it and give the "
                "same command again, what is done stays"
            ) from None

    def replace(self, fleet: str, tables: Mapping[str, tuple[Columns, Iterable[Row]]]) -> None:
        """Replace the rows of a fleet in tables of the given columns, all or none; raises Unwritable."""
        with self._errors(), self._engine.begin() as connection:
            for name, (columns, rows) in tables.items():
                _replace(connection, name, fleet, columns, rows)

    def close(self) -> None:
        """Give back its connections."""
        self._engine.dispose()


def place_of(url: URL) -> str:
    """Return a URL without user, password and options."""
    host = f"{url.host or ''}{f':{url.port}' if url.port else ''}"
    return quote(f"{url.drivername}://{host}/{url.database or ''}", 200)


def _secrets(url: URL) -> list[str]:
    """Return the password, and the values of options, which may be one; as they are and as a URL has them."""
    from urllib.parse import quote as escaped
    from urllib.parse import quote_plus

    values = chain.from_iterable((v,) if isinstance(v, str) else v for v in url.query.values())
    known = [str(url.password), *values] if url.password else [*values]
    forms = {form for text in known for form in (text, escaped(text, safe=""), quote_plus(text))}
    return sorted(filter(None, forms), key=len, reverse=True)


def _replace(connection: Connection, name: str, fleet: str, columns: Columns, rows: Iterable[Row]) -> None:
    """Replace the rows of a fleet in one table, which is made where it is not there."""
    import sqlalchemy as sql
    from sqlalchemy.schema import CreateColumn

    types = {"number": sql.Double, "count": sql.BigInteger, "flag": sql.Boolean}
    names, there = _apart(["fleet", *columns]), dict[str, str]()
    if sql.inspect(connection).has_table(name):
        empty = sql.select(sql.text("*")).select_from(sql.table(name)).where(sql.false())
        there = {str(key).casefold(): str(key) for key in connection.execute(empty).keys()}  # noqa: SIM118 - no mapping
    names = {key: there.get(own.casefold(), own) for key, own in names.items()}  # as the table spells it
    fields = [sql.Column(own, types.get(columns.get(key, ""), sql.Text)()) for key, own in names.items()]
    table = sql.Table(name, sql.MetaData(), *fields)
    table.create(connection, checkfirst=True)
    quoted = connection.dialect.identifier_preparer.format_table(table)
    for own in (own for own in fields if there and own.name.casefold() not in there):
        kind = CreateColumn(own).compile(dialect=connection.dialect)
        connection.exec_driver_sql(f"ALTER TABLE {quoted} ADD COLUMN {kind!s}")  # compiled: as it is
    connection.execute(table.delete().where(table.c.fleet == fleet))
    left = iter(rows)
    while some := list(islice(left, AT_ONCE)):
        filled = [{own: _cell(row.get(key)) for key, own in names.items()} | {"fleet": fleet} for row in some]
        connection.execute(table.insert(), filled)


def _apart(names: Iterable[str]) -> dict[str, str]:
    """Return the names of columns in a database: one that differs from another in its capitals alone ends with `_`."""
    taken: dict[str, str] = {}
    for name in names:
        own = name
        while own.casefold() in {other.casefold() for other in taken.values()}:
            own += "_"
        taken[name] = own
    return taken


def _cell(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, (list, tuple, dict)) else value


def tables_of(
    name: str, summary: Mapping[str, Any], own: Iterable[str], records: Iterable[UnitRecord], table: Path
) -> dict[str, tuple[Columns, Iterable[Row]]]:
    """Return the tables of a fleet, of its `fleet.json`, the records of its units and its `units.parquet`.

    `own` are the manifest's own columns; records are read as they are written.
    """
    counts = {key: summary["counts"][key] for key in ("units", "done", "failed")}
    texts = {key: summary.get(key) for key in ("units_from", "config", "key")}
    written = datetime.now(UTC).isoformat(timespec="seconds")
    fleet = {"name": name, "written": written, "driftlab": __version__, **texts, **counts}
    units = {key: column.type for key, column in all_columns(own).items()}
    return {
        "driftlab_fleets": (FLEETS, [fleet]),
        "driftlab_units": (units, _rows(table)),
        "driftlab_alarms": (ALARMS, _alarms(summary["family"])),
        "driftlab_limits": (LIMITS, _limits(records)),
    }


def _rows(table: Path) -> Iterator[Row]:
    import polars as pl

    for some in pl.read_parquet(table).iter_slices(AT_ONCE):
        yield from some.iter_rows(named=True)


def _alarms(family: Mapping[str, Any]) -> Iterator[Row]:
    for kind, key in (("odd", "odd"), ("out of control", "alarms")):
        for unit, reasons in family.get(key, {}).items():
            note = family.get("acknowledged", {}).get(unit)
            noted = {"note": note["note"], "noted_by": note["by"], "noted_at": note["at"]} if note else {}
            for reason in reasons:
                yield {"unit": unit, "kind": kind, "reason": reason, "acknowledged": note is not None, **noted}


def _limits(records: Iterable[UnitRecord]) -> Iterator[Row]:
    for record in records:
        for row in record.limits:
            yield {**row, "unit": record.unit, "si": row.get("unit")}
