"""The data sets of an HDF5 file, within the budget of a reader.

A compressed chunk is decoded once, whatever its size, and kept until the rows behind it are asked for. HDF5 itself
inflates a chunk as far as its bytes go: it is given none that could go beyond the budget. Such a chunk is inflated
here, no further than its declared size.

Only what the file itself holds is read: no link to another file, no external storage, no virtual data set.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.budget import DEEPEST, LISTING, NAMES, PIECE, TOTAL, UNWRITTEN, TimeBudget, check_size, size_of
from fusion_core.errors import UnreadableFile, quote

if TYPE_CHECKING:
    import h5py

CACHE = 1 << 20  # bytes of decoded chunks that HDF5 keeps of each data set
ATTRIBUTE = 1 << 16  # bytes of an attribute
TEXTS = 64  # values of an attribute whose texts are of any length
STEP = 1 << 17  # bytes of a stream inflated at once, and
PIECE_OF_IT = 1 << 22  # bytes that they may give at once
DEFLATE, SHUFFLE, FLETCHER, SZIP, NBIT, SCALE, LZF = 1, 2, 3, 4, 5, 6, 32000
RATIO = {DEFLATE: 1032, SHUFFLE: 1, FLETCHER: 1, SZIP: 1, NBIT: 1, SCALE: 1, LZF: 128}  # that a byte grows to, at most
TOO_MANY = f"has more than {NAMES:,} groups and data sets, which is the limit; write it anew"
COUNT = {NBIT: 2, SCALE: 2}  # where a filter's parameters say how many values it writes


def names_of(path: Path, file: h5py.Group) -> list[bytes]:
    """Return the path of every data set, each once; raises UnreadableFile where there is no end of them."""
    import h5py

    clock, visited, data_sets = TimeBudget(path, "listing its data sets", LISTING), set(), []
    waiting = [(b"", 0)]
    while waiting:
        here, depth = waiting.pop()
        info = h5py.h5o.get_info(file.id, here or b".")
        if (info.fileno, info.addr) in visited:
            continue
        visited.add((info.fileno, info.addr))
        if info.type == h5py.h5o.TYPE_DATASET:
            data_sets.append(here)
        elif info.type == h5py.h5o.TYPE_GROUP:
            if depth > DEEPEST:
                raise UnreadableFile(
                    f"{path}: has groups within one another more than {DEEPEST} deep, which is the limit; write it anew"
                )
            inside = links_of(path, file[here] if here else file)
            waiting += [(here + b"/" + name if here else name, depth + 1) for name in reversed(inside)]
        if len(visited) + len(waiting) > NAMES:
            raise UnreadableFile(f"{path}: {TOO_MANY}")
        clock.check()
    return data_sets


def links_of(path: Path, group: h5py.Group) -> list[bytes]:
    """Return the names in a group that stand for something in this file, by name; raises UnreadableFile."""
    import h5py

    names: list[bytes] = []

    def add(name: bytes) -> bool | None:
        names.append(name)
        return True if len(names) > NAMES else None

    group.id.links.iterate(add)
    if len(names) > NAMES:
        raise UnreadableFile(f"{path}: {TOO_MANY}")
    return [name for name in names if group.id.links.get_info(name).type == h5py.h5l.TYPE_HARD]


def attribute(path: Path, node: h5py.Group | h5py.Dataset, name: str) -> Any:
    """Return an attribute of a group or data set, None where there is none; raises UnreadableFile beyond the budget."""
    import h5py

    if name not in node.attrs:
        return None
    held = node.attrs.get_id(name)
    what = f"the attribute '{quote(name)}' of '{quote(node.name)}'"
    count, kind = math.prod(held.shape), held.dtype
    check_size(path, what, count * held.get_type().get_size(), ATTRIBUTE)
    most = TEXTS if h5py.check_string_dtype(kind) or h5py.check_vlen_dtype(kind) else ATTRIBUTE
    if count > most:
        raise UnreadableFile(f"{path}: {what} has {count} values, at most {most} are read; write it anew")
    return node.attrs[name]


class DataSetRows:
    """A data set as rows along one of its axes.

    Parameters
    ----------
    path : Path
        The file.
    node : h5py.Dataset
        The data set, of at least one dimension.
    axis : int
        Along which the rows are.

    Attributes
    ----------
    written : int
        Rows that the file holds; the others are declared alone.
    held : int
        Bytes of decoded chunks that are kept.

    Raises
    ------
    UnreadableFile
        Where its values are elsewhere, or more of them have to be held at once than the budget allows.
    """

    def __init__(self, path: Path, node: h5py.Dataset, axis: int = 0) -> None:
        self.path, self.node, self.axis = path, node, axis
        self.name = quote(node.name or "").strip("/")
        self._plan = node.id.get_create_plist()
        if self._plan.get_external_count():
            raise self._refused("keeps its values in another file (external storage), which is not read")
        if node.is_virtual:
            raise self._refused("is virtual, its values are in other data sets, which are not read")
        self.written, self._largest = self._storage()
        self._kept: tuple[int, NDArray[Any]] | None = None  # the first row of what is decoded, and it
        self.step = 0 if node.chunks is None else node.chunks[axis]
        self.filters = [self._plan.get_filter(k) for k in range(self._plan.get_nfilters())]
        self.held, self._own = 0, False
        if self.filters and self.step:
            self._check_chunks()

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Return some rows, from `start` to `stop`."""
        start, stop = rows.start, min(rows.stop, self.node.shape[self.axis])
        if not self.held or start >= stop:
            return np.asarray(self.node[self._at(start, stop)])
        begin, decoded = self._kept or (0, None)
        if decoded is None or not begin <= start <= begin + decoded.shape[self.axis]:
            begin, decoded = start // self.step * self.step, None
        end = begin if decoded is None else begin + decoded.shape[self.axis]
        if end < stop:
            last = min(-(-stop // self.step) * self.step, self.node.shape[self.axis])
            parts = [] if decoded is None or end == start else [self._cut(decoded, start - begin, end - begin)]
            begin = start if parts else end
            self._kept = decoded = None  # whose memory is needed
            parts += self._decoded(end, last)
            decoded = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=self.axis)
            self._kept = begin, decoded
        assert decoded is not None, "it was kept, or decoded"
        return self._cut(decoded, start - begin, stop - begin)

    def _at(self, start: int, stop: int) -> tuple[slice, ...]:
        return (slice(None),) * self.axis + (slice(start, stop),)

    def _cut(self, values: NDArray[Any], start: int, stop: int) -> NDArray[Any]:
        return values[self._at(start, stop)]

    def _refused(self, what: str) -> UnreadableFile:
        return UnreadableFile(f"{self.path}: data set '{self.name}' {what}; copy it with `h5repack -f GZIP=4 OLD NEW`")

    def _storage(self) -> tuple[int, int]:
        """Return the rows that the file holds, and the bytes of the largest chunk as it is stored."""
        import h5py

        shape, chunks = self.node.shape, self.node.chunks
        if chunks is None:
            compact = self._plan.get_layout() == h5py.h5d.COMPACT
            return shape[self.axis] if compact or self.node.id.get_offset() is not None else 0, 0
        across = math.prod(-(-n // c) for k, (n, c) in enumerate(zip(shape, chunks, strict=True)) if k != self.axis)
        most, count, largest = across * -(-shape[self.axis] // chunks[self.axis]), 0, 0

        def add(chunk: Any) -> bool | None:
            nonlocal count, largest
            count, largest = count + 1, max(largest, chunk.size)
            return True if count > most else None  # its index leads back to itself

        if most:
            self.node.id.chunk_iter(add)
        return min(shape[self.axis], -(-count // max(across, 1)) * chunks[self.axis]), largest

    def _check_chunks(self) -> None:
        """See whether its chunks can be decoded, by whom, and how many bytes of them are kept."""
        chunks, width = self.node.chunks, self.node.dtype.itemsize
        codes = [code for code, *_ in self.filters]
        if unknown := next((entry for entry in self.filters if entry[0] not in RATIO), None):
            name = quote(unknown[3].decode("utf-8", "replace"))
            raise self._refused(f"is compressed with filter {unknown[0]} ('{name}'), gzip, lzf or szip was expected")
        whole = math.prod(chunks) * width
        row = width * math.prod(n for k, n in enumerate(self.node.shape) if k != self.axis)
        band = max(whole, row * min(self.step, self.node.shape[self.axis]))
        check_size(self.path, f"a chunk of data set '{self.name}'", band)
        check_size(self.path, f"a stored chunk of data set '{self.name}'", self._largest, 2 * whole + CACHE)
        for code, _, parameters, _ in self.filters:
            if code in COUNT and parameters[COUNT[code]] != math.prod(chunks):
                raise self._refused("has a filter that is not of its chunks")
        grown = self._largest * math.prod(RATIO[code] for code in codes)
        self._own = grown > PIECE
        if self._own and not {DEFLATE, SHUFFLE, FLETCHER}.issuperset(codes):
            raise self._refused(
                f"has a chunk of {size_of(self._largest)} that may hold {size_of(grown)}, at most {size_of(PIECE)} are "
                "read at once"
            )
        if band > CACHE or self._own or SZIP in codes:
            self.held = band

    def _decoded(self, start: int, stop: int) -> list[NDArray[Any]]:
        """Return the rows of whole chunks, from the first row of one."""
        if SZIP in (code for code, *_ in self.filters):
            for _, place in self._places(start, stop):
                self._check_szip(place)
        if not self._own:
            return [np.asarray(self.node[self._at(start, stop)])]
        shape = list(self.node.shape)
        shape[self.axis] = stop - start
        first = tuple(start if k == self.axis else 0 for k in range(len(shape)))
        if tuple(shape) == self.node.chunks and (whole := self._chunk(first)) is not None:
            return [whole]
        values = np.full(shape, self.node.fillvalue, self.node.dtype)
        for into, place in self._places(start, stop):
            chunk = self._chunk(place)
            if chunk is not None:
                part = values[into]
                part[...] = chunk[tuple(slice(0, n) for n in part.shape)]
        return [values]

    def _places(self, start: int, stop: int) -> Iterator[tuple[tuple[slice, ...], tuple[int, ...]]]:
        """Yield the place of each chunk among some rows, and in the data set."""
        ranges = [range(0, n, c) for n, c in zip(self.node.shape, self.node.chunks, strict=True)]
        ranges[self.axis] = range(start, stop, self.step)
        for number in range(math.prod(map(len, ranges))):
            place = tuple(r[k] for r, k in zip(ranges, np.unravel_index(number, [*map(len, ranges)]), strict=True))
            offset = [start if k == self.axis else 0 for k in range(len(place))]
            cut = (slice(p - o, p - o + c) for p, o, c in zip(place, offset, self.node.chunks, strict=True))
            yield tuple(cut), place

    def _check_szip(self, place: tuple[int, ...]) -> None:
        try:
            mask, raw = self.node.id.read_direct_chunk(place)
        except RuntimeError:  # it was never written
            return
        size = math.prod(self.node.chunks) * self.node.dtype.itemsize
        if not mask and int.from_bytes(raw[:4], "little") > size + 4:
            raise self._refused("has a chunk that declares more than its size")

    def _chunk(self, place: tuple[int, ...]) -> NDArray[Any] | None:
        """Return a chunk, None where it was never written."""
        try:
            mask, data = self.node.id.read_direct_chunk(place)
        except RuntimeError as error:
            if "not allocated" in str(error):
                return None
            raise
        width, chunks = self.node.dtype.itemsize, self.node.chunks
        size = math.prod(chunks) * width
        for k, (code, *_) in reversed(list(enumerate(self.filters))):
            if mask >> k & 1:
                continue
            if code == DEFLATE:
                data = _inflated(data, size + 4 * len(self.filters))
            elif code == FLETCHER:
                data = _checked(data)
            else:
                data = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(width, -1).T)
        if memoryview(data).nbytes != size:
            raise OSError(f"a chunk of {memoryview(data).nbytes} bytes, {size} were declared")
        return np.frombuffer(data, self.node.dtype).reshape(chunks)


def check_rows(path: Path, columns: list[DataSetRows]) -> None:
    """Raise UnreadableFile where data sets that are read together declare rows without end, or take too much at once.

    Parameters
    ----------
    path : Path
        The file.
    columns : list of Rows
        One at least.
    """
    first = columns[0]
    declared, written = first.node.shape[first.axis], max(column.written for column in columns)
    if declared - written > written + UNWRITTEN:
        raise UnreadableFile(
            f"{path}: data set '{first.name}' declares {declared:.4g} rows, {written} of them were ever written, at "
            f"most {UNWRITTEN:,} more than twice as many are read; record it again, or cut it to what was measured"
        )
    held = [column.held for column in columns]
    check_size(path, "a chunk of each data set that is named", sum(held) + 2 * max(held), TOTAL)


def _inflated(data: bytes, most: int) -> memoryview:
    """Return the content of a zlib stream; raises OSError where that is more than `most` bytes, or it is damaged."""
    engine, content, at = zlib.decompressobj(), np.empty(most, np.uint8), 0
    try:
        for begin in range(0, len(data), STEP):
            rest: bytes = data[begin : begin + STEP]
            while rest and not engine.eof:
                piece = engine.decompress(rest, PIECE_OF_IT)
                if at + len(piece) > most:
                    raise OSError(f"a chunk inflates to more than the {most} bytes that it declares")
                content[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
                at, rest = at + len(piece), engine.unconsumed_tail
    except zlib.error as error:
        raise OSError(str(error)) from None
    if not engine.eof:
        raise OSError("a compressed chunk is cut short")
    return memoryview(content[:at])  # type: ignore[arg-type]


def _checked(data: bytes | memoryview) -> memoryview:
    """Return a chunk without its Fletcher sum; raises OSError where that is not of its bytes."""
    content, written = memoryview(data)[:-4], bytes(memoryview(data)[-4:])
    words = np.frombuffer(bytes(content) + bytes(len(content) % 2), ">u2")
    a = b = 0
    for begin in range(0, len(words), 1 << 16):
        part = words[begin : begin + (1 << 16)].astype(np.uint64)
        b = int(b + len(part) * a + np.dot(np.arange(len(part), 0, -1, dtype=np.uint64), part)) % 65535
        a = int(a + part.sum()) % 65535
    sums = (b % 65535, a % 65535)
    if sums != tuple(int.from_bytes(written[k : k + 2], "little") % 65535 for k in (2, 0)):
        raise OSError("a chunk's checksum does not fit it")
    return content
