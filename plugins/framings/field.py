"""Units of what a device sends, and the counter in its frames."""

from __future__ import annotations

from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fusion_core.chunk import Array
from fusion_core.contracts import USUAL, Channel, Counter
from fusion_core.errors import UnitError
from fusion_core.settings import Settings
from fusion_core.units import Unit, convert, problem

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


def check_channel(name: str, unit: str | None, d: int) -> None:
    """Raise the validation error of a channel of `d` axes whose unit is missing or wrong, or that has too many axes."""
    usual = USUAL.get(name)
    if unit is None and usual and usual.example:
        raise problem(f"channel {name} has no unit; write unit: {usual.example}")
    try:
        Channel(path="field", unit=unit).check(name)
    except UnitError as error:
        raise problem(str(error)) from None
    if usual and usual.axes and d > usual.axes:
        raise problem(f"channel {name} has {d} axes, at most {usual.axes} were expected; leave the others out")


def channel(name: str, columns: Array, unit: str | None = None) -> Array:
    """Return (N, d) columns in SI as the channel has them: a triad keeps its axis, a scalar is (N,)."""
    zero, slope = _factors(name, unit)
    values = columns if slope == 1 and zero == 0 else columns * slope + zero
    triad = name in USUAL and USUAL[name].axes == 3
    return values if triad or values.shape[1] > 1 else np.ascontiguousarray(values[:, 0])


def sent(name: str, values: Array, unit: str | None = None) -> Array:
    """Return a channel in SI, (N,) or (N, d), as the (N, d) columns that `channel` makes it of."""
    zero, slope = _factors(name, unit)
    return (values.reshape(len(values), -1) - zero) / slope


def counts(counter: Counter, t: Array, first: int) -> NDArray[np.uint64]:
    """Return the numbers (N,) that a device's counter shows at t, where samples are counted from `first`."""
    number = first + np.arange(len(t)) if counter.tick is None else np.rint(t / counter.tick).astype(np.int64)
    return (number % counter.modulo).astype(np.uint64)


@cache
def _factors(name: str, unit: str | None) -> tuple[float, float]:
    """Return the value of 0 `unit` in SI, and of 1 `unit` more."""
    if unit is None:
        return 0.0, 1.0
    zero, one = convert(np.array([0.0, 1.0]), unit, USUAL[name].si if name in USUAL else None)
    return float(zero), float(one - zero)
