"""Scale factor: an error in proportion to the sensor's own input, which may change with temperature."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Unit
from fusion_plugins.effects.common import auxiliary

_EXACT = 1e-3  # of the input: what is left of two that are one, by means over some seconds
_KNOWN = 1.0  # of what is left of the reading: an input that is smaller shows nothing
_TURNED = 0.1  # of the input: it differs by more from one recording to another, or in one
Form = Literal["constant", "of temperature", "both"]


@hookimpl
class ScaleFactor(Effect):
    """Regressors u_i and u_i (T - T_0) on axis i, with u the input: specific force, or the reference of the sensor."""

    explanation: ClassVar = (
        "The sensor answers to its input with a wrong factor, as capacitances, magnets and drive amplitudes change "
        "with temperature: the error is in proportion to the input and has its sign. IEEE Std 1431-2004, scale "
        "factor error and its temperature sensitivity."
    )

    kind: Literal["scale_factor"] = "scale_factor"
    channel: str = "accel"
    """Name of the channel that has the input: the accelerometers' own, or that of the reference."""
    form: Form = "both"
    """The terms: a scale factor error, its change with temperature, or both."""
    zero: Annotated[float, Unit("degC", example="25 degC")] = 25.0
    """T_0, at which the change with temperature is zero."""

    @property
    def requires(self) -> tuple[str, ...]:
        """The input, and the temperature where it matters."""
        return (self.channel,) if self.form == "constant" else (self.channel, "temperature")

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield itself for the sensor's known input, where that is turned or changes.

        The known input is the reading less what is left of it. In one placement it is constant, and a constant scale
        factor is one with the level of the recording.
        """
        found = _input_of(recordings)
        if found is None:
            return
        name, known = found
        means = np.stack([part.mean(axis=0) for part in known])
        size = max(float(np.max(np.abs(part))) for part in known)
        within = max(float(np.max(np.ptp(part, axis=0))) for part in known) > _TURNED * size
        if not within and float(np.max(np.ptp(means, axis=0))) <= _TURNED * size:
            return
        heat = all("temperature" in chunk.channels for chunk in recordings)
        T = float(np.mean(np.concatenate([chunk["temperature"] for chunk in recordings]))) if heat else 25.0
        forms: dict[Form, bool] = {"constant": within, "both": within and heat, "of temperature": heat and not within}
        for form in (form for form, shown in forms.items() if shown):
            yield self.model_copy(update={"channel": name, "form": form, "zero": T})

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the input of each axis, and its product with the temperature; there is no memory."""
        u = chunk[self.channel].reshape(len(chunk), -1)[:, : len(self.axes)]  # one column serves all axes
        factors = [] if self.form == "of temperature" else [np.ones(len(chunk))]
        factors += [] if self.form == "constant" else [chunk["temperature"] - float(self.zero)]
        return on_each_axis(np.stack(factors, axis=1), len(self.axes)) * u[:, :, None], None

    def ends(self, channel: str) -> Array:
        """Return the ends of the domain of a channel; those of the input reach as far to either side."""
        ends = super().ends(channel)
        if channel != self.channel:
            return ends
        largest = np.max(np.abs(ends), axis=1)
        return np.stack([-largest, largest], axis=1)

    @property
    def terms(self) -> tuple[str, ...]:
        """The scale factor error and its change with temperature, as far as they count."""
        both = {"constant": ("scale",), "of temperature": ("scale_per_K",)}
        return both.get(self.form, ("scale", "scale_per_K"))

    @property
    def units(self) -> tuple[str, ...]:
        """Ratios, and ratios per kelvin."""
        return tuple("1/K" if term == "scale_per_K" else "1" for term in self.terms) * len(self.axes)


def _input_of(recordings: Sequence[Chunk]) -> tuple[str, list[Array]] | None:
    """Return the channel that holds the sensor's known input, and that input (N, d) of each recording."""
    if not all("excess" in chunk.channels for chunk in recordings):
        return None
    first, references = recordings[0], auxiliary(recordings)
    for name in first.channels:
        if name == "excess" or first[name].ndim != 2 or first[name].shape != first["excess"].shape:
            continue
        known = [chunk[name] - chunk["excess"] for chunk in recordings]
        size = max(float(np.max(np.abs(part))) for part in known)
        for reference in references:
            if first[reference].ndim == 1 and all(
                np.allclose(part, chunk[reference][:, None], rtol=0, atol=_EXACT * size)
                for part, chunk in zip(known, recordings, strict=True)
            ):
                return reference, known
        constant = all(np.max(np.ptp(part, axis=0)) < _EXACT * size for part in known)
        if constant and size > _KNOWN * max(float(np.max(np.abs(chunk["excess"]))) for chunk in recordings):
            return name, known
    return None
