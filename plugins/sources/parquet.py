"""Recordings as columns of a Parquet file, read by polars, span after span of rows.

::

    path of a channel        what it names
    gx                       a column of numbers
    imu.gyro.x               a field of a struct
    gyro                     lists of one length, or arrays: one column an axis

Times of day, durations and time stamps with a date come as seconds; a null is NaN. What is not asked for is not read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Block, FileSource, Source, Table, foreign, head
from fusion_core.errors import BadValue, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.parquet_layout import RowGroups

if TYPE_CHECKING:
    import polars as pl

SIGNATURE = b"PAR1"
WIDE = 1024  # values of a list that can be channels


class Parquet(FileSource):
    """A Parquet file."""

    signatures: ClassVar[tuple[bytes, ...]] = (SIGNATURE,)
    suffixes: ClassVar[tuple[str, ...]] = (".parquet", ".pq")

    kind: Literal["parquet"] = "parquet"

    @contextmanager
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the file; raises UnreadableFile where it is of another kind or damaged."""
        first = head(path)
        if not (first.startswith(SIGNATURE) or SIGNATURE.startswith(first)):
            raise foreign(path, first, self.kind)
        yield ParquetColumns(path)


class ParquetColumns(Table):
    """The columns of a file, and the fields of those that are structs."""

    def __init__(self, path: Path) -> None:
        import polars as pl

        self.path = path
        self.layout = RowGroups(path)
        with _translated(path):
            self.frame = pl.scan_parquet(path, glob=False)
            self.schema = self.frame.collect_schema()

    @cached_property
    def names(self) -> Sequence[str]:
        """Every column, and in place of a struct its fields."""
        return [path for name, kind in self.schema.items() for path in _leaves(name, kind)]

    def has(self, path: str) -> bool:
        """Whether `path` is a column, or a field of a struct."""
        return self._found(path) is not None

    def unit(self, path: str) -> str | None:
        """Return `s` for a time or a duration."""
        found = self._found(path)
        return "s" if found and found[1].is_temporal() else None

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of about `size` rows."""
        numbers = [self._numbers(path).alias(str(k)) for k, path in enumerate(paths)]
        for frame in self._frames(numbers, paths):
            for part in frame.iter_slices(size):
                yield Block(len(part), partial(self._read, part, list(paths)))

    def _frames(self, columns: Sequence[pl.Expr], paths: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield expressions of columns as data frames of some rows; the next one is read while one is used."""
        tops = {top for path in paths for top in self.schema.names() if path == top or path.startswith(f"{top}.")}
        waiting: Future[pl.DataFrame] | None = None
        with _translated(self.path), ThreadPoolExecutor(1) as ahead:
            for begin, rows in self.layout.spans(tops):
                query = self.frame.slice(begin, rows).select(columns)
                done, waiting = waiting, ahead.submit(query.collect)
                if done is not None:
                    yield done.result()
                    del done
            if waiting is not None:
                yield waiting.result()

    def _found(self, path: str) -> tuple[pl.Expr, pl.DataType] | None:
        """Return the expression and the type of a column or of a field, None where there is no such one."""
        import polars as pl

        for name, kind in self.schema.items():
            if path == name:
                return pl.col(name), kind
            if isinstance(kind, pl.Struct) and path.startswith(f"{name}."):
                found = _field(pl.col(name), kind, path[len(name) + 1 :])
                if found:
                    return found
        return None

    def _numbers(self, path: str) -> pl.Expr:
        """Return the column as numbers in seconds where it is a time; raises BadValue where it is none."""
        import polars as pl

        found = self._found(path)
        assert found is not None  # as `has` said
        column, kind = found
        if isinstance(kind, pl.List | pl.Array):
            inner = pl.Series(dtype=kind.inner).dtype
            if inner.is_numeric() or inner == pl.Boolean:
                return self._axes(path, column, kind)
        elif kind == pl.Date:
            return column.cast(pl.Datetime("us")).cast(pl.Int64) / 1e6
        elif isinstance(kind, pl.Datetime | pl.Duration):
            return column.cast(pl.Int64) / {"ns": 1e9, "us": 1e6, "ms": 1e3}[kind.time_unit]
        elif kind == pl.Time:
            return column.cast(pl.Int64) / 1e9
        elif kind.is_numeric() or kind == pl.Boolean:
            return column.cast(pl.Float64)
        fields = f"name a field of it, e.g. '{next(_leaves(path, kind), path)}'" if isinstance(kind, pl.Struct) else ""
        raise BadValue(
            f"{self.path}: column '{path}' is {kind}, numbers were expected; "
            + (fields or "name another column, or write it as numbers")
        )

    def _axes(self, path: str, column: pl.Expr, kind: pl.DataType) -> pl.Expr:
        """Return lists as arrays of one length: that of the first row which has one."""
        import polars as pl

        if isinstance(kind, pl.Array):
            self._check_width(path, int(np.prod(kind.shape, dtype=np.float64)))
            return column.cast(pl.Array(pl.Float64, kind.shape))
        lengths = column.list.len()
        query = [lengths.min().alias("least"), lengths.max().alias("most")]
        found = [row for frame in self._frames(query, [path]) for row in frame.rows() if row[0] is not None]
        least, most = min((row[0] for row in found), default=1), max((row[1] for row in found), default=1)
        if least != most:
            raise BadValue(
                f"{self.path}: column '{path}' has lists of {least} to {most} values, lists of one length were "
                "expected; write one column an axis"
            )
        self._check_width(path, most)
        return column.cast(pl.List(pl.Float64)).list.to_array(most or 1)

    def _check_width(self, path: str, width: int) -> None:
        if width > WIDE:
            raise BadValue(
                f"{self.path}: column '{path}' has lists of {width:,} values, at most {WIDE:,} are read; write one "
                "column an axis"
            )

    def _read(self, frame: pl.DataFrame, paths: list[str], path: str) -> Array:
        import polars as pl

        column = frame[str(paths.index(path))]
        if isinstance(column.dtype, pl.Array):
            width = column.dtype.shape[0]
            flat = column.fill_null([None] * width).explode().fill_null(np.nan)
            return flat.to_numpy().reshape(len(frame), width)
        values: Array = column.fill_null(np.nan).to_numpy()
        return values


def _field(column: pl.Expr, kind: pl.Struct, path: str) -> tuple[pl.Expr, pl.DataType] | None:
    """Return the expression and the type of a field, or of a field of a field."""
    import polars as pl

    for field in kind.fields:
        inner = pl.Series(dtype=field.dtype).dtype  # an instance, where the field names a class
        if path == field.name:
            return column.struct.field(field.name), inner
        if isinstance(inner, pl.Struct) and path.startswith(f"{field.name}."):
            found = _field(column.struct.field(field.name), inner, path[len(field.name) + 1 :])
            if found:
                return found
    return None


def _leaves(path: str, kind: object) -> Iterator[str]:
    """Yield a column's path, or those of its fields."""
    import polars as pl

    if isinstance(kind, pl.Struct):
        for field in kind.fields:
            yield from _leaves(f"{path}.{field.name}", field.dtype)
    else:
        yield path


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn what polars raises into UnreadableFile."""
    import polars as pl

    try:
        yield
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        reason = " ".join(str(error).split())[:160]
        raise UnreadableFile(f"{path}: is cut short or damaged ({reason}); copy or record it again") from None


@hookimpl
def sources() -> list[type[Source]]:
    """Register the plugin."""
    return [Parquet]
