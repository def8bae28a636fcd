"""Units of a sensor's bias in SI and as it is shown, names of its axes, and numbers, times and lists as texts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from fusion_core.contracts import axis_of
from fusion_core.units import convert

if TYPE_CHECKING:
    from fusion_core.contracts import MeasurementModel, Sensor

EARTH = 7.292115e-5  # rad/s
YEARS = (8e8, 4e9)  # s since 1970, 1995 to 2096: a time between them is a date


@dataclass(frozen=True)
class BiasUnit:
    """The unit of a bias in SI (`rad/s`), and that of tables and figures (`deg/h`)."""

    si: str
    shown: str

    @cached_property
    def factor(self) -> float:
        """Factor from a bias in SI to the shown unit."""
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

    def number(self, value: float, missing: str = "nan") -> str:
        """Return a bias (SI) as tables show it, without its unit; `missing` stands for one that is not finite."""
        return formatted(value * self.factor, self.digits, missing)

    def text(self, value: float, per: str = "") -> str:
        """Return a bias (SI) as one writes it in a config, `per` after its unit."""
        return f"{value * self.factor:.6g} {self.shown}{per}"

    def key(self, name: str) -> str:
        """Return the name of a bias in JSON: that of a rate says its unit, beside any other stands `unit`."""
        return f"{name}_rad_s" if self.si == "rad/s" else name

    @property
    def note(self) -> dict[str, str]:
        """Note in JSON beside names that say no unit."""
        return {} if self.si == "rad/s" else {"unit": self.si}


RATE = BiasUnit("rad/s", "deg/h")


def default_unit(si: str) -> BiasUnit:
    """Return the unit of a bias in an SI unit: of a rate, and where there is none, shown in deg/h; else in SI."""
    return RATE if si in ("", RATE.si) else BiasUnit(si, si)


def unit_of(sensor: Sensor) -> BiasUnit:
    """Return the unit of the bias of a sensor."""
    return BiasUnit(sensor.unit, sensor.shown)


def tracked_unit(model: MeasurementModel | None) -> BiasUnit:
    """Return the unit of the bias that a config's product is about; that of a gyro by default."""
    return RATE if model is None else unit_of(model.tracked)


def axis_name(channel: str, axis: str) -> str:
    """Return the name of an axis in a sentence: `gyro x`, or the channel where the axis has none of its own."""
    return channel if axis == axis_of(channel) else f"{channel} {axis}"


def units(count: int) -> str:
    """Return a number of units, in words."""
    return "1 unit" if count == 1 else f"{count:,} units"


def number(value: float, *, zeros: bool = False, missing: str = "") -> str:
    """Return a value with three digits, from 1000 on without decimals.

    `zeros` keeps those at its end; `missing` stands for values that are not finite.
    """
    if missing and not math.isfinite(value):
        return missing
    if not abs(value) < 1000:
        return f"{value:.0f}"
    return f"{value:#.3g}".rstrip(".") if zeros else f"{value:.3g}"


def formatted(value: float, spec: str, missing: str = "–") -> str:
    """Return a value in a format, or what stands for one that is not finite."""
    return f"{value:{spec}}" if math.isfinite(value) else missing


def rounded(value: float | None, digits: int) -> float | None:
    """Return a value with so many digits, as JSON and pages hold it; None for one that is not finite."""
    return float(f"{value:.{digits}g}") if value is not None and math.isfinite(value) else None


def with_uncertainty(value: float, uncertainty: float) -> str:
    """Return a value with the decimals of its uncertainty, which has two digits; the value alone where there is none.

    Beyond the range of four decimals both have a power of ten.
    """
    if not (math.isfinite(uncertainty) and uncertainty > 0):
        return f"{value:.4g}"
    decimals = 1 - math.floor(math.log10(uncertainty))
    if not 0 <= decimals <= 4:
        return f"{value:.4g} ± {uncertainty:.2g}"
    return f"{value:.{decimals}f} ± {uncertainty:.{decimals}f}"


def duration(seconds: float) -> str:
    """Return a time in seconds, minutes or hours."""
    if seconds < 600:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def listed(words: Sequence[str]) -> str:
    """Return words as a list with `and` before the last."""
    return " and ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)
