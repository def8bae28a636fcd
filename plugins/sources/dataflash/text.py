"""An ArduPilot log as text (`.log`, of Mission Planner or MAVLink tools), turned into the binary log that it was.

::

    FMT, 138, 47, IMU, QBffffff, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ      a description, then rows:
    IMU, 30000000, 0, 0.0012, -0.0003, 0.0001, 0.01, 0.02, -9.81

The text has numbers as they are shown: those of the letters c, C, e, E over 100, those of L over 1e7 (`scan`). The
name of a flight mode becomes 0; a line that is no row of a described message is counted.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fusion_core.budget import COPIED, keep, temporary_folder, unpacked_at_most
from fusion_core.faults import Faults
from fusion_plugins.sources.dataflash.scan import DIVISORS, FMT, FMT_LENGTH, PACKED, SIZES

HEAD = b"\xa3\x95"


@contextmanager
def binary(path: Path, faults: Faults) -> Iterator[Path]:
    """Yield the path of the binary log that the lines of a text log say; lines that say nothing go to `faults`."""
    with temporary_folder(path) as folder:
        place, most = folder / path.name, unpacked_at_most(path)
        with path.open(encoding="latin-1") as lines, place.open("wb") as file:
            rows, lost = bytearray(), list[int]()
            formats = dict[str, tuple[int, str]]()
            for number, line in enumerate(lines, 1):
                row = _row(line.rstrip("\r\n"), formats)
                rows += row
                if not row and line.strip():
                    lost.append(number)
                if len(rows) >= COPIED:
                    keep(path, bytes(rows), file, most)
                    rows.clear()
            keep(path, bytes(rows), file, most)
        faults.add("lines of the log that are no rows, skipped", len(lost), f"at line {lost[0]}" if lost else "")
        yield place


def _row(line: str, formats: dict[str, tuple[int, str]]) -> bytes:
    """Return the record of a line, empty where it is none; a description is added to `formats`, by its name."""
    name, _, rest = line.partition(",")
    if name == "FMT":
        return _description(rest, formats)
    if name not in formats:
        return b""
    kind, letters = formats[name]
    fields = rest.split(",", len(letters) - 1)
    if len(fields) != len(letters):
        return b""
    try:
        values = [_value(field.strip(), letter) for field, letter in zip(fields, letters, strict=True)]
        return HEAD + bytes([kind]) + struct.pack("<" + "".join(PACKED[letter] for letter in letters), *values)
    except (struct.error, ValueError, OverflowError):
        return b""


def _description(rest: str, formats: dict[str, tuple[int, str]]) -> bytes:
    fields = [field.strip() for field in rest.split(",", 4)]
    if len(fields) < 5 or not re.fullmatch("[0-9]{1,3}", fields[0]) or not set(fields[3]) <= set(PACKED):
        return b""
    kind, name, letters = int(fields[0]), fields[2], fields[3]
    length = FMT_LENGTH if kind == FMT else 3 + sum(SIZES[letter] for letter in letters)
    if kind > 255 or length > 255:
        return b""
    formats[name] = kind, letters
    texts = (text.encode("latin-1") for text in (name, letters, fields[4].replace(" ", "")))
    return HEAD + struct.pack("<BBB4s16s64s", FMT, kind, length, *texts)


def _value(text: str, letter: str) -> float | int | bytes:
    if letter in "nNZ":
        return text.encode("latin-1")
    if letter == "a":
        return b""
    if letter in DIVISORS:
        return round(float(text) * DIVISORS[letter])
    if letter == "M" and not text.isdigit():
        return 0
    return float(text) if letter in "fdg" else int(text)
