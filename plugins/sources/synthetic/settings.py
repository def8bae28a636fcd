"""The common part of the settings of a simulation: defaults as a user would write them, and checks of values.

To stand behind a `Unit` in an annotation, as in `Annotated[float, Unit("delta_degC"), DIFFERENCE, default("0 K")]`.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo

from fusion_core.chunk import Array
from fusion_core.units import check_axes
from fusion_core.units.grammar import NUMBER

d = 3  # axes of a triad
PerAxis = float | tuple[float, ...]


def default(written: Any) -> Any:
    """Return the default of a field as a user would write it; it is checked and converted like any other value."""
    return Field(default=written, validate_default=True)


def _one_an_axis(value: PerAxis, info: ValidationInfo) -> PerAxis:
    check_axes(str(info.field_name), value, d)
    return value


def _difference(value: Any) -> Any:
    """Read `5 degC` as a difference of 5 K, where only a difference is meant."""
    written = isinstance(value, str) and re.fullmatch(rf"\s*({NUMBER.pattern})\s*(?:°C|degC|degreeC)\s*", value)
    return f"{written[1]} K" if written else value


def round_to(values: Array, resolution: float | Array) -> Array:
    """Return the nearest multiples of the resolution, one for all or one an axis; the values where it is zero."""
    if not np.any(resolution):
        return values
    step = np.where(np.asarray(resolution) > 0, resolution, 1.0)
    return np.where(np.asarray(resolution) > 0, np.round(values / step) * step, values)


ONE_AN_AXIS = AfterValidator(_one_an_axis)
DIFFERENCE = BeforeValidator(_difference)
