"""In which unit the bias of a sensor is kept, and in which it is shown; what its axes are called."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from fusion_core.contracts import axis_of
from fusion_core.units import convert

if TYPE_CHECKING:
    from fusion_core.contracts import MeasurementModel, Sensor

OF_MOTION = ("rad/s", "m/s^2")  # SI units that are read as they are


@dataclass(frozen=True)
class BiasUnit:
    """The unit of a bias in SI (`rad/s`), and that of tables and figures (`deg/h`)."""

    si: str
    shown: str

    @cached_property
    def factor(self) -> float:
        """What a bias in SI is multiplied by to be shown."""
        return 1.0 / float(convert(1.0, self.shown, self.si))

    @property
    def digits(self) -> str:
        """The format of a bias that is shown: deg/h of any gyro have a size, other units may have any."""
        return ".2f" if self.shown == "deg/h" else ".4g"

    @property
    def columns(self) -> list[tuple[str, float, str]]:
        """Unit, factor and format of the columns of a table: as it is shown, and in SI where that is another unit.

        Not of a ratio, in parts of one: that would be a number without a unit.
        """
        own, si = (self.shown, self.factor, self.digits), (self.si, 1.0, ".3e")
        return [own] if self.si in (self.shown, "1") else [own, si]

    @property
    def said(self) -> BiasUnit:
        """That of sentences: SI for rates and accelerations, whose tables have both; else that of tables."""
        return BiasUnit(self.si, self.si) if self.si in OF_MOTION else self

    def text(self, value: float, per: str = "") -> str:
        """Return a bias (SI) as one writes it in a config, `per` after its unit."""
        return f"{value * self.factor:.6g} {self.shown}{per}"

    def key(self, name: str) -> str:
        """Return the name of a bias in JSON: that of a rate says its unit, beside any other stands `unit`."""
        return f"{name}_rad_s" if self.si == "rad/s" else name

    @property
    def note(self) -> dict[str, str]:
        """What stands in JSON beside names that say no unit."""
        return {} if self.si == "rad/s" else {"unit": self.si}


RATE = BiasUnit("rad/s", "deg/h")


def unit_of(sensor: Sensor) -> BiasUnit:
    """Return the unit of the bias of a sensor."""
    return BiasUnit(sensor.unit, sensor.shown)


def tracked_unit(model: MeasurementModel | None) -> BiasUnit:
    """Return the unit of the bias that a config's product is about; that of a gyro where nothing is said."""
    return RATE if model is None else unit_of(model.tracked)


def axis_name(channel: str, axis: str) -> str:
    """Return what an axis is called in a sentence: `gyro x`, or as the channel where it has no name of its own."""
    return channel if axis == axis_of(channel) else f"{channel} {axis}"
