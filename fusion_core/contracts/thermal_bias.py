"""The contract of bias models that follow a thermal map and carry effects, as identification needs it."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import model_validator

from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.effect import Effect
from fusion_core.contracts.thermal_map import ThermalMap
from fusion_core.errors import ConfigError
from fusion_core.thermal.fitted_map import FittedMap
from fusion_core.units import Unit, problem


class ThermalBias(BiasModel):
    """A bias that follows a map of temperature and what effects add, with a random walk about both.

    A plugin annotates `map` and `effects` again, `Annotated[..., Installed()]`, so that a config can name any that is
    installed. Where `repeatability` is given, the bias at the first sample is N(map and effects there + turn_on_bias,
    repeatability^2); else N(0, sigma_0^2).
    """

    walk: Annotated[float | tuple[float, ...], Unit("bias/sqrt(s)", least=0, example="5e-4 deg/s/sqrt(s)")]
    """Density of the random walk about map and effects."""
    turn_on_bias: Annotated[float | tuple[float, ...], Unit("bias")] | None = None
    """Mean of the bias at a switch-on, less map and effects."""
    repeatability: Annotated[float | tuple[float, ...], Unit("bias", positive=True)] | None = None
    """Deviation of the bias from one switch-on to the next."""
    map: ThermalMap | None = None
    """The map of temperature that the bias follows."""
    effects: tuple[Effect, ...] = ()
    """Effects that the bias follows too, in this order."""

    @model_validator(mode="after")
    def _starts_somewhere(self) -> Self:
        if self.turn_on_bias is not None and self.repeatability is None:
            raise ValueError("turn_on_bias is given and repeatability is not; add how far switch-ons differ from it")
        return self

    @cached_property
    def fitted(self) -> FittedMap | None:
        """The map, read from its file at first use; None where there is none."""
        return None if self.map is None else self.map.load()

    @classmethod
    def from_random_walk(cls, declared: BiasModel) -> Self:
        """Return the model of this class that says what `declared` says, without map and effects.

        Raises
        ------
        ConfigError
            If `declared` is no random walk (`BiasModel.as_random_walk`).
        """
        settings = declared.as_random_walk()
        if settings is None:
            raise ConfigError(f"bias model {declared.kind} is no random walk, and takes neither a map nor effects")
        return cls.model_validate({name: value for name, value in settings.items() if value is not None})

    def having(self, **fields: Any) -> Self:
        """Return the model with other values of some fields, checked as those of a config are.

        Quantities are written with their unit; within `bias_unit(...)` their dimension is checked too.

        Raises
        ------
        pydantic.ValidationError
            If the class has no such field, or the values do not fit together.
        """
        return type(self).model_validate({**dict(self), **fields})


def check_corrected_once(calibration: ThermalMap | None, bias: BiasModel) -> None:
    """Raise the validation error of a sensor whose map is subtracted first, and followed by its bias model too."""
    if calibration is not None and isinstance(bias, ThermalBias) and bias.map is not None:
        raise problem(
            f"a map is subtracted by `calibration` and followed again by the bias model {bias.kind}: the correction "
            "would be applied twice; keep one of the two"
        )
