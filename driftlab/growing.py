"""HDF5 files that grow row by row and can be read at any time, also after the program was killed.

They are written in the single-writer-multiple-reader mode of HDF5: metadata reach the file in an order that leaves it
whole at every moment, so what was flushed is there whatever happens next. A file whose writer was killed still says
that it is being written; opened as a reader beside that writer, it can be read. Its data sets may then differ by the
rows of one flush: the shortest counts.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.errors import UnreadableFile

if TYPE_CHECKING:
    import h5py

Columns = Mapping[str, NDArray[Any]]
BLOCK = 1 << 17  # bytes of one piece of a data set
ROWS = 1 << 16  # rows written, or copied, at once


class GrowingFile:
    """Columns that grow together. The data sets are made when the first rows come.

    Parameters
    ----------
    path : Path
        Of the new file.
    attributes : mapping
        Of the file.
    column_attributes : mapping
        Of each column, by its name.
    """

    def __init__(
        self, path: Path, attributes: Mapping[str, Any], column_attributes: Mapping[str, Mapping[str, Any]]
    ) -> None:
        import h5py

        self.path, self._column_attributes = path, column_attributes
        self._file: h5py.File = h5py.File(path, "w", libver="v110")
        self._file.attrs.update(attributes)
        self._data: dict[str, h5py.Dataset] = {}
        self._pending: list[Columns] = []
        self._waiting = self._written = 0  # rows in memory, and in the file
        self.rows = 0  # that are safe

    def append(self, columns: Columns) -> None:
        """Add rows; few are kept in memory until `flush`, many are written, but only `flush` makes them safe."""
        N = len(next(iter(columns.values())))
        if N == 0:
            return
        self._pending.append(columns)
        self._waiting += N
        if self._waiting >= ROWS:
            self._write()

    def flush(self) -> None:
        """Write what was added; from here on it survives."""
        self._write()
        if self.rows == self._written:
            return
        for data in self._data.values():
            data.flush()
        self.rows = self._written

    def _write(self) -> None:
        if not self._pending:
            return
        names = self._pending[0]
        columns = {name: np.concatenate([part[name] for part in self._pending]) for name in names}
        self._pending.clear()
        if not self._data:
            self._create(columns)
        for name, values in columns.items():
            _extend(self._data[name], self._written, values)
        self._written, self._waiting = self._written + self._waiting, 0

    def close(self) -> None:
        """Write what was added and close the file, which then reads like any other."""
        try:
            self.flush()
        finally:
            self._file.close()

    def _create(self, columns: Columns) -> None:
        for name, values in columns.items():
            rows = max(1, BLOCK // max(1, values[:1].nbytes))
            self._data[name] = self._file.create_dataset(
                name, (0, *values.shape[1:]), values.dtype, maxshape=(None, *values.shape[1:]),
                chunks=(rows, *values.shape[1:]),
            )  # fmt: skip
            self._data[name].attrs.update(self._column_attributes.get(name, {}))
        self._file.swmr_mode = True


def _extend(data: h5py.Dataset, at: int, values: NDArray[Any]) -> None:
    """Add rows after the first `at`: whole pieces directly, ten times as fast as through the library's cache."""
    rows, end = data.chunks[0], at + len(values)
    data.resize(end, axis=0)
    if not np.any(values):  # what was never written is read as zero, and takes no room
        return
    first = min(end, -(-at // rows) * rows)  # the first whole piece
    last = max(first, end // rows * rows)  # the end of the last one
    values = np.ascontiguousarray(values, data.dtype)
    for start in range(first, last, rows):
        data.id.write_direct_chunk((start,) + (0,) * (values.ndim - 1), values[start - at : start - at + rows])
    for start, stop in ((at, first), (last, end)):
        if start < stop:
            data[start:stop] = values[start - at : stop - at]


@contextmanager
def reading(path: Path) -> Iterator[h5py.File]:
    """Open a file, closed or not by the program that wrote it; raises UnreadableFile."""
    import h5py

    file = None
    for swmr in (False, True):
        try:
            file = h5py.File(path, "r", swmr=swmr)
            break
        except OSError as error:
            reason = error
    if file is None:
        raise UnreadableFile(f"{path}: cannot be read ({reason}); it was not written by driftlab, or is damaged")
    try:
        yield file
    finally:
        file.close()


def continued(
    path: Path,
    rows: int | None,
    attributes: Mapping[str, Any],
    column_attributes: Mapping[str, Mapping[str, Any]],
) -> GrowingFile:
    """Return a file in the place of `path` that begins with its first rows (all that are whole, where rows is None)."""
    beside = path.with_name(path.name + ".new")
    new = GrowingFile(beside, attributes, column_attributes)
    with reading(path) as old:
        whole = min((len(data) for data in old.values()), default=0)
        if rows is not None and whole < rows:
            raise UnreadableFile(f"{path}: has {whole} rows, {rows} were expected; begin anew without --resume")
        end = whole if rows is None else rows
        for start in range(0, end, ROWS):
            new.append({name: data[start : min(start + ROWS, end)] for name, data in old.items()})
            new.flush()
    os.replace(beside, path)
    new.path = path
    return new
