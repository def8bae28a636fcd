"""A ULog file: its sensors, its parameters, and the rows of those that are wanted.

::

    size (2 bytes, little endian), type (1 byte), size bytes        D: the first two of them are the subscription

A message counts where the one behind it can be one too; else the next place is looked for from which three
messages follow one another: what is cut or damaged is stepped over and counted. ULog has no checksum: a flipped bit
inside the numbers of a row is not seen.

Source: the ULog file format (docs.px4.io, Log File Format).

PX4's device numbers name the part, its bus and its address::

    device_id = bus type (3 bits) | bus (5 bits) << 3 | address << 8 | part << 16

A gyro and an accelerometer in one chip share bus and address; older firmware gave them different parts. Source: PX4,
src/lib/drivers/device/Device.hpp and src/drivers/drv_sensor.h.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from fusion_core.budget import COUNT, TEXTS, TimeBudget, check_count, check_size
from fusion_core.chunk import Array, Bytes, Integers
from fusion_core.contracts import foreign, head
from fusion_core.errors import UnreadableFile, quote
from fusion_core.faults import Faults
from fusion_plugins.sources.joining import mapped, records, release

SIGNATURE = b"ULog\x01\x125"
HEADER = 16  # bytes, of which the last eight are the start
FLAGS = 40  # bytes of the message of flags, at least
FIELDS, DEEP = 300_000, 16  # numbers in a row of each topic, in all, and formats in one another
APPENDED = 1  # the bit of the incompatible flags that says that data stands behind the log's end
PADDING = "_padding"  # what fields are called that fill a row up, and that a logger leaves out at its end
NUMBERS = {
    **{f"{sign}int{8 * size}_t": f"<{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)},
    "float": "<f4", "double": "<f8", "bool": "i1", "char": "i1",
}  # fmt: skip
U16 = np.dtype("<u2")


@dataclass(frozen=True, eq=False)
class Instance:
    """One of the sensors (or another topic) of a log.

    Attributes
    ----------
    topic, number : str, int
        As in `sensor_gyro[1]`.
    at : (N,) array of int
        Where the messages of its rows begin.
    row : dtype
        The fields of a row.
    data : (B,) array of uint8
        The file.
    """

    topic: str
    number: int
    at: Integers
    row: np.dtype[np.void]
    data: Bytes

    def columns(self, fields: Collection[str]) -> dict[str, Array]:
        """Return all rows of it by field, of those fields that it has."""
        names = [name for name in self.row.names or () if name in fields]
        columns = {name: np.empty(self.rows, self.row[name]) for name in names}
        for start in range(0, self.rows, ROWS):
            part = slice(start, start + ROWS)
            values: Any = records(self.data, self.at[part] + 5, self.row)
            for name in names:
                columns[name][part] = values[name]
        return columns

    @cached_property
    def samples(self) -> Mapping[str, Array]:
        """Some of its rows, by field."""
        values: Any = records(self.data, self.at[sampled(self.rows)] + 5, self.row)
        return {name: values[name] for name in self.row.names or ()}

    @property
    def rows(self) -> int:
        """Number of its rows."""
        return len(self.at)

    @property
    def device(self) -> int | None:
        """The device number; None where the log has none."""
        numbers = self.samples.get("device_id", np.zeros(0))
        return int(np.max(numbers)) or None if len(numbers) and numbers.dtype.kind in "iu" else None

    @property
    def temperature(self) -> float:
        """A temperature that it showed [degC]; NaN where it has none."""
        readings = np.asarray(self.samples.get("temperature", np.zeros(0)), dtype=np.float64)
        finite = readings[np.isfinite(readings)]
        return float(finite[-1]) if len(finite) else np.nan

    @property
    def rate(self) -> float:
        """Rows a second [Hz]; NaN where it is unknown."""
        t = 1e-6 * np.asarray(self.samples.get("timestamp", np.zeros(0)), dtype=np.float64)
        n = sampled(self.rows)[: len(t)]
        return float((n[-1] - n[0]) / (t[-1] - t[0])) if len(t) > 1 and t[-1] > t[0] else np.nan

    @property
    def name(self) -> str:
        """The topic with the number."""
        return f"{self.topic}[{self.number}]"

    def __str__(self) -> str:
        """Return the instance in words."""
        rate = "" if np.isnan(self.rate) else f" at {self.rate:.3g} Hz"
        text = f"{self.name}, {described(self.device)}: {self.rows} rows{rate}"
        if "temperature" not in self.samples:
            return text
        T = self.temperature
        return text + (", no temperature" if np.isnan(T) else f", temperature {T:.4g} °C")


class LogFile:
    """An open log.

    Attributes
    ----------
    instances : dict of (topic, number) to Instance
        In the order of their names.
    parameters : dict of str to float
        Of the vehicle when the log began.
    """

    def __init__(self, path: Path, kind: str) -> None:
        first = head(path)
        if not first.startswith(SIGNATURE):
            raise foreign(path, first, kind)
        self.path, self.data = path, mapped(path)
        self.parameters: dict[str, float] = {}
        self._formats: dict[str, list[tuple[str, int | None, str]]] = {}
        self._added: dict[int, tuple[str, int, np.dtype[np.void]]] = {}  # topic, number and fields by subscription
        self._lengths = np.array([[-1], [65535]]).repeat(IDS, axis=1)  # of a row; at least -1: not known
        self._dropouts: list[tuple[int, float]] = []  # place, and duration in ms
        self._lost, self._first_lost = 0, -1
        self._fields = self._names = 0  # of all subscriptions: numbers in a row, and characters of what they are called
        found = dict(self._found(self._messages(*_sections(path, first, len(self.data)))))
        self.instances = {key: found[key] for key in sorted(found)}
        if not self.instances:
            raise UnreadableFile(f"{path}: ends before its first row ({len(self.data)} bytes); copy or log it again")

    def of(self, topic: str) -> list[Instance]:
        """Return the instances of a topic."""
        return [instance for (name, _), instance in self.instances.items() if name == topic]

    def read(self, wanted: Mapping[Instance, Collection[str]], faults: Faults) -> dict[Instance, dict[str, Array]]:
        """Return the fields of instances that are wanted, by name; what is wrong with the file goes to `faults`."""
        data = {instance: instance.columns({*TIMES, *fields}) for instance, fields in wanted.items()}
        faults.add(
            "bytes of the log that belong to no message that is known (cut, damaged or of a later format)",
            self._lost,
            f"at byte {self._first_lost} of {len(self.data)}",
        )
        if self._dropouts:
            (place, first), total = self._dropouts[0], sum(duration for _, duration in self._dropouts)
            before = [float(data[i]["timestamp"][i.at < place].max(initial=0)) for i in wanted]
            begun = int.from_bytes(self.data[HEADER - 8 : HEADER].tobytes(), "little")
            faults.add(
                f"dropouts, for which the logger wrote nothing ({total / 1e3:.6g} s in all)",
                len(self._dropouts),
                f"of {first / 1e3:.6g} s after t = {max(begun, *before) / 1e6:.3f} s",
            )
        return data

    def _messages(self, begin: int, ends: Sequence[int]) -> dict[int, list[Integers]]:
        """Read the definitions, and return the places of the rows of what they define, by its number, in parts."""
        places: dict[int, list[Integers]] = {}
        out, at, count, text = np.empty(BLOCK // 5 + 1, np.int64), begin, 0, 0
        small = np.int32 if len(self.data) < 2**31 - IDS else np.int64
        with TimeBudget(self.path, "what is no row") as clock:
            for end in ends:
                while at < end:
                    at, n, lost, first, stopped = _walk(self.data[:end], at, at + BLOCK, self._lengths, out, *TYPES)
                    if n:
                        _collect(places, records(self.data, out[:n] + 3, U16), out[:n].astype(small))
                    self._lost, self._first_lost = self._lost + lost, self._first_lost if self._lost else first
                    clock.check(n + stopped)
                    if not stopped:
                        release(self.data)
                    else:
                        size, kind = struct.unpack("<HB", self.data[at : at + 3].tobytes())
                        with suppress(ValueError, KeyError, IndexError):  # of what is damaged
                            self._define(chr(kind), at, self.data[at + 3 : at + 3 + size].tobytes())
                        at, count, text = at + 3 + size, count + 1, text + size
                        check_count(self.path, "parameters, dropouts and the like", count, COUNT // 2)
                        check_size(self.path, "what describes its rows", text, TEXTS)
        return places

    def _define(self, kind: str, at: int, content: bytes) -> None:
        """Take in a message: formats and parameters before the first subscription, dropouts behind it."""
        if kind == "A":
            number, topic = int.from_bytes(content[1:3], "little"), content[3:].decode(errors="ignore")
            if self._added.get(number, ("",))[0]:  # it has rows of that form, and there are no others of its number
                return
            self._added.setdefault(number, ("", 0, np.dtype([])))
            row, padding = self._row(topic)
            self._added[number] = topic, content[0], row
            self._lengths[:, number] = row.itemsize, row.itemsize + padding
        elif kind == "O" and self._added:
            self._dropouts.append((at, int.from_bytes(content, "little")))
        elif kind == "F" and not self._added:
            name, fields = content.decode(errors="ignore").split(":")[:2]
            self._formats[name] = [_declared(field) for field in fields.split(";") if field]
        elif kind == "P" and not self._added:
            form, name = content[1 : 1 + content[0]].decode(errors="ignore").split(" ")[:2]
            (self.parameters[name],) = np.frombuffer(content[1 + content[0] :], NUMBERS[form]).tolist()

    def _found(self, places: dict[int, list[Integers]]) -> Iterator[tuple[tuple[str, int], Instance]]:
        """Yield the instances that have rows with a time; of several subscriptions of one, the first comes last."""
        for number, (topic, instance, row) in reversed(self._added.items()):
            if (parts := places.pop(number, None)) and "timestamp" in (row.names or ()):
                yield (topic, instance), Instance(topic, instance, np.concatenate(parts), row, self.data)

    def _row(self, topic: str) -> tuple[np.dtype[np.void], int]:
        """Return the fields of a topic's rows, and the bytes of padding behind them."""
        fields = list(self._flat(topic, topic, "", 0))
        padding = 0
        while fields and fields[-1][0].startswith(PADDING):
            padding += np.dtype(fields.pop()[1]).itemsize
        return np.dtype(fields), padding

    def _flat(self, topic: str, form: str, prefix: str, depth: int) -> Iterator[tuple[str, str]]:
        """Yield name and type of the numbers of a format, those of arrays and of formats in it too."""
        what = f"numbers in the rows of {quote(topic)} and before it"
        for kind, count, name in self._formats[form]:
            for k in range(1 if count is None else count):
                self._fields = FIELDS if depth > DEEP else self._fields + 1
                check_count(self.path, what, self._fields, FIELDS - 1)
                path = f"{prefix}{name}" if count is None else f"{prefix}{name}[{k}]"
                self._names += len(path)
                check_size(self.path, "the list of its numbers", self._names, TEXTS)
                if kind in NUMBERS:
                    yield path, NUMBERS[kind]
                else:
                    yield from self._flat(topic, kind, f"{path}.", depth + 1)


def _collect(places: dict[int, list[Integers]], numbers: Integers, rows: Integers) -> None:
    """Add places of rows to those of the subscriptions of these numbers."""
    order = np.argsort(numbers, kind="stable")
    which, first = np.unique(numbers[order], return_index=True)
    for number, part in zip(which.tolist(), np.split(rows[order], first[1:]), strict=False):
        places.setdefault(number, []).append(part)


def _declared(field: str) -> tuple[str, int | None, str]:
    """Return type, length and name of a field `float[3] x`; the length is None where it is no array."""
    kind, name = field.split(" ")[:2]
    kind, bracket, count = kind.partition("[")
    length = int(count.partition("]")[0]) if bracket else 0
    if not 0 <= length <= 0xFFFF:
        raise ValueError(f"an array of {length} values")
    return kind, length or None, name


def _sections(path: Path, first: bytes, size: int) -> tuple[int, list[int]]:
    """Return the place at which messages begin, and the ends of the parts of the file.

    After a crash PX4 appends what it kept to the end of the log, which may end within a message; the flags say where.
    """
    if len(first) < HEADER:
        raise UnreadableFile(f"{path}: is cut short ({size} bytes, a ULog header has {HEADER}); copy it again")
    length, kind = struct.unpack_from("<HB", first.ljust(HEADER + 3, b"\0"), HEADER)
    begin = HEADER + 3 + length
    if kind != ord("B") or length < FLAGS or len(first) < begin:
        return HEADER, [size]
    flags = int.from_bytes(first[HEADER + 11 : HEADER + 19], "little")
    if flags & ~APPENDED:
        raise UnreadableFile(
            f"{path}: is of a later format, with the flags 0x{flags:X} that are not known; use a later driftlab"
        )
    offsets = struct.unpack_from("<3Q", first, HEADER + 19) if flags else ()
    return begin, [*sorted(o for o in offsets if begin < o < size), size]


IDS = 65536  # subscriptions that a file can have
ROWS = 1 << 16  # of an instance, read at once
TIMES = "timestamp", "timestamp_sample"  # fields: of the message, and of the sample where it has another
BLOCK = 4 << 20  # bytes between two looks at the clock
SAMPLED = 1024  # of the rows of an instance that tell about it, each so many-th is taken, and some of the first ones

_SHORTEST = np.full(256, -1, np.int64)  # bytes of a message by type; -1: no type that is known
_LONGEST = np.full(256, 65535, np.int64)
for _kind, _size in {"F": 3, "D": 2, "I": 2, "M": 3, "P": 2, "Q": 3, "A": 4, "L": 9, "C": 11, "B": 40}.items():
    _SHORTEST[ord(_kind)] = _size
for _kind, _size in {"R": 2, "S": 8, "O": 2}.items():
    _SHORTEST[ord(_kind)] = _LONGEST[ord(_kind)] = _size
_LONGEST[[ord(_kind) for _kind in "FIPQAD"]] = 10_000  # what is longer is damage
_DEFINING = np.zeros(256, np.bool_)
_DEFINING[[ord(_kind) for _kind in "FPAO"]] = True
TYPES = _SHORTEST, _LONGEST, _DEFINING
_D = ord("D")

NO, WHOLE, CUT, FOREIGN = 0, 1, 2, 3


def sampled(rows: int) -> Integers:
    """Return the numbers of an instance's rows that tell about it: the first, second, fourth and so on, and more."""
    n: Integers = np.arange(rows)
    return np.asarray(n[(n % SAMPLED == 0) | (n < SAMPLED) & (n & (n - 1) == 0)])


@njit(cache=True, nogil=True)
def _status(data, p, lengths, least, most):  # type: ignore[no-untyped-def]
    """Return the kind of the bytes at p: NO message, a WHOLE one, one that the end has CUT, one of a FOREIGN type."""
    if p + 3 > len(data):
        return CUT
    size, kind = data[p] + 256 * data[p + 1], data[p + 2]
    if least[kind] < 0:
        letter = 65 <= kind <= 90 or 97 <= kind <= 122
        return FOREIGN if letter and size > 0 and p + 3 + size <= len(data) else NO
    if size < least[kind] or size > most[kind]:
        return NO
    if kind == _D and p + 5 <= len(data):
        number = data[p + 3] + 256 * data[p + 4]
        if size - 2 < lengths[0, number] or size - 2 > lengths[1, number]:
            return NO
    return WHOLE if p + 3 + size <= len(data) else CUT


@njit(cache=True, nogil=True)
def _followed(data, p, count, lengths, least, most):  # type: ignore[no-untyped-def]
    """Return True if the message at p is whole, and what follows it can be `count` more."""
    if _status(data, p, lengths, least, most) != WHOLE:
        return False
    for _ in range(count):
        p += 3 + data[p] + 256 * data[p + 1]
        status = _status(data, p, lengths, least, most)
        if status == FOREIGN:  # a type that came later: its size must lead to one that is known
            after = p + 3 + data[p] + 256 * data[p + 1]
            status = _status(data, after, lengths, least, most)
            return status in (WHOLE, CUT)
        if status != WHOLE:
            return status == CUT
    return True


@njit(cache=True, nogil=True)
def _walk(data, p, halt, lengths, out, least, most, defining):  # type: ignore[no-untyped-def]
    """Fill `out` with the places of rows, as far as `halt` or what defines others.

    Return how far it came, their number, the bytes that were lost and where the first is, and why it stopped.
    """
    n, lost, first, halt = 0, 0, -1, min(halt, len(data))
    while p < halt:
        if _followed(data, p, 1, lengths, least, most):
            kind = data[p + 2]
            if defining[kind]:
                return p, n, lost, first, True
            size = 3 + data[p] + 256 * data[p + 1]
            if kind == _D and lengths[0, data[p + 3] + 256 * data[p + 4]] >= 0:
                out[n] = p
                n += 1
            elif kind == _D:  # data of a message that was never declared has no meaning
                lost, first = lost + size, p if first < 0 else first
            p += size
            continue
        if first < 0:
            first = p
        begin = p
        p += 1
        while p < halt and not _followed(data, p, 2, lengths, least, most):
            p += 1
        lost += p - begin
    return p, n, lost, first, False


BUSES = {1: "I2C", 2: "SPI", 3: "UAVCAN", 4: "simulation", 5: "serial"}
PARTS = {
    0x11: "LSM303D", 0x12: "LSM6DSV", 0x13: "MPU6000", 0x14: "simulated", 0x21: "MPU6000", 0x22: "L3GD20",
    0x24: "MPU9250", 0x25: "ICM-20649", 0x26: "ICM-42688-P", 0x27: "ICM-40609-D", 0x28: "ICM-20948",
    0x29: "ICM-42605", 0x2A: "ICM-42670-P", 0x2B: "IIM-42652", 0x2C: "IAM-20680HP", 0x2D: "ICM-42686-P",
    0x2E: "IIM-42653", 0x33: "MPU6050", 0x34: "ICM-45686", 0x35: "MPU6050", 0x36: "MPU6500", 0x37: "BMI270",
    0x38: "ICM-20602", 0x3A: "ICM-20608-G", 0x3C: "ICM-20689", 0x41: "BMI055", 0x42: "BMI055", 0x44: "LSM9DS1",
    0x52: "FXOS8701C", 0x54: "FXAS2100C", 0x57: "ADIS16448", 0x58: "ADIS16470", 0x59: "ADIS16477",
    0x5A: "ADIS16507", 0x5B: "SCH16T", 0x5C: "ADIS16607", 0x5D: "ADIS1650x", 0x63: "ADIS16497", 0x66: "BMI088",
    0x6A: "BMI088", 0x6C: "BMI085", 0x6D: "BMI085", 0x80: "CAN", 0x86: "CAN", 0x87: "CAN",
    0xE1: "VN-100", 0xE2: "VN-200", 0xE3: "VN-300",
}  # fmt: skip


def described(device: int | None) -> str:
    """Return a device as text: `1310988 (simulated, simulation 1, address 0x01)`."""
    if not device:
        return "no device_id"
    part = PARTS.get(device >> 16 & 0xFF, f"part 0x{device >> 16 & 0xFF:02X}")
    bus = BUSES.get(device & 0x7, "bus")
    return f"device_id {device} ({part}, {bus} {device >> 3 & 0x1F}, address 0x{device >> 8 & 0xFF:02X})"


def same_place(one: int | None, other: int | None) -> bool:
    """Return True if two devices answer at the same bus and address."""
    return bool(one and other) and (one or 0) & 0xFFFF == (other or 0) & 0xFFFF


def same_part(one: int | None, other: int | None) -> bool:
    """Return True if two devices are halves of one part, as the gyro and the accelerometer of a BMI088 on one bus."""
    name, other_name = (PARTS.get((device or 0) >> 16 & 0xFF) for device in (one, other))
    return name is not None and name == other_name and (one or 0) & 0xFF == (other or 0) & 0xFF
