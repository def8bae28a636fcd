"""Logs of PX4 (`.ulg`): the raw gyroscopes and accelerometers of an autopilot, with their temperatures.

::

    sensor_gyro, sensor_accel     raw, in the axes of the autopilot's board: read
    vehicle_imu, sensor_combined, vehicle_angular_velocity and what follows from them     corrected: refused

Parameters alone do not tell the corrections (the filter's own estimate of the bias is taken off too, and a notch filter
may be on), so corrected topics are refused whatever the parameters are. The gyro is chosen by `device_id` or
`instance`; a note names the one that was read, its part, and the corrections of the vehicle itself. See `table` for the
columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from fusion_core.contracts import FileSource, Table
from fusion_core.errors import ConfigError, MissingChannel, quote
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_core.units import problem
from fusion_plugins.sources.unpacked import plain_file, unpacking

if TYPE_CHECKING:
    from fusion_core.contracts.file_source import RecordingWriter
    from fusion_plugins.sources.ulog.file import Instance, LogFile
    from fusion_plugins.sources.ulog.table import ULogTopics

RAW = {"gyro": "sensor_gyro", "accel": "sensor_accel"}
CORRECTED = (
    "vehicle_imu", "vehicle_imu_status", "sensor_combined", "vehicle_angular_velocity", "vehicle_acceleration",
    "sensor_gyro_integrated", "sensor_accel_integrated",
)  # fmt: skip
LOGGING = "set SDLOG_PROFILE to 5 (10 Hz), or list it in etc/logging/logger_topics.txt, and log again"


def _number(value: object) -> object:
    """Return a device number that is written as text, `0x14010C` too."""
    if not isinstance(value, str):
        return value
    try:
        return int(value, 0)
    except ValueError:
        raise problem(f"'{quote(value)}' is no device_id; write it like 1310988 or \"0x14010C\"") from None


@hookimpl
class Ulog(FileSource):
    """A log of PX4."""

    signatures: ClassVar[tuple[bytes, ...]] = (b"ULog\x01\x125",)
    suffixes: ClassVar[tuple[str, ...]] = (".ulg",)
    written: ClassVar[tuple[str, ...]] = (".ulg",)
    product: ClassVar[str | None] = "px4_log"

    kind: Literal["ulog"] = "ulog"
    device_id: Annotated[int, BeforeValidator(_number)] | None = None
    """Of the gyro to read, as in CAL_GYROn_ID: `1310988` or `"0x14010C"`; the first by default."""
    instance: Annotated[int, Field(ge=0)] | None = None
    """Of the gyro to read: 1 is `sensor_gyro[1]`."""

    @model_validator(mode="after")
    def _check_topics(self) -> Self:
        if self.device_id is not None and self.instance is not None:
            raise problem("both device_id and instance are given; remove one (device_id stays with the part)")
        for name, raw in RAW.items():
            for path in self.channels[name].paths if name in self.channels else ():
                topic = path.partition(".")[0].partition("[")[0]
                if topic in CORRECTED:
                    raise problem(
                        f"channel {name} is read from {topic}, which the autopilot has corrected already (offsets, "
                        f"temperature, rotation, filters); read {raw}: where it is not in the log, {LOGGING}"
                    )
                if topic == f"{raw}_fifo":
                    raise problem(
                        f"channel {name} is read from {topic}, whose rows are packets of raw counts without a "
                        f"temperature; read {raw}, which has the mean of each packet"
                    )
        return self

    @unpacking
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the log; raises MissingChannel where it lacks a sensor that is asked for."""
        from fusion_plugins.sources.ulog.file import LogFile
        from fusion_plugins.sources.ulog.table import ULogTopics

        log = LogFile(path, self.kind)
        table = ULogTopics(log, self._gyro(log), faults)
        self._check_sensors(table)
        if table.gyro is not None:
            for note in table.notes([path for channel in self.channels.values() for path in channel.paths]):
                faults.note(note)
        yield table

    @classmethod
    def writer(cls, path: Path, suffix: str, note: str) -> RecordingWriter:
        """Begin a log."""
        from fusion_plugins.sources.ulog.writer import ULogWriter

        return ULogWriter(path, note)

    @classmethod
    def parameters(cls, path: Path) -> Mapping[str, float]:
        """Return the parameters with which a log begins."""
        from fusion_plugins.sources.ulog.file import LogFile

        with plain_file(path) as place:
            return LogFile(place, "ulog").parameters

    def _gyro(self, log: LogFile) -> Instance | None:
        """Return the gyro that the settings name."""
        gyros = log.of("sensor_gyro")
        if self.device_id is None and self.instance is None:
            paths = [path for name in ("gyro", "time") if name in self.channels for path in self.channels[name].paths]
            named = [i for path in paths for i in gyros if path.startswith(f"sensor_gyro[{i.number}].")]
            return next(iter([*named, *gyros]), None)
        chosen = [i for i in gyros if self.instance == i.number or (self.device_id or -1) == i.device]
        if chosen:
            return chosen[0]
        wanted = f"instance {self.instance}" if self.device_id is None else f"device_id {self.device_id}"
        have = "; ".join(map(str, gyros)) or "none"
        name = "instance" if self.device_id is None else "device_id"
        raise MissingChannel(f"{log.path}: has no gyro of {wanted}; correct source.{name}, the log has: {have}")

    def _check_sensors(self, table: ULogTopics) -> None:
        """Raise MissingChannel where the log lacks a topic or an instance."""
        for name, channel in self.channels.items():
            for path in channel.paths:
                if table.instance(path) is not None:
                    continue
                topic, _, rest = path.partition(".")
                if not rest:
                    raise ConfigError(
                        f"{self.kind}: source.channels.{name}.path: '{path}' names no field; write it like "
                        "sensor_gyro.x, or sensor_gyro[1].x for another instance"
                    )
                sensors = [i for i in table.log.instances.values() if i.topic.startswith(("sensor", "vehicle_imu"))]
                have = "; ".join(str(i) for i in sensors or table.log.instances.values()) or "nothing"
                advice = "correct the path" if table.log.of(topic.partition("[")[0]) else LOGGING
                raise MissingChannel(
                    f"{table.log.path}: has no rows of {topic} for channel {name}; {advice}. The log has: {have}"
                )
