"""A gyro bias as a function of temperature: a polynomial, local steps, and a loop of hysteresis.

::

    b(T) = offset + linear x + quadratic x^2 + cubic x^3 + sum height / (1 + exp(-2 ln 9 (T - at) / width)),
           x = T - reference

    hysteresis:  gain (p - T),    p = play(T) = what follows T when pushed, within T +- width / 2

On a stretch where T is monotone and that begins with p_0, the play operator is p = clip(p_0, T - width/2, T + width/2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from fusion_core.chunk import Array
from fusion_core.settings import Settings
from fusion_core.units import Unit, along_axes
from fusion_plugins.sources.synthetic.chamber import Body, Reading
from fusion_plugins.sources.synthetic.settings import DIFFERENCE, ONE_AN_AXIS, PerAxis, d, default


class SmoothStep(Settings):
    """A smooth step, as where two modes of a resonator cross."""

    at: Reading
    """Temperature of the middle."""
    height: Annotated[float, Unit("rad/s", example="0.02 deg/s")]
    """How much the bias changes."""
    width: Annotated[float, Unit("delta_degC", positive=True, example="0.8 K"), DIFFERENCE]
    """Width from 10 % to 90 % of the height."""

    def bias(self, T: Array) -> Array:
        """Return (N,) in rad/s at T (N,) in degC."""
        return np.asarray(self.height / 2 * (1 + np.tanh(np.log(9) * (T - self.at) / self.width)))


class BiasCurve(Settings):
    """The bias of one axis over temperature."""

    reference: Annotated[Reading, default("25 degC")]
    """Temperature at which the polynomial is its offset."""
    offset: Annotated[float, Unit("rad/s", example="0.1 deg/s"), default("0 deg/s")]
    """Bias at the reference."""
    linear: Annotated[float, Unit("rad/s/K", example="2e-3 deg/s/K"), default("0 deg/s/K")]
    """First coefficient of the polynomial."""
    quadratic: Annotated[float, Unit("rad/s/K^2", example="3e-5 deg/s/K^2"), default("0 deg/s/K^2")]
    """Second coefficient of the polynomial."""
    cubic: Annotated[float, Unit("rad/s/K^3", example="6e-7 deg/s/K^3"), default("0 deg/s/K^3")]
    """Third coefficient of the polynomial."""
    steps: tuple[SmoothStep, ...] = ()
    """Smooth steps at some temperatures."""

    def bias(self, T: Array) -> Array:
        """Return (N,) in rad/s at T (N,) in degC."""
        x = T - self.reference
        smooth = self.offset + x * (self.linear + x * (self.quadratic + x * self.cubic))
        return np.asarray(smooth + sum(step.bias(T) for step in self.steps))


class SimulatedHysteresis(Settings):
    """A loop about the curve: at the same temperature, cooling less warming is gain times width."""

    width: Annotated[float, Unit("delta_degC", positive=True, example="4 K"), DIFFERENCE]
    """Width of the loop."""
    gain: Annotated[PerAxis, Unit("rad/s/delta_degC", example="5 deg/h/K"), ONE_AN_AXIS]
    """Bias a kelvin of the loop's position."""


@dataclass(frozen=True)
class PlayOperator:
    """The play operator on the temperature of a body: `start` (S,) is its value where each monotone piece begins."""

    body: Body
    half: float  # width / 2 [K]
    start: Array

    @classmethod
    def on(cls, body: Body, width: float) -> PlayOperator:
        """Return the operator that begins in the middle of its play."""
        T, half = body.temperature(body.t), width / 2
        start = T.copy()
        for i in range(1, len(T)):
            start[i] = np.clip(start[i - 1], T[i] - half, T[i] + half)
        return cls(body, half, start)

    def lag(self, t: Array, T: Array) -> Array:
        """Return p - T (N,) in K at t (N,) in s, where the body has T (N,)."""
        return np.asarray(np.clip(self.start[self.body.piece(t)] - T, -self.half, self.half))


@dataclass(frozen=True)
class TrueBias:
    """The part of the bias that follows from temperature: curves (one an axis) and hysteresis on one body."""

    curves: tuple[BiasCurve, ...]
    body: Body
    play: PlayOperator | None
    gain: Array  # (d,) [rad/s/K]

    @classmethod
    def of(cls, curves: tuple[BiasCurve, ...], hysteresis: SimulatedHysteresis | None, body: Body) -> TrueBias:
        """Return the bias of a unit with these settings."""
        if hysteresis is None:
            return cls(curves, body, None, np.zeros(d))
        return cls(curves, body, PlayOperator.on(body, hysteresis.width), along_axes(hysteresis.gain, d))

    def at(self, t: Array) -> Array:
        """Return the bias (N, d) in rad/s at t (N,) in s."""
        T = self.body.temperature(t)
        bias = np.stack([curve.bias(T) for curve in self.curves], axis=1)
        return bias if self.play is None else np.asarray(bias + self.play.lag(t, T)[:, None] * self.gain)
