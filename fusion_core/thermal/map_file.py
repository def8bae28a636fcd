"""The file of a fitted map: a JSON envelope with the map's record, to which a kind adds its coefficients.

A kind declares what it adds, writes it, and reads it back::

    class LineFile(MapFile):
        gain: tuple[FiniteFloat, ...]

    write_map(path, LineFile(record=self.record, gain=self.gain.tolist()))      in FittedMap.save
    content = read_map(self.kind, path, LineFile)                               in ThermalMap.read

Whatever is wrong with a file is a MapError that names it. A file of another format (ONNX) keeps the same JSON text
inside it, and uses `read_bytes`, `parse_map` and `write_bytes`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import ValidationError

from fusion_core.budget import read_whole
from fusion_core.chunk import Array
from fusion_core.errors import MapError, quote
from fusion_core.settings import Frozen
from fusion_core.thermal.fitted_map import LARGEST, MapRecord
from fusion_core.thermal.record_texts import parse_json


class MapFile(Frozen):
    """The part that every map file has; a kind adds its coefficients."""

    driftlab_map: Literal[1] = 1
    """Version of the format."""
    record: MapRecord


Content = TypeVar("Content", bound=MapFile)


def write_map(path: Path, content: MapFile) -> None:
    """Write a map's file; raises MapError where it cannot be written."""
    write_bytes(content.record.kind, path, content.model_dump_json(indent=1).encode())


def read_map(kind: str, path: Path, model: type[Content]) -> Content:
    """Read a map's file and check it; raises MapError."""
    return parse_map(kind, path, read_bytes(kind, path), model)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it when it is whole; raises OSError."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    with part.open("xb") as file:  # never in the place of another file
        try:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        except OSError:
            part.unlink()
            raise
    os.replace(part, path)


def write_bytes(kind: str, path: Path, data: bytes) -> None:
    """Write a map's file, whole or not at all."""
    try:
        write_whole(path, data)
    except OSError as error:
        raise MapError(
            f"{kind}: map file {path} cannot be written ({error.strerror}); "
            f"name a file in a folder that exists and can be written"
        ) from None


def read_bytes(kind: str, path: Path) -> bytes:
    """Read a map's file; raises MapError where it cannot be read."""
    try:
        return read_whole(path)
    except OSError as error:
        raise MapError(
            f"{kind}: map file {path} cannot be read ({error.strerror}); name a file that holds a fitted map"
        ) from None


def parse_map(kind: str, path: Path, text: bytes | str, model: type[Content]) -> Content:
    """Check the JSON text of a map file.

    Raises
    ------
    MapError
        If it is not JSON, not a map, of another version or kind, or not whole.
    """
    try:
        data = parse_json(text, LARGEST)
    except (ValueError, RecursionError) as error:
        raise _wrong(kind, path, f"is damaged or not JSON ({quote(error, 120)})", "a JSON map", "refit it") from None
    if not isinstance(data, dict) or "driftlab_map" not in data:
        raise _wrong(kind, path, "has no key 'driftlab_map'", "a map", "name a file that holds a fitted map")
    if data["driftlab_map"] != 1:
        version = f"is of version {quote(repr(data['driftlab_map']))}"
        raise _wrong(kind, path, version, "version 1", "refit it, or use the version that wrote it")
    written = data.get("record")
    found_kind = written.get("kind") if isinstance(written, dict) else None
    if found_kind is not None and found_kind != kind:
        theirs = quote(found_kind)
        advice = f"set kind: {theirs}, or refit it"
        raise _wrong(kind, path, f"holds a map of kind '{theirs}'", f"'{kind}'", advice)
    try:
        content = model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where, why = quote(".".join(map(str, first["loc"]))) or "content", quote(first["msg"], 200)
        raise _wrong(kind, path, f"is damaged at {where} ({why})", "a whole map", "refit it") from None
    return content


def expect_shape(name: str, values: Any, shape: tuple[int, ...]) -> None:
    """Raise ValueError where nested sequences do not have the shape; for the validators of map files."""
    if np.shape(values) != shape:  # a ragged one raises ValueError of its own
        raise ValueError(f"{name} has the shape {np.shape(values)}, not {shape}")


def expect_covariance(name: str, matrices: Array, rounding: float = 1e-9) -> None:
    """Raise ValueError where one of (..., n, n) is not symmetric, or has a variance below zero in some direction.

    `rounding` is that of the numbers, relative to the largest.
    """
    scale = np.max(np.abs(matrices), axis=(-2, -1), keepdims=True)
    scaled = matrices / np.where(scale > 0, scale, 1.0)
    if np.any(np.abs(scaled - np.swapaxes(scaled, -2, -1)) > rounding) or np.any(
        np.linalg.eigvalsh(scaled) < -rounding
    ):
        raise ValueError(f"{name} is no covariance (symmetric, no eigenvalue below zero)")


def _wrong(kind: str, path: Path, has: str, expected: str, remedy: str) -> MapError:
    return MapError(f"{kind}: map file {path} {has}, expected {expected}; {remedy}")
