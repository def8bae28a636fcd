"""Quantity, axis and unit of a column by its name: `Gyro X (deg/s)`, `imu/accel`, `omega_z`, `ax`, `TimeUS`.

A name is split into words: one names the quantity, a last letter or number the axis, brackets or last words the unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

from fusion_core.contracts import USUAL
from fusion_core.units import same_dimension

WORDS = {
    "gyro": {"gyr", "gyro", "gyros", "gyroscope", "gyroscopes", "omega", "rate", "rates", "rot", "ars", "angvel",
             "angularvelocity", "angularrate", "rateofturn", "rotationrate", "drehrate"},
    "accel": {"acc", "accl", "accel", "accels", "accelerometer", "accelerometers", "acceleration", "specificforce",
              "linearacceleration", "beschleunigung"},
    "temperature": {"temp", "temperature", "temperatures", "tmp", "thermistor", "oven", "chamber", "ambient",
                    "temperatur"},
    "time": {"time", "timestamp", "stamp", "sec", "secs", "seconds", "epoch", "utc", "ts", "elapsed", "tow", "micros",
             "millis", "date", "datetime", "zeit", "datum", "xvalue"},
}  # fmt: skip
SURROUNDINGS = {"oven", "ofen", "chamber", "kammer", "ambient", "room", "raum", "air", "bath", "bad", "setpoint",
                "soll", "target", "outside"}  # fmt: skip
"""Words of thermometers beside the sensor, whose bias they lead."""
LETTERS = {"gyro": {"g", "w"}, "accel": {"a", "f"}}  # that mean so beside an axis
NO_SENSOR = {"bias", "truth", "true", "std", "sigma", "cov", "covariance", "var", "variance", "delta", "mag", "offset",
             "orientation", "position", "velocities", "scale", "error", "seq", "rms", "count"}  # fmt: skip
UNITS = {
    "dps": "deg/s", "degs": "deg/s", "degps": "deg/s", "degsec": "deg/s", "degs1": "deg/s", "mdps": "mdeg/s",
    "degh": "deg/h", "deghr": "deg/h", "rads": "rad/s", "radps": "rad/s", "radsec": "rad/s", "rads1": "rad/s",
    "mrads": "mrad/s", "mg": "mg", "ms2": "m/s^2", "mps2": "m/s^2", "mss": "m/s^2", "degc": "degC", "celsius": "degC",
    "kelvin": "K", "degf": "degF", "us": "us", "usec": "us", "micros": "us", "ns": "ns", "nsec": "ns", "ms": "ms",
    "msec": "ms", "millis": "ms", "s": "s", "sec": "s", "secs": "s", "seconds": "s", "g": "g", "c": "degC", "k": "K",
    "f": "degF", "v": "V", "vdc": "V", "ohm": "ohm", "ohms": "ohm", "dph": "deg/h",
}  # fmt: skip
COUNTS = {"lsb", "lsbs", "raw", "adc", "cnt", "cnts", "counts", "digits"}
"""Last words of the names of values as a converter gives them."""
SCALE = re.compile(
    r"[(\[{,_]?\s?(?<!\d)(?<!\d[.,])(?:(?P<per>\d{1,9}(?:[.,]\d{1,12})?)\s?(?:LSB|counts?|digits?)\s?(?:/|per)\s?"
    r"(?P<unit>[^\]}]{1,40}?)|(?P<size>\d{1,9}(?:[.,]\d{1,12})?(?:e-?\d{1,2})?)\s?(?P<each>[^\[({]{1,40}?)\s?(?:/|per)"
    r"\s?(?:LSB|count|digit))\s?[)\]}]?$",
    re.I,
)  # of a count, as [131 LSB/(deg/s)] or (0.0305 deg/s/LSB)
AXES = {"x": "x", "y": "y", "z": "z", "0": "x", "1": "y", "2": "z", "3": "3"}
VEHICLE = {"gyro": ["roll", "pitch", "yaw"], "accel": ["long", "lat", "vert", "longitudinal", "lateral", "vertical"]}
FROM_ONE = {"y": "x", "z": "y", "3": "z"}  # of three columns that are counted from 1


@dataclass(frozen=True)
class Name:
    """The parts of a name; None where one is missing."""

    path: str
    quantity: str | None
    axis: str | None
    unit: str | None
    group: tuple[str, ...]  # its words without axis and unit
    counts: bool = False  # of a converter, by its name, whose size it does not state


LONGEST = 1000
TRIADS = ("gyro", "accel")


def read_name(path: str) -> Name:
    """Read the name of a column; of one of more than `LONGEST` letters nothing is guessed."""
    if len(path) > LONGEST:
        return Name(path, None, None, None, (path,))
    bare, unit = _of_a_count(path) or _in_brackets(path)
    words = [word.lower() for word in re.findall(r"[A-ZÄÖÜ]?[a-zäöüéèß]+|[A-ZÄÖÜ]+(?![a-zäöü])|\d+", bare)]
    counts = unit is None and len(words) > 1 and words[-1] in COUNTS
    words = words[:-1] if counts else words
    letter = re.split(r"[./_\s]", re.split(r"[./]", bare)[-1].strip())[0]
    if letter == "T" or (letter == "t" and words[-1] == "t"):
        return Name(path, "time" if letter == "t" else "temperature", None, unit, (bare,), counts)
    quantity, axis, rest = _meaning(words)
    if unit is None:
        for count in (3, 2, 1):  # `m_s2` and `rad_s` are several words
            suffix = UNITS.get("".join(words[-count:])) if len(words) >= count else None
            shorter = _meaning(words[:-count] if len(words) > count else words)
            if suffix in ("degC", "degF") and len(words) > count and len("".join(words[-count:])) > 1:
                shorter = "temperature", None, words[:-count]  # `imu_T_degC`: no other quantity has such a unit
            if suffix and shorter[0] and _fits(suffix, shorter[0]):
                unit, (quantity, axis, rest) = suffix, shorter
                break
    elif not (quantity and _fits(unit, quantity)) and not NO_SENSOR & set(words):
        quantity = quantity_of(unit)  # whatever its language calls it
    return Name(path, quantity, axis, unit, tuple(rest), counts)


def quantity_of(unit: str) -> str | None:
    """Return the quantity that a unit is of, None where it is none that is known."""
    return next((quantity for quantity in WORDS if _fits(unit, quantity)), None)


def _meaning(words: Sequence[str]) -> tuple[str | None, str | None, Sequence[str]]:
    """Return quantity, axis, and the words without the axis, which is the last, within the last, or the first."""
    last = words[-1] if words else ""
    for axis, rest in (
        (last, words[:-1]),
        (last[-1:] if last[-1:] in "xyz" else "", [*words[:-1], last[:-1]]),
        (words[0] if words and words[0] in "xyz" else "", words[1:]),
    ):
        if axis in AXES and rest and (quantity := _quantity(rest, axis=True)):
            return quantity, AXES[axis], rest
    for word in words:  # `Roll rate`, `acc_lateral`: axes of a vehicle
        rest = [other for other in words if other != word]
        if word in VEHICLE.get(quantity := _quantity(rest, axis=word == words[-1]) or "", ()):
            return quantity, "xyz"[VEHICLE[quantity].index(word) % 3], rest
    if len(words) > 1 and last in AXES:
        return None, AXES[last], words[:-1]
    return _quantity(words, axis=False), None, words


def named(names: Iterable[Name], quantity: str, beside: str = "") -> list[list[Name]]:
    """Return the columns of a quantity, one list a sensor, in the order of axes.

    Triads come first, what is of the surroundings last; of alike ones known units come first, then those whose names
    begin most like the column `beside`. Three columns without axes, all of one stated unit, are a triad in their order.
    """
    groups: dict[tuple[str, ...], list[Name]] = {}
    for name in names:
        if name.quantity == quantity:
            groups.setdefault(name.group if name.axis else (name.path,), []).append(name)
    alone = [group[0] for group in groups.values() if group[0].axis is None]
    if quantity in TRIADS and len(alone) == len(groups) == 3 and len({name.unit for name in alone} | {None}) == 2:
        groups = {(): [replace(name, axis=axis) for name, axis in zip(alone, "xyz", strict=True)]}
    for group in groups.values():
        if {name.axis for name in group} == set(FROM_ONE):
            group[:] = [replace(name, axis=FROM_ONE[name.axis or ""]) for name in group]
        group.sort(key=lambda name: name.axis or "")
        if len({name.axis for name in group}) < len(group):
            del group[1:]
    return sorted(
        groups.values(),
        key=lambda group: (-len(group), _beside(group), group[0].unit is None, -_alike(group, beside)),
    )


def _beside(group: list[Name]) -> bool:
    """Return True for the column of a thermometer that is not the sensor's, by its name."""
    return bool(SURROUNDINGS & set(re.findall("[a-zäöü]+", group[0].path.lower())))


def _alike(group: list[Name], beside: str) -> int:
    """Return with how many equal letters two names begin."""
    pairs = zip(group[0].path, beside, strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def leading(names: Sequence[Name]) -> str | None:
    """Return the first column of the gyro that is taken, of the accelerometer where there is none; None without."""
    groups = [group for quantity in TRIADS for group in named(names, quantity)]
    return groups[0][0].path if groups else None


def known_unit(text: str) -> str | None:
    """Return a unit that is written as a file or a person writes it (`°/s`, `m.s-2`, `mG`) as one that is known."""
    degrees = re.sub("[°º˚]", "deg", text.strip().replace("²", "2").replace("µ", "u").replace("μ", "u"))
    unit = UNITS.get(re.sub(r"[^a-z0-9]", "", degrees.lower()), degrees)
    return unit if unit and same_dimension(unit, unit) else None


def _of_a_count(path: str) -> tuple[str, str] | None:
    """Return a name without the scale that it states, and the size of a count as a unit; None where it states none."""
    found = SCALE.search(path)
    if found is None:
        return None
    unit = known_unit((found["unit"] or found["each"]).strip(" ()"))
    size = float((found["per"] or found["size"]).replace(",", "."))
    if unit is None or not size:
        return None
    return path[: found.start()], f"{1 / size if found['per'] else size:.9g} {unit}"


def _in_brackets(path: str) -> tuple[str, str | None]:
    """Return a name without its brackets, and the unit in them, or behind a comma."""
    bare = re.sub(r"\s*[(\[{](?!\d[)\]])[^()\[\]{}]*[)\]}]\s*$", "", path) or path
    inside = path[len(bare) :].strip(" ()[]{}")
    name, comma, behind = bare.rpartition(",")
    unit = known_unit(inside) if inside else None
    if unit is None and comma and (unit := known_unit(behind)) is not None:
        bare = name
    known = unit is not None or _meaning(re.findall("[a-z]+", bare.lower()))[0] is not None
    return (bare if known else path), unit


def _quantity(words: Sequence[str], *, axis: bool) -> str | None:
    if not words or NO_SENSOR & set(words):
        return None
    ends = {"".join(words[k:]) for k in range(len(words))}
    if not axis and words[-1] in WORDS["temperature"]:  # of a sensor, as `gyro_temp`
        return "temperature"
    spoken = (quantity for quantity, known in WORDS.items() if known & (set(words) | ends))
    lettered = (q for word in (words[-1], words[0]) for q, letters in LETTERS.items() if axis and word in letters)
    return next(spoken, None) or next(lettered, None) or ("time" if list(words) == ["t"] else None)


def _fits(unit: str, quantity: str) -> bool:
    return same_dimension(unit, USUAL[quantity].si)
