"""The places of the records of a DataFlash log: one pass over its bytes, which finds its way back after damage.

::

    record:  A3 95 type  body        FMT (type 128, 89 bytes): type, length, name[4], format[16], labels[64]

A record counts where the next one begins at its end, or the file ends there: bytes that look like a header within
other data do not pass. One that is followed by something else may have lost its tail, and is in doubt
(`log.credible`). Behind a gap the search goes on byte by byte.
Where a type's length is not that of its fields, both are tried; a record that is shorter than its fields is not given.

A DataFlash log describes its messages: FMT their fields, FMTU, UNIT and MULT their units; of older logs the names do.

::

    value = number * scale,    scale by the letter: 0.01 for c C e E, 1e-7 for L

which is what the vehicle's own tools show. The unit carries what FMTU multiplies by beside that (`us` of a `TimeUS`).
Source: ArduPilot, libraries/AP_Logger/LogStructure.h and README.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from struct import calcsize
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fusion_core.budget import COUNT, TimeBudget
from fusion_core.chunk import Bytes, Integers
from fusion_plugins.sources.joining import records, release

PIECE = 1 << 22  # bytes between two looks at the clock, and of a mapped log that are held
ROWS = 1 << 16  # that are made float64 at once
SHORT = 1 << 31  # bytes of a file whose places are int32
Into = tuple[Integers, Integers, Integers, Integers, Integers]
State = tuple[int, int, int, int, int]

PACKED = {
    "b": "b", "B": "B", "M": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d", "g": "e", "q": "q",
    "Q": "Q", "n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "a": "64s",
}  # fmt: skip
"""A field by the letter of its format, as `struct` writes it."""

SIZES = {letter: calcsize(f"<{code}") for letter, code in PACKED.items()}  # bytes
CODES = {letter: f"<{code}" for letter, code in PACKED.items() if not code.endswith("s")} | {"a": "(32,)<i2"}  # numbers

HEAD, SECOND, FMT, FMT_LENGTH = 0xA3, 0x95, 128, 89
_LETTERS = np.zeros(256, dtype=np.int64)
for _letter, _size in SIZES.items():
    _LETTERS[ord(_letter)] = _size


class Scan(NamedTuple):
    """The records of a log, by one pass over it.

    Attributes
    ----------
    at : dict of int to (N,) array of int
        Where the records of each type that was asked for begin, in the order of the file.
    counts : (256,) array of int
        Records of each type.
    doubtful, doubtful_types : (D,) arrays
        Where records begin that nothing known follows, of any type, and their types; they are not in `at`.
    lost, first_lost : int
        Bytes before `end` that are no record, and where the first of them is; -1 where there is none.
    end : int
        Where the last record ends.
    """

    at: dict[int, Integers]
    counts: Integers
    doubtful: Integers
    doubtful_types: Bytes
    lost: int
    first_lost: int
    end: int


def scan(data: Bytes, most: Mapping[int, int], clock: TimeBudget) -> Scan:
    """Return the places of the records of each type, `most` of them at most; raises UnreadableFile out of time."""
    at: Integers = np.empty(sum(most.values()), np.int32 if len(data) < SHORT else np.int64)
    ends = np.cumsum([most.get(kind, 0) for kind in range(256)])
    places, counts = np.concatenate([[0], ends[:-1]]), np.zeros(256, np.int64)  # of the next record of each type
    doubtful = np.empty(min(len(data) // 64, COUNT) + 1024, at.dtype)
    lengths, state = np.zeros((3, 256), np.int64), (0, 0, 0, -1, 0)
    lengths[:2, FMT], lengths[2] = FMT_LENGTH, _LETTERS
    while state[0] + 3 <= len(data):
        rows, stop = counts.sum(), state[0] + PIECE
        state = _walk(data, stop, lengths, (at, places, ends, counts, doubtful), state)
        clock.check(int(counts.sum() - rows))
        release(data)
    _, doubts, lost, first_lost, end = state
    doubtful = doubtful[:doubts].copy()
    found = {kind: at[ends[kind] - count : places[kind]] for kind, count in most.items()}
    # places of few records do not keep those of all in memory
    found = {kind: part if 2 * len(part) > len(at) else part.copy() for kind, part in found.items()}
    return Scan(found, counts, doubtful, data[doubtful + 2], lost, first_lost, end)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _walk(data: Bytes, stop: int, lengths: Integers, into: Into, state: State) -> State:
    """Fill `at` (M,), `counts` (256,), `doubtful` as far as `stop`; return how far it came.

    The next record of a type goes to `places` (256,) of `at`, if that is before `ends` (256,). `lengths` (3, 256) are
    declared, as the letters of the formats add up, and of each letter; the state is where it goes on, how many are in
    doubt, the bytes lost, the first of them, and the end of the last record.
    """
    n, (pos, doubts, lost, first_lost, end) = len(data), state
    at, places, ends, counts, doubtful = into
    length, fields, letters = lengths
    while pos + 3 <= n and pos < stop:
        kind, step = data[pos + 2], 0
        if data[pos] == HEAD and data[pos + 1] == SECOND:
            longer, shorter = max(length[kind], fields[kind]), min(length[kind], fields[kind])
            if _follows(data, pos + longer, longer):
                step = longer
            elif _follows(data, pos + shorter, shorter):
                step = shorter
            elif kind != FMT and 3 < fields[kind] <= n - pos and doubts < len(doubtful):
                doubtful[doubts] = pos
                doubts += 1
        if step and kind == FMT:
            size = _format_size(data, pos, letters)
            if size == 0:
                step = 0
            else:
                length[data[pos + 3]], fields[data[pos + 3]] = max(3, data[pos + 4]), size
        if step == 0:
            pos += 1
            continue
        if pos > end:
            first_lost = end if lost == 0 else first_lost
            lost += pos - end
        if step >= fields[kind]:
            if places[kind] < ends[kind]:
                at[places[kind]] = pos
                places[kind] += 1
            counts[kind] += 1
        pos += step
        end = pos
    return pos, doubts, lost, first_lost, end


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _follows(data: Bytes, end: int, length: int) -> bool:
    """Return True if a record of `length` that ends at `end` is whole: the file ends there, or the next one begins."""
    n = len(data)
    if length < 3 or end > n:
        return False
    return (end == n or data[end] == HEAD) and (end + 1 >= n or data[end + 1] == SECOND)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _format_size(data: Bytes, pos: int, letters: Integers) -> int:
    """Return the length of the records that an FMT at `pos` describes, by its letters; 0 where it is damaged.

    By what it declares, where a letter is none that is known.
    """
    for k in range(4):
        c = data[pos + 5 + k]
        if (k == 0 and c < 48) or c > 126:
            return 0
    size = 3
    for k in range(16):
        c = data[pos + 9 + k]
        if c == 0:
            break
        if c < 48 or c > 126:
            return 0
        if letters[c] == 0:
            return int(data[pos + 4])
        size += letters[c]
    return size


DIVISORS = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
CLOCKS = {"TimeUS": 1e-6, "TimeMS": 1e-3, "SampleUS": 1e-6}
"""Fields that are times since power-up, and their unit in s."""

USUAL_UNITS = {"TimeUS": "us", "SampleUS": "us", "TimeMS": "ms", "Temp": "degC", "T": "degC", "Press": "Pa"}
AXES = {"Gyr": "rad/s", "Acc": "m/s^2"}
"""Units of older logs, which name none; of the axes in messages of inertial units."""

OLDER = {"T": "Temp", "TimeUS": "TimeMS", "EG": "ErrG", "EA": "ErrA", "GH": "GyHlt", "AH": "AcHlt"}
"""Fields by the names of today, and how earlier vehicles called them."""

INERTIAL = ("IMU", "GYR", "ACC")
"""Messages of inertial units: one an instance in earlier logs (IMU, IMU2; GYR1, GYR2), a field `I` since."""

DESCRIPTIONS = ("FMT", "FMTU", "UNIT", "MULT")
"""Messages about messages."""


@dataclass(frozen=True)
class Message:
    """A kind of message, as the log's own FMT describes it.

    Attributes
    ----------
    type, length : int
    name, letters : str
    labels : tuple of str
    units : dict of str to str
        Of fields whose unit is known.
    instance : str or None
        The field that says which of several sensors a row is of.
    """

    type: int
    length: int
    name: str
    letters: str
    labels: tuple[str, ...]
    units: dict[str, str] = field(default_factory=dict)
    scales: dict[str, float] = field(default_factory=dict)
    instance: str | None = None

    def label(self, name: str) -> str | None:
        """Return the field of that name, of today's or of its day; None where it has none that is a number."""
        for label in (name, OLDER.get(name)):
            if label in self.labels and self.letters[self.labels.index(label)] in CODES:
                return label
        return None

    def has(self, **fields: str) -> bool:
        """Return True if it has fields of these names, each of one of the letters."""
        letters_of = dict(zip(self.labels, self.letters, strict=True))
        return all(letters_of.get(label, " ") in letters for label, letters in fields.items())

    @property
    def numbers(self) -> list[str]:
        """The fields that are numbers."""
        return [label for label, letter in zip(self.labels, self.letters, strict=True) if letter in CODES]

    @property
    def clock(self) -> str | None:
        """The field that says when a row was written."""
        return self.label("TimeUS")

    @property
    def size(self) -> int:
        """Bytes of a record, by its letters."""
        return 3 + sum(SIZES[letter] for letter in self.letters)

    def raw(self, data: Bytes, at: Integers, label: str) -> np.ndarray:
        """Return a field as it stands in the records at `at` (N,), unscaled."""
        k = self.labels.index(label)
        offset = 3 + sum(SIZES[letter] for letter in self.letters[:k])
        return records(data[offset:], at, self._type(label))

    def _type(self, label: str) -> np.dtype[Any]:
        """Return the type of a field as it stands in the records."""
        letter = self.letters[self.labels.index(label)]
        return np.dtype(CODES.get(letter, f"S{SIZES[letter]}"))

    def values(self, data: Bytes, at: Integers, label: str) -> np.ndarray:
        """Return a field of the records at `at` (N,) as float64 (N,), or (N, 32) where it is an array."""
        values = np.empty((len(at), *self._type(label).shape))
        with np.errstate(invalid="ignore"):  # a signalling NaN is damage, and NaN then
            for start in range(0, len(at), ROWS):
                values[start : start + ROWS] = self.raw(data, at[start : start + ROWS], label)
        divisor = DIVISORS.get(self.letters[self.labels.index(label)])
        if divisor is not None:
            values /= divisor
        if label in self.scales:
            values *= self.scales[label]
        return values

    def text(self, data: Bytes, at: Integers, label: str) -> list[str]:
        """Return a field of characters, without what follows its end."""
        return [bytes(raw).split(b"\0")[0].decode("latin-1") for raw in self.raw(data, at, label)]


def described(data: Bytes, at: Integers) -> dict[int, list[tuple[int, Message]]]:
    """Return the messages by type that the FMT records at `at` (N,) describe, each with where it does.

    A description that only repeats the one before it is left out.
    """
    messages: dict[int, list[tuple[int, Message]]] = {}
    for pos in at.tolist():
        record = data[pos : pos + 89].tobytes()
        name, letters, labels = (
            part.split(b"\0")[0].decode("latin-1").strip() for part in (record[5:9], record[9:25], record[25:89])
        )
        letters = letters[: next((k for k, letter in enumerate(letters) if letter not in SIZES), len(letters))]
        parts = tuple(part.strip() for part in labels.split(","))[: len(letters)]
        message = _usual(Message(record[3], record[4], name, letters[: len(parts)], parts))
        known = messages.setdefault(message.type, [])
        if not known or known[-1][1] != message:
            known.append((pos, message))
    return messages


def _usual(message: Message) -> Message:
    """Return the message with what is known of its fields by their names."""
    inertial = message.name.startswith(INERTIAL)
    units = {label: unit for label, unit in USUAL_UNITS.items() if label in message.labels}
    if not inertial and not message.name.startswith("BAR"):
        units = {label: unit for label, unit in units.items() if label in CLOCKS}
    for label in message.labels if inertial else ():
        if label[:3] in AXES and label[3:] in ("X", "Y", "Z"):
            units[label] = AXES[label[:3]]
    instance = "I" if "I" in message.labels and message.letters[message.labels.index("I")] in "bBM" else None
    return replace(message, units=units, instance=instance)


def with_units(
    message: Message, units: str, multipliers: str, names: dict[str, str], sizes: dict[str, float]
) -> Message:
    """Return the message with units by its FMTU; `names` are of UNIT, `sizes` of MULT."""
    units_of, scales, instance = dict(message.units), {}, message.instance
    for k, label in enumerate(message.labels[: len(units)]):
        if units[k] == "#":
            instance = label
        unit = names.get(units[k], "").strip()
        if not unit or units[k] in "-?#":
            continue
        size = sizes.get(multipliers[k], 1.0) if k < len(multipliers) else 1.0
        size = 1.0 if size == 0 or message.letters[k] in DIVISORS else size
        if unit == "degC" and size != 1:  # a scale with an offset cannot carry a factor
            scales[label], size = size, 1.0
        units_of[label] = _written(unit, size)
    return replace(message, units=units_of, scales=scales, instance=instance)


def _written(unit: str, size: float) -> str:
    if unit == "s" and size in (1e-6, 1e-3):
        return "us" if size == 1e-6 else "ms"
    head, slash, rest = unit.partition("/")
    power = rest.split("/")
    if slash and len(power) == 2 and power[0] == power[1]:  # m/s/s
        unit = f"{head}/{power[0]}^2"
    return unit if size == 1 else f"{size:.7g} {unit}"
