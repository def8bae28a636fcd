"""Conversion of units by pint, with the definitions of `units.txt`; `ordinary.txt` has what it says of ordinary ones.

An angle is a dimension of its own (so 5 Hz is not 5 rad/s), `g` is standard gravity and not a gram. Inside the program
everything is SI, except that temperatures are in degC.
"""

from __future__ import annotations

import sys
import unicodedata
from collections.abc import Mapping
from fractions import Fraction
from functools import cache, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_core.errors import UnitError, quote
from fusion_core.units.grammar import read_quantity, read_scaled_unit

if TYPE_CHECKING:
    import pint

PRODUCTS = ("V", "ohm", "Pa", "T", "W", "N", "J", "F", "H", "Wb")  # SI units that are products of others
_THERMOMETERS = frozenset({"degree_Celsius", "degree_Fahrenheit"})  # they count from another zero


@cache
def registry() -> pint.UnitRegistry[float]:
    """Return the unit registry of the program: pint, with the definitions of `units.txt`."""
    hidden = sys.modules.setdefault("dask", None) is None  # type: ignore[arg-type]
    import pint  # which else imports dask, to know its arrays: that takes longer than all of pint

    if hidden:
        del sys.modules["dask"]
    definitions = str(files(__package__).joinpath("units.txt"))
    return pint.UnitRegistry(definitions, autoconvert_offset_to_baseunit=True)


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
    if (factor := _ordinary(names)[1].get(unit)) is not None:
        return _checked(number * factor, number, text)
    target = _known(unit)
    if not names and not target.dimensionless:
        raise UnitError(f"'{quote(text)}' has no unit")
    source = of_pint(names, text)
    if str(target).startswith("delta_") and str(source) in _THERMOMETERS:
        raise UnitError(f"'{quote(text)}' is a temperature, a difference was expected; write it in K")
    if source.dimensionality != target.dimensionality:
        raise UnitError(f"'{quote(text)}' cannot be converted to {plain(unit)}; write a quantity of that dimension")
    try:
        value = float(registry().Quantity(number, source).to(target).magnitude)
    except (OverflowError, ZeroDivisionError):
        value = np.inf
    return _checked(value, number, text)


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
    number, names = read_scaled_unit(unit)
    if (factor := _ordinary(names)[1].get(si_unit or "")) is not None:
        return _checked(factor * number, number, unit), 0.0
    source, target = of_pint(names, unit), _known(si_unit or si_unit_of(unit))
    if source.dimensionality != target.dimensionality:
        raise UnitError(f"unit '{quote(unit)}' cannot be converted to {si_unit}; name a unit of that dimension")
    try:
        zero = float(registry().Quantity(0.0, source).to(target).magnitude)
        slope = float(registry().Quantity(1.0, source).to(target).magnitude) - zero
    except (OverflowError, ZeroDivisionError):
        slope, zero = np.inf, 0.0
    except TypeError:  # pint's, for a difference of temperatures where a reading is meant
        raise UnitError(f"unit '{quote(unit)}' is of a difference; name that of a reading, e.g. degC") from None
    return _checked(slope * number, number, unit), zero


def dimension_of(unit: str) -> str:
    """Return the dimension of a unit, as `[angle] / [time]`."""
    return str(_known(unit).dimensionality)


def si_unit_of(unit: str) -> str:
    """Return the unit in which a quantity written in `unit` is kept inside the program."""
    names = read_scaled_unit(unit)[1]
    return _ordinary(names)[0] or si_unit(of_pint(names, unit))


def si_unit(unit: pint.Unit) -> str:
    """Return the unit in which a quantity of pint's unit is kept inside the program."""
    if dict(unit.dimensionality) == {"[temperature]": 1}:
        return "degC"
    return f"{registry().get_base_units(unit)[1]:C}" or "1"


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
    up, down = (
        [name if power == s else f"{name}^{abs(power):g}" for name, power in powers.items() if s * power > 0]
        for s in (1, -1)
    )
    written = "/".join(["*".join(up) or "1", *down])
    si = _named(si_unit_of(written))
    return si, written if all(power.is_integer() for power in powers.values()) else si


def _named(unit: str) -> str:
    """Return an SI unit by its symbols: one where it has one (V), or those that a map of a triad has too (m/s^2)."""
    simple = {"degC": "K", "dimensionless": "1"}  # of a temperature: of its differences, and their noise
    return simple.get(unit) or next(
        (n for n in PRODUCTS if si_unit_of(n) == unit), f"{registry().Unit(unit):~C}".replace("**", "^")
    )


def same_dimension(unit: str, other: str) -> bool:
    """Return True if two units are of one dimension; False where one is not known."""
    try:
        return _known(unit).dimensionality == _known(other).dimensionality
    except UnitError:
        return False


@cache
def ordinary_units() -> dict[str, tuple[str, dict[str, float]]]:
    """Return the units of `ordinary.txt`: by each the unit in SI, and pint's factors by what it is converted to."""
    known: dict[str, tuple[str, dict[str, float]]] = {}
    for row in files(__package__).joinpath("ordinary.txt").read_text(encoding="utf-8").splitlines()[2:]:
        unit, target, factor, si = map(str.strip, row.split("|"))
        known.setdefault(unit, (si, {}))[1][target] = float(factor)
    return known


def _ordinary(names: Mapping[str, Fraction]) -> tuple[str, dict[str, float]]:
    key = " ".join(name if power == 1 else f"{name}^{power}" for name, power in names.items())
    return ordinary_units().get(key, ("", {}))


def _known(unit: str) -> pint.Unit:
    return of_pint(read_scaled_unit(unit)[1], unit)


def of_pint(names: Mapping[str, Fraction], text: str) -> pint.Unit:
    """Return pint's unit; a thermometer's reading is one only where it stands alone, elsewhere it is a difference."""
    known = [(_canonical(name, text), exponent) for name, exponent in names.items()]
    alone = len(known) == 1 and known[0][1] == 1
    powers: dict[str, float] = {}
    for name, exponent in known:
        plain = name if alone or name not in _THERMOMETERS else f"delta_{name}"
        powers[plain] = powers.get(plain, 0.0) + float(exponent)
    powers.pop("", None)  # dimensionless
    container = registry().UnitsContainer({name: power for name, power in powers.items() if power})
    return registry().Unit(container)


def _canonical(name: str, text: str) -> str:
    """Return pint's name of a unit; nothing but a single name is ever given to pint."""
    known = registry()
    import pint

    try:
        return str(known.get_name(unicodedata.normalize("NFKC", name)))
    except (pint.UndefinedUnitError, pint.OffsetUnitCalculusError):  # of the latter, the milli-degC
        part = "" if name == text else f"'{quote(text)}': "
        raise UnitError(f"{part}unknown unit '{quote(name)}'; write one like deg/s, mrad/s, mg, hPa, degC") from None


def _checked(value: float, number: float, text: str) -> float:
    """Return a value in SI; raises UnitError where it is beyond the numbers of a computer."""
    if not np.isfinite(value) or (number != 0 and value == 0):
        raise UnitError(f"'{quote(text)}' is beyond the numbers of a computer; write a number and a unit of physics")
    return value


def plain(unit: str) -> str:
    """Return a unit as it is written, where a difference of temperatures is in K."""
    return unit.replace("delta_degC", "K")
