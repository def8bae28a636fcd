"""The sensors of an autopilot that are corrected for temperature, as they are found in its logs."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from driftlab.commands.inputs import config_of
from driftlab.config import Config, part_of, with_recording
from driftlab.recordings.screening import read
from driftlab.starter import reading
from driftlab.storage.in_memory import InMemoryName, in_memory_name
from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import FileSource
from fusion_core.errors import ConfigError, MissingChannel
from fusion_core.faults import Faults

NUMBERS = range(8)  # of sensors of a kind that are looked for
BLOCK = 1 << 20  # bytes of a log at a time
ROWS, POWERS = 20_000, 5  # of all logs, by which their levels are told, and of temperature beside them


class Topic(NamedTuple):
    """The topic of a kind of sensor: its name, the fields of its axes and of its temperature."""

    name: str
    axes: tuple[str, ...]
    temperature: str
    numbers: range = NUMBERS


class Platform(NamedTuple):
    """An autopilot: the form of its parameters, its kinds of sensors, and the clock of its rows."""

    export: str
    topics: Mapping[str, Topic]  # by channel
    first: int  # number of the first sensor in the parameters' names
    clock: str


XYZ = ("x", "y", "z")
PLATFORMS = {  # by the packaged config
    "px4_log": Platform(
        "px4",
        {
            **{name: Topic(f"sensor_{name}", XYZ, "temperature") for name in ("gyro", "accel", "mag")},
            "baro": Topic("sensor_baro", ("pressure",), "temperature"),
        },
        0,
        "time",
    ),
    "ardupilot_log": Platform(
        "ardupilot",
        {
            "gyro": Topic("IMU", ("GyrX", "GyrY", "GyrZ"), "T"),
            "accel": Topic("IMU", ("AccX", "AccY", "AccZ"), "T"),
            "baro": Topic("BARO", ("Press",), "Temp", range(1)),  # the first alone is corrected
        },
        1,
        "TimeUS",
    ),
}
HELD: Mapping[str, Mapping[str, Any]] = {  # of sensors whose input is constant; noise and walk are usual ones
    "baro": {"noise": "2 Pa/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "0.05 Pa/sqrt(s)"}},
    "mag": {
        "noise": "0.5 uT/sqrt(Hz)",
        "bias": {"kind": "random_walk", "walk": "1e-3 uT/sqrt(s)", "axes": list(XYZ)},
    },
}


@dataclass(frozen=True)
class LogSensor:
    """A sensor of a vehicle in its logs.

    Attributes
    ----------
    channel : str
        gyro, accel, mag or baro.
    number : int
        As in the parameters' names: from 0 for PX4, from 1 for ArduPilot.
    about : mapping of str to str
        Facts on the device, as a map's provenance has them.
    unit : str
        Of its fields.
    recordings : tuple of str
        The logs that have it.
    places : tuple of int
        Its number in each of them, from 0.
    """

    channel: str
    number: int
    about: Mapping[str, str]
    unit: str
    recordings: tuple[str, ...]
    places: tuple[int, ...]

    @property
    def logged(self) -> list[tuple[str, int]]:
        """Its logs, each with its number there."""
        return list(zip(self.recordings, self.places, strict=True))

    @property
    def device(self) -> str:
        """Its device id; empty where the logs have none."""
        return self.about.get("device_id", "")

    @property
    def name(self) -> str:
        """Channel and number, e.g. `gyro 0`."""
        return f"{self.channel} {self.number}"

    def beside(self, other: LogSensor) -> LogSensor:
        """Return the sensor with what another log has of it."""
        recordings, places = self.recordings + other.recordings, self.places + other.places
        return replace(self, recordings=recordings, places=places)

    @property
    def held(self) -> bool:
        """True if it is of a kind whose input is constant and unknown."""
        return self.channel in HELD


def product_of(recordings: Sequence[str]) -> str:
    """Return the packaged config that reads all logs; raises DataError where one is no autopilot's."""
    kinds = dict[str, str]()
    for name in recordings:
        path = part_of(name)[0]
        sources = reading.file_sources(path, reading.beginning(path, reading.HEAD))
        known = next((cls.product for cls in sources if cls.product in PLATFORMS), None)
        if known is None:
            raise MissingChannel(
                f"{path}: is no log of an autopilot, one of PX4 (.ulg) or ArduPilot (.bin) was expected; use fit-map "
                "with a config for other recordings"
            )
        kinds[name] = known
    if len(set(kinds.values())) > 1:
        raise ConfigError(f"{' and '.join(kinds)}: are of PX4 and of ArduPilot; give the logs of one vehicle")
    return next(iter(kinds.values()))


def config_and_data(
    product: str, sensor: LogSensor, sensors: Sequence[LogSensor], site: Mapping[str, str]
) -> tuple[Config, list[str]]:
    """Return the config by which a sensor's map is fitted, and its recordings."""
    if sensor.held:
        configs = [_held(product, sensor, place) for place in sensor.places]
        return configs[0], _levelled(configs, sensor)
    configs = []
    for name, place in zip(sensor.recordings, sensor.places, strict=True):
        gyros = [at for one in sensors if one.channel == "gyro" for log, at in one.logged if log == name]
        gyro = place if place in gyros else min(gyros, default=place)
        configs.append(_config(product, site, _paths(product, sensor.channel, place, gyro)))
    names = zip(sensor.recordings, sensor.places, configs, strict=True)
    data = [name if at == sensor.places[0] else _read_by(config, name) for name, at, config in names]
    return configs[0], data


def _read_by(config: Config, recording: str) -> InMemoryName:
    """Return a recording that is read by another config than the first."""
    source = with_recording(config, recording).source
    assert source is not None
    return InMemoryName(source)


def _held(product: str, sensor: LogSensor, place: int) -> Config:
    """Return the config of a sensor whose input is constant, as the log has it at `place`."""
    platform, topic = PLATFORMS[product], PLATFORMS[product].topics[sensor.channel]
    row = f"{topic.name}[{place}]"
    fields = [f"{row}.{axis}" for axis in topic.axes]
    channels = {
        "time": {"path": f"{row}.{platform.clock}"},
        "temperature": {"path": f"{row}.{topic.temperature}"},
        sensor.channel: {"path": fields if len(fields) > 1 else fields[0], "unit": sensor.unit},
    }
    model = {"kind": "held", "channel": sensor.channel, "update_interval": "1 s", **HELD[sensor.channel]}
    return config_of({"source": {"kind": _kind(product), "channels": channels}, "filter": model})


def _paths(product: str, channel: str, place: int, gyro: int) -> dict[str, Any]:
    """Return the paths of channels that read the sensor at a place in the log; `gyro` is that of the rows."""
    platform = PLATFORMS[product]
    paths: dict[str, Any] = {}
    for name in ("gyro", "accel"):
        topic, at = platform.topics[name], place if name == channel else gyro
        paths[name] = [f"{topic.name}[{at}].{axis}" for axis in topic.axes]
    own, rows = platform.topics[channel], platform.topics["gyro"].name
    time = f"{rows}[{gyro if product == 'px4_log' else place}].{platform.clock}"
    return {"time": time, **paths, "temperature": f"{own.name}[{place}].{own.temperature}"}


def _kind(product: str) -> str:
    source = _config(product, {}, {}).source
    assert source is not None
    return source.kind


def _config(product: str, site: Mapping[str, str], paths: Mapping[str, Any]) -> Config:
    channels = {name: {"path": path} for name, path in paths.items()}
    return config_of({"extends": product, **site, "source": {"channels": channels}})


def _levelled(configs: Sequence[Config], sensor: LogSensor) -> list[str]:
    """Return the recordings of a sensor, each less its level at the middle of all temperatures.

    The level is the field or the air pressure of a day and place. It is estimated together with a curve that all logs
    share, so that logs of different temperatures join::

        y_k = level_j + c_1 (T_k - T_mid) + ... + c_5 (T_k - T_mid)^5,    k in log j
    """
    model = configs[0].filter
    assert model is not None
    logs = [with_recording(config, name) for config, name in zip(configs, sensor.recordings, strict=True)]
    chunks = [concatenate(read(config, Faults())) for config in logs]
    T, y = (np.concatenate([chunk[name] for chunk in chunks]) for name in ("temperature", sensor.channel))
    log = np.repeat(range(len(chunks)), list(map(len, chunks)))
    some = np.unique(np.linspace(0, len(T) - 1, ROWS).astype(int))
    x = (T - (T.min() + T.max()) / 2) / max(float(np.ptp(T)), 1e-9)
    X = np.column_stack([np.eye(len(chunks))[log], *(x**k for k in range(1, POWERS + 1))])
    levels = np.linalg.lstsq(X[some], y[some].reshape(len(some), -1), rcond=None)[0][: len(chunks)]
    names = []
    for chunk, name, level in zip(chunks, sensor.recordings, levels, strict=True):
        held = {sensor.channel: chunk[sensor.channel] - level, "temperature": chunk["temperature"]}
        units = {sensor.channel: model.tracked.unit}
        names.append(InMemoryName(in_memory_name(Chunk(chunk.t, held), units, name)))
    return list(names)


def sensors_of(product: str, recordings: Sequence[str], site: Mapping[str, str]) -> list[LogSensor]:
    """Return the sensors of all logs, none of which is there twice, by their devices; the first log numbers them.

    Raises
    ------
    ConfigError
        If a log is there twice, or two devices have one number, or one id.
    """
    rest = {name: topic for name, topic in PLATFORMS[product].topics.items() if product != "px4_log" and name in HELD}
    more = {name: f"{topic.name}.{topic.axes[0]}" for name, topic in rest.items()}  # or their rows are not read
    source = _config(product, site, more).source
    assert isinstance(source, FileSource)
    _check_twice(recordings)
    found = dict[tuple[str, str | int], LogSensor]()
    for name in recordings:
        for one in _in_log(product, source, name):
            before = found.get(key := (one.channel, one.device or one.number))
            if before is not None and name in before.recordings:
                raise ConfigError(
                    f"{name}: has the device id {one.device} as {before.name} and as {one.name}, two sensors were "
                    "expected to have two; use fit-map with a config for each"
                )
            found[key] = one if before is None else before.beside(one)
    order, first = list(PLATFORMS[product].topics), dict[str, LogSensor]()
    for one in found.values():
        if (other := first.setdefault(one.name, one)) is not one:
            raise ConfigError(
                f"{one.recordings[0]}: has the device id {one.device or 'unknown'} as {one.name}, "
                f"{other.recordings[0]} has {other.device or 'none'}; give the logs of one vehicle, first one that has "
                "all its sensors"
            )
    return sorted(found.values(), key=lambda one: (order.index(one.channel), one.number))


def _in_log(product: str, source: FileSource, recording: str) -> Iterator[LogSensor]:
    """Yield the sensors of one log."""
    platform, path = PLATFORMS[product], part_of(recording)[0]
    with source.model_copy(update={"path": path}).open(path, Faults()) as table:
        for channel, topic in platform.topics.items():
            for at in topic.numbers:
                place = f"{topic.name}[{at}].{topic.axes[0]}"
                with suppress(MissingChannel):
                    if table.has(place):
                        about, unit = table.about(place), table.unit(place) or ""
                        yield LogSensor(channel, at + platform.first, about, unit, (recording,), (at,))


def _check_twice(recordings: Sequence[str]) -> None:
    """Raise ConfigError where the same rows are there twice: they would count as two soaks that agree."""
    parts = [(name, *part_of(name)) for name in recordings]
    digests = {path: _digest(path) for path in {path for _, path, _ in parts}} if len(parts) > 1 else {}
    for (name, path, span), (again, other, beside) in combinations(parts, 2):
        begin = max(span.get("start") or 0.0, beside.get("start") or 0.0)
        ends = [end for end in (span.get("stop"), beside.get("stop")) if end is not None]
        if digests[path] == digests[other] and (not ends or begin < min(ends)):
            raise ConfigError(
                f"{again}: has the same rows as {name}, which would count twice; give each log once, or parts of it "
                "that do not overlap"
            )


def _digest(path: Path) -> str:
    """Return the SHA-256 of a log's plain bytes."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        packed = file.read(2) == reading.GZIP
        file.seek(0)
        unpacked: Callable[[bytes], bytes] = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress if packed else bytes
        while data := file.read(BLOCK):
            total.update(unpacked(data))
    return total.hexdigest()
