"""The channels that a file probably has: columns by their names, units as the file or a name says, else by values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from driftlab.guessing import units
from driftlab.guessing.names import UNITS, Name, leading, named, read_name
from driftlab.guessing.quiet import Noise, noise_of
from driftlab.guessing.reading import Columns
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import USUAL
from fusion_core.units import convert, same_dimension

SENSORS = ("gyro", "accel")
FIELDS = ("time", "gyro", "accel", "temperature")


@dataclass(frozen=True)
class Found:
    """A channel: its columns, its unit (None: to be asked for), and why; `guessed` where nobody said so."""

    paths: tuple[str, ...]
    axes: tuple[str, ...]
    values: Array  # (N, d), in the file's unit
    unit: str | None
    why: str
    guessed: bool


@dataclass(frozen=True)
class Channels:
    """What was found: channels by name, their noise in the file's units, and the columns that are none of them."""

    found: dict[str, Found]
    noise: dict[str, Noise]
    others: tuple[Name, ...]
    step: float | None  # between rows [s]


def channels_of(columns: Columns, said: Mapping[str, str], written: Mapping[str, str]) -> Channels:
    """Find the channels; `said` are units by channel as the user gives them, `written` as the file's comments do."""
    names = [_of_its_dimension(read_name(path), columns.units.get(path)) for path in columns.values]
    beside = leading(names) or ""
    groups = {field: group for field in FIELDS if (group := _group(field, names, columns, beside)) is not None}
    own_time = next((n for n in names if beside.startswith(f"{n.path}.") and columns.units.get(n.path) == "s"), None)
    if own_time is not None:  # the stream that the sensor is a part of: a topic stands for its time
        groups["time"] = [own_time]
    for field in [field for field in groups if field == "time" and not _rises(columns.values[groups[field][0].path])]:
        del groups[field]
    known = {name.path for group in groups.values() for name in group}
    others = tuple(name for name in names if name.path not in known)
    found: dict[str, Found] = {}
    noise: dict[str, Noise] = {}
    for field in ("temperature", "time", "accel"):
        if field in groups:
            values = _values(groups[field], columns)
            stated = _stated(field, groups[field], columns, said, written)
            found[field] = _found(groups[field], values, stated or _by_values(field, values, found), stated)
    t = _seconds(found.get("time"))
    for field in SENSORS:
        if field in groups and t is not None and (own_noise := noise_of(t, _values(groups[field], columns))):
            noise[field] = own_noise
    if "gyro" in groups:
        stated = _stated("gyro", groups["gyro"], columns, said, written)
        values = _values(groups["gyro"], columns)
        accel = found["accel"].unit if "accel" in found else None
        density = noise["gyro"].white if "gyro" in noise else np.zeros(values.shape[1])
        found["gyro"] = _found(groups["gyro"], values, stated or units.of_gyro(values, density, accel), stated)
    step = None if t is None or len(t) < 2 else float(np.median(np.diff(t)))
    return Channels({field: found[field] for field in FIELDS if field in found}, noise, others, step)


def channels_in(samples: Chunk) -> Channels:
    """Return the channels of samples in SI, as a framing gives them."""
    found = {}
    for field in FIELDS:
        if field in samples.channels:
            values = samples[field].reshape(len(samples), -1)
            found[field] = Found((field,), tuple("xyz"[: values.shape[1]]), values, USUAL[field].si, "", False)
    pairs = [(field, noise_of(samples.t, found[field].values)) for field in SENSORS if field in found]
    noise = {field: own for field, own in pairs if own is not None}
    return Channels(found, noise, (), float(np.median(np.diff(samples.t))) if len(samples) > 1 else None)


def noise_of_column(columns: Columns, path: str, time: Found | None) -> Noise | None:
    """Return the noise of one column, in its unit."""
    t = _seconds(time)
    return None if t is None else noise_of(t, columns.values[path].reshape(len(t), -1))


def _of_its_dimension(name: Name, unit: str | None) -> Name:
    """Return a name; without its quantity where the file's unit is of another, as a thermometer's time."""
    if unit is None or name.quantity is None or not same_dimension(unit, unit):
        return name
    return name if _understood(unit, name.quantity) else replace(name, quantity=None)


def _by_values(field: str, values: Array, found: Mapping[str, Found]) -> units.Guess:
    if field == "accel":
        return units.of_accel(values)
    if field == "temperature":
        return units.of_temperature(values[:, 0])
    T = found["temperature"].values if "temperature" in found and found["temperature"].unit in ("degC", "K") else [0.0]
    return units.of_time(values[:, 0], float(np.nanpercentile(T, 99) - np.nanpercentile(T, 1)))


def _group(field: str, names: list[Name], columns: Columns, beside: str) -> list[Name] | None:
    """Return the columns of a channel, at most three numbers a row; None where there are none."""
    for group in sorted(
        named(names, field, beside), key=lambda group: (-len(group), group[0].path not in columns.units)
    ):
        width = sum(1 if columns.values[name.path].ndim == 1 else columns.values[name.path].shape[1] for name in group)
        most = USUAL[field].axes or 1
        if width <= most and np.any(np.isfinite(_values(group, columns))):
            return group
    return None


def _found(group: list[Name], values: Array, guess: units.Guess, stated: units.Guess | None) -> Found:
    axes = tuple(name.axis or "" for name in group) if len(group) > 1 else tuple("xyz"[: values.shape[1]])
    return Found(tuple(name.path for name in group), axes, values, guess.unit, guess.why, stated is None)


def _stated(
    field: str, group: list[Name], columns: Columns, said: Mapping[str, str], written: Mapping[str, str]
) -> units.Guess | None:
    """Return the unit that somebody has said: the user, the file, its comments, or the columns' names."""
    if field in said:
        return units.Guess(said[field], "")
    texts = {columns.units.get(name.path) for name in group}
    for text in texts:
        if len(texts) == 1 and text is not None and (unit := _understood(text, field)) is not None:
            return units.Guess(unit, "as the file says" if unit == text else f"the file says '{text}'")
    if field in written:
        return units.Guess(written[field], "as the file says")
    by_name = {name.unit for name in group}
    unit = next(iter(by_name))
    return units.Guess(unit, "by the name") if len(by_name) == 1 and unit is not None else None


def _understood(text: str, field: str) -> str | None:
    """Return a unit that a file writes in its own way (`C`, `seconds since 2021-09-20`) as one that is known."""
    si = USUAL[field].si
    word = re.sub(r"[^a-z0-9]", "", text.split(" since ")[0].lower())
    return next((unit for unit in (text, UNITS.get(word, "")) if unit and same_dimension(unit, si)), None)


def _values(group: list[Name], columns: Columns) -> Array:
    return np.column_stack([columns.values[name.path] for name in group])


def _rises(t: Array) -> bool:
    finite = t[np.isfinite(t)] if t.ndim == 1 else np.empty(0)
    return len(finite) > 1 and bool(np.all(np.diff(finite) >= 0) and finite[-1] > finite[0])


def _seconds(time: Found | None) -> Array | None:
    return None if time is None or time.unit is None else np.asarray(convert(time.values[:, 0], time.unit, "s"))
