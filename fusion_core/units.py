"""Dimensional values as users write them: `3.18 deg/h/sqrt(Hz)`, `1.5e-4 deg/s`, `40.9 deg`.

Parsing is pint's; the units are those of `units.txt`, where an angle is a dimension of its own (so 5 Hz is not
5 rad/s) and `g` is standard gravity and not a gram. `sqrt(Hz)` may be written.
Inside the program everything is SI, except that temperatures are in degC.
"""

from __future__ import annotations

import re
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import PydanticCustomError, core_schema

from fusion_core.errors import UnitError

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pint
    from numpy.typing import ArrayLike, NDArray
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler

_THERMOMETER = r"(?<![A-Za-z_])(?:°|deg|degree)([CF])\b"  # a temperature that counts from another zero
_BIAS_UNIT: ContextVar[str | None] = ContextVar("bias_unit", default=None)


@contextmanager
def bias_unit(unit: str | None) -> Iterator[None]:
    """Within the block, `bias` in the unit of a field means `unit` (a gyro's is rad/s, an accelerometer's m/s^2)."""
    token = _BIAS_UNIT.set(unit)
    try:
        yield
    finally:
        _BIAS_UNIT.reset(token)


@cache
def registry() -> pint.UnitRegistry[float]:
    """Return the unit registry of the program: pint, with the definitions of `units.txt`."""
    import pint

    definitions = str(files("fusion_core").joinpath("units.txt"))
    return pint.UnitRegistry(definitions, autoconvert_offset_to_baseunit=True)


def _parse(text: str) -> pint.Quantity[float]:
    import pint

    plain = re.sub(r"(?:sqrt|√)\(([^()]*)\)", r"(\1)**0.5", text).replace("√Hz", "Hz**0.5")
    plain = re.sub(r"\b([A-Za-zµμ]+)(-?\d+)\b", r"\1**\2", plain)  # m/s2, rad s-1
    if not re.fullmatch(rf"[\d.eE+\- ]*{_THERMOMETER}\s*", plain):
        plain = re.sub(_THERMOMETER, r"delta_deg\1", plain)  # of a rate or a slope, not a reading
    try:
        quantity: pint.Quantity[float] = registry().Quantity(plain)
    except pint.UndefinedUnitError as error:
        names: object = error.unit_names
        name = names if isinstance(names, str) else ", ".join(error.unit_names)
        raise UnitError(f"'{text}': unknown unit '{name}'; write one like deg/s, mrad/s, mg, hPa, degC") from None
    except Exception:  # pint raises whatever its tokenizer raised
        raise UnitError(f"'{text}' is not a quantity; write a number and a unit, e.g. '0.1 s'") from None
    if not np.isfinite(quantity.magnitude):
        raise UnitError(f"'{text}' is not a finite number; write a number and a unit, e.g. '0.1 s'")
    return quantity


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
        If the text has no unit, an unknown one, or one of another dimension.
    """
    import pint

    quantity = _parse(text)
    target = _parse(f"1 {unit}")
    if quantity.unitless and not target.unitless:
        raise UnitError(f"'{text}' has no unit")
    try:
        return float(quantity.to(target.units).magnitude)
    except pint.DimensionalityError:
        plain = unit.replace("delta_degC", "K")
        raise UnitError(f"'{text}' cannot be converted to {plain}; write a quantity of that dimension") from None


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
    import pint

    one = _parse(unit if re.match(r"\s*[\d.+-]", unit) else f"1 {unit}")
    target = _parse(f"1 {si_unit or si_unit_of(unit)}").units
    try:
        zero = registry().Quantity(0.0, one.units).to(target).magnitude
        slope = registry().Quantity(1.0, one.units).to(target).magnitude - zero
    except pint.DimensionalityError:
        raise UnitError(f"unit '{unit}' cannot be converted to {si_unit}; name a unit of that dimension") from None
    return slope * one.magnitude, zero


def si_unit_of(unit: str) -> str:
    """Return the unit in which a quantity written in `unit` is kept inside the program."""
    quantity = _parse(unit if re.match(r"\s*[\d.+-]", unit) else f"1 {unit}")
    if dict(quantity.dimensionality) == {"[temperature]": 1}:
        return "degC"
    return f"{registry().get_base_units(quantity.units)[1]:C}" or "1"


class Quantity(float):
    """A float in SI that remembers how it was written, so that a config can be written back unchanged."""

    text: str

    def __new__(cls, value: float, text: str) -> Quantity:
        """Make the float `value`, written as `text`."""
        self = super().__new__(cls, value)
        self.text = text
        return self

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        write = core_schema.plain_serializer_function_ser_schema(lambda value: value.text)
        return core_schema.is_instance_schema(cls, serialization=write)

    def __getnewargs__(self) -> tuple[float, str]:  # type: ignore[override]
        return float(self), self.text


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
        read = self._read if source is float else self._read_axes
        write = core_schema.plain_serializer_function_ser_schema(self._write, when_used="unless-none")
        self._one_an_axis = source is not float
        return core_schema.no_info_plain_validator_function(read, serialization=write)

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        one = {"type": "string", "description": f"a quantity in {self.unit}", "examples": [self.example]}
        return {"anyOf": [one, {"type": "array", "items": one}]} if self._one_an_axis else one

    def _read_axes(self, value: Any) -> Quantity | tuple[Quantity, ...]:
        return tuple(self._read(item) for item in value) if isinstance(value, list | tuple) else self._read(value)

    def _read(self, value: Any) -> Quantity:
        if isinstance(value, Quantity):
            return value
        if not isinstance(value, str):
            raise _problem(f"{value!r} has no unit; write e.g. '{self._with_unit(value)}'")
        unit = self.unit
        if "bias" in unit:
            bias = _BIAS_UNIT.get()
            unit = unit.replace("bias", f"({bias})") if bias else si_unit_of(value)
        try:
            number = to_si(value, unit)
        except UnitError as error:
            raise _problem(f"{error} (here e.g. '{self.example}')") from None
        if self.positive and number <= 0:
            raise _problem(f"'{value}' must be greater than zero")
        if self.least is not None and number < self.least:
            raise _problem(f"'{value}' must be at least {self.least:g} {unit}")
        return Quantity(number, value)

    def _with_unit(self, value: Any) -> str:
        return f"{value} {self.example.partition(' ')[2]}" if isinstance(value, int | float) else self.example

    def _write(self, value: float | tuple[float, ...]) -> str | list[str]:
        if isinstance(value, tuple):
            return [value.text if isinstance(value, Quantity) else f"{value!r} {self.unit}" for value in value]
        return value.text if isinstance(value, Quantity) else f"{value!r} {self.unit}"


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("unit", "{text}", {"text": text})


def check_axes(name: str, value: float | tuple[float, ...], d: int) -> None:
    """Raise the validation error of a field that has neither one value nor one an axis."""
    if isinstance(value, tuple) and len(value) != d:
        raise _problem(f"{name} has {len(value)} values for {d} axes; write one for all, or one an axis")


def along_axes(value: float | tuple[float, ...], d: int) -> NDArray[np.float64]:
    """Return (d,) from one value for all axes, or one an axis."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (d,))
