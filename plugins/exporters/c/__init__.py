"""C99 without libraries, for firmware of one's own: `<channel>_bias.h`, `.c` and a self-test for each sensor.

::

    gyro_bias(T)         the map, as straight lines between knots; beyond its domain its value there
    gyro_bias_step(...)  the same with what effects add, their memories in a struct
    gyro_input(...)      a reading less its bias, scale factor and misalignment, where the map has them

The loss is measured in the code's own arithmetic, bit for bit: `emulation`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Calibrated, Deviation, Export, Exporter, Loss, SensorLoss, warm_up
from fusion_core.errors import ConfigError, quote
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit, same_dimension
from fusion_plugins.exporters.c.program import MAX_KNOTS, Program, channels_of, program_of, why_not

_OF_KNOWN = 0.1  # of what the map itself is good to: the loss where none is set
_OF_SWING = 1e-4  # at least
_PLACES = 200  # at which that is looked up


@hookimpl
class C99(Exporter):
    """C99 with a table of knots, its memories in a struct."""

    folder: ClassVar[bool] = True

    kind: Literal["c"] = "c"
    loss: Annotated[float, Unit("bias", positive=True, example="1 deg/h")] | None = None
    """Largest error of the straight lines; without it a tenth of what the map itself is good to."""

    knots: Literal["smallest", "float"] = "smallest"
    """As what knots are kept: 16-bit integers with a scale where these are fine enough for the loss, or float."""

    def export(self, what: Export, path: Path) -> Loss:
        """Write header, source and self-test of each sensor that has a map."""
        from fusion_plugins.exporters.c.text import identifier

        losses: list[Loss] = []
        channels = [sensor.channel for sensor in what.mapped]
        if len({identifier(channel).lower() for channel in channels}) < len(channels):
            have = ", ".join(map(quote, channels))
            raise ConfigError(f"export {self.kind}: {have} have one name in C; name one of the channels otherwise")
        files: dict[str, str] = {}
        for sensor in what.mapped:
            self._check_unit(sensor)
            loss, texts = self._export(sensor, what.serial)
            losses.append(loss)
            files |= texts
        for name, text in files.items():  # all, or none
            (path / name).write_text(text, encoding="utf-8")
        return Loss(*(tuple(item for loss in losses for item in getattr(loss, name)) for name in vars(losses[0])))

    def _export(self, sensor: Calibrated, serial: str) -> tuple[Loss, dict[str, str]]:
        """Return the loss of a sensor, and the text of its files by their names."""
        from fusion_plugins.exporters.c.text import files

        left = [(effect, reason) for effect in sensor.effects if (reason := why_not(effect)) is not None]
        held = sensor.without(*(effect for effect, _ in left))
        program = self._program(held)
        loss = Loss(
            (self._measured(sensor, held, program),),
            tuple(f"{sensor.channel}: {effect.kind}: {reason}" for effect, reason in left),
            tuple(self._notes(held)),
        )
        size = sum(table.size for table in program.lookups)
        effects = [f"{effect.kind} of {effect.subject}" for effect in held.effects]
        knots = " and ".join(str(len(table.knots)) for table in program.lookups)
        comment = [
            *([f"Unit {serial}."] if serial else []),
            f"A {sensor.fitted.record.kind} map as straight lines between {knots} knots, {size} bytes.",
            *([f"With effects: {', '.join(effects)}."] if effects else []),
            "",
            *loss.lines(),
        ]
        return loss, files(held, program, comment)

    def _check_unit(self, sensor: Calibrated) -> None:
        unit = self.loss.unit if isinstance(self.loss, Quantity) else None
        if unit and not same_dimension(unit, sensor.unit):
            raise ConfigError(
                f"export {self.kind}: loss {self.loss.text} is no {sensor.unit}, the unit of {sensor.channel}; "  # type: ignore[union-attr]
                f"write e.g. --set 'loss=1 {sensor.shown}'"
            )

    def _program(self, sensor: Calibrated) -> Program:
        loss = usual_loss(sensor) if self.loss is None else np.full(len(sensor.axes), float(self.loss))
        program = program_of(sensor, loss, floats=self.knots == "float")
        if program is None:
            limits = " / ".join(f"{value * sensor.factor:.3g}" for value in loss)
            raise ConfigError(
                f"export {self.kind}: {MAX_KNOTS} knots leave more of {sensor.channel} than {limits} {sensor.shown}; "
                "set a larger loss"
            )
        return program

    def _measured(self, sensor: Calibrated, held: Calibrated, program: Program) -> SensorLoss:
        """Measure what the program of `held` loses of `sensor`, without effects of channels that a warm-up lacks."""
        from fusion_plugins.exporters.c.emulation import at_rest, gain, run

        here = [effect for effect in sensor.effects if not channels_of(effect)]
        known = replace(sensor, effects=tuple(here))
        if len(here) < len(sensor.effects):
            program = self._program(replace(held, effects=tuple(effect for effect in here if effect in held.effects)))

        def resting(T: Array) -> Array:
            return at_rest(program, T.astype(np.float32)).astype(np.float64)

        def running(chunk: Chunk) -> Array:
            dt = np.broadcast_to(chunk.dt, chunk.t.shape).astype(np.float32)
            channels = {name: values.astype(np.float32) for name, values in chunk.channels.items()}
            return run(program, dt, channels).astype(np.float64)

        recording = warm_up(sensor.fitted.domain)
        whole = known.bias(recording)
        causes = {
            f"{effect.kind}, which is left out": Deviation.of(whole - known.without(effect).bias(recording))
            for effect in here
            if effect not in held.effects
        }
        return SensorLoss.measured(known, resting, running, causes, gain=partial(gain, program))

    def _notes(self, sensor: Calibrated) -> Iterator[str]:
        low, high = sensor.fitted.domain
        yield f"{sensor.channel}: beyond {low:.4g} to {high:.4g} degC the bias is that of the nearer end"
        for effect in sensor.effects:
            channels = " and ".join(sorted(channels_of(effect)))
            if channels:
                yield f"{sensor.channel}: {effect.kind} of {channels} is in the code; the warm-up has no such channel"


def usual_loss(sensor: Calibrated) -> Array:
    """Return a tenth (d,) of the deviation of the map's curve, or of its residual where the map does not tell."""
    fitted = sensor.fitted
    T = np.linspace(*fitted.domain, _PLACES)
    known = np.sqrt(np.mean(fitted.sigma(T) ** 2, axis=0))
    swing = np.ptp(fitted.bias(T), axis=0)
    largest = np.maximum(np.max(swing), np.finfo(np.float32).tiny)
    return np.asarray(np.maximum(_OF_KNOWN * known, _OF_SWING * largest))
