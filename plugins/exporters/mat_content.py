"""The variables of a small MAT file, checked before scipy makes room for what they declare."""

from __future__ import annotations

import io
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from fusion_core.budget import DEEPEST, FILE, inflated, read_whole
from fusion_core.errors import UnreadableFile

MATRIX, COMPRESSED = 14, 15
CELL, STRUCT = 1, 2
READ = (CELL, STRUCT, 4, *range(6, 16))  # cells, structs, text and numbers


def content_of(path: Path) -> dict[str, Any]:
    """Return the variables of a file of version 5 to 7, structs as dictionaries.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is damaged, of another version, or declares more than it holds.
    """
    from scipy.io import loadmat

    data = read_whole(path)
    if not data.startswith(b"MATLAB 5.0"):
        raise ValueError("it does not begin as a MAT file of version 5 to 7 does")
    order = ">" if data[126:128] == b"MI" else "<"
    at, total = 128, 0
    while at + 8 <= len(data):
        kind, size, _ = _tag(data, at, order)
        element = data[at : at + 8 + size]
        if kind == COMPRESSED:
            element = inflated(path, "a variable", zlib.decompressobj(), element[8:], FILE)
        total += len(element)
        if total > 4 * FILE:
            raise UnreadableFile(f"{path}: its variables take more than {4 * FILE >> 20} MB, which is the limit")
        _check(element, 0, len(element), order, 0)
        at += 8 + size
    content: dict[str, Any] = loadmat(io.BytesIO(data), simplify_cells=True)  # type: ignore[arg-type]
    return content


def _tag(data: bytes, at: int, order: str) -> tuple[int, int, int]:
    """Return type and size of the element at a place, and where its content begins."""
    first, second = np.frombuffer(data[at : at + 8], f"{order}u4").tolist()
    return (first & 0xFFFF, first >> 16, at + 4) if first >> 16 else (first, second, at + 8)


def _check(data: bytes, at: int, end: int, order: str, depth: int) -> None:
    """Raise ValueError where a variable declares more values than it has bytes, or goes too deep."""
    kind, size, begin = _tag(data, at, order)
    if kind != MATRIX or begin + size > end or depth > DEEPEST:
        raise ValueError(f"a variable is damaged, or more than {DEEPEST} deep")
    if size == 0:
        return
    stop, at = begin + size, begin + 16
    cls = int(np.frombuffer(data[begin + 8 : begin + 12], f"{order}u4")[0]) & 0xFF
    _, size, begin = _tag(data, at, order)
    count = math.prod(np.frombuffer(data[begin : begin + size], f"{order}i4").tolist())
    at = _after(data, at, order)
    at = _after(data, at, order)  # its name
    fields = 1
    if cls == STRUCT:
        width = int(np.frombuffer(data[_tag(data, at, order)[2] :][:4], f"{order}i4")[0])
        at = _after(data, at, order)
        fields, at = _tag(data, at, order)[1] // max(width, 1), _after(data, at, order)
    if cls not in READ or not 0 <= count * fields * (8 if cls in (CELL, STRUCT) else 1) <= stop - at:
        raise ValueError(f"a variable of class {cls} declares {count} values in {stop - at} bytes")
    while cls in (CELL, STRUCT) and at + 8 <= stop:
        _check(data, at, stop, order, depth + 1)
        at = _after(data, at, order)


def _after(data: bytes, at: int, order: str) -> int:
    """Return where the next element begins."""
    _, size, begin = _tag(data, at, order)
    return at + 8 if begin == at + 4 else begin + size + -size % 8
