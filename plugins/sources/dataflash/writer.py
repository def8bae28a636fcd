"""A DataFlash log as an ArduPilot vehicle writes it: one inertial unit, for rehearsals.

::

    FMT of every message | UNIT | MULT | FMTU | PARM | a row of IMU at each sample

Times are those since power-up, `BOOT` before the first sample.

Source: ArduPilot 4.6, libraries/AP_Logger/LogStructure.h and libraries/AP_InertialSensor/LogStructure.h.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from fusion_core.chunk import Chunk

BOOT = 20.0  # s
CODES = {"B": "u1", "b": "i1", "H": "<u2", "I": "<u4", "Q": "<u8", "f": "<f4", "d": "<f8", "n": "S4", "N": "S16",
         "Z": "S64"}  # fmt: skip
UNITS = {"-": "", "s": "s", "E": "rad/s", "o": "m/s/s", "O": "degC", "z": "Hz", "#": "instance", "b": "B"}
MULTIPLIERS = {"-": 0.0, "0": 1.0, "F": 1e-6}


class LoggedMessage(NamedTuple):
    """A kind of message: its number, the letters and labels of its fields, their units and multipliers."""

    type: int
    letters: str
    labels: str
    units: str
    multipliers: str

    @property
    def row(self) -> np.dtype[np.void]:
        """A record of it."""
        fields = zip(self.labels.split(","), self.letters, strict=True)
        return np.dtype([("head", "u1", 3), *((label, CODES[letter]) for label, letter in fields)])

    def rows(self, count: int = 1, **columns: object) -> bytes:
        """Return records of it; what is not given is zero."""
        rows = np.zeros(count, self.row)
        rows["head"] = (0xA3, 0x95, self.type)
        for label, values in columns.items():
            rows[label] = values
        return rows.tobytes()


MESSAGES = {
    "FMT": LoggedMessage(128, "BBnNZ", "Type,Length,Name,Format,Columns", "-b---", "-----"),
    "UNIT": LoggedMessage(177, "QbZ", "TimeUS,Id,Label", "s--", "F--"),
    "MULT": LoggedMessage(178, "Qbd", "TimeUS,Id,Mult", "s--", "F--"),
    "FMTU": LoggedMessage(179, "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---"),
    "PARM": LoggedMessage(64, "QNff", "TimeUS,Name,Value,Default", "s---", "F---"),
    "NOTE": LoggedMessage(220, "QZZ", "TimeUS,Begin,End", "s--", "F--"),
    "IMU": LoggedMessage(
        138, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz", "s#EEEooo--O--zz",
        "F-000000-----00",
    ),
}  # fmt: skip
PARAMETERS = {"AHRS_ORIENTATION": 0, "INS_GYR_CAL": 0, "INS_TCAL1_ENABLE": 0, "LOG_DISARMED": 1}


class DataFlashWriter:
    """A log that is being written."""

    names: ClassVar[tuple[str, ...]] = ("gyro", "accel", "temperature")

    def __init__(self, path: Path, note: str) -> None:
        fmt, unit, mult, fmtu, parm = (MESSAGES[name].rows for name in ("FMT", "UNIT", "MULT", "FMTU", "PARM"))
        size, text = MESSAGES["NOTE"].row["Begin"].itemsize, note.encode()
        parts = [
            fmt(Type=m.type, Length=m.row.itemsize, Name=name, Format=m.letters, Columns=m.labels)
            for name, m in MESSAGES.items()
        ]
        parts += [unit(Id=ord(key), Label=label) for key, label in UNITS.items()]
        parts += [mult(Id=ord(key), Mult=size_of_one) for key, size_of_one in MULTIPLIERS.items()]
        parts += [fmtu(FmtType=m.type, UnitIds=m.units, MultIds=m.multipliers) for m in MESSAGES.values()]
        parts += [parm(Name=name, Value=value) for name, value in PARAMETERS.items()]
        self._file = path.open("wb")
        self._file.write(b"".join(parts) + MESSAGES["NOTE"].rows(Begin=text[:size], End=text[size:]))

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""
        pairs = {"Gyr": chunk["gyro"], "Acc": chunk["accel"]}
        columns = {f"{name}{axis}": values[:, k] for name, values in pairs.items() for k, axis in enumerate("XYZ")}
        stamps = np.rint((BOOT + chunk.t) * 1e6)
        columns |= {"TimeUS": stamps, "T": chunk["temperature"]}
        self._file.write(MESSAGES["IMU"].rows(len(chunk), **columns, GH=1, AH=1, GHz=2000, AHz=2000))

    def close(self) -> None:
        """Finish the log."""
        self._file.close()
