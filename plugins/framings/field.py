"""Units of what a device sends, and the counter in its frames."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic_core import PydanticCustomError

from fusion_core.chunk import Array
from fusion_core.contracts import USUAL
from fusion_core.contracts.framing import Counter
from fusion_core.errors import UnitError, quote
from fusion_core.settings import Settings
from fusion_core.units import Unit, convert, si_unit_of

VALID = "valid"  # zero where the device says that a sample must not be used


class DeviceCounter(Settings):
    """The number in each frame by which the device counts: frames, or with `tick` its own time."""

    field: str
    """Name of the field or column that counts."""
    modulo: Annotated[int, Field(gt=1, le=1 << 64)]
    """The count is zero again after its last value; 256 for one byte."""
    tick: Annotated[float, Unit("s", positive=True, example="1 us")] | None = None
    """Duration of one count."""

    def as_counter(self) -> Counter:
        """Return the counter in the core's terms."""
        return Counter(min(self.modulo, (1 << 63) - 1), self.tick)  # no device counts as far as 64 bits


def check_unit(name: str, unit: str | None) -> None:
    """Raise the validation error of a channel whose unit is missing, unknown, or of another dimension."""
    usual = USUAL.get(name)
    si, example = (usual.si if usual else None), (usual and usual.example) or "0.1 V"
    if unit is None:
        if usual and usual.example:
            raise problem(f"channel {name} has no unit; write unit: {example}")
        return
    try:
        convert(0.0, unit, si)
    except UnitError:
        what = f"cannot be converted to {si}" if si and _is_unit(unit) else "is not known"
        raise problem(f"channel {name}: unit '{quote(unit)}' {what}; write it like '{example}'") from None


def _is_unit(unit: str) -> bool:
    try:
        return bool(si_unit_of(unit))
    except UnitError:
        return False


def factors(name: str, unit: str | None) -> tuple[float, float]:
    """Return the value of 0 `unit` in SI, and of 1 `unit` more."""
    if unit is None:
        return 0.0, 1.0
    zero, one = convert(np.array([0.0, 1.0]), unit, USUAL[name].si if name in USUAL else None)
    return float(zero), float(one - zero)


def in_si(values: Array, factor: tuple[float, float]) -> Array:
    """Return values in SI by their `factors`."""
    zero, slope = factor
    return values if slope == 1 and zero == 0 else values * slope + zero


def check_axes(name: str, d: int) -> None:
    """Raise the validation error of a channel with more axes than there are."""
    usual = USUAL.get(name)
    if usual and usual.axes and d > usual.axes:
        raise problem(f"channel {name} has {d} axes, at most {usual.axes} were expected; leave the others out")


def shaped(name: str, columns: Array) -> Array:
    """Return (N, d) columns as the channel has them: a triad keeps its axis, a scalar is (N,)."""
    triad = name in USUAL and USUAL[name].axes == 3
    return columns if triad or columns.shape[1] > 1 else np.ascontiguousarray(columns[:, 0])


def problem(text: str) -> PydanticCustomError:
    """Return a validation error."""
    return PydanticCustomError("framing", "{text}", {"text": text})
