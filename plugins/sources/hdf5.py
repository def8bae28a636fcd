"""Recordings as data sets of an HDF5 file; a NetCDF-4 file is one and is read as it is.

::

    value = raw * scale_factor + add_offset,    NaN where raw is _FillValue or missing_value

as the CF conventions (section 8.1) define packed data; a file without these attributes is read unchanged. A
unit is an attribute `unit` or `units` of the data set. Rows are read in blocks, before START only their time; what a
file may cost is bounded by `fusion_core.data_sets`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from fusion_core.budget import rows_at_once
from fusion_core.chunk import Array
from fusion_core.contracts import Block, Table, foreign, head
from fusion_core.contracts.table import row_blocks
from fusion_core.data_sets import DataSetRows, attribute, check_rows, names_of
from fusion_core.errors import BadValue, FusionError, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.joining import TableSource
from fusion_plugins.sources.unpacked import damaged, unpacking

SIGNATURE = b"\x89HDF\r\n\x1a\n"


@hookimpl
class Hdf5(TableSource):
    """An HDF5 or NetCDF-4 file."""

    signatures: ClassVar[tuple[bytes, ...]] = (SIGNATURE,)
    suffixes: ClassVar[tuple[str, ...]] = (".h5", ".hdf5", ".nc")

    kind: Literal["hdf5"] = "hdf5"

    @unpacking
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the file; raises UnreadableFile where it is of another kind, damaged, or being written."""
        import h5py

        first = head(path)
        with _translated(path):
            cut = first.startswith(SIGNATURE) or SIGNATURE.startswith(first)
            if not cut and not h5py.is_hdf5(path):
                raise foreign(path, first, self.kind)
            with _open(path) as file:
                yield DataSets(path, file)


class DataSets(Table):
    """The data sets of an open file."""

    noun: ClassVar[str] = "data set"

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self.file = path, file
        self._data: dict[str, DataSetRows] = {}

    @cached_property
    def names(self) -> Sequence[str]:
        """Every data set, in groups too; of a name that is not UTF-8, the bytes are shown."""
        return [name.decode("utf-8", "backslashreplace") for name in names_of(self.path, self.file)]

    def has(self, path: str) -> bool:
        """Return True if `path` is a data set; it may begin with a slash."""
        return path.strip("/") in self.names and path in self.file

    def unit(self, path: str) -> str | None:
        """Return the attribute `unit` or `units`, where it is text."""
        for name in ("unit", "units"):
            value = np.ravel(self._attribute(path, name))
            text = value[0] if len(value) == 1 else None
            text = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
            if isinstance(text, str) and text.strip("\0 "):
                return text.strip("\0 ")
        return None

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of `size` rows; nothing is read before a column is asked for."""
        rows = self._rows(paths)
        self._data = {path: DataSetRows(self.path, self.file[path]) for path in paths}  # once, not for every block
        data = list(self._data.values())
        check_rows(self.path, data)
        row = sum(8.0 * np.prod(column.node.shape[1:]) for column in data)
        size = rows_at_once(self.path, f"the data sets {', '.join(paths)}"[:100], size, row)
        packing = {path: self._packing(path) for path in paths}
        yield from row_blocks(rows, size, partial(self._read, packing))

    def _rows(self, paths: Sequence[str]) -> int:
        """Return the number of rows of all data sets together."""
        kinds = {path: (self.file[path].shape, self.file[path].dtype) for path in paths}
        if self.file.swmr_mode:
            # a writer that was killed has left some data sets longer than others by what it wrote last
            whole = min(shape[0] for shape, _ in kinds.values() if shape)
            kinds = {path: ((whole, *shape[1:]), dtype) for path, (shape, dtype) in kinds.items()}
        first, expected = paths[0], kinds[paths[0]][0]
        for path, (shape, dtype) in kinds.items():
            where = f"{self.path}: data set '{path}' has"
            if dtype.kind not in "iufb":
                raise BadValue(f"{where} values of type {dtype}, numbers were expected; name another data set")
            if len(shape) not in (1, 2):
                raise BadValue(f"{where} shape {shape}, (rows,) or (rows, axes) was expected; name another data set")
            if shape[0] != expected[0]:
                raise BadValue(
                    f"{where} shape {shape} and '{first}' {expected}, the same number of rows was expected; "
                    "name data sets that were sampled together, rows along the first axis"
                )
        return int(expected[0])

    def _packing(self, path: str) -> tuple[list[Any], float, float]:
        """Return the raw values that stand for a missing one, the factor and the offset."""
        missing = [self._attribute(path, name) for name in ("_FillValue", "missing_value")]
        if missing[0] is None and "_NCProperties" in self.file.attrs:
            missing.append(self.file[path].fillvalue or None)  # NetCDF's default for its type; 0 where it has none
        values = [value for part in missing if part is not None for value in np.ravel(part)]
        return values, self._factor(path, "scale_factor", 1.0), self._factor(path, "add_offset", 0.0)

    def _factor(self, path: str, name: str, default: float) -> float:
        """Return the attribute as a number, `default` where it is not there; raises BadValue."""
        value = self._attribute(path, name)
        if value is None:
            return default
        if np.size(value) != 1 or np.asarray(value).dtype.kind not in "iuf" or not np.isfinite(value).all():
            raise BadValue(
                f"{self.path}: data set '{path}' has the attribute {name} {str(value)[:40]!r}, one finite number was "
                "expected; correct or remove it"
            )
        return float(np.ravel(value)[0])

    def _read(self, packing: dict[str, tuple[list[Any], float, float]], rows: slice, path: str) -> Array:
        missing, factor, offset = packing[path]
        raw = self._data[path][rows]
        values = np.asarray(raw, dtype=np.float64)
        for value in missing:
            values = np.where(raw == value, np.nan, values)
        return values if factor == 1 and offset == 0 else values * factor + offset

    def _attribute(self, path: str, name: str) -> Any:
        return attribute(self.path, self.file[path], name)


def _open(path: Path) -> Any:
    """Open the file; one whose writer goes on, or was killed, beside that writer where it wrote for readers (SWMR)."""
    import h5py

    try:
        return h5py.File(path, "r")
    except OSError as error:
        if "already open for" in str(error):  # as a writer's mark in the file says
            with suppress(OSError):
                return h5py.File(path, "r", swmr=True)
        raise error
    except RuntimeError as error:  # of a header that is cut short
        raise OSError(str(error)) from None


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn what h5py raises, while the file is open, into UnreadableFile."""
    try:
        yield
    except FusionError:
        raise
    except BlockingIOError:
        raise UnreadableFile(
            f"{path}: is being written by another program; wait until it is closed, or read a copy"
        ) from None
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError) as error:
        reason = str(error).strip("'\"")
        if "filter" in reason and ("regist" in reason or "plugin" in reason):
            raise UnreadableFile(
                f"{path}: is compressed with a filter that is not installed ({reason}); "
                "rewrite it with `h5repack -f GZIP=4 OLD NEW`"
            ) from None
        if "already open for write" in reason:
            raise UnreadableFile(
                f"{path}: was not closed by the program that wrote it; repair a copy with `h5clear -s COPY`"
            ) from None
        # of `Unable to ... (truncated file: eof = ...)` the library's cause, without its numbers
        raise damaged(path, reason.rpartition(" (")[2].partition(": eof")[0].rstrip(")")) from None
