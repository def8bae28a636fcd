"""Dimensional values as users write them: `3.18 deg/h/sqrt(Hz)`, `1.5e-4 deg/s`, `40.9 deg`.

The text is read by `fusion_core.grammar`; what a unit means is pint's, with the definitions of `units.txt`, where an
angle is a dimension of its own (so 5 Hz is not 5 rad/s) and `g` is standard gravity and not a gram.
Inside the program everything is SI, except that temperatures are in degC.
"""

from __future__ import annotations

import re
import unicodedata
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError, PydanticKnownError, core_schema

from fusion_core.errors import UnitError, shown
from fusion_core.grammar import read_quantity, read_scaled_unit

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from fractions import Fraction

    import pint
    from numpy.typing import ArrayLike, NDArray
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler

_THERMOMETERS = frozenset({"degree_Celsius", "degree_Fahrenheit"})  # they count from another zero
PRODUCTS = ("V", "ohm", "Pa", "T", "W", "N", "J", "F", "H", "Wb")  # SI units that are products of others
LONGEST_NAME = 60  # of an axis
LIMITS = {"s": (1e-9, 1e9), "degC": (0, 1e4), "delta_degC": (1e-9, 1e4), "K": (1e-9, 1e4), "Hz": (1e-9, 1e9)}
"""Sizes that a setting can have by its unit; for all others 1e-30 to 1e30. Squares of these keep their digits."""

_BIAS_UNIT: ContextVar[str | None] = ContextVar("bias_unit", default=None)
_AXES: ContextVar[tuple[tuple[str, ...], bool]] = ContextVar("axes", default=(("x", "y", "z"), False))


@contextmanager
def bias_unit(unit: str | None) -> Iterator[None]:
    """Within the block, `bias` in the unit of a field means `unit` (a gyro's is rad/s, an accelerometer's m/s^2)."""
    token = _BIAS_UNIT.set(unit)
    try:
        yield
    finally:
        _BIAS_UNIT.reset(token)


@contextmanager
def section_axes(names: tuple[str, ...], *, only: bool = False) -> Iterator[None]:
    """Within the block, axes that are not written are `names`; with `only`, no other axes can be written."""
    token = _AXES.set((names, only))
    try:
        yield
    finally:
        _AXES.reset(token)


def usual_axes() -> tuple[str, ...]:
    """Return the axes of a section that names none."""
    return _AXES.get()[0]


@cache
def registry() -> pint.UnitRegistry[float]:
    """Return the unit registry of the program: pint, with the definitions of `units.txt`."""
    import pint

    definitions = str(files("fusion_core").joinpath("units.txt"))
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
    target = _known(unit)
    if not names and not target.dimensionless:
        raise UnitError(f"'{shown(text)}' has no unit")
    found = _of_pint(names, text)
    if str(target).startswith("delta_") and _is_reading(found):
        raise UnitError(f"'{shown(text)}' is a temperature, a difference was expected; write it in K")
    if found.dimensionality != target.dimensionality:
        plain = unit.replace("delta_degC", "K")
        raise UnitError(f"'{shown(text)}' cannot be converted to {plain}; write a quantity of that dimension")
    try:
        value = float(registry().Quantity(number, found).to(target).magnitude)
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
    number, found = _scaled(unit)
    target = _known(si_unit or si_unit_of(unit))
    if found.dimensionality != target.dimensionality:
        raise UnitError(f"unit '{shown(unit)}' cannot be converted to {si_unit}; name a unit of that dimension")
    try:
        zero = float(registry().Quantity(0.0, found).to(target).magnitude)
        slope = float(registry().Quantity(1.0, found).to(target).magnitude) - zero
    except (OverflowError, ZeroDivisionError):
        slope, zero = np.inf, 0.0
    except TypeError:  # pint's, for a difference of temperatures where a reading is meant
        raise UnitError(f"unit '{shown(unit)}' is of a difference; name that of a reading, e.g. degC") from None
    return _checked(slope * number, number, unit), zero


def same_dimension(unit: str, other: str) -> bool:
    """Return whether two units are of one dimension; False where one is not known."""
    try:
        return _known(unit).dimensionality == _known(other).dimensionality
    except UnitError:
        return False


def unit_of_density(text: str) -> tuple[str, str]:
    """Return the unit of a signal in SI and as it is written, from its white-noise density (`0.06 ppm/sqrt(Hz)`).

    Where the density is not written per sqrt(Hz), the unit as written is that in SI.

    Raises
    ------
    UnitError
        If the text is not a quantity.
    """
    powers = {name: float(power) for name, power in read_quantity(text)[1].items()}
    powers["Hz"] = powers.get("Hz", 0.0) + 0.5
    up, down = (
        "*".join(name if power == s else f"{name}^{abs(power):g}" for name, power in powers.items() if s * power > 0)
        for s in (1, -1)
    )
    written = (up or "1") + (f"/{down.replace('*', '/')}" if down else "")
    si = _derived(si_unit_of(written))
    return si, written if all(power.is_integer() for power in powers.values()) else si


def _derived(unit: str) -> str:
    """Return an SI unit by its name where it has one (V, and not kilogram*meter**2/ampere/second**3)."""
    plain = {"degC": "K", "dimensionless": "1"}  # of a temperature: of its differences, and their noise
    return plain.get(unit) or next((name for name in PRODUCTS if si_unit_of(name) == unit), unit)


def si_unit_of(unit: str) -> str:
    """Return the unit in which a quantity written in `unit` is kept inside the program."""
    return _si_unit(_scaled(unit)[1])


def _si_unit(found: pint.Unit) -> str:
    if dict(found.dimensionality) == {"[temperature]": 1}:
        return "degC"
    return f"{registry().get_base_units(found)[1]:C}" or "1"


def _scaled(unit: str) -> tuple[float, pint.Unit]:
    number, names = read_scaled_unit(unit)
    return number, _of_pint(names, unit)


def _known(unit: str) -> pint.Unit:
    return _scaled(unit)[1]


def _of_pint(names: Mapping[str, Fraction], text: str) -> pint.Unit:
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
    """Return what pint calls a unit; nothing but a single name is ever given to it."""
    import pint

    try:
        return str(registry().get_name(unicodedata.normalize("NFKC", name)))
    except (pint.UndefinedUnitError, pint.OffsetUnitCalculusError):  # of the latter, the milli-degC
        part = "" if name == text else f"'{shown(text)}': "
        raise UnitError(f"{part}unknown unit '{shown(name)}'; write one like deg/s, mrad/s, mg, hPa, degC") from None


def _is_reading(unit: pint.Unit) -> bool:
    return str(unit) in _THERMOMETERS


def _checked(value: float, number: float, text: str) -> float:
    """Return a value in SI; raises UnitError where it is beyond the numbers of a computer."""
    if not np.isfinite(value) or (number != 0 and value == 0):
        raise UnitError(f"'{shown(text)}' is beyond the numbers of a computer; write a number and a unit of physics")
    return value


class Quantity(float):
    """A float in SI that remembers how it was written, so that a config can be written back unchanged."""

    text: str
    unit: str | None

    def __new__(cls, value: float, text: str, unit: str | None = None) -> Quantity:
        """Make the float `value`, written as `text`; `unit` is what the value is in, where it is known."""
        self = super().__new__(cls, value)
        self.text, self.unit = text, unit
        return self

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        write = core_schema.plain_serializer_function_ser_schema(lambda value: value.text)
        return core_schema.is_instance_schema(cls, serialization=write)

    def __getnewargs__(self) -> tuple[float, str, str | None]:  # type: ignore[override]
        return float(self), self.text, self.unit


class Unit:
    """Annotation of a float field: the user writes a quantity with its unit, the program gets SI.

    `Annotated[float, Unit("rad/s")]`, or `Annotated[float | tuple[float, ...], Unit("rad/s")]` where one value an
    axis may be written instead. In the unit, `bias` stands for the unit of the bias that the plugin models,
    which the section of the config decides: `Unit("bias/sqrt(s)")` is rad/s/sqrt(s) under a gyro.
    """

    def __init__(
        self, unit: str, *, positive: bool = False, least: float | None = None, example: str | None = None
    ) -> None:
        self.unit, self.positive, self.least = unit, positive, least
        self.example = example or f"0.1 {unit.replace('bias', 'deg/s')}"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        read = self._read if source is float else self.read
        write = core_schema.plain_serializer_function_ser_schema(self._write, when_used="unless-none")
        self._one_an_axis = source is not float
        return core_schema.no_info_plain_validator_function(read, serialization=write)

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        one = {"type": "string", "description": f"a quantity in {self.unit}", "examples": [self.example]}
        return {"anyOf": [one, {"type": "array", "items": one}]} if self._one_an_axis else one

    def read(self, value: Any) -> Quantity | tuple[Quantity, ...]:
        """Return one quantity or several in SI; raises a validation error that says what to write."""
        return tuple(self._read(item) for item in value) if isinstance(value, list | tuple) else self._read(value)

    def _read(self, value: Any) -> Quantity:
        if isinstance(value, Quantity):
            return value
        if not isinstance(value, str):
            raise _problem(f"{shown(repr(value))} has no unit; write e.g. '{self._with_unit(value)}'")
        try:
            unit = self._of_bias(value)
            number = to_si(value, unit)
        except UnitError as error:
            raise _problem(f"{error} (here e.g. '{self.example}')") from None
        text = f"'{shown(value)}'"
        if self.positive and number <= 0:
            raise _problem(f"{text} must be greater than zero")
        if self.least is not None and number < self.least:
            raise _problem(f"{text} must be at least {self.least:g} {unit}")
        low, high = LIMITS.get(unit, (1e-30, 1e30))
        if number and not low <= abs(number) <= high:
            plain = unit.replace("delta_degC", "K")
            raise _problem(f"{text} is not a size that can be meant, {low:g} to {high:g} {plain} can; correct it")
        return Quantity(number, " ".join(value.split()), unit)

    def _of_bias(self, text: str) -> str:
        """Return the unit of the field; where nothing says of what the bias is, it is that of the text."""
        bias = _BIAS_UNIT.get()
        if "bias" not in self.unit:
            return self.unit
        if bias is None:
            return _si_unit(_of_pint(read_quantity(text)[1], text))
        # at its front, and without a power, the unit of the bias reads as well without parentheses
        return self.unit.replace("bias", bias if re.match(r"bias(?![\w^*])", self.unit) else f"({bias})")

    def _with_unit(self, value: Any) -> str:
        return f"{value} {self.example.partition(' ')[2]}" if type(value) in {int, float} else self.example

    def _write(self, value: float | tuple[float, ...]) -> str | list[str]:
        if isinstance(value, tuple):
            return [value.text if isinstance(value, Quantity) else f"{float(value)!r} {self.unit}" for value in value]
        return value.text if isinstance(value, Quantity) else f"{float(value)!r} {self.unit}"


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("unit", "{text}", {"text": text})


def check_axes(name: str, value: float | tuple[float, ...], d: int) -> None:
    """Raise the validation error of a field that has neither one value nor one an axis."""
    if isinstance(value, tuple) and len(value) != d:
        raise _problem(f"{name} has {len(value)} values for {d} axes; write one for all, or one an axis")


def _distinct(axes: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(axes)) < len(axes):
        raise _problem(f"names {', '.join(axes[:6])}, each one once was expected; remove the repeated")
    return axes


def _axis(value: Any) -> str:
    names, only = _AXES.get()
    if only and value not in names:
        expected = f"{', '.join(repr(name) for name in names[:-1])} or {names[-1]!r}"
        raise PydanticKnownError("literal_error", {"expected": expected})
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= LONGEST_NAME:
        raise _problem(f"{shown(repr(value))} is not the name of an axis; write a short text")
    return value


Axes = Annotated[tuple[Annotated[str, BeforeValidator(_axis)], ...], Field(min_length=1), AfterValidator(_distinct)]
"""The axes of a block, each once."""


def along_axes(value: float | tuple[float, ...], d: int) -> NDArray[np.float64]:
    """Return (d,) from one value for all axes, or one an axis."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (d,))
