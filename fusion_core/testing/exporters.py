"""The laws of exporters, on a unit that is made for them: a gyro and an accelerometer, with maps and noise.

Files that were written with hostile texts are compared with those of plain ones: the same lines, keys, cells and code.
Each is read as its target reads it: YAML and JSON by their readers, CSV as a spreadsheet does, C as a compiler sees it
(trigraphs, spliced lines, comments taken out), any other text by its lines. Of a file that is no text there is nothing
to compare but that it is there.
"""

from __future__ import annotations

import csv
import io
import json
import pickle
import re
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

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
from fusion_core.escaping import FORMULA, is_plain
from fusion_core.testing.samples import check_refused

LOW, HIGH = -10.0, 50.0
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class MadeMap(FittedMap):
    """A map about 20 degC, times `size`, in the unit of its record: gentle waves, or straight lines."""

    size: float = 1.0
    form: Literal["wavy", "straight", "holed"] = "wavy"

    def save(self, path: Path) -> None:
        """Raise: it is no map of a file."""
        raise NotImplementedError

    def _bias(self, T: Array) -> Array:
        x = (T - 20) / 30
        if self.form == "straight":
            return self.size * np.outer(x, [1.0, -0.5, 0.3])
        x = np.where(T > 40, np.nan, x) if self.form == "holed" else x
        return self.size * np.stack([x, x**2 - 0.3 * x, np.sin(2 * x)], axis=1)

    def _slope(self, T: Array) -> Array:
        return (self._bias(T + 1e-4) - self._bias(T - 1e-4)) / 2e-4


class Named(Effect):
    """An effect of a channel that the simulated warm-up lacks, with a term, called as somebody likes."""

    kind: Literal["named"] = "named"
    explanation: ClassVar = "The supply reaches the sensor's readout."
    channel: str = "voltage"

    @property
    def requires(self) -> tuple[str, ...]:
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
        fitted = MadeMap(record, size=size) if channel in mapped else None
        sensors.append(Calibrated(channel, si, shown, AXES, fitted, (), *densities))
    return Export(tuple(sensors), 200.0, "17")


UNITS = (("gyro", "accel"), ("gyro",), ("accel",))


def writes_what_it_says_it_writes(exporter: Exporter) -> None:
    """One file at the path, or some in the folder, and none beside; the loss is of the unit's sensors, and finite."""
    what = _accepted(exporter)
    loss, files = _written(exporter, what)
    assert files, "no file is written"
    assert all(files.values()), f"{', '.join(name for name, content in files.items() if not content)}: is empty"
    if not exporter.folder:
        name = f"unit{exporter.suffix}"
        assert list(files) == [name], f"{', '.join(files)} is written, {name} was asked for"
    for lost in loss.sensors:
        sensor = what.sensor(lost.sensor.channel)
        assert sensor is not None, f"a loss of {lost.sensor.channel} is reported, which the unit does not have"
        for deviation in (lost.domain, lost.warm_up, *lost.causes.values()):
            _check_deviation(deviation, len(sensor.axes))
    assert all(isinstance(line, str) and "\n" not in line for line in loss.lines()), "a line of the loss is no line"


def the_same_calibration_gives_the_same_bytes(exporter: Exporter) -> None:
    """The files depend on the calibration and the settings alone, not on the hour or the place."""
    what = _accepted(exporter)
    (_, first), (_, second) = (_written(exporter, what) for _ in range(2))
    differs = [name for name in first if first[name] != second.get(name)]
    assert not differs, f"{', '.join(differs)}: differs from export to export"


def what_it_is_given_is_not_changed(exporter: Exporter) -> None:
    """Neither the calibration nor the settings are changed by an export."""
    what, before = _accepted(exporter), exporter.model_copy(deep=True)
    known = _content(what)
    _written(exporter, what)
    assert _content(what) == known, "the calibration is changed"
    assert exporter == before, "the settings are changed"


def refuses_what_it_cannot_hold(exporter: Exporter) -> None:
    """Of a unit with neither map nor noise nothing is written, and ConfigError says so."""
    whole = unit()
    empty = replace(whole, sensors=tuple(replace(one, noise=None, walk=None) for one in whole.sensors))
    assert _written_or_refused(exporter, empty) is None, (
        "a unit with neither map nor noise is exported; raise ConfigError"
    )


def refuses_a_map_that_gives_no_number(exporter: Exporter) -> None:
    """A map that gives no number somewhere in its domain is refused with ConfigError, where maps leave at all."""
    what = _accepted(exporter)
    holed = (
        replace(one, map=replace(one.map, form="holed")) if isinstance(one.map, MadeMap) else one
        for one in what.sensors
    )
    written = _written_or_refused(exporter, replace(what, sensors=tuple(holed)))
    if written is not None:
        assert not written[0].sensors, "a map that gives no number is exported; use Export.mapped, which refuses it"


def takes_effects_that_a_warm__up_does_not_show(exporter: Exporter) -> None:
    """An effect of a channel that the simulated warm-up lacks is left out, or held; it is no reason to fail."""
    what = _accepted(exporter)
    effect = Named(coefficients=(1e-6, 2e-6, 3e-6))
    more = replace(what, sensors=tuple(replace(one, effects=(effect,)) for one in what.sensors))
    loss, _ = _written(exporter, more)
    for lost in loss.sensors:
        _check_deviation(lost.warm_up, len(lost.sensor.axes))


def what_is_read_back_is_what_was_written(exporter: Exporter) -> None:
    """The calibrations of a file that can be read back are the unit's, as far as the loss says; others are refused."""
    if type(exporter).read is Exporter.read:
        return
    what = _accepted(exporter)
    with tempfile.TemporaryDirectory() as folder:
        path = _path(exporter, Path(folder))
        loss = exporter.export(what, path)
        back = {again.channel: again for again in exporter.read(path)}
        other = Path(folder) / "other"
        other.write_bytes(b"\x00\x01 nothing of this kind \xff\n")
        text = "a file of another form is read; raise UnreadableFile or ConfigError"
        check_refused(FusionError, text, exporter.read, other)
    assert set(back) == {lost.sensor.channel for lost in loss.sensors}, f"{', '.join(back)} is read back"
    for lost in loss.sensors:
        again, fitted = back[lost.sensor.channel], lost.sensor.fitted
        T = np.linspace(*again.domain, 201)[1:-1]
        assert again.unit == lost.sensor.unit, f"{again.channel} is read back in {again.unit}"
        error = again.bias(T) - fitted.bias(np.clip(T, *fitted.domain))
        error = error - np.mean(error, axis=0)  # a level may be left to another place of the target
        allowed = 2.1 * lost.domain.largest + 1e-6 * np.max(np.abs(fitted.bias(T)), axis=0)
        assert np.all(np.abs(error) <= allowed), f"{again.channel} is read back {np.max(np.abs(error), axis=0)} off"


def a_text_is_data(exporter: Exporter) -> None:
    """A serial number, a channel, an axis, an effect or a provenance of any name makes no line, key or command more.

    Each such text is refused with ConfigError before anything is written, or what is written has the lines, keys,
    cells and code that it has with a plain text in its place.
    """
    what = _with_a_line(_accepted(exporter))
    for place, put in PLACES.items():
        written = _written_or_refused(exporter, put(what, PLAIN))
        if written is not None:
            before = {name: _skeleton(name, content) for name, content in written[1].items()}
            for text in HOSTILE:
                _check_text(exporter, put(what, text), before, place, text)


def _check_text(exporter: Exporter, what: Export, before: dict[str, Any], place: str, text: str) -> None:
    title = f"{place} {text[:60]!r}: "
    read_back = place == "channel" and type(exporter).read is not Exporter.read
    written = _written_or_refused(exporter, what, title, read_back=read_back)
    if written is not None:
        loss, files, channels = written
        _check_like(before, files, title)
        assert channels <= {text, "gyro", "accel"}, f"{title}is read back as {channels}"
        assert all(is_plain(line) for line in loss.lines()), f"{title}the loss has another line"


TRIGRAPHS = {"/": "\\", "'": "^", "(": "[", ")": "]", "<": "{", ">": "}", "=": "#", "!": "|", "-": "~"}
HOSTILE = (
    "a\nEVIL,1\n# ", "a\r\nEVIL 1", "\rEVIL 1", "a\x85EVIL: 1", "a\u2028EVIL: 1", "a\u2029EVIL: 1", "a\x0bEVIL: 1",
    "a\x1cEVIL 1", "\x00", "\x1b[2J\x1b]0;evil\x07", "\x9b31m", "\x7f", "\u202eevil\u202c", "a\u200bb", "\ufeff",
    "\ud800", "\U000e0041", '"', "'", "`", "\\", "a\\", "*/ int evil; /*", "*", "/", "//", "/* ", "??/", "*??/",
    "?>", "]]>", "--> <!--", "</script>", "<img src=x onerror=alert(1)>", "{{ 7 * 7 }}", "{% raw %}",
    "=cmd|' /C calc'!A1", "@SUM(1,1)", "+1", "-1", "a,=1+1", "a;=1+1", "a\t=1", "\uff1d1", "%", "%YAML:1.0", "#",
    "# a", "a: b", "- a", "&a", "*a", "!!python/object:os.system {}", "? a", "|", ">", "---", "...", "~", "null",
    "1e3", "0x10", " ", " a ", "a" * 5000, "\N{GRINNING FACE}", "\N{MICRO SIGN}\N{DEGREE SIGN}", "end", "int",
    "product", "driftlab", "../../evil", "/etc/passwd", "con", "a.b", "a" * 64,
)  # fmt: skip
PLAIN = "voltage"  # a text as most are


def _with_a_line(what: Export) -> Export:
    """Return a unit with one map, which is a line: it is exported in no time."""
    (first, *_) = what.mapped
    held = replace(first, map=MadeMap(first.fitted.record, size=1e-3, form="straight"))
    return replace(what, sensors=tuple(held if one is first else replace(one, map=None) for one in what.sensors))


def _changed(what: Export, recorded: dict[str, Any], **more: Any) -> Export:
    """Return a unit with other texts of its sensor and in its map's record: a plugin's own need not be checked."""

    def change(one: Calibrated) -> Calibrated:
        record = MapRecord.model_construct(**{**dict(one.fitted.record), **recorded})
        return replace(one, map=MadeMap(record, size=1e-3, form="straight"), **more)

    return replace(what, sensors=tuple(one if one.map is None else change(one) for one in what.sensors))


def _named(what: Export, text: str) -> Export:
    """Return a unit whose serial number, effect, kind of map and provenance are called so."""
    keys = ("instance", "calibration", "imu", "recordings", text)
    effect = Named(channel=text, coefficients=(1e-6, 2e-6, 3e-6))
    record = {"kind": text, "provenance": {**dict.fromkeys(keys, text), "device_id": "1310988"}}
    return replace(_changed(what, record, effects=(effect,)), serial=text)


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
            _written(exporter, unit(*mapped))
        except ConfigError as error:
            why = error
        else:
            return unit(*mapped)
    raise AssertionError(f"refuses a gyro and an accelerometer with maps and noise: {why}")


def _written(exporter: Exporter, what: Export) -> tuple[Loss, dict[str, bytes]]:
    with tempfile.TemporaryDirectory() as folder:
        return exporter.export(what, _path(exporter, Path(folder))), _files(Path(folder))


def _written_or_refused(
    exporter: Exporter, what: Export, title: str = "", *, read_back: bool = False
) -> tuple[Loss, dict[str, bytes], set[str]] | None:
    """Return the loss, the files and the channels that are read back of an export; None where it is refused."""
    with tempfile.TemporaryDirectory() as folder:
        path = _path(exporter, Path(folder))
        try:
            loss = exporter.export(what, path)
        except ConfigError:
            assert not _files(Path(folder)), f"{title}a file is written, and then refused"
            return None
        files, channels = _files(Path(folder)), {back.channel for back in exporter.read(path)} if read_back else set()
        return loss, files, channels


def _path(exporter: Exporter, folder: Path) -> Path:
    return folder if exporter.folder else folder / f"unit{exporter.suffix}"


def _files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _content(what: Export) -> bytes:
    """Return the content of a unit without its cached values."""
    T = np.linspace(LOW, HIGH, 101)
    sensors = [
        (one.channel, one.unit, one.shown, one.axes, one.effects, one.noise, one.walk)
        + (() if one.map is None else (one.map.record, one.map.outside, one.map.bias(T)))
        for one in what.sensors
    ]
    return pickle.dumps((sensors, what.rate, what.serial))


def _check_deviation(deviation: Deviation, d: int) -> None:
    for values in (deviation.rms, deviation.largest):
        assert np.shape(values) == (d,), f"a loss has shape {np.shape(values)}, ({d},) was expected"
        assert np.all(np.isfinite(values)), "a loss is not finite"
    assert np.all(deviation.rms <= deviation.largest * (1 + 1e-9)), "a loss's rms is larger than its largest"


def _skeleton(name: str, content: bytes) -> Any:
    """Return the form of a file without its texts: the same for all texts that are data alone."""
    try:
        whole = content.decode()
    except UnicodeDecodeError:
        return "no text"
    if "\x00" in whole:
        return "no text"
    of_form = FORMS.get(name.rpartition(".")[2])
    return len(whole.splitlines()), None if of_form is None else of_form(whole)


def _check_like(before: Mapping[str, Any], files: Mapping[str, bytes], title: str) -> None:
    """Raise AssertionError where files differ in more than a text from the skeletons of others."""
    assert len(files) == len(before), f"{title}{len(files)} files are written, {len(before)} with a plain text"
    for (other, wanted), (name, content) in zip(sorted(before.items()), sorted(files.items()), strict=True):
        assert is_plain(name), f"{title}a file is called {name!r}"
        form = _skeleton(name, content)
        assert form == wanted, f"{title}{name} has other lines, keys, cells or code than {other} with a plain text"
        if form != "no text":
            strange = [line for line in content.decode().split("\n") if not is_plain(line.replace("\t", " "))]
            assert not strange, f"{title}{name} has {strange[0]!r}"


def _keys(whole: str) -> Any:
    import yaml

    try:  # what OpenCV writes first is no directive of others
        return _shape(yaml.safe_load(whole.removeprefix("%YAML:1.0")))
    except yaml.YAMLError:
        return "no YAML"


def _shape(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _shape(value) for name, value in content.items()}
    return [_shape(value) for value in content] if isinstance(content, list) else type(content).__name__


def _cells(whole: str) -> list[tuple[bool, int]]:
    """Return the number of cells of each row, comments aside, and whether one is a formula."""
    rows = csv.reader(io.StringIO(whole, newline=""))
    formula = re.compile(rf"\s*[{FORMULA}](?![\d.])")
    return [
        (any(formula.match(cell) for cell in row), 0 if row and row[0].startswith("#") else len(row)) for row in rows
    ]


def _code(whole: str) -> str:
    """Return C without comments, its words all alike."""
    for letter, sign in TRIGRAPHS.items():
        whole = whole.replace(f"??{letter}", sign)
    spliced = re.sub(r"\\[ \t]*\n", "", whole)
    bare = re.sub(r'("(?:\\.|[^"\\\n])*")|/\*.*?\*/|//[^\n]*', lambda match: match[1] or " ", spliced, flags=re.DOTALL)
    return re.sub(r"[\w.+-]+", "w", bare)


def _plain_lines(whole: str) -> list[str]:
    """Return the lines that are no comments."""
    return [line for line in whole.splitlines() if not line.startswith("#")]


FORMS = {
    "yaml": _keys, "yml": _keys, "json": lambda whole: _shape(json.loads(whole)), "csv": _cells, "c": _code, "h": _code,
    "params": _plain_lines, "parm": _plain_lines,
}  # fmt: skip
