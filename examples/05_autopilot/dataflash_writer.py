"""A DataFlash log (.bin) written from arrays, as an ArduPilot vehicle could have: for tests and for the proof.

::

    FMT of every message, UNIT, MULT, FMTU, PARM, then the rows of all IMUs in the order of time

The layout is that of ArduPilot 4.6 (libraries/AP_Logger/LogStructure.h, libraries/AP_InertialSensor/LogStructure.h).
`record`s of any other message can be described with `formats` and put between, for logs of other times.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

CODES = {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "c": "<i2", "H": "<u2", "C": "<u2", "i": "<i4", "e": "<i4",
         "L": "<i4", "I": "<u4", "E": "<u4", "q": "<i8", "Q": "<u8", "f": "<f4", "d": "<f8", "g": "<f2",
         "n": "S4", "N": "S16", "Z": "S64", "a": "(32,)<i2"}  # fmt: skip
UNITS = {"-": "", "?": "UNKNOWN", "s": "s", "E": "rad/s", "o": "m/s/s", "O": "degC", "z": "Hz", "#": "instance",
         "P": "Pa", "k": "deg/s", "m": "m", "n": "m/s", "b": "B"}  # fmt: skip
MULTIPLIERS = {"-": 0.0, "?": 1.0, "2": 1e2, "0": 1.0, "B": 1e-2, "C": 1e-3, "F": 1e-6}


@dataclass(frozen=True)
class Format:
    """A message: its type, name, the letters of its fields, their labels, units and multipliers."""

    type: int
    name: str
    letters: str
    labels: str
    units: str = ""
    multipliers: str = ""

    @property
    def dtype(self) -> np.dtype:
        names = self.labels.split(",")
        head = [("head", "u1", 3)]
        return np.dtype(head + [(name, CODES[letter]) for name, letter in zip(names, self.letters, strict=True)])

    @property
    def length(self) -> int:
        return self.dtype.itemsize


FMT = Format(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", "-b---", "-----")
UNIT = Format(177, "UNIT", "QbZ", "TimeUS,Id,Label", "s--", "F--")
MULT = Format(178, "MULT", "Qbd", "TimeUS,Id,Mult", "s--", "F--")
FMTU = Format(179, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---")
PARM = Format(64, "PARM", "QNff", "TimeUS,Name,Value,Default", "s---", "F---")
MSG = Format(91, "MSG", "QZ", "TimeUS,Message", "s-", "F-")
DSF = Format(98, "DSF", "QIHIIII", "TimeUS,Dp,Blk,Bytes,FMn,FMx,FAv", "s--bbbb", "F--0000")
IMU = Format(138, "IMU", "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz",
             "s#EEEooo--O--zz", "F-000000-----00")  # fmt: skip
GYR = Format(139, "GYR", "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ", "s#sEEE", "F-F000")
ACC = Format(140, "ACC", "QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ", "s#sooo", "F-F000")
BARO = Format(141, "BARO", "QBffcfIffB", "TimeUS,I,Alt,Press,Temp,CRt,SMS,Offset,GndTemp,H", "s#mPOnsmO-", "F-00B0C?0-")
MESSAGES = (FMT, UNIT, MULT, FMTU, PARM, MSG, DSF, IMU, GYR, ACC, BARO)


def rows(message: Format, columns: Mapping[str, object], n: int) -> np.ndarray:
    """Return n records of a message; a column that is not given is zero."""
    table = np.zeros(n, dtype=message.dtype)
    table["head"] = (0xA3, 0x95, message.type)
    for name, values in columns.items():
        table[name] = values
    return table


def record(message: Format, **columns: object) -> bytes:
    """Return one record."""
    return rows(message, columns, 1).tobytes()


def formats(messages: Iterable[Format] = MESSAGES, *, units: bool = True, t: float = 0.1) -> bytes:
    """Return the head of a log: a description of every message and, in logs since 2018, of their units."""
    messages, us = list(messages), round(t * 1e6)
    parts = [
        b"\xa3\x95\x80"
        + struct.pack("<BB4s16s64s", m.type, m.length, *(x.encode() for x in (m.name, m.letters, m.labels)))
        for m in messages
    ]
    if units:
        parts += [record(UNIT, TimeUS=us, Id=ord(key), Label=unit.encode()) for key, unit in UNITS.items()]
        parts += [record(MULT, TimeUS=us, Id=ord(key), Mult=size) for key, size in MULTIPLIERS.items()]
        parts += [
            record(FMTU, TimeUS=us, FmtType=m.type, UnitIds=m.units.encode(), MultIds=m.multipliers.encode())
            for m in messages
        ]
    return b"".join(parts)


def parameters(values: Mapping[str, float], t: float = 0.1) -> bytes:
    """Return the parameters as PARM records of time t in s."""
    return b"".join(record(PARM, TimeUS=round(t * 1e6), Name=name.encode(), Value=v) for name, v in values.items())


def imu_rows(t: np.ndarray, imus: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return IMU records (N n,), those of one time together.

    Parameters
    ----------
    t : (N,) array
        s since power-up.
    imus : sequence of (gyro (N, 3) rad/s, accel (N, 3) m/s^2, temperature (N,) degC)
    """
    n = len(imus)
    table = rows(IMU, {"TimeUS": np.repeat(np.rint(t * 1e6), n), "I": np.tile(range(n), len(t))}, n * len(t))
    for k, (gyro, accel, temperature) in enumerate(imus):
        part = table[k::n]
        for axis, name in enumerate("XYZ"):
            part[f"Gyr{name}"], part[f"Acc{name}"] = gyro[:, axis], accel[:, axis]
        part["T"] = temperature
        part["GH"] = part["AH"] = 1
        part["GHz"] = part["AHz"] = 2000
    return table


def write_log(
    path: Path,
    t: np.ndarray,
    imus: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    values: Mapping[str, float] | None = None,
    changes: Iterable[tuple[float, str, float]] = (),
) -> Path:
    """Write a log.

    Parameters
    ----------
    path : Path
    t : (N,) array
        Times of the rows, s since power-up.
    imus : sequence of (gyro (N, 3) rad/s, accel (N, 3) m/s^2, temperature (N,) degC)
        In the frame and with the corrections that the parameters say.
    values : mapping of str to float
        Parameters as the log begins with them.
    changes : iterable of (time in s, name, value)
        Parameters that changed later.
    """
    body, done = imu_rows(t, imus), 0
    with path.open("wb") as file:
        file.write(formats() + parameters(values or {}))
        file.write(record(MSG, TimeUS=100_000, Message=b"ArduCopter V4.6.0 (written from arrays)"))
        for when, name, value in sorted(changes):
            upto = len(imus) * int(np.searchsorted(t, when))
            file.write(body[done:upto].tobytes() + parameters({name: value}, when))
            done = upto
        file.write(body[done:].tobytes())
    return path
