"""In which unit the bias of a config is kept, and in which it is shown."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from driftlab.config import Config
from fusion_core.units import convert


@dataclass(frozen=True)
class BiasUnit:
    """The unit of a bias in SI (`rad/s`), and that of tables and figures (`deg/h`)."""

    si: str
    shown: str

    @cached_property
    def factor(self) -> float:
        """What a bias in SI is multiplied by to be shown."""
        return 1.0 / float(convert(1.0, self.shown, self.si))

    def text(self, value: float, per: str = "") -> str:
        """Return a bias (SI) as one writes it in a config, `per` after its unit."""
        return f"{value * self.factor:.6g} {self.shown}{per}"


def unit_of(config: Config) -> BiasUnit:
    """Return the unit of the bias that the config's product is about."""
    assert config.filter is not None
    return BiasUnit(config.filter.tracked.unit, config.filter.tracked.shown)
