"""Temperature and its rate from a sensor that may be coarse: causal estimators, chosen by `kind`.

Both give a temperature without the sensor's steps and its time derivative, with no lag on a steady ramp, from a
handful of numbers carried from sample to sample: a run can be cut anywhere.
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from fusion_core import recursions
from fusion_core.chunk import Array, Chunk, extremes, locked
from fusion_core.settings import Settings
from fusion_core.units import Quantity, Unit

WALK = Quantity(2e-4, "2e-4 K/s/sqrt(s)")  # density of the random walk of a temperature's rate


class Regression(Settings):
    """A straight line through the recent past, older samples counting less (weight exp(-2 age / window)).

    The mean age of a sample is that of a plain window of the same length. While the recording is younger than the
    window, the slope is drawn towards zero: two samples do not make a rate.
    """

    kind: Literal["regression"] = "regression"
    window: Annotated[float, Unit("s", positive=True, example="60 s")] = Quantity(60.0, "60 s")
    """Window of the regression: that of the rate, and the longest that is taken for the temperature itself."""

    @property
    def memory_s(self) -> float:
        """Length of the window in s."""
        return float(self.window)

    def start(self, T: float) -> Array:
        """Return the memory before the first sample: reference, five weighted sums, and the pull on the slope."""
        return np.array([T, 0.0, 0.0, 0.0, 0.0, 0.0, (self.window / 2) ** 2])

    def run(self, dt: Array, T: Array, memory: Array) -> tuple[Array, Array, Array]:
        """Return temperature (N,), its rate (N,) in K/s, and the memory, from steps dt (N,) and samples T (N,)."""
        smooth, rate, memory = np.empty(len(T)), np.empty(len(T)), memory.copy()
        recursions.regression_rate(dt, T, memory, self.window / 2, smooth, rate)
        return smooth, rate, memory


class Kalman(Settings):
    """Two states, temperature and its rate; the rate is a random walk.

    ``noise`` is the standard deviation of a sample (a sensor with steps of q has q / sqrt(12) at least).
    """

    kind: Literal["kalman"] = "kalman"
    noise: Annotated[float, Unit("delta_degC", positive=True, example="0.1 K")] = Quantity(0.1, "0.1 K")
    """Deviation of a reading of the thermometer."""
    walk: Annotated[float, Unit("delta_degC/s/sqrt(s)", positive=True, example="2e-4 K/s/sqrt(s)")] = WALK
    """Density of the random walk of the temperature's rate."""

    @property
    def memory_s(self) -> float:
        """Length in s of the window whose straight line follows a change of the rate as fast."""
        return float(2 * (self.noise / self.walk) ** 0.5)

    def start(self, T: float) -> Array:
        """Return the memory before the first sample: temperature, rate, and the triangle of P."""
        return np.array([T, 0.0, self.noise**2, 0.0, 0.1**2])

    def run(self, dt: Array, T: Array, memory: Array) -> tuple[Array, Array, Array]:
        """Return temperature (N,), its rate (N,) in K/s, and the memory, from steps dt (N,) and samples T (N,)."""
        smooth, rate, memory = np.empty(len(T)), np.empty(len(T)), memory.copy()
        recursions.kalman_rate(dt, T, memory, self.noise**2, self.walk**2, smooth, rate)
        return smooth, rate, memory


CONDITIONED = ("temperature_rate", "temperature_raw", "temperature_window")
"""Channels that a temperature gets with its smoothing: its rate, the measured values, the window in s."""

RateEstimator = Annotated[Regression | Kalman, Field(discriminator="kind")]


class RateMemory(NamedTuple):
    """The memory from chunk to chunk: numbers of rate and temperature, and the range measured so far in degC."""

    numbers: Array
    range: tuple[float, float]
    value: Array


def with_rate(
    chunk: Chunk,
    estimator: Regression | Kalman,
    memory: RateMemory | None,
    known: tuple[float, float] = (0.0, 0.0),
    domain: tuple[float, float] = (np.inf, -np.inf),
) -> tuple[Chunk, RateMemory | None]:
    """Return the chunk with a smooth `temperature` and with `temperature_rate`, where it has a temperature.

    A regression smooths no longer than the thermometer's steps and noise ask for: what it averages over it lags behind
    where the temperature turns. The window of each epoch is `temperature_window`, in s. `known` are steps in K, seen
    elsewhere, and the variance in K^2 of what they leave in means. Beyond the `domain` of the maps, in degC, the smooth
    temperature stays within what was measured so far: an estimate that runs ahead of a reversal would leave that of a
    map that was fitted on the very same recording.
    """
    if "temperature" not in chunk.channels:
        return chunk, memory
    T = chunk["temperature"]
    if memory is None:  # before the first sample, that of a straight line too
        memory = RateMemory(estimator.start(T[0]), (T[0], T[0]), np.array([T[0], *np.zeros(9)]))
    dt, value, windows = chunk.each_dt, memory.value.copy(), np.empty(len(T))
    smooth, rate, numbers = estimator.run(dt, T, memory.numbers)
    if isinstance(estimator, Regression):
        steps = chunk["temperature_step"] if "temperature_step" in chunk.channels else np.zeros(len(T))
        given = dt, T, rate, steps, known, value, estimator.memory_s, float(WALK)
        recursions.regression_value(*given, smooth, windows)
    else:
        windows[:] = estimator.memory_s
    (low, high), (coldest, hottest), (least, largest) = memory.range, extremes(T), extremes(smooth)
    if least < domain[0] or largest > domain[1]:
        lows, highs = np.minimum(np.minimum.accumulate(T), low), np.maximum(np.maximum.accumulate(T), high)
        smooth = np.clip(smooth, np.minimum(lows, domain[0]), np.maximum(highs, domain[1]))
    smooth, rate, windows = locked(smooth), locked(rate), locked(windows)
    conditioned = chunk.having(temperature=smooth, temperature_rate=rate, temperature_raw=T, temperature_window=windows)
    return conditioned, RateMemory(numbers, (min(low, coldest), max(high, hottest)), value)
