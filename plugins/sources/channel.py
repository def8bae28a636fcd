"""One channel of a recording: where it is in the file, and in which unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from fusion_core.errors import UnitConflict, UnitError, shown
from fusion_core.settings import Settings
from fusion_core.units import convert, si_unit_of

SI = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC", "valid": "1"}
USUAL = {
    "time": "s",
    "gyro": "deg/s",
    "accel": "g",
    "temperature": "degC",
}  # channels that need a unit, and one to write
Name = Annotated[str, Field(min_length=1)]


class Channel(Settings):
    """Where one channel is in the file."""

    path: Name | Annotated[tuple[Name, ...], Field(min_length=1)]  # a column or data set, or one an axis
    unit: str | None = None  # as in the file; may carry a factor, as in `0.5 rad/s`

    @property
    def paths(self) -> tuple[str, ...]:
        """The columns or data sets of the channel."""
        return (self.path,) if isinstance(self.path, str) else self.path

    def check(self, name: str) -> None:
        """Raise UnitError where the unit is unknown or of the wrong dimension for channel `name`."""
        if self.unit is None:
            return
        example = USUAL.get(name, "0.1 V")
        try:
            si_unit_of(self.unit)
        except UnitError:
            raise UnitError(
                f"channel {name}: unit '{shown(self.unit)}' is not known; write it like '{example}'"
            ) from None
        if name in SI and _scale(self.unit, SI[name]) is None:
            advice = f"write a unit like '{example}'" if name in USUAL else "it has no unit, remove it"
            raise UnitError(f"channel {name}: unit '{shown(self.unit)}' cannot be converted to {SI[name]}; {advice}")

    def conversion(self, file: Path, name: str, path: str, found: str | None) -> tuple[str, str] | None:
        """Return the unit of `path` and the SI unit to convert it to; `found` is the unit in the file.

        Raises
        ------
        UnitError
            If channel `name` needs a unit and there is none that can be used.
        UnitConflict
            If config and file give units of the same dimension and different size.
        """
        si = SI.get(name) or _si(self.unit or found)
        theirs = None if found is None or si is None else _scale(found, si)
        advice = f"write unit: {USUAL.get(name, 'UNIT')} under source.channels.{name}"
        if self.unit is not None and si is not None:
            if theirs is not None and not np.allclose(_scale(self.unit, si) or np.nan, theirs, rtol=1e-9, atol=0):
                ours, other = shown(self.unit), shown(found)
                raise UnitConflict(
                    f"{file}: channel {name} is in '{ours}' by the config and in '{other}' by the file ('{path}'); "
                    f"remove the wrong one, e.g. source.channels.{name}.unit"
                )
            return self.unit, si
        if name in USUAL and found is None:
            raise UnitError(f"{file}: channel {name} has no unit, neither in the config nor in the file; {advice}")
        if name in USUAL and theirs is None:
            raise UnitError(
                f"{file}: channel {name} is in '{shown(found)}' by the file, which is no unit of {si}; {advice}"
            )
        return None if theirs is None or found is None or si is None else (found, si)


def _si(unit: str | None) -> str | None:
    try:
        return None if unit is None else si_unit_of(unit)
    except UnitError:
        return None


def _scale(unit: str, si: str) -> list[float] | None:
    """Return what 0 and 1 `unit` are in `si`, or None where the unit is unknown or of another dimension."""
    try:
        zero, one = convert([0.0, 1.0], unit, si)
        return [float(zero), float(one)]
    except UnitError:
        return None
