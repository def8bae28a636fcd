"""Dimensional values as users write them: `3.18 deg/h/sqrt(Hz)`, `1.5e-4 deg/s`, `40.9 deg`.

The text is read by `fusion_core.units.grammar`, and converted by `fusion_core.units.conversion`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import PydanticCustomError, core_schema

from fusion_core.errors import UnitError, quote
from fusion_core.units.conversion import convert as convert
from fusion_core.units.conversion import dimension_of, of_pint, plain, si_unit
from fusion_core.units.conversion import registry as registry
from fusion_core.units.conversion import same_dimension as same_dimension
from fusion_core.units.conversion import si_unit_of as si_unit_of
from fusion_core.units.conversion import to_si as to_si
from fusion_core.units.conversion import unit_of_density as unit_of_density
from fusion_core.units.grammar import read_quantity

LIMITS = {"s": (1e-9, 1e9), "degC": (0, 1e4), "delta_degC": (1e-9, 1e4), "K": (1e-9, 1e4), "Hz": (1e-9, 1e9)}
"""Sizes that a setting can have by its unit; for all others 1e-30 to 1e30. Squares of these keep their digits."""

_BIAS_UNIT: ContextVar[tuple[str | None, str | None]] = ContextVar("bias_unit", default=(None, None))  # and in messages
_AXES: ContextVar[tuple[str, ...]] = ContextVar("axes", default=("x", "y", "z"))


@contextmanager
def bias_unit(unit: str | None, shown: str | None = None) -> Iterator[None]:
    """Within the block, `bias` in the unit of a field means `unit` (a gyro's is rad/s, an accelerometer's m/s^2).

    In the examples of messages it means `shown`, where that is given: a unit of the same dimension (`ppm`).
    """
    token = _BIAS_UNIT.set((unit, shown))
    try:
        yield
    finally:
        _BIAS_UNIT.reset(token)


@contextmanager
def section_axes(names: tuple[str, ...]) -> Iterator[None]:
    """Within the block, axes that are not written are called so."""
    token = _AXES.set(names)
    try:
        yield
    finally:
        _AXES.reset(token)


def usual_axes() -> tuple[str, ...]:
    """Return the axes of a section that names none."""
    return _AXES.get()


class Quantity(float):
    """A float in SI that remembers how it was written, so that a config can be written back unchanged.

    Its unit is empty where it was given as a bare number in SI and nothing says of what the bias is.
    """

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

    A config must have the unit. In Python a bare number is taken as SI: `RandomWalk(walk=2e-6)`.
    """

    def __init__(
        self, unit: str, *, positive: bool = False, least: float | None = None, example: str | None = None
    ) -> None:
        self.unit, self.positive, self.least = unit, positive, least
        self.example = example or f"0.1 {plain(unit.replace('bias', 'deg/s'))}"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        read = self._read if source is float else self.read
        write = core_schema.plain_serializer_function_ser_schema(self.write, when_used="unless-none")
        self._one_an_axis = source is not float
        return core_schema.with_info_plain_validator_function(read, serialization=write)

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        unit = plain(self.unit)
        dimension = "" if "bias" in unit else dimension_of(unit)
        one = {"type": "string", "description": f"a quantity in {unit}", "examples": [self.example], "x-unit": unit}
        one |= {"x-dimension": dimension} if dimension else {}
        return {"anyOf": [one, {"type": "array", "items": one}]} if self._one_an_axis else one

    def read(self, value: Any, info: ValidationInfo) -> Quantity | tuple[Quantity, ...]:
        """Return one quantity or several; raises a validation error that says what to write."""
        if isinstance(value, list | tuple):
            return tuple(self._read(item, info) for item in value)
        return self._read(value, info)

    def _read(self, value: Any, info: ValidationInfo) -> Quantity:
        if isinstance(value, Quantity):
            return value if value.unit != "" else self._of_number(float(value))
        if isinstance(value, int | float) and not isinstance(value, bool) and "folder" not in (info.context or {}):
            return self._of_number(float(value))
        if not isinstance(value, str):
            raise problem(f"{quote(repr(value))} has no unit; write e.g. '{self._with_unit(value)}'")
        try:
            unit = self._of_bias(value)
            number = to_si(value, unit)
        except UnitError as error:
            example = self._fitting_example()
            raise problem(f"{error} (here e.g. '{example}')" if example else str(error)) from None
        return Quantity(self._checked(number, unit, f"'{quote(value)}'"), " ".join(value.split()), unit)

    def _of_number(self, number: float) -> Quantity:
        """Return a number in SI; where nothing says what the unit of the bias is, it has no unit either."""
        known = "bias" not in self.unit or _BIAS_UNIT.get()[0] is not None
        unit = self._of_bias("") if known else ""
        text = f"{number!r} {plain(unit)}".rstrip()
        if not np.isfinite(number):
            raise problem(f"{text} is not a finite number; write one")
        return Quantity(self._checked(number, unit or self.unit, text), text, unit)

    def _checked(self, number: float, unit: str, text: str) -> float:
        """Return the number; raises where it is not of a sign and size that the field can have."""
        if self.positive and number <= 0:
            raise problem(f"{text} must be greater than zero")
        if self.least is not None and number < self.least:
            raise problem(f"{text} must be at least {self.least:g} {plain(unit)}")
        low, high = LIMITS.get(unit, (1e-30, 1e30))
        if number and not low <= abs(number) <= high:
            raise problem(f"{text} is not a size that can be meant, {low:g} to {high:g} {plain(unit)} can; correct it")
        return number

    def _of_bias(self, text: str) -> str:
        """Return the unit of the field; where nothing says of what the bias is, it is that of the text."""
        bias, _ = _BIAS_UNIT.get()
        if "bias" not in self.unit:
            return self.unit
        if bias is None:
            return si_unit(of_pint(read_quantity(text)[1], text))
        # at its front, and without a power, the unit of the bias reads as well without parentheses
        return self.unit.replace("bias", bias if re.match(r"bias(?![\w^*])", self.unit) else f"({bias})")

    def _fitting_example(self) -> str:
        """Return an example in the unit of the bias; none where it is not known how that is written."""
        bias, written = _BIAS_UNIT.get()
        if "bias" not in self.unit or bias in (None, "rad/s"):  # that of which the example speaks
            return self.example
        return f"0.1 {plain(self.unit.replace('bias', written))}" if written else ""

    def _with_unit(self, value: Any) -> str:
        example = self._fitting_example() or self.example
        return f"{value} {example.partition(' ')[2]}" if type(value) in {int, float} else example

    def write(self, value: float | tuple[float, ...]) -> str | float | list[str | float]:
        """Return one quantity or several as a config has them."""
        return [self._written(item) for item in value] if isinstance(value, tuple) else self._written(value)

    def _written(self, value: float) -> str | float:
        if isinstance(value, Quantity):
            return value.text if value.unit != "" else float(value)
        return float(value) if "bias" in self.unit else f"{float(value)!r} {plain(self.unit)}"


def problem(text: str) -> PydanticCustomError:
    """Return the error for a value of a config, or for values that do not fit together, to be raised by a validator."""
    return PydanticCustomError("config", "{text}", {"text": text})


def check_axes(name: str, value: float | tuple[float, ...], d: int) -> None:
    """Raise the validation error of a field that has neither one value nor one an axis."""
    if isinstance(value, tuple) and len(value) != d:
        raise problem(f"{name} has {len(value)} values for {d} axes; write one for all, or one an axis")


def axis_names(axes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of axes; raises the validation error of those that are none, or not each once."""
    for axis in axes:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9]{0,15}", axis):
            raise problem(f"'{quote(axis)}' is no name of an axis; write up to 16 letters and digits, a letter first")
    if len(set(axes)) < len(axes):
        raise problem(f"names {', '.join(axes[:6])}, each one once was expected; remove the repeated")
    return axes


Axes = Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(axis_names)]
"""The axes of a block, each once: x, y and z of a triad, or any other names."""


def check_triad(axes: tuple[str, ...]) -> None:
    """Raise the validation error of a triad whose axes are not among x, y and z."""
    other = [axis for axis in axes if axis not in ("x", "y", "z")]
    if other:
        raise problem(f"bias.axes has '{other[0]}', a triad has x, y and z; name those that there are")


def along_axes(value: float | tuple[float, ...], d: int) -> NDArray[np.float64]:
    """Return (d,) from one value for all axes, or one an axis."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (d,))


def unsettled(model: BaseModel) -> bool:
    """Return True if a field was given as a bare number, and the unit of the bias is not known yet."""
    values = (item for _, value in model for item in (value if isinstance(value, tuple) else (value,)))
    return any(isinstance(item, Quantity) and item.unit == "" for item in values)
