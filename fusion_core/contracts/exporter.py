"""The contract of exporters: a calibration is written for another program or device, and read back.

The loss of a calibration is measured as the target evaluates it:

::

    over the domain:     target(T) - map(T)       at many places from its lowest to its highest temperature
    over a warm-up:      target - (map and effects),   T(t) = T_high - (T_high - T_low) exp(-t / 15 min), 1 h at 1 Hz

The first is the curve's; the second has what runs in time: a lag that the target cannot hold, a correction that it
renews too rarely.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.calibration import TEMPERATURES, Calibrated, Export
from fusion_core.contracts.plugin import Plugin
from fusion_core.errors import ConfigError
from fusion_core.escaping import line
from fusion_core.thermal.triad_matrix import TriadMatrix

CLOSER = 10  # times TEMPERATURES, at which a loss is looked at: its largest lies between the knots of a target's table


@dataclass(frozen=True)
class ReadBack:
    """A sensor's calibration as a file of the target has it.

    Attributes
    ----------
    channel, unit : str
        Whose bias it is, and its SI unit.
    axes : tuple of str
        Names of the d axes.
    domain : (float, float)
        Temperatures that it is for, degC.
    bias : function of T (N,) -> (N, d)
        What the target subtracts within the domain.
    order : int
        The degree of polynomial that holds it.
    notes : tuple of str
        What one should know of it.
    matrix : TriadMatrix, optional
        Scale factor and misalignment of a triad, where the target holds some.
    about : mapping of str to str
        Facts on the device, as a source's `about`.
    """

    channel: str
    unit: str
    axes: tuple[str, ...]
    domain: tuple[float, float]
    bias: Callable[[Array], Array]
    order: int = 3
    notes: tuple[str, ...] = ()
    matrix: TriadMatrix | None = None
    about: Mapping[str, str] = field(default_factory=dict)


class Exporter(Plugin):
    """A form in which a calibration leaves; its fields are what the user may choose."""

    suffix: ClassVar[str] = ""  # of the file; empty where it is a folder
    folder: ClassVar[bool] = False  # whether it writes several files, into a folder

    @abstractmethod
    def export(self, what: Export, path: Path) -> Loss:
        """Write what the target can hold to the file `path` (into it, where `folder`), and return what is lost.

        Raises
        ------
        ConfigError
            If the target would not use the file, or could not: nothing is to be written that is silently useless.
        """

    def read(self, path: Path) -> list[ReadBack]:
        """Return the calibrations that a file of the target has; by default ConfigError: it cannot be read back."""
        raise ConfigError(f"import {self.kind}: {path} cannot be read back; only some forms can, as px4 and ardupilot")


HOUR, RISE = 3600.0, 900.0  # s: how long a warm-up lasts, and its time constant


def warm_up(domain: tuple[float, float]) -> Chunk:
    """Return an hour's warm-up over a domain (degC) at 1 Hz, with the channel `temperature`."""
    t, (low, high) = np.arange(HOUR + 1), domain
    return Chunk(t, {"temperature": np.clip(high - (high - low) * np.exp(-t / RISE), low, high)})


@dataclass(frozen=True)
class Deviation:
    """Rms and largest error (d,) of the values that the target gives, in the sensor's unit."""

    rms: Array
    largest: Array

    @classmethod
    def of(cls, error: Array) -> Self:
        """Return the deviation of errors (N, d)."""
        return cls(np.sqrt(np.mean(error**2, axis=0)), np.max(np.abs(error), axis=0))


@dataclass(frozen=True)
class MatrixLoss:
    """The error G(T) (I + M(T)) - I of the input over the domain, where the target takes G(T) (reading - bias) for it.

    Attributes
    ----------
    scale : Deviation
        Of its diagonal, parts of one.
    misalignment : Deviation
        Of the rest of each row, root of the sum of squares, rad.
    """

    scale: Deviation
    misalignment: Deviation

    @classmethod
    def measured(cls, sensor: Calibrated, gain: Callable[[Array], Array] | None = None) -> Self | None:
        """Measure it by G(T) (N, 3, 3); without `gain` the target holds nothing of M. None where there is no M."""
        if sensor.matrix is None:
            return None
        T, one = np.linspace(*sensor.fitted.domain, TEMPERATURES), np.eye(3)
        G = one if gain is None else gain(T)
        error = G @ (one + sensor.matrix.at(T)) - one
        across = np.sqrt(np.sum((error * (1 - one)) ** 2, axis=2))
        return cls(Deviation.of(np.diagonal(error, axis1=1, axis2=2)), Deviation.of(across))

    def as_json(self) -> dict[str, Any]:
        """Return the numbers, in ppm and mrad."""
        units = {"scale_ppm": (self.scale, 1e6), "misalignment_mrad": (self.misalignment, 1e3)}
        return {
            name: {what: (values * factor).tolist() for what, values in vars(deviation).items()}
            for name, (deviation, factor) in units.items()
        }

    def __str__(self) -> str:
        shown = ((self.scale, 1e6, "ppm of scale factor"), (self.misalignment, 1e3, "mrad of misalignment"))
        rows = [([float(f"{v * factor:.3g}") for v in lost.largest], what) for lost, factor, what in shown]
        return " and ".join(f"{'/'.join(f'{v:g}' for v in values)} {what}" for values, what in rows)


@dataclass(frozen=True)
class SensorLoss:
    """The loss of one sensor.

    Attributes
    ----------
    sensor : Calibrated
    domain, warm_up : Deviation
        Over the map's domain, and over an hour's warm-up with the effects that the sensor has.
    causes : mapping of str to Deviation
        Over the warm-up too: how much of it is from what, in words.
    flight : tuple of ((float, float), Deviation), or None
        Over the temperatures (degC) at which the unit is used, where they were given.
    matrix : MatrixLoss or None
        Of scale factor and misalignment; None where the map has none.
    """

    sensor: Calibrated
    domain: Deviation
    warm_up: Deviation
    causes: Mapping[str, Deviation] = field(default_factory=dict)
    flight: tuple[tuple[float, float], Deviation] | None = None
    matrix: MatrixLoss | None = None

    @classmethod
    def measured(
        cls,
        sensor: Calibrated,
        target: Callable[[Array], Array],
        running: Callable[[Chunk], Array] | None = None,
        causes: Mapping[str, Deviation] | None = None,
        flown: tuple[float, float] | None = None,
        gain: Callable[[Array], Array] | None = None,
    ) -> Self:
        """Measure the loss.

        Parameters
        ----------
        sensor : Calibrated
            With a map; effects that a warm-up does not show, as of other channels, do not count.
        target : function of T (N,) -> (N, d)
            What the target gives at rest at a temperature, in its own arithmetic.
        running : function of a Chunk -> (N, d), optional
            What it gives over a recording, where that is more than `target` of each temperature.
        causes : mapping of str to Deviation, optional
            What the loss over the warm-up is from.
        flown : (float, float), optional
            Temperatures within the domain at which the unit is used.
        gain : function of T (N,) -> (N, 3, 3), optional
            By which the target multiplies readings less their bias; without it scale factor and misalignment are lost.
        """
        domain = sensor.fitted.domain

        def over(ends: tuple[float, float]) -> Deviation:
            T = np.linspace(*ends, CLOSER * TEMPERATURES)
            return Deviation.of(target(T) - sensor.fitted.bias(T))

        recording = warm_up(domain)
        given = target(recording["temperature"]) if running is None else running(recording)
        return cls(
            sensor,
            over(domain),
            Deviation.of(given - seen_in_a_warm_up(sensor).bias(recording)),
            causes or {},
            None if flown is None else (flown, over(flown)),
            MatrixLoss.measured(sensor, gain),
        )

    def lines(self) -> list[str]:
        """Return the loss in words."""
        sensor = self.sensor
        low, high = sensor.fitted.domain
        warm_up = f"an hour's warm-up from {low:.4g} to {high:.4g} degC, time constant {RISE / 60:g} min"
        flight = () if self.flight is None else (self._over(*self.flight) + ", where it is used",)
        lines = [
            self._over(sensor.fitted.domain, self.domain),
            *flight,
            f"{self._whose}: loses {self._said(self.warm_up)} over {warm_up}",
            *(f"{self._whose}: of that, {what}: {self._said(deviation)}" for what, deviation in self.causes.items()),
        ]
        if self.matrix is not None:
            lines.append(f"{self._whose}: loses {self.matrix} at most over {low:.4g} to {high:.4g} degC")
        if (residual := self.residual) is not None:
            lines.append(f"{self._whose}: the map itself leaves {sensor.text(residual)} {sensor.shown} rms")
        return lines

    @property
    def residual(self) -> Array | None:
        """Rms (d,) that the map itself leaves, of averages where they are known; None: not known."""
        record = self.sensor.fitted.record
        rms = record.averaged_residual or record.residual
        return None if rms is None else np.asarray(rms)

    @property
    def _whose(self) -> str:
        """The sensor, and the order of the numbers of its axes."""
        sensor = self.sensor
        return sensor.channel if len(sensor.axes) == 1 else f"{sensor.channel} {'/'.join(sensor.axes)}"

    def _over(self, ends: tuple[float, float], deviation: Deviation) -> str:
        return f"{self._whose}: loses {self._said(deviation)} over {ends[0]:.4g} to {ends[1]:.4g} degC"

    def _said(self, deviation: Deviation) -> str:
        sensor = self.sensor
        return f"{sensor.text(deviation.rms)} {sensor.shown} rms, {sensor.text(deviation.largest)} at most"

    def as_json(self) -> dict[str, Any]:
        """Return the numbers in the sensor's SI unit, and in the unit in which they are shown."""
        sensor = self.sensor

        def in_shown_unit(deviation: Deviation) -> dict[str, Any]:
            return {name: (values * sensor.factor).tolist() for name, values in vars(deviation).items()}

        return {
            "channel": sensor.channel,
            "unit": sensor.shown,
            "axes": list(sensor.axes),
            "range": list(sensor.fitted.domain),
            "domain": in_shown_unit(self.domain),
            "warm_up": {"duration_s": HOUR, "time_constant_s": RISE, **in_shown_unit(self.warm_up)},
            "flight": None if self.flight is None else {"range": list(self.flight[0]), **in_shown_unit(self.flight[1])},
            "causes": {what: in_shown_unit(deviation) for what, deviation in self.causes.items()},
            **({} if self.matrix is None else {"matrix": self.matrix.as_json()}),
            "map_residual": None if self.residual is None else (self.residual * sensor.factor).tolist(),
        }


def causes(steps: Mapping[str, Array]) -> dict[str, Deviation]:
    """Return the deviation that each step of a chain of calculations adds.

    `steps` are values (N, d): the first what should be given, under any name; each further one under what makes it
    differ from the one before. A step that changes nothing is left out.
    """
    pairs = pairwise(steps.items())
    changes = {what: np.asarray(after, dtype=np.float64) - before for (_, before), (what, after) in pairs}
    return {what: Deviation.of(change) for what, change in changes.items() if np.any(change)}


def seen_in_a_warm_up(sensor: Calibrated) -> Calibrated:
    """Return the sensor with those effects alone that a warm-up shows: known ones, of temperature and time."""
    hidden = (e for e in sensor.effects if set(e.requires) - {"temperature"} or e.coefficients is None)
    return sensor.without(*hidden)


def beyond_a_map(sensor: Calibrated) -> tuple[Calibrated, tuple[str, ...]]:
    """Return the sensor with those effects that a warm-up shows, and what a target that holds a map alone leaves out.

    The latter in words, each with its size over the warm-up.
    """
    recording, visible = warm_up(sensor.fitted.domain), seen_in_a_warm_up(sensor)
    left_out = []
    for effect in sensor.effects:
        size = "of a size that a warm-up does not show"
        if effect in visible.effects:
            lost = Deviation.of(visible.bias(recording) - visible.without(effect).bias(recording))
            size = f"{sensor.text(lost.rms)} {sensor.shown} rms over a warm-up"
        left_out.append(f"{sensor.channel}: {effect.kind} of {effect.subject}, {size}")
    if sensor.walk is not None and np.any(sensor.walk):
        after = sensor.text(sensor.walk * np.sqrt(HOUR))
        left_out.append(f"{sensor.channel}: the random walk about it, {after} {sensor.shown} after an hour (1 sigma)")
    return visible, tuple(left_out)


@dataclass(frozen=True)
class Loss:
    """The loss of an export.

    Attributes
    ----------
    sensors : tuple of SensorLoss
        Of those whose maps leave; none where only noise does.
    left_out : tuple of str
        What the target cannot hold, in words.
    notes : tuple of str
        What the user has to know or do beside.
    """

    sensors: tuple[SensorLoss, ...] = ()
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return all of it in words, a line each: for the screen, and for comments of a file."""
        lost = [text for sensor in self.sensors for text in sensor.lines()]
        texts = [*lost, *(f"left out: {what}" for what in self.left_out), *(f"note: {what}" for what in self.notes)]
        return [line(text) for text in texts]

    def as_json(self) -> dict[str, Any]:
        """Return all of it for `loss.json`."""
        return {
            "loss": [sensor.as_json() for sensor in self.sensors],
            "left_out": list(self.left_out),
            "notes": list(self.notes),
        }
