"""Thermal gradient: a bias that follows the difference of two thermometers and its rate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import TEMPERATURE, Behind, Reading, Signal, Weighted
from fusion_core.contracts.table import auxiliary
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import lag_of, varied


@hookimpl
class ThermalGradient(Effect):
    """The difference of a second thermometer to `temperature`, and its rate over `window`.

    The rate is what of the difference a lag of half the window has not followed yet, a second: its relaxation.
    """

    unit: ClassVar = "bias/K, bias/(K/s)"
    explanation: ClassVar = (
        "A temperature difference across the sensor bends its mount and, in a fibre coil, shifts the phase as it moves "
        "(Shupe effect): the bias follows the difference and its rate. D. M. Shupe, Applied Optics 19 (1980) 654."
    )

    kind: Literal["thermal_gradient"] = "thermal_gradient"
    channel: str = "temperature_case"
    """Name of the second thermometer's channel."""
    form: Literal["difference", "rate", "both"] = "both"
    """Input: the difference of the thermometers, its rate, or both."""
    window: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """Window over which the rate is taken."""

    @property
    def requires(self) -> tuple[str, ...]:
        """The two thermometers."""
        return (self.channel, "temperature")

    def candidates(self) -> Iterator[Self]:
        """Yield the difference, and its rate over windows from 5 s to 320 s without and with it."""
        yield self.model_copy(update={"form": "difference"})
        for form in ("rate", "both"):
            seen = self.model_copy(update={"form": form})
            yield from varied(seen, "window", (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0))

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield every channel whose name begins with `temperature_`."""
        for name in sorted(auxiliary(recordings)):
            if name.startswith("temperature_"):
                yield from self.model_copy(update={"channel": name}).candidates()

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return difference and rate; the memory is that of the lag that the rate is taken from."""
        difference = chunk[self.channel] - chunk["temperature"]
        smooth, memory = lag_of(chunk, difference, self.window / 2, memory)
        terms = {"difference": difference, "rate": (difference - smooth) / (self.window / 2)}
        return on_each_axis(np.stack([terms[name] for name in self.terms], axis=1), len(self.axes)), memory

    def realisation(self) -> tuple[Signal, ...]:
        """Return difference and rate."""
        difference = Weighted(((1.0, Reading(self.channel)), (-1.0, TEMPERATURE)))
        tau = float(self.window) / 2
        terms: dict[str, Signal] = {"difference": difference, "rate": Weighted(((1 / tau, Behind(difference, tau)),))}
        return tuple(terms[name] for name in self.terms)

    @property
    def variant(self) -> str:
        """Its form."""
        return self.form

    @property
    def terms(self) -> tuple[str, ...]:
        """Difference, rate, or both."""
        return ("difference", "rate") if self.form == "both" else (self.form,)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the terms, axis by axis."""
        units = {"difference": "bias/K", "rate": "bias/(K/s)"}
        return tuple(units[term] for _ in self.axes for term in self.terms)
