"""Temperature of a climatic chamber over time, and of a body that follows it.

The chamber's temperature is a chain of straight lines, the body's a lag of first order behind it, in closed form
(`fusion_core.recursions.LaggedLines`). Pieces are cut where T turns: on each one T is monotone, which gives the play
operator (`fusion_plugins.sources.synthetic.bias`) a closed form too.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core.chunk import Array
from fusion_core.recursions import LaggedLines
from fusion_core.settings import Settings
from fusion_core.units import Unit, problem
from fusion_plugins.sources.synthetic.settings import DIFFERENCE, default

Reading = Annotated[float, Unit("degC", example="25 degC")]
Rate = Unit("delta_degC/s", positive=True, example="2 K/min")


class _Profile(Settings):
    @abstractmethod
    def knots(self) -> tuple[Array, Array]:
        """Return times (M,) in s, from 0 on, and temperatures (M,) in degC; straight lines in between."""

    @property
    def duration(self) -> float:
        """Length in s."""
        return float(self.knots()[0][-1])


class ChamberSoak(_Profile):
    """Plateaus from `start` by `step`, the last one at `stop`; then the same ones back down, if asked.

    The default is the soak of Fontanella et al. 2018, sec. 4.
    """

    kind: Literal["soak"] = "soak"
    start: Annotated[Reading, default("-20.53 degC")]
    """First temperature."""
    stop: Annotated[Reading, default("48.08 degC")]
    """Last temperature."""
    step: Annotated[float, Unit("delta_degC", positive=True, example="5 K"), DIFFERENCE, default("5 K")]
    """From one temperature to the next."""
    hold: Annotated[float, Unit("s", positive=True, example="2.5 h"), default("2.5 h")]
    """Time at each temperature."""
    ramp: Annotated[float, Rate, default("2 K/min")]
    """Rate from one temperature to the next."""
    down: bool = False
    """True if it comes back by the same steps."""

    def plateaus(self) -> Array:
        """Return their temperatures (M,) in degC, in order."""
        swing = self.stop - self.start
        whole = int(np.floor(abs(swing) / self.step + 1e-9))
        levels = self.start + np.sign(swing) * self.step * np.arange(whole + 1)
        if abs(levels[-1] - self.stop) > 1e-9 * self.step:
            levels = np.append(levels, self.stop)
        return np.concatenate([levels, levels[-2::-1]]) if self.down else levels

    def knots(self) -> tuple[Array, Array]:
        """Return the beginning and the end of each plateau."""
        levels = self.plateaus()
        return _held(levels, self.hold, self.ramp)


class Ramp(_Profile):
    """Straight up and down again between two temperatures, `cycles` times, each end held.

    The default is the ramp of Fontanella et al. 2018, sec. 4, once up and down.
    """

    kind: Literal["ramp"] = "ramp"
    low: Annotated[Reading, default("27.28 degC")]
    """Lowest temperature."""
    high: Annotated[Reading, default("34.08 degC")]
    """Highest temperature."""
    rate: Annotated[float, Rate, default("2 K/min")]
    """Rate of the temperature."""
    hold: Annotated[float, Unit("s", least=0, example="60 s"), default("60 s")]
    """Time at either end."""
    cycles: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Number of sweeps up and down."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.low < self.high:
            raise problem(f"low is {self.low:g} degC and high {self.high:g} degC; write low below high")
        return self

    def knots(self) -> tuple[Array, Array]:
        """Return the beginning and the end of each hold."""
        levels = np.array([self.low, *[self.high, self.low] * self.cycles])
        return _held(levels, self.hold, self.rate)


class ChamberTable(_Profile):
    """Straight lines between given points; the first and the last value are held."""

    kind: Literal["table"] = "table"
    time: Annotated[tuple[Annotated[float, Unit("s", least=0, example="1 h")], ...], Field(min_length=1)]
    """Times, increasing."""
    temperature: Annotated[tuple[Reading, ...], Field(min_length=1)]
    """Temperatures at these times, straight in between."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.time) != len(self.temperature):
            counts = f"{len(self.time)} times and {len(self.temperature)} temperatures"
            raise problem(f"{counts} are given; write one temperature for each time")
        step = np.diff(self.time)
        if np.any(step <= 0):
            k = int(np.argmax(step <= 0))
            raise problem(f"time {self.time[k + 1]:g} s follows {self.time[k]:g} s; write times that increase")
        return self

    def knots(self) -> tuple[Array, Array]:
        """Return the given points, from time 0 on."""
        t, T = np.array(self.time, dtype=np.float64), np.array(self.temperature, dtype=np.float64)
        return (t, T) if t[0] == 0 else (np.append(0.0, t), np.append(T[0], T))


Profile = ChamberSoak | Ramp | ChamberTable


def _held(levels: Array, hold: float, rate: float) -> tuple[Array, Array]:
    """Return the knots of plateaus `levels` (M,), each held, with a ramp in between."""
    moves = np.append(0.0, np.abs(np.diff(levels)) / rate)
    begin = np.cumsum(moves) + hold * np.arange(len(levels))
    t, T = np.column_stack([begin, begin + hold]).ravel(), np.repeat(levels, 2)
    keep = np.append(True, np.diff(t) > 0)
    return t[keep], T[keep]


def body_behind(profile: Profile, tau: float) -> LaggedLines:
    """Return the body that follows the profile with lag tau, in balance at the start; on each piece T is monotone."""
    lines = LaggedLines.behind(*profile.knots(), tau)
    pieces = []
    lengths = np.append(np.diff(lines.t), np.inf)
    for t_i, u_i, s, c, length in zip(lines.t, lines.u, lines.s, lines.c, lengths, strict=True):
        pieces.append((t_i, u_i, s, c))
        turn = tau * np.log(c / (s * tau)) if s * tau * c > 0 else 0.0  # where dT/dt = s - (c/tau) exp(-x/tau) = 0
        if 0 < turn < length:
            pieces.append((t_i + turn, u_i + s * turn, s, s * tau))
    begins, starts, slopes, transients = np.array(pieces, dtype=np.float64).T
    return LaggedLines(begins, starts, slopes, transients, tau)
