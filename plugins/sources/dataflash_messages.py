"""What a DataFlash log says of its messages: FMT (fields), FMTU, UNIT and MULT (units), and older logs by name.

::

    value = number * scale,    scale by the letter: 0.01 for c C e E, 1e-7 for L

which is what the vehicle's own tools show. The unit carries what FMTU multiplies by beside that (`us` of a `TimeUS`).
Source: ArduPilot, libraries/AP_Logger/LogStructure.h and README.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from fusion_plugins.sources.dataflash_scan import SIZES, Bytes, Places
from fusion_plugins.sources.dataflash_scan import field as column

CODES = {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "c": "<i2", "H": "<u2", "C": "<u2", "i": "<i4", "e": "<i4",
         "L": "<i4", "I": "<u4", "E": "<u4", "q": "<i8", "Q": "<u8", "f": "<f4", "d": "<f8", "g": "<f2",
         "a": "(32,)<i2"}  # fmt: skip
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
        """Whether it has fields of these names, each of one of the letters."""
        own = dict(zip(self.labels, self.letters, strict=True))
        return all(own.get(label, " ") in letters for label, letters in fields.items())

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

    def raw(self, data: Bytes, at: Places, label: str) -> np.ndarray:
        """Return a field as it stands in the records at `at` (N,), unscaled."""
        k = self.labels.index(label)
        offset = 3 + sum(SIZES[letter] for letter in self.letters[:k])
        code = CODES.get(self.letters[k], f"S{SIZES[self.letters[k]]}")
        return column(data, at, offset, np.dtype(code))

    def values(self, data: Bytes, at: Places, label: str) -> np.ndarray:
        """Return a field of the records at `at` (N,) as float64 (N,), or (N, 32) where it is an array."""
        with np.errstate(invalid="ignore"):  # a signalling NaN is damage, and NaN then
            values = self.raw(data, at, label).astype(np.float64)
        divisor = DIVISORS.get(self.letters[self.labels.index(label)])
        values = values if divisor is None else values / divisor
        scale = self.scales.get(label)
        return values if scale is None else values * scale

    def text(self, data: Bytes, at: Places, label: str) -> list[str]:
        """Return a field of characters, without what follows its end."""
        return [bytes(raw).split(b"\0")[0].decode("latin-1") for raw in self.raw(data, at, label)]


def described(data: Bytes, at: Places) -> dict[int, list[tuple[int, Message]]]:
    """Return the messages by type that the FMT records at `at` (N,) describe, each with where it does.

    A description that only repeats the one before it is left out.
    """
    found: dict[int, list[tuple[int, Message]]] = {}
    for pos in at.tolist():
        record = data[pos : pos + 89].tobytes()
        name, letters, labels = (
            part.split(b"\0")[0].decode("latin-1").strip() for part in (record[5:9], record[9:25], record[25:89])
        )
        letters = letters[: next((k for k, letter in enumerate(letters) if letter not in SIZES), len(letters))]
        parts = tuple(part.strip() for part in labels.split(","))[: len(letters)]
        message = _usual(Message(record[3], record[4], name, letters[: len(parts)], parts))
        known = found.setdefault(message.type, [])
        if not known or known[-1][1] != message:
            known.append((pos, message))
    return found


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
    found, scales, instance = dict(message.units), {}, message.instance
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
        found[label] = _written(unit, size)
    return replace(message, units=found, scales=scales, instance=instance)


def _written(unit: str, size: float) -> str:
    if unit == "s" and size in (1e-6, 1e-3):
        return "us" if size == 1e-6 else "ms"
    head, slash, rest = unit.partition("/")
    power = rest.split("/")
    if slash and len(power) == 2 and power[0] == power[1]:  # m/s/s
        unit = f"{head}/{power[0]}^2"
    return unit if size == 1 else f"{size:.7g} {unit}"
