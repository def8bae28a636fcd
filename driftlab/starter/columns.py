"""The channels that a file probably has: columns by their names, units by the file or a name, else by values.

The unit of values follows from their size in a unit at rest on the Earth. An accelerometer shows 1 g whatever else it
shows; a thermometer what people can stand, or a chamber reaches; a clock rises. A gyroscope at rest shows its bias and
its noise, of which a size is only probable: where they may be of either unit, the accelerometers tell whether the file
is in SI.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from driftlab.noise.quick import QuickNoise, noise_of
from driftlab.starter.names import NO_SENSOR, TRIADS, Name, known_unit, leading, named, quantity_of, read_name
from driftlab.starter.reading import FileColumns
from driftlab.units import YEARS
from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.contracts import USUAL
from fusion_core.errors import ConfigError, quote
from fusion_core.units import convert, same_dimension, to_si

V = TypeVar("V")
FIELDS = ("time", "gyro", "accel", "temperature")


@dataclass(frozen=True)
class GuessedChannel:
    """A channel: its columns, its unit (None: to be asked for), and why; `guessed` where it is stated nowhere."""

    paths: tuple[str, ...]
    axes: tuple[str, ...]
    values: Array  # (N, d), in the file's unit
    unit: str | None
    why: str
    guessed: bool


@dataclass(frozen=True)
class Channels:
    """The channels by name, their noise in the file's units, and the columns that are none of them."""

    found: dict[str, GuessedChannel]
    noise: dict[str, QuickNoise]
    others: tuple[Name, ...]
    step: float | None  # between rows [s]


@dataclass(frozen=True)
class Answers:
    """The choices of the user: columns and units by channel, the interval of rows, decimal sign, order of dates."""

    columns: Mapping[str, str]
    units: Mapping[str, str]
    interval: str | None = None
    decimal: str | None = None
    dates: str | None = None


def channels_of(columns: FileColumns, given: Answers, written: Mapping[str, str]) -> Channels:
    """Return the channels by what the user says, then by names and values; `written` are units of its comments."""
    names = [_of_its_dimension(read_name(path), columns.units.get(path)) for path in columns.values]
    chosen = {field: _chosen(field, text, names) for field, text in given.columns.items()}
    taken = {name.path for group in chosen.values() for name in group}
    names = [name for name in names if name.path not in taken]
    beside = leading([*chosen.get("gyro", ()), *names]) or ""
    groups = {field: group for field in FIELDS if (group := _group(field, names, columns, beside)) is not None} | chosen
    if given.interval is not None:
        groups.pop("time", None)
    stream = next((n for n in names if beside.startswith(f"{n.path}.") and columns.units.get(n.path) == "s"), None)
    if stream is not None and "time" not in chosen and given.interval is None:
        groups["time"] = [stream]  # that the sensor is a part of: a topic stands for its time
    known = {name.path for group in groups.values() for name in group}
    others = tuple(name for name in names if name.path not in known)
    channels: dict[str, GuessedChannel] = {}
    noise: dict[str, QuickNoise] = {}
    t = _regular(given.interval, columns)
    led = _known(_values(groups["gyro"], columns)) if "gyro" in groups else None
    for field in (field for field in ("temperature", "time", "accel", "gyro") if field in groups):
        group, values = groups[field], _values(groups[field], columns)
        T = _between(channels["temperature"].values[:, 0]) if "temperature" in channels else None
        own = _known(values)  # rows that are not another sensor's alone
        own = own & led if led is not None and np.any(own & led) else own  # and of these the gyro's, which are used
        if field in TRIADS and t is not None:
            quick = noise_of(t[own], values[own], None if T is None else T[own])
            noise |= {} if quick is None else {field: quick}
        stated = _stated(field, group, columns, given.units, written)
        counts = any(name.counts for name in group) and field in ("gyro", "temperature")
        guess = stated or (OF_COUNTS if counts else _by_values(field, values, channels, noise))
        rivals = [name.path for name in others if name.quantity == field == "temperature"]
        if rivals and field not in chosen:
            why = f"of {1 + len(rivals)} temperatures; the map follows the sensor's own, and {rivals[0]} is another"
            guess, stated = Guess(guess.unit, why), None
        axes = tuple(name.axis or "" for name in group) if len(group) > 1 else tuple("xyz"[: values.shape[1]])
        paths = tuple(name.path for name in group)
        channels[field] = GuessedChannel(paths, axes, values, guess.unit, guess.why, stated is None)
        t = _seconds(channels.get("time")) if "time" in channels else t
    step = _step(t if t is None or led is None or not np.any(led) else t[led])
    return Channels(_in_order(channels), _in_order(noise), others, step)


def _known(values: Array) -> Flags:
    """Return the rows (N,) of values (N, d) with a number in them."""
    return np.asarray(np.any(np.isfinite(values), axis=1), dtype=np.bool_)


def _chosen(field: str, text: str, names: list[Name]) -> list[Name]:
    """Return the columns that the user names for a channel, whole or by their beginnings, one an axis."""
    by_path = {name.path: name for name in names}
    group = []
    for word in [text] if text in by_path else [part.strip() for part in text.split(",")]:
        alike = [path for path in by_path if path.lower().startswith(word.lower())]
        if word not in by_path and len(alike) != 1:
            none = f"no column of numbers is called so, there are {', '.join(by_path)}"
            like = f"{len(alike)} columns begin so" if alike else none
            raise ConfigError(f"--column {field}={text}: '{word}': {like}; write the whole name of one")
        group.append(by_path[word if word in by_path else alike[0]])
    if len(group) > 3:
        raise ConfigError(f"--column {field}={text}: {len(group)} columns, one an axis was expected; leave some out")
    return [replace(name, axis=axis) for name, axis in zip(group, "xyz", strict=False)] if len(group) > 1 else group


def _regular(interval: str | None, columns: FileColumns) -> Array | None:
    """Return the times of rows that are an interval apart, s."""
    rows = len(next(iter(columns.values.values()), ()))
    return None if interval is None else to_si(interval, "s") * np.arange(rows, dtype=np.float64)


def channels_in(samples: Chunk) -> Channels:
    """Return the channels of samples in SI, as a framing gives them."""
    channels = {}
    for field in (field for field in FIELDS if field in samples.channels):
        values = samples[field].reshape(len(samples), -1)
        channels[field] = GuessedChannel((field,), tuple("xyz"[: values.shape[1]]), values, USUAL[field].si, "", False)
    T = samples.channels.get("temperature")
    pairs = ((field, noise_of(samples.t, channels[field].values, T)) for field in TRIADS if field in channels)
    return Channels(channels, {field: noise for field, noise in pairs if noise is not None}, (), _step(samples.t))


def _in_order(by_field: Mapping[str, V]) -> dict[str, V]:
    return {field: by_field[field] for field in FIELDS if field in by_field}


def _step(t: Array | None) -> float | None:
    """Return the usual step of times (N,), s."""
    t = None if t is None else t[np.isfinite(t)]
    return None if t is None or len(t) < 2 else float(np.median(np.diff(t)))


def noise_of_column(columns: FileColumns, path: str, found: Mapping[str, GuessedChannel]) -> QuickNoise | None:
    """Return the noise of one column beside the temperature, in its unit."""
    t = _seconds(found.get("time"))
    T = _between(found["temperature"].values[:, 0])
    return None if t is None else noise_of(t, columns.values[path][:, None], T)


def _between(T: Array) -> Array:
    """Return a temperature (N,) that few rows read with all of them: a source draws it between its readings, too."""
    at = np.flatnonzero(np.isfinite(T))
    return np.interp(np.arange(len(T)), at, T[at]) if len(at) > 2 and np.median(np.diff(at)) > 1 else T


def _of_its_dimension(name: Name, unit: str | None) -> Name:
    """Return a name with the file's unit; of its quantity where the name has another, as a thermometer's time."""
    known = None if unit is None else known_unit(unit.split(" since ")[0])
    if unit is None or known is None or (name.quantity is not None and _understood(unit, name.quantity)):
        return replace(name, unit=name.unit or known)
    unnamed = name.quantity in (None, "time") and not NO_SENSOR.intersection(name.group)  # T1 [°C] is no time
    return replace(name, quantity=quantity_of(known) if unnamed else None)


def _by_values(
    field: str, values: Array, channels: Mapping[str, GuessedChannel], noise: Mapping[str, QuickNoise]
) -> Guess:
    """Guess the unit of a channel, by those that are known already."""
    if field == "accel":
        return of_accel(values)
    if field == "temperature":
        return of_temperature(values[:, 0])
    if field == "gyro":
        density = noise["gyro"].white if "gyro" in noise else np.zeros(values.shape[1])
        return of_gyro(values, density, channels["accel"].unit if "accel" in channels else None)
    thermometer = channels.get("temperature")
    T = thermometer.values if thermometer is not None and thermometer.unit in ("degC", "K") else [0.0]
    return of_time(values[:, 0], float(np.nanpercentile(T, 99) - np.nanpercentile(T, 1)))


def _group(field: str, names: list[Name], columns: FileColumns, beside: str) -> list[Name] | None:
    """Return the columns of a channel, at most three numbers a row; None where there are none."""
    groups = named(names, field, beside)
    for group in sorted(groups, key=lambda group: (-len(group), group[0].path not in columns.units)):
        width = sum(1 if columns.values[name.path].ndim == 1 else columns.values[name.path].shape[1] for name in group)
        most = USUAL[field].axes or 1
        values = _values(group, columns)
        if width <= most and np.any(np.isfinite(values)) and (field != "time" or _rises(values[:, 0])):
            return group
    return None


def _stated(
    field: str, group: list[Name], columns: FileColumns, given: Mapping[str, str], written: Mapping[str, str]
) -> Guess | None:
    """Return the unit of a channel that the user, the file, its comments, or the columns' names state."""
    if field in given:
        return Guess(given[field], "")
    if group[0].path == TICKS and np.median(np.diff(columns.values[TICKS])) < RATES["us"][1] / 100:
        return Guess("0.1 ms", "as MT Manager writes it")
    texts = {columns.units.get(name.path) for name in group}
    for text in texts:
        if len(texts) == 1 and text is not None and (unit := _understood(text, field)) is not None:
            return Guess(unit, "as the file says" if unit == text else f"the file says '{text}'")
    if field in written:
        return Guess(written[field], "as the file says")
    by_name = {name.unit for name in group}
    unit = next(iter(by_name))
    if unit is not None and field in TRIADS and not same_dimension(unit, USUAL[field].si):
        why = f"is in {unit}, which is no unit of {field}; name other columns, or its unit with --unit {field}=UNIT"
        raise ConfigError(f"column '{quote(group[0].path)}': {why}")
    return Guess(unit, "by the name") if len(by_name) == 1 and unit is not None else None


def _understood(text: str, field: str) -> str | None:
    """Return a unit that a file writes in its own way (`C`, `seconds since 2021-09-20`) as one that is known."""
    si = USUAL[field].si
    known = (text, known_unit(text.split(" since ")[0]))
    return next((unit for unit in known if unit and same_dimension(unit, si)), None)


def _values(group: list[Name], columns: FileColumns) -> Array:
    return np.column_stack([columns.values[name.path] for name in group])


def _rises(t: Array) -> bool:
    finite = t[np.isfinite(t)] if t.ndim == 1 else np.empty(0)
    return len(finite) > 1 and bool(np.mean(np.diff(finite) < 0) < FALLS and np.median(np.diff(finite)) > 0)


def _seconds(time: GuessedChannel | None) -> Array | None:
    return None if time is None or time.unit is None else np.asarray(convert(time.values[:, 0], time.unit, "s"))


EPOCHS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of time stamps since 1970
DAYS = {25569.0: "as Excel counts", 719529.0: "as MATLAB counts"}  # numbers of 1970-01-01 among days
DAY = 86_400.0  # s
SLOWEST = 5.0  # s, of days: 6e-5 of them, which no clock in seconds has for a step
FALLS = 0.01  # of the steps of a time, where a clock was set
RATES = {"s": (1e-4, 1.0), "ms": (2.0, 499.0), "us": (500.0, 499_999.0), "ns": (500_000.0, 1e9)}  # steps that are usual
TICKS = "SampleTimeFine"  # of Xsens: in us where its steps are those of a slow device
G = {"g": 1.0, "m/s^2": 9.80665, "mg": 1000.0, "Gal": 980.665}
NEAR = 0.15  # of g: bias and scale of accelerometers without calibration
QUIET_DEG, QUIET_RAD = 1.5e-3, 1e-4  # noise densities that only gyros in deg/s have, and only those in rad/s
LARGE = 0.3  # mean rate: 17 deg/s of bias has no gyro
FASTEST = 0.1  # K/s over a whole recording: faster is no chamber
COUNTS = 30.0  # and beyond, no unit is probable


class Guess(NamedTuple):
    """A unit, and why; None where the values do not tell it."""

    unit: str | None
    why: str


OF_COUNTS = Guess(None, "raw counts, by the name: write their size, as in 0.0305 deg/s or 0.01 degC")


def of_time(t: Array, swing: float = 0.0) -> Guess:
    """Guess the unit of time stamps (N,), while which the temperature moved by `swing` K."""
    finite = t[np.isfinite(t)]
    steps = np.diff(finite)
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    for unit, factor in EPOCHS.items():
        if len(finite) and YEARS[0] < finite[0] * factor < YEARS[1]:
            return Guess(unit, f"{finite[0]:.4g} is a date in {unit} since 1970")
    for epoch, why in DAYS.items():
        if len(finite) and YEARS[0] < (finite[0] - epoch) * DAY < YEARS[1] and step * DAY <= SLOWEST:
            return Guess("day", f"{finite[0]:.9g} is a date in days, {why}")
    for unit, (low, high) in RATES.items():
        if low <= step <= high:
            lasts = float(finite[-1] - finite[0])
            larger = [name for name in EPOCHS if EPOCHS[name] >= EPOCHS[unit]][::-1]
            likely = next((name for name in larger if swing <= FASTEST * lasts * EPOCHS[name]), unit)
            why = f"steps of {step:.6g} {likely} are {1 / (step * EPOCHS[likely]):.4g} Hz"
            return Guess(likely, why if likely == unit else f"{why}; in {unit} the temperature would jump")
    return Guess(None, f"steps of {step:.6g}: s, ms, us or ns?")


def of_accel(values: Array) -> Guess:
    """Guess the unit of an accelerometer (N, d): at rest a triad shows 1 g."""
    if values.shape[1] < 3:
        size = float(np.nanmax(np.abs(np.nanmedian(values, axis=0))))
        return Guess(None, f"of {values.shape[1]} axes, up to {size:.4g}: g, m/s^2 or mg?")
    norm = float(np.nanmedian(np.linalg.norm(values, axis=1)))
    unit = min(G, key=lambda unit: abs(np.log(max(norm, 1e-9) / G[unit])))
    if abs(norm / G[unit] - 1) < NEAR:
        return Guess(unit, f"the norm is {norm:.4g}")
    if norm > 1500:
        bits = round(np.log2(norm))
        count = 2.0**bits if abs(norm / 2.0**bits - 1) < NEAR else norm
        return Guess(f"{1 / count:.6g} g", f"the norm is {norm:.5g} counts: 1 g is {count:.6g}")
    return Guess(None, f"the norm is {norm:.4g}, neither 1 g, 9.8 m/s^2 nor 1000 mg")


def of_temperature(T: Array) -> Guess:
    """Guess the unit of a temperature (N,)."""
    low, high = (float(np.nanpercentile(T, q)) for q in (1, 99))
    span = f"{low:.4g} to {high:.4g}"
    if low >= -60 and high <= 130:
        return Guess("degC", span)
    if low >= 200 and high <= 420:
        return Guess("K", span)
    if low >= -6000 and high <= 13000:
        return Guess("0.01 degC", span)
    return Guess(None, f"{span}: raw counts? value = number * scale + offset has no unit; convert it first")


def of_gyro(values: Array, density: Array, accel: str | None) -> Guess:
    """Guess the unit of a gyroscope (N, d) at rest.

    `density` (d,) is its white noise in the file's unit/sqrt(Hz), `accel` the unit of the accelerometers.
    """
    level, noise = float(np.nanmax(np.abs(np.nanmedian(values, axis=0)))), float(np.max(density))
    sizes = f"mean {level:.2g} and noise {noise:.2g}/sqrt(Hz)"
    if level > COUNTS or noise > COUNTS / 100:
        return Guess(None, f"{sizes}: deg/h, mrad/s, or raw counts? Write their size, as in 0.0305 deg/s")
    if np.array_equal(values, np.rint(values), equal_nan=True) and np.any(values):
        return Guess(None, f"{sizes}, in whole numbers: raw counts? Write their size, as in 0.0305 deg/s")
    if level > LARGE or noise > QUIET_DEG:
        return Guess("deg/s", f"{sizes} are too large for rad/s")
    if 0 < noise < QUIET_RAD:
        return Guess("rad/s", f"{sizes} are small for deg/s")
    if accel == "m/s^2":
        return Guess("rad/s", "the accelerometers are in SI")
    if accel in ("g", "mg"):
        return Guess("deg/s", f"the accelerometers are in {accel}")
    return Guess(None, f"{sizes}: rad/s or deg/s?")
