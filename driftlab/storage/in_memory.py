"""A recording in memory: arrays with units as a source, with the same checks as a file's.

`in_memory_name` takes a mapping of names to arrays, a data frame, or samples in SI. Arrays of float64 in SI are not
copied.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr, computed_field

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import USUAL, MeasurementModel, Source, Usual
from fusion_core.contracts.table import si_of_channel
from fusion_core.errors import BadValue, ConfigError, MissingChannel, UnitError, quote
from fusion_core.faults import Faults
from fusion_core.settings import did_you_mean
from fusion_core.units import convert

_COLUMN = re.compile(r"(?P<name>.+?)(?:_(?P<axis>[xyz]))?(?: \[(?P<unit>[^\]]+)\])?")


class MemorySource(Source):
    """Samples in the memory of a program; `in_memory_name` makes it, no config can."""

    kind: Literal["memory"] = "memory"
    title: str  # its name in messages and results
    units: Mapping[str, str]  # as the samples were given

    _samples: Chunk = PrivateAttr()
    _known: bool = PrivateAttr(default=False)  # to be in SI, as a `Chunk` is

    def check_units(self, model: MeasurementModel) -> None:
        """Raise UnitError where a sensor that a model follows has no unit, or one of another dimension."""
        names = [name for name in self._samples.channels if name in self.units or not self._known]
        try:
            model.check_units({name: self.units.get(name) for name in names})
        except UnitError as error:
            for name in names:
                if name not in self.units and f"channels.{name}:" in str(error):
                    raise _without_unit(self.title, name, model.tracked.shown) from None
            raise UnitError(str(error).replace("source.channels.", f"{self.title}: channel ")) from None

    def chunks(self, size: int, faults: Faults) -> Iterator[Chunk]:
        """Yield the samples as chunks of at most `size`, in SI units."""
        t, channels = self._samples.t, self._samples.channels
        for start in range(0, len(t), size):
            part = slice(start, start + size)
            yield Chunk(t[part], {name: values[part] for name, values in channels.items()})

    @property
    def name(self) -> str:
        """Name of the samples."""
        return self.title

    @computed_field  # type: ignore[prop-decorator]
    @property
    def rows(self) -> int:
        """Number of samples."""
        return len(self._samples)

    @property
    def bytes(self) -> int:
        """Size of the samples."""
        return self._samples.t.nbytes + sum(values.nbytes for values in self._samples.channels.values())

    @computed_field  # type: ignore[prop-decorator]
    @cached_property
    def sha256(self) -> str:
        """Hash of the samples' names and values in SI."""
        digest = hashlib.sha256()
        for name, values in sorted({"time": self._samples.t, **self._samples.channels}.items()):
            digest.update(f"{name} {values.shape} ".encode())
            digest.update(values.data)
        return digest.hexdigest()


class InMemoryName(str):
    """The name of a recording in memory, where the name of a file may stand too; `source` has the samples."""

    source: Source

    def __new__(cls, source: Source) -> InMemoryName:
        """Take the name of the source."""
        self = super().__new__(cls, source.name)
        self.source = source
        return self

    def identity(self) -> dict[str, Any]:
        """Return size and hash of the samples; of any other source, those of its settings."""
        if isinstance(self.source, MemorySource):
            return {"bytes": self.source.bytes, "sha256": self.source.sha256}
        settings = self.source.model_dump_json().encode()
        return {"bytes": len(settings), "sha256": hashlib.sha256(settings).hexdigest()}


class CopyName(str):
    """The name of a recording that is read from a copy: `URL` or `URL::START:STOP`; `copy` is the copy's, alike."""

    copy: str

    def __new__(cls, name: str, copy: str) -> CopyName:
        """Take the name that was given."""
        self = super().__new__(cls, name)
        self.copy = copy
        return self

    @property
    def url(self) -> str:
        """The URL, without a range."""
        _, colons, span = self.copy.partition("::")
        return self.removesuffix(colons + span)


def in_memory_name(data: Any, units: Mapping[str, str] | None = None, title: str = "data") -> MemorySource:
    """Return samples in memory as a source.

    Parameters
    ----------
    data : mapping, data frame or Chunk
        Of a mapping, each value is an array (N,) or (N, d), or a pair of an array and its unit:
        `{"time": (t, "s"), "gyro": (omega, "deg/s")}`. Of a data frame, a column is a channel; those that end in `_x`,
        `_y`, `_z` are the axes of one, and a unit may stand behind the name: `gyro_x [deg/s]`. A `Chunk` is in SI.
        What is masked (`numpy.ma`), null or NaN is missing: its row is left out and counted.
    units : mapping of str to str, optional
        Units of the channels that have none in `data`.
    title : str
        Name of the samples in messages.

    Raises
    ------
    UnitError
        If a unit is missing where one is needed, is not known, or is of another dimension.
    DataError
        If there is no time, the channels have different lengths, or one is no array of numbers.
    ConfigError
        If `units` names a channel that is not there.
    """
    if isinstance(data, Chunk):
        given: dict[str, Any] = {"time": data.t, **data.channels}
        units = {name: usual.si for name, usual in USUAL.items() if name in given and usual.example} | dict(units or {})
    elif isinstance(data, Mapping):
        given = dict(data)
    elif hasattr(data, "columns"):
        given = _of_columns(data)
    else:
        raise BadValue(
            f"{title}: is a {type(data).__name__}, a path, a mapping of names to arrays, a data frame or a Chunk was "
            'expected; write e.g. {"time": (t, "s"), "gyro": (omega, "deg/s")}'
        )
    written = _units(given, units or {}, title)
    if "time" not in given:
        have = ", ".join(sorted(map(str, given))) or "none"
        raise MissingChannel(f'{title}: has no time, only {have}; add "time": (t, "s")')
    values = {name: _values(name, item, written.get(name), title) for name, item in given.items()}
    t = values.pop("time")
    for name, array in values.items():
        if len(array) != len(t):
            raise BadValue(
                f"{title}: channel {name} has {len(array)} rows and time {len(t)}, as many were expected; "
                "give channels that were sampled together"
            )
    source = MemorySource(title=title, units=written)
    source._samples, source._known = Chunk(t, values), isinstance(data, Chunk)
    return source


def _of_columns(frame: Any) -> dict[str, Any]:
    """Return the channels of a data frame: arrays, or pairs of an array and its unit."""
    parts: dict[str, list[tuple[str, str | None, Any]]] = {}
    for column in map(str, frame.columns):
        part = _COLUMN.fullmatch(column)
        assert part is not None, "every text has a name"
        parts.setdefault(part["name"], []).append((part["axis"] or "", part["unit"], frame[column]))
    channels: dict[str, Any] = {}
    for name, items in parts.items():
        columns = [_plain(column) for _, _, column in sorted(items, key=lambda item: item[0])]
        values = columns[0] if len(columns) == 1 else np.column_stack(columns)
        named = {unit for _, unit, _ in items if unit is not None}
        if len(named) > 1:
            raise UnitError(f"columns {name}: are in {' and '.join(sorted(named))}; convert them to one unit")
        channels[name] = (values, named.pop()) if named else values
    return channels


def _units(given: dict[str, Any], units: Mapping[str, str], title: str) -> dict[str, str]:
    """Take the units out of pairs, and return those of all channels that have one."""
    for name in units:
        if name not in given:
            advice = did_you_mean(name, given, "remove it", "'")
            raise ConfigError(f"units: names '{quote(name)}', which {title} does not have; {advice}")
    written = dict(units)
    for name, item in given.items():
        if isinstance(item, tuple) and len(item) == 2 and isinstance(item[1], str):
            given[name] = item[0]
            if written.setdefault(name, item[1]) != item[1]:
                own, by = quote(item[1]), quote(written[name])
                raise UnitError(f"{title}: channel {name} is in '{own}' and in '{by}' by units; remove one of the two")
    return written


def _plain(item: Any) -> NDArray[Any]:
    """Return a plain array of data; masked values, and nulls in a column of a data frame, are NaN."""
    if isinstance(item, list | tuple) and any(map(np.ma.isMaskedArray, item)):
        item = np.ma.array(item)
    if np.ma.is_masked(item):
        return np.ma.filled(item.astype(np.float64), np.nan)
    array = np.asarray(item)
    if array.dtype.kind == "O" and hasattr(item, "isna"):  # of pandas: its NA is no number
        with suppress(TypeError, ValueError):
            return np.asarray(item.astype("Float64").to_numpy(dtype=np.float64, na_value=np.nan))
    return array


def _values(name: str, item: Any, unit: str | None, title: str) -> Array:
    """Return a channel in SI: (N, d) of gyro and accel, (N,) or (N, d) of the others."""
    usual = USUAL.get(name)
    array = _plain(item)
    if name == "time" and array.dtype.kind == "M":  # with a date: s since 1970, as a file's are
        array, unit = (array - np.datetime64(0, "s")) / np.timedelta64(1, "s"), "s"
    if array.dtype.kind not in "iufb":
        raise BadValue(f"{title}: channel {name} is of type {array.dtype}, numbers were expected; convert it")
    most = (usual and usual.axes) or np.inf
    d = 1 if array.ndim == 1 else array.shape[-1]
    if array.ndim not in (1, 2) or not 1 <= d <= most:
        expected = "(N,)" if most == 1 else f"(N,) or (N, {'1 to 3' if most == 3 else 'd'})"
        raise BadValue(
            f"{title}: channel {name} has shape {array.shape}, {expected} was expected; time is the first axis"
        )
    si = _si(name, unit, usual, title)
    values = convert(array, unit, si) if unit is not None and si is not None else array
    if most == 3 or d == 1:
        values = values.reshape((len(values), d) if most == 3 else len(values))
    # in one piece and writable, or the compiled loops would be compiled once more for it
    return np.require(values, np.float64, ["C", "W"])


def _si(name: str, unit: str | None, usual: Usual | None, title: str) -> str | None:
    """Return the unit to convert a channel to; None where it stays as it is."""
    if unit is None:
        if usual is not None and usual.example is not None:
            raise _without_unit(title, name, usual.example)
        return None
    try:
        return si_of_channel(name, unit)
    except UnitError as error:
        raise UnitError(f"{title}: {error}") from None


def _without_unit(title: str, name: str, example: str) -> UnitError:
    advice = f'write "{name}": ({name}, "{example}"), or units={{"{name}": "{example}"}}'
    return UnitError(f"{title}: channel {name} has no unit; {advice}")
