"""The limits that a customer sets for a unit, and its serial number, as a config writes them."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from fusion_core.errors import shown
from fusion_core.escaping import is_plain
from fusion_core.settings import Settings
from fusion_core.units import Unit

LONGEST = 64  # characters of a serial number


def _serial(value: Any) -> Any:
    """Return a serial number as text; of a number with a point nobody knows any more how it was written."""
    if isinstance(value, float):
        raise _problem(f"{value!r} is a number, and its digits may not be those on the label; write it in quotes")
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if isinstance(value, str) and not (0 < len(value) <= LONGEST and is_plain(value) and value == value.strip()):
        raise _problem(f"'{shown(value)}' is no serial number; write 1 to {LONGEST} characters in one line")
    return value


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("serial", "{text}", {"text": text})


Serial = Annotated[str, BeforeValidator(_serial, json_schema_input_type=str | int)]
"""The serial number of a unit, as it is on its label."""

Bias = Annotated[float, Unit("bias", positive=True, example="5 deg/h")]


class Limits(Settings):
    """What the worst axis of the tracked sensor may have at most."""

    bias_instability: Bias | None = None
    """Floor of the Allan deviation, the coefficient B of IEEE Std 952."""
    residual: Bias | None = None
    """Rms of 30 s averages about the thermal map, in the samples of its fit."""
    coast: Bias | None = None
    """Rms error of the bias that is predicted without a measurement, over 10 minutes after an alignment."""
    swing: Bias | None = None
    """Largest less smallest bias of the thermal map over its domain."""
    hysteresis: Bias | None = None
    """Largest difference between warming and cooling at one temperature: a hysteresis, a lag, a relaxation."""
    noise: Annotated[float, Unit("bias/sqrt(Hz)", positive=True, example="4 deg/h/sqrt(Hz)")] | None = None
    """Density of the white noise."""

    @property
    def declared(self) -> dict[str, float]:
        """Those that are set, by name, in SI."""
        return {name: float(value) for name, value in self if value is not None}
