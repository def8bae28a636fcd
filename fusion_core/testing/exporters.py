"""The laws of exporters, on a unit that is made for them: a gyro and an accelerometer, with maps and noise.

What is written of hostile texts is read as its target reads it, in `fusion_core.testing.written`.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import (
    Calibrated,
    Deviation,
    Effect,
    Export,
    Exporter,
    FittedMap,
    Loss,
    MapRecord,
    Memory,
    on_each_axis,
)
from fusion_core.contracts.effect import Reading, Signal
from fusion_core.errors import ConfigError, FusionError
from fusion_core.escaping import is_plain
from fusion_core.testing.written import HOSTILE, check_like, skeleton

LOW, HIGH = -10.0, 50.0
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class WavyMap(FittedMap):
    """A map of straight lines and gentle waves about 20 degC, times `size`, in the unit of its record."""

    size: float = 1.0

    def save(self, path: Path) -> None:
        """Raise: it is no map of a file."""
        raise NotImplementedError

    def _bias(self, T: Array) -> Array:
        x = (T - 20) / 30
        return self.size * np.stack([x, x**2 - 0.3 * x, np.sin(2 * x)], axis=1)

    def _slope(self, T: Array) -> Array:
        x = (T - 20) / 30
        return self.size / 30 * np.stack([np.ones_like(x), 2 * x - 0.3, 2 * np.cos(2 * x)], axis=1)


class Holed(WavyMap):
    """The same with no number above 40 degC."""

    def _bias(self, T: Array) -> Array:
        return np.where(T[:, None] > 40, np.nan, super()._bias(T))


class StraightMap(WavyMap):
    """A map of straight lines."""

    def _bias(self, T: Array) -> Array:
        return self.size * np.outer((T - 20) / 30, [1.0, -0.5, 0.3])

    def _slope(self, T: Array) -> Array:
        return np.broadcast_to(self.size / 30 * np.array([1.0, -0.5, 0.3]), (len(T), 3))


class Supply(Effect):
    """A bias that follows the supply voltage."""

    kind: Literal["supply"] = "supply"
    requires: ClassVar = ("voltage",)
    explanation: ClassVar = "The supply reaches the sensor's readout."

    def candidates(self) -> Iterator[Self]:
        """Yield itself."""
        yield self

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the voltage."""
        return on_each_axis(chunk["voltage"], len(self.axes)), memory


class Named(Supply):
    """An effect of a channel, with terms and hyper-parameters, that are called as somebody likes."""

    kind: Literal["named"] = "named"  # type: ignore[assignment]
    channel: str = "voltage"

    @property
    def requires(self) -> tuple[str, ...]:  # type: ignore[override]
        """The channel."""
        return (self.channel,)

    @property
    def terms(self) -> tuple[str, ...]:
        """As the channel."""
        return (self.channel,)

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the channel."""
        return on_each_axis(chunk[self.channel], len(self.axes)), memory

    def realisation(self) -> tuple[Signal, ...]:
        """Return the channel, as firmware would read it."""
        return (Reading(self.channel),)


def unit(*mapped: str) -> Export:
    """Return a unit of gyro and accelerometer, both with noise, of which those that are named have a map."""
    sensors = []
    for channel, si, shown, size in (("gyro", "rad/s", "deg/h", 1e-3), ("accel", "m/s^2", "mg", 0.02)):
        record = MapRecord(
            kind="curve",
            domain=(LOW, HIGH),
            channel=channel,
            unit=si,
            axes=AXES,
            residual=(size / 100,) * 3,
            provenance={"device_id": "1310988"},
        )
        densities = size * np.array([0.1, 0.2, 0.15]), size * np.array([2e-3, 1e-3, 3e-3])
        fitted = WavyMap(record, size=size) if channel in mapped else None
        sensors.append(Calibrated(channel, si, shown, AXES, fitted, (), *densities))
    return Export(tuple(sensors), 200.0, "17")


UNITS = (("gyro", "accel"), ("gyro",), ("accel",))


def writes_what_it_says_it_writes(exporter: Exporter) -> None:
    """One file at the path, or some in the folder, and none beside; the loss is of the unit's sensors, and finite."""
    what = _accepted(exporter)
    with tempfile.TemporaryDirectory() as folder:
        loss, found = _written(exporter, what, Path(folder))
        assert found, "no file is written"
        assert all(found.values()), f"{', '.join(name for name, content in found.items() if not content)}: is empty"
        if not exporter.folder:
            assert list(found) == [_name(exporter)], f"{', '.join(found)} is written, {_name(exporter)} was asked for"
    for lost in loss.sensors:
        own = what.sensor(lost.sensor.channel)
        assert own is not None, f"a loss of {lost.sensor.channel} is told, which the unit has not"
        for deviation in (lost.domain, lost.warm_up, *lost.causes.values()):
            _check_deviation(deviation, len(own.axes))
    assert all(isinstance(line, str) and "\n" not in line for line in loss.lines()), "a line of the loss is no line"


def same_calibration_gives_the_same_bytes(exporter: Exporter) -> None:
    """What is written depends on the calibration and the settings alone, not on the hour or the place."""
    what = _accepted(exporter)
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        (_, first), (_, second) = (_written(exporter, what, Path(folder)) for folder in (one, other))
    differs = [name for name in first if first[name] != second.get(name)]
    assert not differs, f"{', '.join(differs)}: differs from export to export"


def what_it_is_given_is_not_changed(exporter: Exporter) -> None:
    """Neither the calibration nor the settings are changed by an export."""
    what, before = _accepted(exporter), exporter.model_copy(deep=True)
    known = _content(what)
    with tempfile.TemporaryDirectory() as folder:
        _written(exporter, what, Path(folder))
    assert _content(what) == known, "the calibration is changed"
    assert exporter == before, "the settings are changed"


def refuses_what_it_cannot_hold(exporter: Exporter) -> None:
    """Of a unit with neither map nor noise nothing is written, and ConfigError says so."""
    whole = unit()
    empty = replace(whole, sensors=tuple(replace(one, noise=None, walk=None) for one in whole.sensors))
    with tempfile.TemporaryDirectory() as folder:
        try:
            _written(exporter, empty, Path(folder))
        except ConfigError:
            assert not list(_files(Path(folder))), "a file is written, and then refused"
        else:
            raise AssertionError("a unit with neither map nor noise is exported; raise ConfigError")


def refuses_a_map_that_gives_no_number(exporter: Exporter) -> None:
    """Where a map leaves, ConfigError says of one that gives no number somewhere in its domain that it does not."""
    what = _accepted(exporter)
    holed = [
        one if one.map is None else replace(one, map=Holed(one.map.record, size=one.map.size))
        for one in what.sensors
        if one.map is None or isinstance(one.map, WavyMap)
    ]
    with tempfile.TemporaryDirectory() as folder:
        try:
            loss, _ = _written(exporter, replace(what, sensors=tuple(holed)), Path(folder))
        except ConfigError:
            assert not list(_files(Path(folder))), "a file is written, and then refused"
        else:
            assert not loss.sensors, "a map that gives no number is exported; use Export.mapped, which refuses it"


def takes_effects_that_a_warm_up_does_not_show(exporter: Exporter) -> None:
    """An effect of a channel that the simulated warm-up lacks is left out, or held; it is no reason to fail."""
    what = _accepted(exporter)
    effect = Supply.model_validate({"kind": "supply", "coefficients": [1e-6, 2e-6, 3e-6]})
    more = replace(what, sensors=tuple(replace(one, effects=(effect,)) for one in what.sensors))
    with tempfile.TemporaryDirectory() as folder:
        loss, _ = _written(exporter, more, Path(folder))
    for lost in loss.sensors:
        _check_deviation(lost.warm_up, len(lost.sensor.axes))


def what_is_read_back_is_what_was_written(exporter: Exporter) -> None:
    """Where a file can be read back, its calibrations are the unit's, as far as the loss says; others are refused."""
    if type(exporter).read is Exporter.read:
        return
    what = _accepted(exporter)
    with tempfile.TemporaryDirectory() as folder:
        loss, _ = _written(exporter, what, Path(folder))
        path = Path(folder) / ("" if exporter.folder else _name(exporter))
        back = {found.channel: found for found in exporter.read(path)}
        other = Path(folder) / "other"
        other.write_bytes(b"\x00\x01 nothing of this kind \xff\n")
        try:
            exporter.read(other)
        except FusionError:
            pass
        else:
            raise AssertionError("a file of another form is read; raise UnreadableFile or ConfigError")
    assert set(back) == {lost.sensor.channel for lost in loss.sensors}, f"{', '.join(back)} is read back"
    for lost in loss.sensors:
        found, fitted = back[lost.sensor.channel], lost.sensor.fitted
        T = np.linspace(*found.domain, 201)[1:-1]
        assert found.unit == lost.sensor.unit, f"{found.channel} is read back in {found.unit}"
        error = found.bias(T) - fitted.bias(np.clip(T, *fitted.domain))
        error = error - np.mean(error, axis=0)  # a level may be left to another place of the target
        allowed = 2.1 * lost.domain.largest + 1e-6 * np.max(np.abs(fitted.bias(T)), axis=0)
        assert np.all(np.abs(error) <= allowed), f"{found.channel} is read back {np.max(np.abs(error), axis=0)} off"


def a_text_is_data(exporter: Exporter) -> None:
    """Whatever a serial number, a channel, an axis, an effect or a provenance is called, no line, key or command more.

    Each such text is refused with ConfigError before anything is written, or what is written has the lines, keys,
    cells and code that it has with a plain text in its place.
    """
    what = _with_a_line(_accepted(exporter))
    for place, put in PLACES.items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                _, files = _written(exporter, put(what, PLAIN), Path(folder))
            except ConfigError:
                continue
        before = {name: skeleton(name, content) for name, content in files.items()}
        for text in HOSTILE:
            _check_text(exporter, put(what, text), before, place, text)


def _check_text(exporter: Exporter, what: Export, before: dict[str, Any], place: str, text: str) -> None:
    said = f"{place} {text[:60]!r}"
    with tempfile.TemporaryDirectory() as folder:
        try:
            loss, found = _written(exporter, what, Path(folder))
        except ConfigError:
            assert not list(_files(Path(folder))), f"{said}: a file is written, and then refused"
            return
        check_like(before, found, said)
        if place == "channel" and type(exporter).read is not Exporter.read:
            back = {one.channel for one in exporter.read(Path(folder) / ("" if exporter.folder else _name(exporter)))}
            assert back <= {text, "gyro", "accel"}, f"{said}: is read back as {back}"
    assert all(is_plain(line) for line in loss.lines()), f"{said}: the loss has another line"


PLAIN = "voltage"  # a text as most are


def _with_a_line(what: Export) -> Export:
    """Return a unit with one map, which is a line: it is exported in no time."""
    (first, *_) = what.mapped
    held = replace(first, map=StraightMap(first.fitted.record, size=1e-3))
    return replace(what, sensors=tuple(held if one is first else replace(one, map=None) for one in what.sensors))


def _changed(what: Export, recorded: dict[str, Any], **more: Any) -> Export:
    """Return a unit with other texts of its sensor and in its map's record: a plugin's own need not be checked."""

    def change(one: Calibrated) -> Calibrated:
        record = MapRecord.model_construct(**{**dict(one.fitted.record), **recorded})
        return replace(one, map=StraightMap(record, size=1e-3), **more)

    return replace(what, sensors=tuple(one if one.map is None else change(one) for one in what.sensors))


def _named(what: Export, text: str) -> Export:
    """Return a unit whose serial number, effect, kind of map and provenance are called so."""
    told = ("instance", "calibration", "imu", "recordings", text)
    effect = Named(channel=text, coefficients=(1e-6, 2e-6, 3e-6))
    said = {"kind": text, "provenance": {**dict.fromkeys(told, text), "device_id": "1310988"}}
    return replace(_changed(what, said, effects=(effect,)), serial=text)


PLACES: dict[str, Callable[[Export, str], Export]] = {
    "name": _named,
    "channel": lambda what, text: _changed(what, {"channel": text}, channel=text),
    "axis": lambda what, text: _changed(what, {"axes": (text, "y", "z")}, axes=(text, "y", "z")),
    "device": lambda what, text: _changed(what, {"provenance": {"device_id": text}}),
}


def _accepted(exporter: Exporter) -> Export:
    """Return a unit that the exporter takes: with both maps, or one."""
    for mapped in UNITS:
        try:
            with tempfile.TemporaryDirectory() as folder:
                _written(exporter, unit(*mapped), Path(folder))
        except ConfigError as error:
            why = error
        else:
            return unit(*mapped)
    raise AssertionError(f"refuses a gyro and an accelerometer with maps and noise: {why}")


def _written(exporter: Exporter, what: Export, folder: Path) -> tuple[Loss, dict[str, bytes]]:
    loss = exporter.export(what, folder if exporter.folder else folder / _name(exporter))
    return loss, {path.name: path.read_bytes() for path in _files(folder)}


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _content(what: Export) -> bytes:
    """Return what a unit says of itself, but for what it has worked out on the way."""
    T = np.linspace(LOW, HIGH, 101)
    said = [
        (one.channel, one.unit, one.shown, one.axes, one.effects, one.noise, one.walk)
        + (() if one.map is None else (one.map.record, one.map.outside, one.map.bias(T)))
        for one in what.sensors
    ]
    return pickle.dumps((said, what.rate, what.serial))


def _name(exporter: Exporter) -> str:
    return f"unit{exporter.suffix}"


def _check_deviation(found: Deviation, d: int) -> None:
    for values in (found.rms, found.largest):
        assert np.shape(values) == (d,), f"a loss has shape {np.shape(values)}, ({d},) was expected"
        assert np.all(np.isfinite(values)), "a loss is not finite"
    assert np.all(found.rms <= found.largest * (1 + 1e-9)), "a loss's rms is larger than its largest"


LAWS = {
    "writes what it says it writes": writes_what_it_says_it_writes,
    "the same calibration gives the same bytes": same_calibration_gives_the_same_bytes,
    "what it is given is not changed": what_it_is_given_is_not_changed,
    "refuses what it cannot hold": refuses_what_it_cannot_hold,
    "refuses a map that gives no number": refuses_a_map_that_gives_no_number,
    "takes effects that a warm-up does not show": takes_effects_that_a_warm_up_does_not_show,
    "what is read back is what was written": what_is_read_back_is_what_was_written,
    "a text is data": a_text_is_data,
}
