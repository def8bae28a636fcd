"""Any sensor at a constant or known input: a resistor, a voltage reference, a magnetometer in a shield.

::

    z_k = mean reading of the epoch - mean reference = C x_k + r_k,    r_k ~ N(0, noise^2 / tau)

The reading less its reference is the bias plus white noise: there is no state beside those of the bias model, and
nothing that moves. Without a reference the reading itself is the bias. The mean over an epoch and the mean of the
temperature over it are of the same moment. One channel of d axes; tau is what was measured of an epoch, s.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
import pydantic

from fusion_core import contracts
from fusion_core import units as quantities
from fusion_core.chunk import Array, Chunk, constant
from fusion_core.contracts.thermal_bias import check_corrected_once
from fusion_core.errors import UnitError, quote
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Installed
from fusion_core.thermal.record_texts import Name
from fusion_core.units import Quantity, Unit
from fusion_plugins.measurement_models.alignment import noise_ratios

PerAxis = float | tuple[float, ...]
OF_SENSOR = Unit("bias", example="10 V")
LEVELS = 10.0  # times the first reading that a prior reaches which is not declared


def _read_reference(value: Any, info: pydantic.ValidationInfo) -> Any:
    """Return the name of a channel, or a constant in SI; a thermometer's is a reading and no difference."""
    if isinstance(value, str) and value and not (value[0].isdigit() or value[0] in "+-."):
        return value
    warm = unit_of(info.data.get("noise"))[0] == "K"
    return (Unit("degC", example="25 degC") if warm else OF_SENSOR).read(value, info)


Reference = Annotated[
    str | PerAxis,
    pydantic.PlainValidator(_read_reference),
    pydantic.PlainSerializer(lambda value: value if isinstance(value, str) else OF_SENSOR.write(value)),
    pydantic.WithJsonSchema(
        {"type": "string", "description": "a channel, or a quantity", "examples": ["set_point", "10 V"]}
    ),
]


@hookimpl
class Held(contracts.MeasurementModel):
    """A sensor at a constant or known input."""

    kind: Literal["held"] = "held"
    channel: Name
    """Name of the sensor's channel."""
    noise: Annotated[PerAxis, Unit("bias/sqrt(Hz)", positive=True, example="0.06 ppm/sqrt(Hz)")]
    """Density of the white noise; its unit, less 1/sqrt(Hz), is that of the sensor."""
    bias: Annotated[contracts.BiasModel, Installed()]
    """Model of the bias."""
    reference: Reference | None = None
    """Reading of an ideal sensor: a channel, or a constant; zero by default."""
    range: Annotated[float, Unit("bias", positive=True, example="10 V")] | None = None
    """Range of the sensor, beyond which it is saturated."""
    calibration: Annotated[contracts.ThermalMap, Installed()] | None = None
    """The map that is subtracted before the filter."""
    false_alarm: Annotated[float, pydantic.Field(gt=0, lt=0.1)] = 1e-7
    """Probability that a good sample is refused."""
    realign_after: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """After how long a time of refusals the filter begins anew."""

    @pydantic.model_validator(mode="wrap")
    @classmethod
    def _in_its_own_unit(cls, data: Any, handler: pydantic.ModelWrapValidatorHandler[Self]) -> Self:
        """Read the quantities of the section in the unit of its noise, and name its axis by its channel."""
        if not isinstance(data, dict):
            return handler(data)
        axes = cls._usual_axes(data.get("channel"))
        with quantities.bias_unit(*unit_of(data.get("noise"))), quantities.section_axes(axes):
            return handler(data)

    @classmethod
    def _usual_axes(cls, channel: Any) -> tuple[str, ...]:
        return (contracts.axis_of(str(channel)),)

    @pydantic.model_validator(mode="after")
    def _fits_together(self) -> Self:
        quantities.check_axes("noise", self.noise, len(self.bias.axes))
        if unit_of(self.noise)[0] is None:
            raise ValueError("noise has no unit, and the sensor's unit follows from it; write e.g. '0.06 ppm/sqrt(Hz)'")
        if isinstance(self.reference, tuple):
            quantities.check_axes("reference", self.reference, len(self.bias.axes))
        check_corrected_once(self.calibration, self.bias)
        return self

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return a resistor, and a thermometer beside a reference."""
        bias = {"kind": "random_walk", "walk": "5e-4 ppm/sqrt(s)"}
        warm = {"kind": "random_walk", "walk": "1e-4 K/sqrt(s)"}
        one = {"channel": "resistance", "noise": "0.06 ppm/sqrt(Hz)", "bias": bias}
        other = {"channel": "probe", "noise": "1 mK/sqrt(Hz)", "bias": warm, "reference": "25 degC"}
        return (cls.model_validate(one), cls.model_validate(other))

    @cached_property
    def sensors(self) -> tuple[contracts.Sensor, ...]:
        """The one sensor."""
        unit, shown = unit_of(self.noise)
        assert unit is not None, "the noise is a quantity"
        noise = quantities.along_axes(self.noise, len(self.bias.axes))
        shown = shown if unit != "K" or shown.endswith("K") else unit  # of a thermometer: differences
        one = contracts.Sensor(self.channel, "filter", unit, shown, noise, self.range, self.bias, self.calibration)
        return (one,)

    def with_tracked(self, **fields: Any) -> Self:
        """Return the model with other settings of its sensor."""
        return self.model_copy(update=fields)

    def check_units(self, units: Mapping[str, str | None]) -> None:
        """Raise UnitError where sensor or reference are in another dimension than the noise, or in none."""
        sensor = self.tracked
        for name in (self.channel, *self.requires):
            if name not in units:
                continue
            unit, declared = units[name], f"filter.noise is in {sensor.shown}/sqrt(Hz)"
            if unit is None:
                text = f"has no unit, {declared}; write unit: {sensor.shown} if that is what the file has"
            elif not quantities.same_dimension(unit, sensor.shown):
                text = f"is in {quote(unit)}, {declared}; correct one of the two"
            else:
                continue
            raise UnitError(f"source.channels.{name}: {text}")

    @property
    def requires(self) -> tuple[str, ...]:
        """The channel of the reference, where it is one."""
        return (self.reference,) if isinstance(self.reference, str) else ()

    @property
    def patience(self) -> contracts.Patience:
        """The gate of the innovations, and the time after which a level that has jumped is taken as it is."""
        return contracts.Patience(self.false_alarm, float(self.realign_after))

    def prior(self, blocks: Sequence[contracts.Prior], alignment: contracts.Alignment | None = None) -> contracts.State:
        """Put the prior together; where that of the bias is not declared, it reaches as far as the first readings.

        1 SI unit, which stands for "nothing is known", is wide for a gyro and narrow for a resistor of 10 kohm.
        """
        (block,) = blocks
        level = np.zeros(len(self.bias.axes)) if alignment is None else alignment.levels[self.channel]
        P = block.P.copy()
        for axis in range(len(level)):
            if self.bias.sigma_0 is None and P[axis, axis] >= 1.0:
                P[axis, axis] = max(P[axis, axis], (LEVELS * level[axis]) ** 2)
        return super().prior([contracts.Prior(block.x, P)], alignment)

    def equations(
        self, chunk: Chunk, steps: Sequence[contracts.Transition], alignment: contracts.Alignment
    ) -> tuple[contracts.Transition, contracts.Measurement]:
        """Measure the bias itself."""
        (step,), name = steps, self.tracked.block.name
        H = np.eye(len(self.tracked.axes)) if step.C is None else step.C
        z = chunk[self.channel] - self.known(chunk, alignment)
        R = np.diag(self.tracked.noise**2) / constant(chunk["tau"])[..., None, None]
        return self.space.transition({name: step}), contracts.Measurement(z, H, R, np.ones(len(chunk), dtype=bool))

    def known(self, chunk: Chunk, alignment: contracts.Alignment | None = None) -> Array:
        """Return the reference: (d,), or (N, d) where it is a channel."""
        if isinstance(self.reference, str):
            d = len(self.tracked.axes)
            return np.broadcast_to(chunk[self.reference].reshape(len(chunk), -1), (len(chunk), d))
        return quantities.along_axes(0.0 if self.reference is None else self.reference, len(self.tracked.axes))

    def still(self, window: Chunk) -> bool:
        """Return True: nothing ever moves."""
        return True

    def aligned(self, window: Chunk, site: contracts.Site) -> contracts.Alignment:
        """Take note of how noisy the sensor is, and of its level."""
        dt, zero = float(np.median(window["tau"])), np.zeros(len(self.tracked.axes))
        known = np.broadcast_to(self.known(window), window[self.channel].shape)
        less = window[self.channel] - known
        ratios = noise_ratios(window.having(**{self.channel: less}), self.sensors)
        inputs, levels = {self.channel: np.mean(known, axis=0)}, {self.channel: np.mean(less, axis=0)}
        return contracts.Alignment(float(window.t[-1]), dt, inputs, ratios, zero, levels=levels)


def unit_of(noise: Any) -> tuple[str | None, str]:
    """Return the unit of the sensor in SI and as written, from its noise; None where that is not a quantity."""
    first = noise[0] if isinstance(noise, list | tuple) and noise else noise
    text = first.text if isinstance(first, Quantity) else first
    try:
        return quantities.unit_of_density(text) if isinstance(text, str) else (None, "")
    except UnitError:  # the field itself will say
        return None, ""
