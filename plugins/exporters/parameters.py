"""Parameter files of autopilots: numbers by name, one a line.

Read are the lines that ground stations write: `1<TAB>1<TAB>NAME<TAB>VALUE<TAB>TYPE` (QGroundControl), `NAME,VALUE`
(Mission Planner, `ulog_params`), `NAME VALUE` (MAVProxy) and `NAME=VALUE` (ArduPilot's own); `#` begins a comment.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fusion_core.budget import check_regular
from fusion_core.errors import UnreadableFile, shown

FIELDS = re.compile(r"[\s,=]+")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
LARGEST = 10_000_000  # bytes; a vehicle has some 1,500 parameters
LOGS = {  # how a log begins, what it is, and what writes its parameters
    b"ULog": ("a PX4 log", "`ulog_params -i LOG FILE` of pyulog"),
    b"\xa3\x95": ("a DataFlash log", "`mavparms.py LOG > FILE` of pymavlink"),
}


def read_parameters(path: Path) -> dict[str, float]:
    """Return a file's parameters by name.

    Raises
    ------
    UnreadableFile
        If it is not there, is a log, holds a line that is no parameter, or says two things of one.
    """
    found: dict[str, float] = {}
    for number, line in enumerate(_text(path).splitlines(), 1):
        fields = FIELDS.split(line.split("#")[0].strip())
        if fields == [""]:
            continue
        name, text = fields[2:4] if len(fields) == 5 and fields[0].isdigit() else [*fields, ""][:2]
        value = _number(text)
        if not NAME.match(name) or value is None or len(fields) not in (2, 5):
            raise UnreadableFile(
                f"{path}, line {number}: '{shown(line.strip())}' is no parameter, expected NAME VALUE, NAME,VALUE or "
                "QGroundControl's five columns; name a parameter file that a ground station saved"
            )
        if found.setdefault(name, value) != value:
            raise UnreadableFile(
                f"{path}, line {number}: {name} is {value:.9g}, and {found[name]:.9g} further up; keep one of the two"
            )
    return found


def single(value: float) -> str:
    """Return the shortest text that single precision reads as the nearest number to `value`."""
    return str(np.float32(value)).removesuffix(".0")


def integer(values: Mapping[str, float], name: str) -> int:
    """Return a parameter that is a whole number; 0 where it is not given."""
    return int(values.get(name, 0))


def missing(values: Mapping[str, float], names: Sequence[str]) -> tuple[str, ...]:
    """Return in words which of the parameters are not given, and taken as 0."""
    gone = [name for name in names if name not in values]
    return (f"{', '.join(gone)}: missing, taken as 0, which they are by default",) if gone else ()


def _text(path: Path) -> str:
    try:
        check_regular(path)
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name a parameter file") from None
    for begins, (what, tool) in LOGS.items():
        if data.startswith(begins):
            raise UnreadableFile(
                f"{path}: is {what}, expected a parameter file; save the vehicle's parameters with the ground station, "
                f"or take those of the log: {tool}"
            )
    try:
        if len(data) > LARGEST:
            raise ValueError
        return data.decode("utf-8-sig")
    except ValueError:
        raise UnreadableFile(
            f"{path}: is no text, expected a parameter file; name one that a ground station saved"
        ) from None


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
