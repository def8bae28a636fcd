"""Periodic: a line in the spectrum of the bias."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.effects.common import longest_span, varied

_LINES = 3  # highest lines that are tried
_CYCLES = 10  # within the longest recording that a line has at least: fewer pass for a drift
_PADDING = 8  # frequencies to the resolution of a recording
_FINE = 8  # frequencies to the resolution of all recordings together
_MAX_FREQUENCIES = 1000  # frequencies that are tried on either side of a line


@hookimpl
class Periodic(Effect):
    """Sine and cosine of time as the recording counts it: one phase for all recordings of one clock."""

    continuous: ClassVar = {"period": 1.001}
    course: ClassVar = "line"
    several: ClassVar = True
    requires: ClassVar = ()
    explanation: ClassVar = (
        "A chamber's control cycle, a pump or a sampling beat shakes or warms the sensor with a fixed period: a line "
        "in the spectrum of what is left. Schuster's periodogram, Terrestrial Magnetism 3 (1898) 13."
    )

    kind: Literal["periodic"] = "periodic"
    period: Annotated[float, Unit("s", positive=True, example="97 s")] = Quantity(100.0, "100 s")
    """Period of the line."""

    def proposals(self, recordings: Sequence[Chunk]) -> Iterator[Self]:
        """Yield the highest lines of the residual's power, summed over axes and recordings."""
        return varied(self, "period", _lines(recordings))

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return sine and cosine; there is no memory."""
        phase = 2 * np.pi * (chunk.t / self.period)
        return on_each_axis(np.stack([np.sin(phase), np.cos(phase)], axis=1), len(self.axes)), None

    @property
    def terms(self) -> tuple[str, ...]:
        """Sine, cosine."""
        return ("sin", "cos")


def _lines(recordings: Sequence[Chunk]) -> list[float]:
    """Return the periods (s) of the highest lines, at least three steps of the longest recording's grid apart."""
    length = max(len(chunk) for chunk in recordings)
    step = float(np.mean(np.concatenate([np.diff(chunk.t)[: length // 8 + 1] for chunk in recordings])))
    size = _PADDING * length
    power = sum(
        np.sum(np.abs(np.fft.rfft(np.nan_to_num(chunk["residual"]), n=size, axis=0)) ** 2, axis=1)
        for chunk in recordings
    )
    power = np.array(power)
    power[: _PADDING * _CYCLES] = 0.0
    periods = []
    for _ in range(_LINES):
        k = int(np.argmax(power))
        if power[k] <= 0:
            break
        periods.append(_in_phase(recordings, size * step / k))
        power[max(0, k - 3 * _PADDING) : k + 3 * _PADDING + 1] = 0.0
    return periods


def _in_phase(recordings: Sequence[Chunk], period: float) -> float:
    """Return the period near this one at which one sine and cosine fit all recordings best: they share a clock."""
    t = np.concatenate([chunk.t for chunk in recordings])
    e = np.concatenate([np.nan_to_num(chunk["residual"]) for chunk in recordings])
    longest = longest_span(recordings)
    whole = float(np.ptp(t))
    steps = min(int(np.ceil(2 * _FINE * whole / longest)), _MAX_FREQUENCIES)
    f = 1 / period + np.linspace(-1, 1, 2 * steps + 1) / longest
    if not np.any(f * longest >= _CYCLES):  # gaps at the beginning: the step is no longer that of most rows
        return period
    f = f[f * longest >= _CYCLES]
    t = t - t.mean()
    power = [float(np.sum(np.abs(np.exp(-2j * np.pi * frequency * t) @ e) ** 2)) for frequency in f]
    return float(1 / f[int(np.argmax(power))])
