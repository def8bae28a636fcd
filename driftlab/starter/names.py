"""Quantity, axis and unit of a column by its name: `Gyro X (deg/s)`, `imu/accel`, `omega_z`, `ax`, `TimeUS`.

A name is split into words: one names the quantity, a last letter or number the axis, brackets or last words the unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile

from fusion_core.contracts import USUAL
from fusion_core.units import same_dimension

WORDS = {
    "gyro": {"gyr", "gyro", "gyros", "gyroscope", "gyroscopes", "omega", "rate", "rates", "rot", "ars", "angvel",
             "angularvelocity", "angularrate", "rateofturn", "rotationrate"},
    "accel": {"acc", "accel", "accels", "accelerometer", "accelerometers", "acceleration", "specificforce",
              "linearacceleration"},
    "temperature": {"temp", "temperature", "temperatures", "tmp", "thermistor", "oven", "chamber", "ambient"},
    "time": {"time", "timestamp", "stamp", "sec", "secs", "seconds", "epoch", "utc", "ts"},
}  # fmt: skip
LETTERS = {"gyro": {"g", "w"}, "accel": {"a", "f"}}  # that mean so beside an axis
NO_SENSOR = {"bias", "truth", "true", "std", "sigma", "cov", "covariance", "var", "variance", "delta", "mag", "offset",
             "orientation", "position", "velocities", "scale", "error", "seq"}  # fmt: skip
UNITS = {
    "dps": "deg/s", "degs": "deg/s", "degps": "deg/s", "mdps": "mdeg/s", "rads": "rad/s", "radps": "rad/s",
    "mg": "mg", "ms2": "m/s^2", "mps2": "m/s^2", "mss": "m/s^2", "degc": "degC", "celsius": "degC", "kelvin": "K",
    "us": "us", "usec": "us", "ns": "ns", "nsec": "ns", "ms": "ms", "msec": "ms", "s": "s", "sec": "s", "secs": "s",
    "seconds": "s", "g": "g", "c": "degC", "k": "K", "f": "degF",
}  # fmt: skip
AXES = {"x": "x", "y": "y", "z": "z", "0": "x", "1": "y", "2": "z"}


@dataclass(frozen=True)
class Name:
    """The parts of a name; None where one is missing."""

    path: str
    quantity: str | None
    axis: str | None
    unit: str | None
    group: tuple[str, ...]  # its words without axis and unit


LONGEST = 1000


def read_name(path: str) -> Name:
    """Read the name of a column; of one of more than `LONGEST` letters nothing is guessed."""
    if len(path) > LONGEST:
        return Name(path, None, None, None, (path,))
    bare, unit = _in_brackets(path)
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", bare)]
    if (letter := re.split(r"[./]", bare)[-1].strip()) in ("t", "T"):
        return Name(path, "time" if letter == "t" else "temperature", None, unit, (bare,))
    quantity, axis, rest = _meaning(words)
    if unit is None:
        for count in (3, 2, 1):  # `m_s2` and `rad_s` are several words
            suffix = UNITS.get("".join(words[-count:])) if len(words) > count else None
            shorter = _meaning(words[:-count])
            if suffix and shorter[0] and _fits(suffix, shorter[0]):
                unit, (quantity, axis, rest) = suffix, shorter
                break
    elif quantity and not _fits(unit, quantity):
        unit = None
    return Name(path, quantity, axis, unit, tuple(rest))


def _meaning(words: Sequence[str]) -> tuple[str | None, str | None, Sequence[str]]:
    """Return quantity, axis, and the words without the axis."""
    axis = None
    if len(words) > 1 and words[-1] in AXES:
        axis, words = AXES[words[-1]], words[:-1]
    elif words and words[-1][-1] in "xyz" and _quantity([*words[:-1], words[-1][:-1]], axis=True):
        axis, words = words[-1][-1], [*words[:-1], words[-1][:-1]]
    return _quantity(words, axis=axis is not None), axis, words


def named(names: Iterable[Name], quantity: str, beside: str = "") -> list[list[Name]]:
    """Return the columns of a quantity, one list a sensor, in the order of axes.

    Triads and known units come first, then those whose names begin most like the column `beside`.
    """
    groups: dict[tuple[str, ...], list[Name]] = {}
    for name in names:
        if name.quantity == quantity:
            groups.setdefault(name.group if name.axis else (name.path,), []).append(name)
    for group in groups.values():
        group.sort(key=lambda name: name.axis or "")
        axes = [name.axis for name in group]
        if len(set(axes)) < len(axes):
            del group[1:]
    return sorted(groups.values(), key=lambda group: (-len(group), group[0].unit is None, -_alike(group, beside)))


def _alike(group: list[Name], beside: str) -> int:
    """Return with how many equal letters two names begin."""
    pairs = zip(group[0].path, beside, strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def leading(names: Iterable[Name]) -> str | None:
    """Return the first column of the gyro that is taken, of the accelerometer where there is none; None without."""
    names = list(names)
    groups = [group for quantity in ("gyro", "accel") for group in named(names, quantity)]
    return groups[0][0].path if groups else None


def _in_brackets(path: str) -> tuple[str, str | None]:
    brackets = re.search(r"[(\[]([^)\]]*)[)\]]\s*$", path)
    if brackets is None or brackets[1].isdigit():
        return path, None
    text = brackets[1].strip()
    text = UNITS.get(re.sub(r"[^a-z0-9]", "", text.lower()), text)
    return (path[: brackets.start()], text) if same_dimension(text, text) else (path, None)


def _quantity(words: Sequence[str], *, axis: bool) -> str | None:
    if not words or NO_SENSOR & set(words):
        return None
    ends = {"".join(words[k:]) for k in range(len(words))}
    for quantity, known in WORDS.items():
        if known & (set(words) | ends) or (axis and words[-1] in LETTERS.get(quantity, ())):
            return quantity
    return "time" if list(words) == ["t"] else None


def _fits(unit: str, quantity: str) -> bool:
    return same_dimension(unit, USUAL[quantity].si)
