"""Tables of a stimulus: segments of a turntable, and placements.

A table of segments is CSV with the units of its columns in its head, one segment a line, in seconds from the first row
of the recording::

    start [s],stop [s],axis,rate [deg/s]
    60,90,z,100
    92,122,-z,100

`axis` is x, y or z of the unit, with - the other way, or the three parts of a vector; the rate turns right-handed about
it. A table of placements has start and stop alone.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BeforeValidator

from fusion_core.chunk import Array
from fusion_core.contracts.stimulus import AXES
from fusion_core.errors import ConfigError, DataError, UnitError, quote
from fusion_core.settings import ConfigPath
from fusion_core.units import convert

HEAD = re.compile(r"\s*(\w+)\s*(?:\[([^\]]+)\])?\s*")
UNITS = {"start": "s", "stop": "s", "rate": "rad/s"}


def _each(value: Any) -> Any:
    """Return one file or axis as those of one recording."""
    return (value,) if isinstance(value, str | Path) else value


Files = Annotated[tuple[ConfigPath, ...], BeforeValidator(_each, json_schema_input_type=str | list[str])]
Directions = Annotated[tuple[str, ...], BeforeValidator(_each, json_schema_input_type=str | list[str])]


class TurntableSegment(NamedTuple):
    """A part of a recording, s from its first row, and the rate of the unit there (3,), rad/s."""

    start: float
    stop: float
    axis: tuple[float, float, float]
    rate: float


def direction(text: str) -> tuple[float, float, float]:
    """Return the unit vector of `x`, `-y` or `0.6 0.8 0`; raises ConfigError."""
    plain = text.strip().lower()
    try:
        if plain.lstrip("+-") in tuple(AXES):
            parts = [(-1.0 if plain[0] == "-" else 1.0) * (name == plain[-1]) for name in AXES]
        else:
            parts = [float(part) for part in plain.replace(";", " ").split()]
        size = float(np.linalg.norm(parts))
        if len(parts) == 3 and np.isfinite(size) and size > 0:
            return parts[0] / size, parts[1] / size, parts[2] / size
    except ValueError:
        pass
    raise ConfigError(f"axis '{quote(text)}': is no direction; write x, y, z, -x, -y, -z, or three numbers")


def segments(path: Path, *, rates: bool) -> list[TurntableSegment]:
    """Read a table of segments, with `rates`, or of placements; raises ConfigError or DataError."""
    needed = ("start", "stop", "axis", "rate") if rates else ("start", "stop")
    example = "start [s],stop [s]" + ",axis,rate [deg/s]" * rates
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            head, *lines = [line for line in csv.reader(file) if any(map(str.strip, line))] or [[]]
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read ({error}); name a table in CSV") from None
    named = [match.groups() if (match := HEAD.fullmatch(cell)) else ("", None) for cell in head]
    columns = {name: (k, unit) for k, (name, unit) in enumerate(named)}
    if not set(needed) <= set(columns):
        raise DataError(f"{path}: its head is '{quote(','.join(head))}'; write `{example}`")
    found = []
    for number, line in enumerate(lines, 2):
        try:
            values = {name: _value(line, *columns[name], name) for name in needed if name != "axis"}
            axis = direction(line[columns["axis"][0]]) if rates else (0.0, 0.0, 1.0)
        except (ValueError, IndexError, UnitError, ConfigError) as error:
            raise DataError(f"{path}: line {number}: {error}; write lines as `{example}` says") from None
        found.append(TurntableSegment(values["start"], values["stop"], axis, values.get("rate", 0.0)))
    if not found:
        raise DataError(f"{path}: has no line under its head; write one for each segment")
    return found


def _value(line: Sequence[str], k: int, unit: str | None, name: str) -> float:
    if unit is None:
        raise ValueError(f"column {name} has no unit in the head")
    value = float(convert(float(line[k]), unit, UNITS[name]))
    if not np.isfinite(value):
        raise ValueError(f"{name} is {line[k]}, a finite number was expected")
    return value


def file_of(files: tuple[Path, ...], k: int) -> Path:
    """Return the table of recording k; raises ConfigError."""
    if k >= len(files):
        raise ConfigError(f"stimulus: has {len(files)} tables for more recordings; name one for each, in their order")
    return files[k]


def halved(rows: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return first quarter and rest of each of some ranges of rows."""
    cuts = [(a, a + max((b - a) // 4, 1), b) for a, b in rows]
    return [part for a, cut, b in cuts for part in ((a, cut), (cut, b))]


def rows_of(t: Array, start: float, stop: float) -> tuple[int, int]:
    """Return the first row of a segment and that after its last, s from the first row; raises DataError."""
    a, b = np.searchsorted(t, [t[0] + start, t[0] + stop])
    if b - a < 2:
        raise DataError(
            f"segment from {start:g} to {stop:g} s: the recording has {b - a} samples there, and lasts "
            f"{t[-1] - t[0]:.1f} s; count seconds from its first row, and see that stimulus.settle leaves some"
        )
    return int(a), int(b)
