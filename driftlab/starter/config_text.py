"""The text of a starter config, with notes on guesses and on the places to be filled in."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from driftlab.noise.quick import QuickNoise
from driftlab.starter.columns import Channels, GuessedChannel, of_accel
from driftlab.starter.names import TRIADS, Name, read_name
from driftlab.starter.reading import FileColumns, FoundFraming
from fusion_core.chunk import Array
from fusion_core.escaping import line, yaml_text
from fusion_core.units import convert, same_dimension

SITE = "# latitude: 40.9 deg      # of the site: takes the Earth's rate out of the bias, at most 15 deg/h"
DENSITIES = {"gyro": ("deg/h", "deg/s", 36.0), "accel": ("ug", "mg", 1000.0)}  # small, large, and from where on
UNITS_OF = {
    "time": ("s", "ms", "us", "ns"), "gyro": ("deg/s", "rad/s", "deg/h", "mdeg/s"), "accel": ("g", "m/s^2", "mg"),
    "temperature": ("degC", "degF", "K"),
}  # fmt: skip  # that are usual
FASTEST = 0.1  # s between epochs
QUIET = 20.0  # times less noise than the others of a triad: more than sensors of one kind differ by
FLAGS = {"status", "state", "valid", "ok", "flag", "flags", "err", "error", "good", "quality"}  # words of their names
SOUND = {"valid", "ok", "good"}  # those of which 0 says that a row is none
FEW = 5  # values of a flag, at most
AXES = tuple(str.maketrans("xX", pair) for pair in ("xX", "yY", "zZ"))


class OpenQuestion(NamedTuple):
    """A question to the user: the option that answers it, of which channel, its words, and answers, the guess first."""

    option: str
    field: str
    text: str
    choices: tuple[str, ...]
    needed: bool = True


DOUBTED = {"decimal": "the decimal sign", "dates": "what stands first in dates"}
APART = OpenQuestion("interval", "", "the interval between rows: no column is a time", ("10 ms", "20 ms", "1 s"))


@dataclass(frozen=True)
class Starter:
    """A config as text, and the places to be filled in, a sentence each; `questions` a person can be asked.

    `problems` are columns of sensors that hold no numbers.
    """

    text: str
    asked: tuple[str, ...]
    questions: tuple[OpenQuestion, ...] = ()
    problems: tuple[str, ...] = ()


def of_columns(path: str, name: str, columns: FileColumns, channels: Channels, map_name: str) -> Starter:
    """Return the config of a file with named columns; `path` is the file's, from the config's folder."""
    held = held_of(columns, channels)
    questions = tuple(_questions(columns, channels))
    if held is not None and not (question := of_a_sensor(columns)).needed:
        questions = (question, *questions)
    asked = [question.text for question in questions if question.needed]
    asked += _noises(channels) if held is None else ()
    lines = [*_about(name, columns, channels), "source:", f"  kind: {columns.kind}", f"  path: {yaml_text(path)}"]
    guessed = {key: f"   # guess: {doubt.why}" for key, doubt in columns.doubts.items()}
    settings = ((key, json.dumps(value, ensure_ascii=False)) for key, value in columns.settings.items())
    lines += [f"  {key}: {text}{guessed.get(key, '')}" for key, text in settings]
    if "time" not in channels.found and "interval" not in columns.settings:
        apart = _apart(columns, channels)
        why = apart.text.partition(": ")[2]
        lines.append(f"  # interval: {apart.choices[0]}       # fill in: {why}, so how far are the rows apart?")
    lines.append("  channels:")
    lines += [_channel(field, channel) for field, channel in channels.found.items()]
    if held is not None:
        note = "# guess: the sensor, since no column is a gyro; correct its unit"
        place = f"{{path: {yaml_text(held.path)}, unit: {yaml_text(_held_unit(held))}}}"
        lines.append(f"    {yaml_text(_key(held.path))}: {place}   {note}")
    lines += [_auxiliary(other, columns) for other in channels.others if other != held]
    lines += [_not_read(path, why, columns) for path, why in columns.unread.items()]
    lines += [] if held else [SITE]
    lines += _filter(channels, map_name) if held is None else _held_filter(held, channels)
    return _starter(lines, asked, questions, [*unread_of(columns, channels), *_quiet(channels)])


def of_product(path: str, name: str, product: str, map_name: str) -> Starter:
    """Return the config of a file that a product's source reads; `map_name` is its map's, once fitted."""
    lines = [f"# From {name}. Noise and walk of {product} are guesses for such units: see `driftlab allan`."]
    lines += [f"extends: {product}", f"source: {{path: {yaml_text(path)}}}", SITE]
    lines += ["# filter:                 # with the lines below, once `driftlab fit-map` has made the map"]
    lines += [f"#   gyro: {{calibration: {{kind: spline, path: {yaml_text(map_name)}}}}}"]
    return _starter(lines)


def with_map(text: str, kind: str, path: str) -> str:
    """Return the config with the map that it has a comment for; one without that comment stays as it is."""
    calibration = f"calibration: {{kind: {kind}, path: {yaml_text(path)}}}"
    text = re.sub(r"(?m)^( +)# calibration: \{kind: .*", lambda found: found[1] + calibration, text)
    return re.sub(r"(?m)^# filter: .*\n#   gyro: .*", lambda _: f"filter:\n  gyro: {{{calibration}}}", text)


def of_frames(path: str, name: str, frames: FoundFraming, channels: Channels | None, map_name: str) -> Starter:
    """Return the config of a file of bytes in which a framing finds frames; `channels` where their time is known."""
    lines = [f"# From {name}: {frames.count:,} whole frames in its first bytes."]
    lines += [f"extends: {frames.product}   # guess: it finds them"] if frames.product else []
    lines += ["source:", f"  kind: {frames.source}", f"  path: {yaml_text(path)}"]
    asked, questions = [] if channels is None else list(_noises(channels)), tuple[OpenQuestion, ...]()
    if channels is None:
        questions = (APART._replace(text="the interval between samples: the frames have no clock"),)
        asked = [questions[0].text]
        lines.append("  # interval: 10 ms       # fill in: between samples, as the device is set")
        channels = Channels({}, {}, (), None)
    elif frames.interval is not None:
        lines.append(f"  interval: {frames.interval}")
    if not frames.product:
        settings = frames.framing.model_dump(mode="json", exclude_defaults=True)
        known = (key for key in settings if key != "interval" or channels.found)
        text = "".join(f", {key}: {json.dumps(settings[key])}" for key in known)
        lines.append(f"  framing: {{kind: {frames.framing.kind}{text}}}   # guess: it finds frames")
    lines += [SITE, *_filter(channels, map_name)]
    return _starter(lines, asked, questions)


def _starter(
    lines: list[str], asked: Sequence[str] = (), questions: tuple[OpenQuestion, ...] = (), problems: Sequence[str] = ()
) -> Starter:
    """Return a config of lines; a name of a stranger's file begins no other."""
    return Starter("\n".join(map(line, lines)) + "\n", tuple(map(line, asked)), questions, tuple(map(line, problems)))


def _about(name: str, columns: FileColumns, channels: Channels) -> Iterator[str]:
    rows = len(next(iter(columns.values.values()), ()))
    count = f"the first {rows:,} rows" if columns.more else f"{rows:,} rows"
    gyro = channels.found.get("gyro")
    of = ", the gyro's" if gyro is not None and np.mean(np.isfinite(gyro.values)) <= 0.5 else ""
    rate = f"{of} at {1 / channels.step:.4g} Hz" if channels.step else ""
    yield f"# From {name}: {count}{rate}."
    yield "# Lines with `guess` stand on names and values alone: look at each, then run `driftlab check` on this file."


def _questions(columns: FileColumns, channels: Channels) -> Iterator[OpenQuestion]:
    for option, doubt in columns.doubts.items():
        yield OpenQuestion(option, "", f"{DOUBTED[option]}: {doubt.why}", doubt.ways, needed=False)
    if "time" not in channels.found and "interval" not in columns.settings:
        yield _apart(columns, channels)
    for field, channel in channels.found.items():
        if channel.guessed:
            choices = tuple(dict.fromkeys(filter(None, [channel.unit, *UNITS_OF[field]])))
            text = f"the unit of {field} ({channel.why})"
            yield OpenQuestion("units", field, text, choices, needed=channel.unit is None)


def _apart(columns: FileColumns, channels: Channels) -> OpenQuestion:
    """Return the question for the interval: a guess where a time changes once in many rows."""
    for name in (name for name in channels.others if name.quantity == "time"):
        steps = np.diff(columns.values[name.path])
        at = np.flatnonzero(steps)
        if len(at) > 2 and np.all(steps[at] > 0) and (rows := float(np.median(np.diff(at)))) > 1:
            text = f"the interval between rows: '{name.path}' stays the same over some {rows:.0f} rows"
            guess = float(np.median(steps[at])) / rows
            return APART._replace(text=text, choices=(f"{guess:.6g} s", *APART.choices))
    return APART


def unread_of(columns: FileColumns, channels: Channels | None) -> list[str]:
    """Return sentences on cells that are no numbers, of columns that a channel lacks; the first without channels."""
    if channels is None:
        return list(columns.unread.values())[:1]
    found = []
    for path, why in columns.unread.items():
        name = read_name(path)
        channel = channels.found.get(name.quantity or "")
        if name.quantity == "time":
            cell = why.partition(" is not a number")[0]
            why = f"{cell} is neither a number nor a date that is known; write dates as 2026-03-14 09:00:00"
        part = name.axis is not None and channel is not None and channel.values.shape[1] < 3
        if name.quantity is not None and (channel is None or part):
            found.append(why)
    return found


def of_a_sensor(columns: FileColumns) -> OpenQuestion:
    """Return the question for the gyro's columns; three that differ by the axis alone are the guess."""
    known = columns.values
    triads = [triad for path in known if len(triad := {path.translate(axis): 0 for axis in AXES}.keys() & known) == 3]
    triads.sort(
        key=lambda triad: of_accel(np.nan_to_num(np.column_stack([known[p] for p in sorted(triad)]))).unit is not None
    )
    choices = (*[",".join(sorted(triad)) for triad in triads[:1]], *known)
    text = "the columns of the gyro's axes: no name says which they are"
    return OpenQuestion("columns", "gyro", text, choices, needed=not triads)


def _noises(channels: Channels) -> Iterator[str]:
    for field in TRIADS:
        if field in channels.found and field not in channels.noise:
            yield f"the noise of {field}: no quiet stretch with a known time was found"


def _channel(field: str, channel: GuessedChannel) -> str:
    path = yaml_text(channel.paths[0]) if len(channel.paths) == 1 else f"[{', '.join(map(yaml_text, channel.paths))}]"
    if channel.unit is None:
        return f"    {field}: {{path: {path}}}   # fill in unit: {channel.why}"
    note = f"   # guess: {channel.why}" if channel.guessed else f"   # {channel.why}" if channel.why else ""
    return f"    {field}: {{path: {path}, unit: {yaml_text(channel.unit)}}}{note}"


def _auxiliary(name: Name, columns: FileColumns) -> str:
    """Return a comment on a column of numbers that is not read; of a flag, how many rows it would leave out."""
    values = columns.values[name.path]
    if _is_flag(name.path) and values.ndim == 1 and len(np.unique(values)) <= FEW:
        share, sound = f"{100 * float(np.mean(values == 0)):.3g} % of these", not SOUND.isdisjoint(_words(name.path))
        left_out = f"leaves out the rows in which it is 0, {share}" + ("" if sound else ": where 0 is no reading")
        return f"    # valid: {{path: {yaml_text(name.path)}}}   # {left_out}"
    unit = name.unit or columns.units.get(name.path)
    known = f", unit: {yaml_text(unit)}" if unit is not None and _is_unit(unit) else ""
    return f"    # {yaml_text(_key(name.path))}: {{path: {yaml_text(name.path)}{known}}}"


def _not_read(path: str, why: str, columns: FileColumns) -> str:
    """Return a comment on a column of texts; of a flag, how it is read."""
    cell = found[1] if (found := re.search(r"'([^']*)' is not a number", why)) else ""
    if _is_flag(path) and columns.flags and cell:
        flags = f"source.flags: {{{yaml_text(path)}: {yaml_text(cell)}}}"
        text = f"with {flags}, where that text is of sound rows, leaves out the others"
        return f"    # valid: {{path: {yaml_text(path)}}}   # {text}"
    return f"    # {yaml_text(path)} is not read: {why}"


def _is_flag(path: str) -> bool:
    return not FLAGS.isdisjoint(_words(path))


def _words(path: str) -> list[str]:
    return re.findall("[a-z]+", path.lower())


def _filter(channels: Channels, map_name: str) -> Iterator[str]:
    yield "filter:"
    yield f"  update_interval: {max(channels.step or FASTEST, FASTEST):.6g} s"
    yield "  align: 60 s             # at rest at the beginning"
    for sensor in TRIADS:
        channel, noise = channels.found.get(sensor), channels.noise.get(sensor)
        if channel is None and sensor == "accel":
            yield "  accel: null             # none was found"
            continue
        axes = "" if channel is None or len(channel.axes) == 3 else f"axes: [{', '.join(channel.axes)}], "
        yield f"  {sensor}:"
        if channel is None or noise is None or channel.unit is None:
            example = "0.01 deg/s" if channel is None else "0.1 deg/s" if sensor == "gyro" else "1 mg"
            density = f"{np.max(noise.white):.2g} times the unit of {sensor}/sqrt(Hz)" if noise else "a data sheet's"
            yield f"    # noise: {example}/sqrt(Hz)   # fill in: {density}"
            yield f"    bias: {{{axes}kind: random_walk}}   # fill in walk: of the bias, as in walk: 1 deg/h/sqrt(s)"
            continue
        white, walk = _in_units(sensor, noise, channel.unit)
        yield f"    noise: {white}   # guess: {_stretch(noise)}; better: `driftlab allan`"
        yield f"    bias: {{{axes}kind: random_walk, walk: {walk}}}   # {_walk(noise)}"
        if sensor == "gyro" and "temperature" in channels.found:
            fitted = f"{{kind: spline, path: {yaml_text(map_name)}}}"
            yield f"    # calibration: {fitted}   # once `driftlab fit-map` has made it"


def _quiet(channels: Channels) -> Iterator[str]:
    """Yield a sentence on each axis that has far less noise than the others of its sensor."""
    for sensor in TRIADS:
        channel, noise = channels.found.get(sensor), channels.noise.get(sensor)
        if channel is None or noise is None:
            continue
        usual = float(np.median(noise.white))
        for axis, white in zip(channel.axes, noise.white, strict=True):
            if QUIET * white < usual:
                yield (
                    f"{sensor} {axis} has {usual / white:,.0f} times less noise than the others: it is in another "
                    f"unit, or no sensor is there; correct source.channels.{sensor}"
                )


def _in_units(sensor: str, noise: QuickNoise, unit: str) -> tuple[str, str]:
    """Return noise and walk in the units of data sheets: one value, or one an axis where they differ."""
    small, large, limit = DENSITIES[sensor]
    zero, one = np.asarray(convert(np.array([0.0, 1.0]), unit, small))

    def text(values: Array, root: str) -> str:
        values, density = values * float(one - zero), small
        if np.max(values) >= limit:
            values, density = np.asarray(convert(values, small, large), dtype=np.float64), large
        return _per_axis(values, f"{density}/sqrt({root})")

    return text(noise.white, "Hz"), text(noise.walk, "s")


def _per_axis(values: Array, unit: str) -> str:
    if np.ptp(values) < 0.2 * np.max(values):
        return f"{float(np.max(values)):.3g} {unit}"
    return f"[{', '.join(f'{float(value):.3g} {unit}' for value in values)}]"


def _walk(noise: QuickNoise) -> str:
    if np.all(noise.known):
        return "guess: the likeliest beside the temperature"
    return "unknown: at most so, by these rows; better: `driftlab allan` on a night at rest"


def _stretch(noise: QuickNoise) -> str:
    return f"quietest stretch, {noise.seconds:.4g} s from {noise.start:.4g} s on"


def held_of(columns: FileColumns, channels: Channels) -> Name | None:
    """Return the column that a `held` filter may take, where the file has neither gyro nor accelerometer."""
    if any(sensor in channels.found for sensor in TRIADS) or "temperature" not in channels.found:
        return None
    others = (n for n in channels.others if n.quantity is None and columns.values[n.path].ndim == 1)
    return next((name for name in others if _measures(columns.values[name.path])), None)


def _measures(values: Array) -> bool:
    """Tell a reading from a constant, a counter, and a column that is mostly empty."""
    steps = np.diff(values[np.isfinite(values)])
    return len(steps) > len(values) / 2 and bool(np.ptp(steps) > 0)


def _is_unit(text: str) -> bool:
    """Return True if a text is a unit, as the name of a column may be: `ppm` or `mV`."""
    return same_dimension(text, text)


def _held_unit(held: Name) -> str:
    return held.unit or (held.path if _is_unit(held.path) else "1")


def _held_filter(held: Name, channels: Channels) -> Iterator[str]:
    unit, noise = _held_unit(held), channels.noise.get(held.path)
    yield "filter:"
    yield "  kind: held"
    yield f"  channel: {yaml_text(_key(held.path))}"
    yield f"  update_interval: {max(channels.step or FASTEST, FASTEST):.6g} s"
    yield "  align: 300 s            # at the beginning"
    if noise is None:
        yield f"  # noise: 1 {unit}/sqrt(Hz)   # fill in"
        yield f"  # bias: {{kind: random_walk, walk: 0.01 {unit}/sqrt(s)}}   # fill in"
        return
    white, walk = _per_axis(noise.white, f"{unit}/sqrt(Hz)"), _per_axis(noise.walk, f"{unit}/sqrt(s)")
    yield f"  noise: {white}   # guess: {_stretch(noise)}; better: `driftlab allan`"
    yield f"  bias: {{kind: random_walk, walk: {walk}}}   # {_walk(noise)}"


def _key(path: str) -> str:
    """Return a column's name as that of a channel."""
    return re.sub(r"\W+", "_", path).strip("_").lower() or "column"
