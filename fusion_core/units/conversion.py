"""Conversion of units, by the definitions of `units.txt`.

An angle is a dimension of its own (so 5 Hz is not 5 rad/s), `g` is standard gravity and not a gram. Inside the program
everything is SI, except that temperatures are in degC. A unit is given by its powers here: the exponents of units by
their full names.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping
from fractions import Fraction
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_core.errors import UnitError, quote
from fusion_core.units.grammar import NUMBER, read_quantity, read_scaled_unit, read_unit

PRODUCTS = ("V", "ohm", "Pa", "T", "W", "N", "J", "F", "H", "Wb")  # SI units that are products of others
_DEFINITION = re.compile(rf"(?:({NUMBER.pattern})(?: \* |$))?([^;]*)(?:; offset: ({NUMBER.pattern}))?")

Powers = Mapping[str, float]


class NamedUnit(NamedTuple):
    """A unit that has a name: `scale` times the powers `of` others; what a thermometer reads counts from `zero`."""

    name: str
    symbol: str
    scale: float = 1.0
    of: Powers | None = None  # None of a base unit
    zero: float = 0.0
    dimension: str = ""  # of a base unit; a count has none


@cache
def _table() -> tuple[dict[str, NamedUnit], dict[str, tuple[str, float]]]:
    """Return the units, and full name and scale of the prefixes, by all that they are called."""
    units: dict[str, NamedUnit] = {}
    prefixes = {"": ("", 1.0)}
    for line in Path(__file__).with_name("units.txt").read_text(encoding="utf-8").splitlines():
        name, *others = (part.strip() for part in line.partition("#")[0].split("="))
        if not others:
            continue
        value, *called = others
        if name.endswith("-"):
            prefixes |= dict.fromkeys((each.rstrip("-") for each in (name, *called)), (name.rstrip("-"), float(value)))
            continue
        unit = _defined(name, called[0] if called else name, value)
        units |= dict.fromkeys((name, *called), unit)
        if unit.zero:  # and of the differences of its readings
            differences = (f"delta_{name}", *(f"{delta}{each}" for each in called for delta in ("delta_", "Δ")))
            units |= dict.fromkeys(differences, unit._replace(name=differences[0], zero=0.0))
    return units, prefixes


def _defined(name: str, symbol: str, value: str) -> NamedUnit:
    if value.startswith("["):
        return NamedUnit(name, symbol, dimension=value.partition(";")[0].removeprefix("[]"))
    scale, of, zero = _DEFINITION.fullmatch(value).groups()  # type: ignore[union-attr]
    powers = {part: float(power) for part, power in read_unit(of).items()} if of else {}
    return NamedUnit(name, symbol, float(scale or 1), powers, float(zero or 0))


@cache
def _named_unit(name: str) -> NamedUnit | None:
    """Return the unit of a name, which may have a prefix and the s of a plural; None where there is none."""
    units, prefixes = _table()
    for plural in ("", "s"):
        for prefix, (full, scale) in prefixes.items():
            unit = units.get(name[len(prefix) : len(name) - len(plural)])
            alike = name.startswith(prefix) and name.endswith(plural)
            if not alike or unit is None or (plural and len(name) - len(prefix) == 2):  # ms is no plural of m
                continue
            if not prefix or full + unit.name in units:
                return units[full + unit.name]
            return None if unit.zero else NamedUnit(full + unit.name, name, scale, {unit.name: 1.0})
    return None


def _parts(powers: Powers, times: float = 1.0) -> Iterator[tuple[NamedUnit, float]]:
    """Yield each unit of a product with its exponent, and behind it those that it is made of."""
    for name, power in powers.items():
        unit = _named_unit(name)
        assert unit is not None, "powers are of known units"
        yield unit, times * power
        yield from _parts(unit.of or {}, times * power)


def _in_base(powers: Powers) -> dict[NamedUnit, float]:
    """Return the exponents of the base units, sorted by their names."""
    total: dict[NamedUnit, float] = {}
    for unit, power in _parts(powers):
        if unit.of is None:
            total[unit] = total.get(unit, 0.0) + power
    return {unit: power for unit, power in sorted(total.items()) if power}


def _dimension(powers: Powers) -> dict[str, float]:
    return {unit.dimension: power for unit, power in _in_base(powers).items() if unit.dimension}


def _scale(source: Powers, target: Powers) -> float:
    """Return the factor from one unit to another of its dimension."""
    up: dict[float, float] = {}
    down: dict[float, float] = {}
    ratio = {name: source.get(name, 0.0) - target.get(name, 0.0) for name in (*source, *target)}
    for unit, power in _parts({name: power for name, power in ratio.items() if power}):
        if unit.of is not None:
            side = down if power < 0 else up
            side[unit.scale] = side.get(unit.scale, 0.0) + abs(power)
    factor = 1.0
    for side, other, sign in ((up, down, 1), (down, up, -1)):
        for scale, power in side.items():
            left = power - other.get(scale, 0.0)  # what is above and below cancels, and rounds nothing
            factor *= scale ** (sign * left) if left > 0 else 1.0
    return factor


def _converted(value: float, source: Powers, target: Powers, text: str) -> float:
    """Return a value in another unit of the same dimension; beyond the numbers of a computer it is infinite."""
    if source == target:
        return value
    first, last = _thermometer(source), _thermometer(target)
    if (first and _is_difference(target)) or (last and _is_difference(source)):
        raise UnitError(f"unit '{quote(text)}' is of a difference; name that of a reading, e.g. degC")
    try:
        if first is not None:
            value, source = value * first.scale + first.zero, first.of or {}
        if last is not None:
            return (value * _scale(source, last.of or {}) - last.zero) / last.scale
        return value * _scale(source, target)
    except (OverflowError, ZeroDivisionError):
        return np.inf


def to_si(text: str, unit: str) -> float:
    """Convert a written quantity to `unit`.

    Parameters
    ----------
    text : str
        A number with its unit.
    unit : str
        The unit to convert to, which also says the dimension.

    Raises
    ------
    UnitError
        If the text is not `number unit`, or the unit is unknown or of another dimension.
    """
    number, names = read_quantity(text)
    target = _known(unit)
    if not names and _dimension(target):
        raise UnitError(f"'{quote(text)}' has no unit")
    source = powers_of(names, text)
    if _is_difference(target) and _thermometer(source):
        raise UnitError(f"'{quote(text)}' is a temperature, a difference was expected; write it in K")
    if _dimension(source) != _dimension(target):
        raise UnitError(f"'{quote(text)}' cannot be converted to {plain(unit)}; write a quantity of that dimension")
    return _checked(_converted(number, source, target, text), number, text)


def convert(values: ArrayLike, unit: str, si_unit: str | None = None) -> NDArray[np.float64]:
    """Convert an array from `unit` to `si_unit`, or to the SI unit of the same dimension (degC for temperatures).

    `unit` may carry a factor, as in `0.5 mrad/s`.

    Raises
    ------
    UnitError
        If a unit is unknown or the dimensions differ.
    """
    factor, zero = _affine(unit, si_unit)
    array = np.asarray(values, dtype=np.float64)
    return array if factor == 1 and zero == 0 else array * factor + zero


@lru_cache(maxsize=256)  # a recording is converted block by block
def _affine(unit: str, si_unit: str | None) -> tuple[float, float]:
    """Return factor and offset from `unit` to `si_unit`."""
    number, source = _scaled(unit)
    target = _known(si_unit or si_unit_of(unit))
    if _dimension(source) != _dimension(target):
        raise UnitError(f"unit '{quote(unit)}' cannot be converted to {si_unit}; name a unit of that dimension")
    zero = _converted(0.0, source, target, unit)
    slope = _converted(1.0, source, target, unit) - zero
    return _checked(slope * number, number, unit), zero


def dimension_of(unit: str) -> str:
    """Return the dimension of a unit, as `[angle] / [time]`."""
    return _written(_dimension(_known(unit)), " * ", " / ", " ** ")


def si_unit_of(unit: str) -> str:
    """Return the unit in which a quantity written in `unit` is kept inside the program."""
    return si_unit(_scaled(unit)[1])


def si_unit(powers: Powers) -> str:
    """Return the unit in which a quantity of a unit is kept inside the program."""
    if _dimension(powers) == {"[temperature]": 1}:
        return "degC"
    return _written({unit.name: power for unit, power in _in_base(powers).items()}, "*", "/", "**")


def _written(powers: Powers, times: str, per: str, power: str, one: str = "dimensionless") -> str:
    """Return powers as a product and quotients; `one` where there are none."""
    parts = {name: name + (f"{power}{abs(value):g}" if abs(value) != 1 else "") for name, value in powers.items()}
    up, down = ([parts[name] for name, value in powers.items() if sign * value > 0] for sign in (1, -1))
    return per.join([times.join(up) or "1", *down]) if up or down else one


def unit_of_density(text: str) -> tuple[str, str]:
    """Return the unit of a signal in SI and as it is written, from its white-noise density (`0.06 ppm/sqrt(Hz)`).

    Where the density is not written per sqrt(Hz), the unit as written is that in SI.

    Raises
    ------
    UnitError
        If the text is not a quantity with a unit.
    """
    names = read_quantity(text)[1]
    if not names:
        raise UnitError(f"'{quote(text)}' has no unit")
    powers = {name: float(power) for name, power in names.items()}
    powers["Hz"] = powers.get("Hz", 0.0) + 0.5
    written = _written(powers, "*", "/", "^", one="1")
    known = _known(written)
    simple = {"degC": "K", "dimensionless": "1"}  # of a temperature: of its differences, and their noise
    si = simple.get(si_unit(known)) or next((one for one in PRODUCTS if si_unit_of(one) == si_unit(known)), None)
    si = si or _written(
        {unit.symbol: power for unit, power in _in_base(known).items()}, "*", "/", "^"
    )  # those of a triad: m/s^2
    return si, written if all(power.is_integer() for power in powers.values()) else si


def same_dimension(unit: str, other: str) -> bool:
    """Return True if two units are of one dimension; False where one is not known."""
    try:
        return _dimension(_known(unit)) == _dimension(_known(other))
    except UnitError:
        return False


def _scaled(unit: str) -> tuple[float, Powers]:
    number, names = read_scaled_unit(unit)
    return number, powers_of(names, unit)


@lru_cache(maxsize=256)
def _known(unit: str) -> Powers:
    return _scaled(unit)[1]


def powers_of(names: Mapping[str, Fraction], text: str) -> Powers:
    """Return the powers of a unit that was read; a thermometer's reading is one only where it stands alone.

    Elsewhere it is a difference. Raises UnitError where a name is unknown; `text` is what the unit was read from.
    """
    powers: dict[str, float] = {}
    for written, exponent in names.items():
        plain_name = unicodedata.normalize("NFKC", written)
        unit = None if plain_name == "dimensionless" else _named_unit(plain_name)
        if unit is None and plain_name != "dimensionless":
            part = "" if written == text else f"'{quote(text)}': "
            advice = "write one like deg/s, mrad/s, mg, hPa, degC"
            raise UnitError(f"{part}unknown unit '{quote(written)}'; {advice}")
        if unit is not None:
            name = f"delta_{unit.name}" if unit.zero and (len(names) > 1 or exponent != 1) else unit.name
            powers[name] = powers.get(name, 0.0) + float(exponent)
    return {name: power for name, power in powers.items() if power}


def _thermometer(powers: Powers) -> NamedUnit | None:
    """Return the unit of what a thermometer reads, None where that is not what powers are of."""
    unit = _named_unit(*powers) if len(powers) == 1 else None
    return unit if unit is not None and unit.zero else None


def _is_difference(powers: Powers) -> bool:
    """Return True if a unit is that of the differences of what a thermometer reads."""
    return any(name.startswith("delta_") for name in powers)


def _checked(value: float, number: float, text: str) -> float:
    """Return a value in SI; raises UnitError where it is beyond the numbers of a computer."""
    if not np.isfinite(value) or (number != 0 and value == 0):
        raise UnitError(f"'{quote(text)}' is beyond the numbers of a computer; write a number and a unit of physics")
    return value


def plain(unit: str) -> str:
    """Return a unit as it is written, where a difference of temperatures is in K."""
    return unit.replace("delta_degC", "K")
