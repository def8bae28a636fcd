"""HDF5 files that grow row by row and can be read at any time, also after the program was killed.

They are written in the single-writer-multiple-reader mode of HDF5: metadata reach the file in an order that leaves it
whole at every moment, so what was flushed is there whatever happens next. A file whose writer was killed still says
that it is being written; opened as a reader beside that writer, it can be read. Its data sets may then differ by the
rows of one flush: the shortest counts.
"""

from __future__ import annotations

import errno
import os
import re
import zlib
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from driftlab.storage.system import has_posix_locks, sync
from fusion_core.budget import check_regular
from fusion_core.data_sets import DataSetRows, check_rows
from fusion_core.errors import UnreadableFile

if TYPE_CHECKING:
    import h5py

Columns = Mapping[str, NDArray[Any]]
PIECE = 1 << 12  # rows of one piece of a data set
ROWS = 1 << 15  # rows written, or copied, at once
AS_IT_IS = 1  # of a piece that the compression was left out


class GrowingFile:
    """Columns that grow together. The data sets are made when the first rows come.

    Until then the file is called `PATH.new`: what is called PATH can be read at every moment.

    Pieces are handed to HDF5 as they are to be in the file, ten times as fast as through its cache, by a thread of
    their own: HDF5 lets others work meanwhile.

    Parameters
    ----------
    path : Path
        Of the new file.
    attributes : mapping
        Of the file.
    column_attributes : mapping
        Of each column, by its name.
    single : collection of str
        Columns that are kept in single precision.
    settling : collection of str
        Columns that are mostly the same from row to row: a piece of equal rows that is written whole is compressed to
        next to nothing. HDF5 (2.0) misreads their other pieces in the process that writes them, until it has closed
        the file.
    early : bool
        Whether the file gets its name with its first rows; otherwise only by `settle`.

    Raises
    ------
    OSError
        Here and in every method: if the file cannot be written, with its name and the reason.
    """

    def __init__(
        self,
        path: Path,
        attributes: Mapping[str, Any],
        column_attributes: Mapping[str, Mapping[str, Any]],
        single: Collection[str] = (),
        settling: Collection[str] = (),
        *,
        early: bool = True,
    ) -> None:
        import h5py

        self.path, self._column_attributes = path, column_attributes
        self._single, self._settling = single, settling
        self._beside: Path | None = beside(path)
        self._early = early
        with named(path):
            self._file: h5py.File = h5py.File(self._beside, "w", libver="v110")
            self._file.attrs.update(attributes)
        self._data: dict[str, h5py.Dataset] = {}
        self._pending: list[Columns] = []
        self._begun: dict[str, list[NDArray[Any]]] = {}  # rows of the piece that is not full
        self._packed: dict[str, tuple[bytes, bytes]] = {}  # the row that a column repeated last, and the piece of it
        self._waiting = self._written = 0  # rows in memory alone, and handed to the thread that writes
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="writer")
        self._under_way: Future[None] | None = None
        self.rows = 0  # that are safe

    def append(self, columns: Columns) -> None:
        """Add rows; few are kept in memory until `flush`, many are written, but only `flush` makes them safe."""
        N = len(next(iter(columns.values())))
        if N == 0:
            return
        self._pending.append(columns)
        self._waiting += N
        if self._waiting >= ROWS:
            self._write((self._written + self._waiting) // PIECE * PIECE)

    def flush(self) -> None:
        """Write all rows that were added; from here on they survive."""
        if self._waiting:
            self._write(self._written + self._waiting)
        self._wait()
        if self.rows == self._written:
            return
        with named(self.path):
            for data in self._data.values():
                data.flush()
        self.rows = self._written

    def _write(self, end: int) -> None:
        """Have the rows up to `end` written; those beyond the last whole piece stay in memory too."""
        self._wait()
        if not self._data:
            with named(self.path):
                self._create(self._pending[0])
            if self._early:
                self.settle()
        self._under_way = self._thread.submit(self._put_all, self._pending, self._written, end)
        self._pending = []
        self._waiting, self._written = self._written + self._waiting - end, end

    def _wait(self) -> None:
        """Wait for the thread that writes; raises its error, from then on every time."""
        if self._under_way is not None:
            with named(self.path):
                self._under_way.result()

    def _put_all(self, parts: list[Columns], written: int, end: int) -> None:
        """Write rows up to `end`, from the beginning of the piece on that is not full; keep those of the last one."""
        start, whole = written // PIECE * PIECE, end // PIECE * PIECE
        for name, data in self._data.items():
            rows = [*self._begun.get(name, []), *(part[name] for part in parts)]  # from `start` on
            begins, dtype = np.cumsum([0, *map(len, rows)]).tolist(), data.dtype
            data.id.set_extent((end, *data.shape[1:]))
            for at in range(start, end, PIECE):
                piece = _joined(rows, begins, at - start, min(at + PIECE, end) - start, dtype)
                self._put(name, at, piece, new=at >= written)  # a piece that is there in part keeps its place
            left = _joined(rows, begins, whole - start, begins[-1], dtype)
            self._begun[name] = [left.copy() if left.strides[0] else left]

    def _put(self, name: str, at: int, piece: NDArray[Any], *, new: bool) -> None:
        data, place, full = self._data[name], (at,) + (0,) * (piece.ndim - 1), len(piece) == PIECE
        if not full:
            piece = np.concatenate([piece, np.zeros((PIECE - len(piece), *piece.shape[1:]), piece.dtype)])
        settled = new and full and name in self._settling
        if settled and (piece.strides[0] == 0 or (np.all(piece[0] == piece[-1]) and np.all(piece[1:] == piece[:-1]))):
            row, packed = self._packed.get(name, (b"", b""))
            if row != piece[0].tobytes():
                row, packed = piece[0].tobytes(), zlib.compress(piece.tobytes())
                self._packed[name] = row, packed
            data.id.write_direct_chunk(place, packed)
        else:  # as it is: rows that were safe before are written again, byte by byte the same
            data.id.write_direct_chunk(place, np.ascontiguousarray(piece), AS_IT_IS if name in self._settling else 0)

    def close(self) -> None:
        """Write the rest and close the file, which then reads like any other; without a row it is removed."""
        try:
            self.flush()
        finally:
            self._thread.shutdown()
            try:
                with named(self.path):
                    self._file.close()
            finally:
                if self._data and self._early:  # also where the last rows could not be written: others are safe
                    self.settle()
                elif self._beside is not None and not self._data:
                    self._beside.unlink(missing_ok=True)
        if self._data:
            self.settle()

    def settle(self) -> None:
        """Give the file its name, in one step, in the place of an earlier file; on Windows once it is closed."""
        if self._beside is not None and (has_posix_locks() or not self._file):
            with named(self.path):
                if not self._early:  # rows are in it that are safe under the name already
                    sync(self._beside)
                os.replace(self._beside, self.path)
                if not self._early:
                    sync(self.path.parent)
            self._beside = None

    def _create(self, columns: Columns) -> None:
        for name, values in columns.items():
            shape = values.shape[1:]
            self._data[name] = self._file.create_dataset(
                name, (0, *shape), np.float32 if name in self._single else values.dtype, maxshape=(None, *shape),
                chunks=(PIECE, *shape), compression="gzip" if name in self._settling else None,
            )  # fmt: skip
            self._data[name].attrs.update(self._column_attributes.get(name, {}))
        self._file.swmr_mode = True


def _joined(parts: list[NDArray[Any]], begins: list[int], start: int, stop: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return rows of parts that follow one another, row by row in memory; where one stands for all, as one that does.

    Each part begins at a row of all. Rows of one part are not copied: most pieces are.
    """
    found = [part[max(start - at, 0) : max(stop - at, 0)] for part, at in zip(parts, begins, strict=False)]
    found = [part for part in found if len(part)] or [parts[0][:0]]
    if len(found[0]) and not any(part.strides[0] or np.any(part[0] != found[0][0]) for part in found):
        row = found[0][0].astype(dtype)
        return np.broadcast_to(row, (sum(map(len, found)), *row.shape))
    return np.ascontiguousarray(found[0] if len(found) == 1 else np.concatenate(found), dtype=dtype)


def beside(path: Path) -> Path:
    """Return the name of a file until it can be read."""
    return path.with_name(path.name + ".new")


def reason(error: BaseException) -> str:
    """Return the reason of an error of the system, or of HDF5, whose texts are long."""
    if number := getattr(error, "errno", None):
        return os.strerror(number)
    message = re.search(r"error message = '([^']*)'", str(error))
    return message[1] if message else str(error)


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Raise errors of HDF5 as an OSError with a number, a reason and the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = getattr(error, "errno", None) or next(
            (code for code in errno.errorcode if os.strerror(code) == reason(error)), errno.EIO
        )
        raise OSError(number, os.strerror(number) if number != errno.EIO else reason(error), str(path)) from error


@contextmanager
def reading(path: Path) -> Iterator[h5py.File]:
    """Open a file, closed or not by the program that wrote it; raises UnreadableFile."""
    import h5py

    file = None
    try:
        check_regular(path)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name an existing file") from None
    for swmr in (False, True):
        try:
            file = h5py.File(path, "r", swmr=swmr)
            break
        except (OSError, RuntimeError) as error:  # the latter where the header is cut short
            why = error
        if "already open for" not in str(why):  # beside no writer, HDF5 would try a damaged file again for ever
            break
    if file is None:
        raise UnreadableFile(f"{path}: cannot be read ({why}); it was not written by driftlab, or is damaged")
    try:
        yield file
    finally:
        file.close()


def columns_of(path: Path, group: h5py.Group, names: Collection[str]) -> dict[str, DataSetRows]:
    """Return data sets of a group by their names; raises UnreadableFile where they declare what they do not hold."""
    columns = {name: DataSetRows(path, group[name]) for name in names}
    if columns:
        check_rows(path, list(columns.values()))
    return columns


def _rows_of(path: Path) -> int:
    """Return the rows of a file that are whole; 0 where it cannot be read."""
    try:
        with reading(path) as file:
            return min((len(data) for data in file.values()), default=0)
    except UnreadableFile:
        return 0


def continued(
    path: Path,
    rows: int | None,
    attributes: Mapping[str, Any],
    column_attributes: Mapping[str, Mapping[str, Any]],
    single: Collection[str] = (),
    settling: Collection[str] = (),
) -> GrowingFile:
    """Return a file in the place of `path` that begins with its first rows (all that are whole, where rows is None)."""
    if not has_posix_locks() and _rows_of(beside(path)) > _rows_of(path):  # of a killed program, which had it open
        os.replace(beside(path), path)
    new = GrowingFile(path, attributes, column_attributes, single, settling, early=False)
    with reading(path) as old:
        whole = min((len(data) for data in old.values()), default=0)
        if rows is not None and whole < rows:
            raise UnreadableFile(f"{path}: has {whole} rows, {rows} were expected; begin anew without --resume")
        end = whole if rows is None else rows
        columns = columns_of(path, old, list(old))
        for start in range(0, end, ROWS):
            new.append({name: data[start : min(start + ROWS, end)] for name, data in columns.items()})
            new.flush()
    if end:
        new.settle()
    else:
        new._early = True  # with its first row
    return new
