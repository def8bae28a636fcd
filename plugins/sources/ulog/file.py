"""A ULog file: its sensors, its parameters, and the rows of those that are wanted.

The file is read twice, block after block: once for its definitions and some rows of each sensor, once for the wanted
rows. The whole messages make a ULog, which pyulog decodes.

Whole messages of a ULog file: what is cut or damaged is stepped over and counted.

::

    size (2 bytes, little endian), type (1 byte), size bytes        D: the first two of them are the subscription

A message counts where the one behind it can be one too; else the next place is looked for from which three
messages follow one another. ULog has no checksum: a flipped bit inside the numbers of a row is not seen.

Source: the ULog file format (docs.px4.io, Log File Format).

PX4's device numbers name the part, its bus and its address::

    device_id = bus type (3 bits) | bus (5 bits) << 3 | address << 8 | part << 16

A gyro and an accelerometer in one chip share bus and address; older firmware gave them different parts. Source: PX4,
src/lib/drivers/device/Device.hpp and src/drivers/drv_sensor.h.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fusion_core.budget import COUNT, TEXTS, TimeBudget, check_count, check_size
from fusion_core.chunk import Array
from fusion_core.contracts import foreign, head
from fusion_core.errors import ConfigError, UnreadableFile, quote
from fusion_core.faults import Faults

SIGNATURE = b"ULog\x01\x125"
HEADER = 16  # bytes, of which the last eight are the start
FIELDS, DEEP = 300_000, 16  # numbers in a row of each topic, in all, and formats in one another
APPENDED = 1  # the bit of the incompatible flags that says that data stands behind the log's end


@dataclass(frozen=True, eq=False)
class Instance:
    """One of the sensors (or another topic) of a log.

    Attributes
    ----------
    topic, number : str, int
        As in `sensor_gyro[1]`.
    rows : int
    samples : dict of str to array
        Some of its rows, by field.
    """

    topic: str
    number: int
    subscription: int
    rows: int
    samples: Mapping[str, Array]

    @property
    def device(self) -> int | None:
        """The device number; None where the log has none."""
        numbers = self.samples.get("device_id", np.zeros(0))
        return int(np.max(numbers)) or None if len(numbers) else None

    @property
    def temperature(self) -> float:
        """A temperature that it showed [degC]; NaN where it has none."""
        readings = np.asarray(self.samples.get("temperature", np.zeros(0)), dtype=np.float64)
        finite = readings[np.isfinite(readings)]
        return float(finite[-1]) if len(finite) else np.nan

    @property
    def rate(self) -> float:
        """Rows a second [Hz]; NaN where that cannot be told."""
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
        self.path, self.size = path, path.stat().st_size
        self.clock = TimeBudget(path, "what is no row")
        self._flags, self._ends = _sections(path, first, self.size)
        log = self._decoded(RowSelection(), counted := Counted())
        if not any("timestamp" in d.data for d in log.data_list):
            raise UnreadableFile(f"{path}: ends before its first row ({self.size} bytes); copy or log it again")
        # of a damaged log, a parameter may be anything
        known = log.initial_parameters.items()
        self.parameters: dict[str, float] = {name: value for name, value in known if isinstance(value, int | float)}
        self._formats = log.message_formats
        self.instances = {
            (d.name, d.multi_id): Instance(d.name, d.multi_id, d.msg_id, int(counted.rows[d.msg_id]), d.data)
            for d in log.data_list
            if "timestamp" in d.data  # else its format is damaged
        }
        self._row_sizes = {d.msg_id: self._row_size(d) for d in log.data_list}

    def of(self, topic: str) -> list[Instance]:
        """Return the instances of a topic."""
        return [instance for (name, _), instance in self.instances.items() if name == topic]

    def read(self, wanted: Collection[Instance], faults: Faults) -> dict[Instance, dict[str, Array]]:
        """Return the rows of instances, by field; what is wrong with the file goes to `faults`."""
        rows = RowSelection(*(np.full(65536, value, np.int64) for value in (-1, -1, 0)))
        for number, (least, most) in self._row_sizes.items():
            rows.shortest[number], rows.longest[number] = least, most
        for instance in wanted:
            rows.step[instance.subscription] = 1
        log = self._decoded(rows, counted := Counted())
        faults.add(
            "bytes of the log that belong to no message that is known (cut, damaged or of a later format)",
            counted.lost,
            f"at byte {counted.first_lost} of {self.size}",
        )
        if log.dropouts:
            total = sum(dropout.duration for dropout in log.dropouts) / 1e3
            first = log.dropouts[0]
            faults.add(
                f"dropouts, for which the logger wrote nothing ({total:.6g} s in all)",
                len(log.dropouts),
                f"of {first.duration / 1e3:.6g} s after t = {first.timestamp / 1e6:.3f} s",
            )
        data = {(d.name, d.multi_id): d.data for d in log.data_list}
        lacking = {instance: {name: v[:0] for name, v in instance.samples.items()} for instance in wanted}
        return {instance: data.get((instance.topic, instance.number), lacking[instance]) for instance in wanted}

    def _row_size(self, data: Any) -> tuple[int, int]:
        """Return the bytes of a row, without and with what its format has at its end as padding."""
        from pyulog import ULog

        least = sum(ULog.get_field_size(field.type_str) for field in data.field_data)
        padding = 0
        for kind, count, name in reversed(self._formats[data.name].fields):
            if not name.startswith("_padding"):
                break
            padding += ULog.get_field_size(kind) * max(count, 1)
        return least, least + padding

    def _decoded(self, wanted: RowSelection, counted: Counted) -> Any:
        """Return the log that pyulog reads in the whole messages of the file."""
        from pyulog.exceptions import ULogException

        stream, rows = io.BytesIO(), 0
        with self.clock, self.path.open("rb") as file:
            stream.write(file.read(HEADER) + self._flags)
            start = HEADER + len(self._flags)
            for end in self._ends:
                for part in messages(file, start, end, wanted, counted):
                    stream.write(part)
                    before, rows = rows, int(counted.rows.sum()) + counted.others
                    self.clock.check(rows - before)
                    check_count(self.path, "parameters, dropouts and the like", counted.others, COUNT // 2)
                    check_size(self.path, "what describes its rows", counted.text, TEXTS)
                start = end
        stream.seek(0)
        try:
            with _silent():
                return bounded(self.path)(stream)
        except ULogException as error:
            raise UnreadableFile(f"{self.path}: cannot be decoded by pyulog ({error}); use a later pyulog") from None


def bounded(path: Path) -> Callable[[BinaryIO], Any]:
    """Return pyulog's reader, with a limit to the numbers of a row, which may be of arrays in arrays in arrays."""
    from pyulog import ULog

    total = 0

    def numbers(formats: Mapping[str, Any], name: str, known: dict[tuple[str, int], int], depth: int = 0) -> int:
        if depth > DEEP:
            return FIELDS
        if (name, depth) not in known:
            fields = formats[name].fields if name in formats else ()
            sizes = [
                1 if kind in ULog._UNPACK_TYPES else numbers(formats, kind, known, depth + 1) for kind, *_ in fields
            ]
            counts = (max(array, 1) * size for (_, array, _), size in zip(fields, sizes, strict=True))
            known[name, depth] = min(sum(counts), FIELDS)
        return known[name, depth]

    class Added(ULog._MessageAddLogged):  # type: ignore[misc]
        def _parse_format(self, formats: Mapping[str, Any]) -> None:
            nonlocal total
            total += numbers(formats, self.message_name, {})
            check_count(path, f"numbers in the rows of {quote(self.message_name)} and before it", total, FIELDS - 1)
            super()._parse_format(formats)

    return type("Bounded", (ULog,), {"_MessageAddLogged": Added})


def _sections(path: Path, first: bytes, size: int) -> tuple[bytes, list[int]]:
    """Return the message of flags as pyulog may see it, and where the parts of the file end.

    After a crash PX4 appends what it kept to the end of the log, which may end within a message; the flags say where.
    """
    if len(first) < HEADER:
        raise UnreadableFile(f"{path}: is cut short ({size} bytes, a ULog header has {HEADER}); copy it again")
    length, kind = struct.unpack_from("<HB", first.ljust(HEADER + 3, b"\0"), HEADER)
    if kind != ord("B") or length < 40 or len(first) < HEADER + 3 + length:
        return b"", [size]
    flags = bytearray(first[HEADER : HEADER + 3 + length])
    offsets: tuple[int, ...] = struct.unpack_from("<3Q", flags, 19) if flags[11] & APPENDED else ()
    flags[11] &= ~APPENDED  # what pyulog gets is in one piece
    flags[19:43] = bytes(24)
    return bytes(flags), [*sorted(o for o in offsets if HEADER + len(flags) < o < size), size]


@contextmanager
def _silent() -> Iterator[None]:
    """Keep pyulog from writing to standard output, which is the command's: only its own `print` is taken away."""
    from pyulog import core

    core.print = lambda *_, **__: None
    try:
        yield
    finally:
        vars(core).pop("print", None)  # another thread may have been faster


def require_pyulog(kind: str) -> None:
    """Raise ConfigError where pyulog is not installed."""
    try:
        import pyulog  # noqa: F401
    except ImportError:
        raise ConfigError(
            f"{kind}: reads PX4 logs with pyulog, which is not installed; pip install 'driftlab[px4]'"
        ) from None


IDS = 65536  # subscriptions that a file can have
BLOCK = 2 << 20  # bytes read at a time
LONGEST = 3 + 65535  # bytes of a message
AHEAD = 4 * LONGEST  # bytes that must be known behind a message before it is judged
STAMP = 8  # bytes of a time stamp, which every row has
SAMPLED = 1024  # of the rows of a subscription, where only some are wanted, each so many-th is taken

_SHORTEST = np.full(256, -1, np.int64)  # bytes of a message by type; -1: no type that is known
_LONGEST = np.full(256, 65535, np.int64)
for _kind, _size in {"F": 3, "D": 2, "I": 2, "M": 3, "P": 2, "Q": 3, "A": 4, "L": 9, "C": 11, "B": 40}.items():
    _SHORTEST[ord(_kind)] = _size
for _kind, _size in {"R": 2, "S": 8, "O": 2}.items():
    _SHORTEST[ord(_kind)] = _LONGEST[ord(_kind)] = _size
_KEPT = np.zeros(256, np.bool_)  # what a reader needs beside the rows; no text, no synchronisation
for _kind in "FIPQARO":
    _KEPT[ord(_kind)] = True
_LONGEST[[ord(_kind) for _kind in "FIPQAD"]] = 10_000  # what is longer, pyulog takes for damage
_A, _D = ord("A"), ord("D")

NO, WHOLE, CUT, FOREIGN = 0, 1, 2, 3


@dataclass
class RowSelection:
    """The selection of rows.

    Attributes
    ----------
    shortest, longest : (65536,) arrays of int
        Bytes of a row by subscription; `shortest` is -1 where the file has none of that number, or none yet: those
        of which `longest` is known are entered where the file names them.
    step : (65536,) array of int
        0 for none, 1 for all, `SAMPLED` for some: the first, second, fourth and so on, and each so many-th.
    """

    shortest: NDArray[np.int64] = field(default_factory=lambda: np.full(IDS, -1, np.int64))
    longest: NDArray[np.int64] = field(default_factory=lambda: np.full(IDS, 65535, np.int64))
    step: NDArray[np.int64] = field(default_factory=lambda: np.full(IDS, SAMPLED, np.int64))


@dataclass
class Counted:
    """The numbers of messages, and of lost bytes.

    Attributes
    ----------
    rows : (65536,) array of int
        Of each subscription, whether taken or not.
    others, text : int
        Definitions, parameters, dropouts and the like that were taken, and their bytes.
    lost : int
        Bytes that belong to no message that is known.
    first_lost : int
        Where in the file the first of them is; -1 where there is none.
    """

    rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(IDS, np.int64))
    others: int = 0
    text: int = 0
    lost: int = 0
    first_lost: int = -1


def messages(file: BinaryIO, start: int, stop: int, wanted: RowSelection, counted: Counted) -> Iterator[bytes]:
    """Yield the definitions and the wanted rows between two places of a file, as the file has them."""
    file.seek(start)
    held, at, final = b"", start, False
    while not final:
        more = file.read(min(BLOCK, stop - at - len(held)))
        data = np.frombuffer(held + more, np.uint8)
        final = not more or at + len(data) >= stop
        out = np.empty(len(data), np.uint8)
        done, taken, lost, first, others, text = _scan(
            data, final, wanted.shortest, wanted.longest, wanted.step, counted.rows, out, _SHORTEST, _LONGEST, _KEPT
        )
        counted.lost += lost
        counted.others += others
        counted.text += text
        if first >= 0 and counted.first_lost < 0:
            counted.first_lost = at + first
        yield out[:taken].tobytes()
        held, at = data[done:].tobytes(), at + done


def sampled(rows: int) -> NDArray[np.int64]:
    """Return the numbers of a subscription's rows that are taken where some are."""
    n: NDArray[np.int64] = np.arange(rows)
    rows_taken: NDArray[np.int64] = n[(n % SAMPLED == 0) | (n < SAMPLED) & (n & (n - 1) == 0)]
    return rows_taken


@njit(cache=True, nogil=True)
def _status(data, p, shortest, longest, least, most):  # type: ignore[no-untyped-def]
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
        if size - 2 < shortest[number] or size - 2 > longest[number]:
            return NO
    return WHOLE if p + 3 + size <= len(data) else CUT


@njit(cache=True, nogil=True)
def _followed(data, p, count, shortest, longest, least, most):  # type: ignore[no-untyped-def]
    """Return True if the message at p is whole, and what follows it can be `count` more."""
    if _status(data, p, shortest, longest, least, most) != WHOLE:
        return False
    for _ in range(count):
        p += 3 + data[p] + 256 * data[p + 1]
        status = _status(data, p, shortest, longest, least, most)
        if status == FOREIGN:  # a type that came later: its size must lead to one that is known
            after = p + 3 + data[p] + 256 * data[p + 1]
            status = _status(data, after, shortest, longest, least, most)
            return status in (WHOLE, CUT)
        if status != WHOLE:
            return status == CUT
    return True


@njit(cache=True, nogil=True)
def _scan(data, final, shortest, longest, step, rows, out, least, most, others_wanted):  # type: ignore[no-untyped-def]
    """Copy what is wanted to `out`; return bytes read, written, lost, where first, and number and bytes of others."""
    p, q, lost, first, end, others, text = 0, 0, 0, -1, len(data), 0, 0
    while p < end and (final or p + AHEAD < end):
        if not _followed(data, p, 1, shortest, longest, least, most):
            if first < 0:
                first = p
            begin = p
            p += 1
            while p < end and (final or p + AHEAD < end):
                if _followed(data, p, 2, shortest, longest, least, most):
                    break
                p += 1
            lost += p - begin
            continue
        size, kind = data[p] + 256 * data[p + 1], data[p + 2]
        take = others_wanted[kind]
        others += take
        text += take * size
        if kind == _A:
            number = data[p + 4] + 256 * data[p + 5]
            if shortest[number] < 0 and longest[number] > 0:
                shortest[number] = STAMP
        if kind == _D:
            number = data[p + 3] + 256 * data[p + 4]
            n, every = rows[number], step[number]
            rows[number] = n + 1
            some = n % every == 0 or (n < every and n & (n - 1) == 0) if every > 1 else every == 1
            take = some and shortest[number] >= 0  # pyulog loses its way in rows of what it does not know yet
        if take:
            out[q : q + 3 + size] = data[p : p + 3 + size]
            q += 3 + size
        p += 3 + size
    return p, q, lost, first, others, text


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
