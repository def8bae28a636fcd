"""The topics of a PX4 log as columns: the rows are those of one topic, the others are joined to them by time.

::

    sensor_gyro.x       of the gyro that is read          sensor_gyro[1].x     of instance 1
    sensor_gyro.time    of the sample; of the message where the log has no other

Another topic without a number is the instance that belongs to the gyro: by PX4's own pairs (`vehicle_imu`), else at the
same bus and address (`device_id`), else of the same part on that bus, else of the same number, else the first.

The columns are raw: PX4's drivers turn `sensor_gyro` and `sensor_accel` into the axes of the board and correct nothing
(src/lib/drivers/gyroscope/PX4Gyroscope.cpp, since 1.11). Before 1.11 they took CAL_GYROn_{X,Y,Z}OFF off, and of an
accelerometer CAL_ACCn too: from the log's own parameters that is undone. TC_* and SENS_BOARD_ROT act later, on
`vehicle_imu` and what follows from it (src/lib/sensor_calibration/Gyroscope.hpp).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Block, Table
from fusion_core.contracts.table import row_blocks
from fusion_core.errors import MissingChannel
from fusion_core.faults import Faults
from fusion_plugins.sources.joining import FieldPath, joined, taken_apart
from fusion_plugins.sources.ulog.file import Instance, LogFile, described, same_part, same_place

TIME = "time"
AXES = ("x", "y", "z")
UNITS = {  # of a field, by itself and by its topic: a ULog names none
    **{("", name): "us" for name in (TIME, "timestamp", "timestamp_sample")},
    **{("sensor_gyro", axis): "rad/s" for axis in AXES},
    **{("sensor_accel", axis): "m/s^2" for axis in AXES},
    **{("sensor_mag", axis): "G" for axis in AXES},
    ("", "temperature"): "degC",
    ("", "voltage_v"): "V",
    ("", "current_a"): "A",
}
LEAST_PA = 2000.0  # no mbar is more, no Pa under 25 km less
CALIBRATED = {"sensor_gyro": "GYRO", "sensor_accel": "ACC"}  # and what its parameters are called
SLOTS = {**CALIBRATED, "sensor_baro": "BARO", "sensor_mag": "MAG"}
ASTRAY = 1e6  # us: a time stamp that stands out from the four about it by more is damaged; disorder of less is sorted


class ULogTopics(Table):
    """The columns of an open log; `gyro` is the instance that is read, None where the log has none."""

    noun: ClassVar[str] = "field"

    def __init__(self, log: LogFile, gyro: Instance | None, faults: Faults) -> None:
        self.log, self.gyro, self.faults = log, gyro, faults

    @property
    def names(self) -> Sequence[str]:
        """The fields of the gyro and of what belongs to it, then those of all instances."""
        topics = sorted({topic for topic, _ in self.log.instances}, key=_order)
        defaults = [(topic, self.default(topic)) for topic in topics]
        several = [i for topic in topics if len(instances := self.log.of(topic)) > 1 for i in instances]
        return [
            *(f"{topic}.{name}" for topic, instance in defaults if instance for name in _fields(instance)),
            *(f"{i.name}.{name}" for i in several for name in _fields(i)),
        ]

    def has(self, path: str) -> bool:
        """Return True if there is such a topic with such a field."""
        instance = self.instance(path)
        return instance is not None and _column(path).field in _fields(instance)

    def unit(self, path: str) -> str | None:
        """Return the unit that PX4's messages have for a field, where it is known."""
        column, instance = _column(path), self.instance(path)
        if column == ("sensor_baro", column.number, "pressure") and instance is not None:
            return "Pa" if np.median(instance.samples["pressure"]) > LEAST_PA else "mbar"  # since 1.14, before
        return UNITS.get((column.name, column.field)) or UNITS.get(("", column.field))

    def about(self, path: str) -> Mapping[str, str]:
        """Return device number and instance, and the n of the CAL_GYROn_ID (CAL_ACCn_ID) that is the device's."""
        instance = self.instance(path)
        if instance is None or not instance.device:
            return {}
        begin = f"CAL_{SLOTS.get(instance.topic, '')}"
        slots = [n for n in range(4) if self.log.parameters.get(f"{begin}{n}_ID") == instance.device]
        device = {"device_id": str(instance.device), "instance": str(instance.number)}
        return device | ({"calibration": str(slots[0])} if slots else {})

    def instance(self, path: str) -> Instance | None:
        """Return the instance that a path names."""
        column = _column(path)
        if column.number is not None:
            return self.log.instances.get((column.name, column.number))
        return self.default(column.name) if column.field else None

    def default(self, topic: str) -> Instance | None:
        """Return the instance of a topic that belongs to the gyro."""
        instances = self.log.of(topic)
        if self.gyro is None or not instances:
            return instances[0] if instances else None
        if topic == self.gyro.topic:
            return self.gyro
        device = self.gyro.device
        for imu in self.log.of("vehicle_imu") if topic == "sensor_accel" else []:
            if device and device in imu.samples.get("gyro_device_id", ()):
                paired = {int(one) for one in imu.samples.get("accel_device_id", ())}
                if ours := [i for i in instances if i.device in paired]:
                    return ours[0]
        place = [i for i in instances if same_place(i.device, device)]
        part = [i for i in instances if same_part(i.device, device)]
        number = [i for i in instances if i.number == self.gyro.number]
        return (place or part or number or instances)[0]

    def notes(self, paths: Sequence[str]) -> list[str]:
        """Return notes on the sensors that `paths` name: their devices, and the corrections of the vehicle itself."""
        read = list(dict.fromkeys(i for path in paths if (i := self.instance(path))))
        others = [i for i in self.log.of("sensor_gyro") if i not in read]
        lines = [f"read are {'; '.join(map(str, read))}"]
        if others:
            lines.append(f"not read are {'; '.join(map(str, others))}")
        names = [name for name in ("TC_G_ENABLE", "TC_A_ENABLE") if self.log.parameters.get(name)]
        names += [name for i in read for axis in AXES if (name := self._offset(i, axis)) and self.log.parameters[name]]
        if names:
            have = ", ".join(f"{name} = {self.log.parameters[name]:.6g}" for name in names)
            lines.append(f"the vehicle itself corrects by {have}; the columns read are without that")
        if any(i.topic in CALIBRATED and before_1_11(i) for i in read):
            lines.append("is of firmware before 1.11, whose CAL_ offsets and scales were taken out")
        return [f"{self.log.path.name}: {line}" for line in lines]

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of `size` rows of the topic of the first path."""
        named = {path: self._instance(path) for path in paths}
        instances = list(dict.fromkeys(named.values()))  # the leading one first
        wanted = {i: [_column(path).field for path in paths if named[path] is i] for i in instances}
        data = self.log.read(wanted, self.faults)
        self._check_temperatures(named, data)
        t, values = np.empty(0), dict[str, Array]()
        for instance in instances:
            fields, own = [path for path in paths if named[path] is instance], data.pop(instance)
            times, rows = self._rows(instance, own)
            columns = [self._column(instance, own, _column(path).field)[rows] for path in fields]
            if instance is instances[0]:
                t = times
            else:
                columns = [*joined(t, times, np.column_stack(columns)).T]
            values |= zip(fields, columns, strict=True)
        del own, times, rows, columns
        yield from row_blocks(len(t), size, lambda rows, path: np.asarray(values[path][rows], dtype=np.float64))

    def _instance(self, path: str) -> Instance:
        instance = self.instance(path)
        assert instance is not None, "the source asked for it before"
        return instance

    def _column(self, instance: Instance, data: Mapping[str, Array], field: str) -> Array:
        """Return a field of a topic, as the sensor gave it."""
        if field == TIME:
            return _times(data)
        offset, scale = self.calibration(instance, field)
        values = np.asarray(data[field])
        return values if (offset, scale) == (0.0, 1.0) else values / scale + offset

    def calibration(self, instance: Instance, field: str) -> tuple[float, float]:
        """Return offset and scale that the vehicle's driver has applied to an axis: `(raw - offset) scale`."""
        offset = self._offset(instance, field)
        if offset is None or not before_1_11(instance):
            return 0.0, 1.0
        scale = float(self.log.parameters.get(offset.replace("OFF", "SCALE"), 1.0))
        return float(self.log.parameters[offset]), scale or 1.0

    def _offset(self, instance: Instance, axis: str) -> str | None:
        """Return the parameter that has the vehicle's offset of an axis, by the device it is for."""
        known, sensor = self.log.parameters, CALIBRATED.get(instance.topic)
        for n in range(4) if sensor and axis in AXES and instance.device else ():
            name = f"CAL_{sensor}{n}_{axis.upper()}OFF"
            if known.get(f"CAL_{sensor}{n}_ID") == instance.device and name in known:
                return name
        return None

    def _rows(self, instance: Instance, data: Mapping[str, Array]) -> tuple[Array, np.ndarray]:
        """Return the times of a topic's rows, rising, and which of its rows they are."""
        t = _times(data)
        rows = np.arange(len(t))
        if np.all(t[1:] >= t[:-1]):
            return t, rows
        from scipy.ndimage import median_filter

        good = np.abs(t - median_filter(t, 5, mode="nearest")) <= ASTRAY
        first = t[int(np.argmin(good))]
        what = f"rows of {instance.name} whose time stamp is damaged, left out"
        self.faults.add(what, int(np.sum(~good)), f"at t = {first / 1e6:.3f} s")
        rows = rows[good]
        back = np.diff(t[rows])
        if np.all(back > -ASTRAY):  # else two logs in one file: refused by whoever uses the rows
            first = t[rows][1:][back < 0][:1].sum()
            what = f"rows of {instance.name} that came after a later one, put in order"
            self.faults.add(what, int(np.sum(back < 0)), f"at t = {first / 1e6:.3f} s")
            rows = rows[np.argsort(t[rows], kind="stable")]
        return t[rows], rows

    def _check_temperatures(self, named: Mapping[str, Instance], data: Mapping[Instance, Mapping[str, Array]]) -> None:
        """Raise MissingChannel where a temperature that is asked for was never measured."""
        for path, instance in named.items():
            field = _column(path).field
            if field != "temperature" or not np.all(np.isnan(data[instance][field])) or not len(data[instance][field]):
                continue
            others = [
                i for i in self.log.instances.values() if i.topic.startswith("sensor") and np.isfinite(i.temperature)
            ]
            have = "; ".join(map(str, others)) or "no other sensor of the log has one"
            beside = self.default("sensor_accel")
            name = others[0].name if others else ""
            if beside is not None and np.isfinite(beside.temperature):
                name = "sensor_accel"  # the one beside it
            advice = f"set source.channels.temperature.path: {name}.temperature, or another's" if name else "log one"
            raise MissingChannel(
                f"{self.log.path}: {instance.name}, {described(instance.device)}, measures no temperature (NaN in all "
                f"rows); {advice}: {have}"
            )


def _column(path: str) -> FieldPath:
    return taken_apart(path) or FieldPath(path, None, "")


def before_1_11(instance: Instance) -> bool:
    """Return True if a raw topic is of firmware whose drivers applied the calibration, by its fields."""
    return "integral_dt" in instance.samples or "error_count" not in instance.samples


def _fields(instance: Instance) -> list[str]:
    return [TIME, *instance.samples]


def _order(topic: str) -> tuple[bool, bool, str]:
    return topic != "sensor_gyro", topic != "sensor_accel", topic


def _times(data: Mapping[str, Array]) -> Array:
    """Return the times of the samples [us]; those of the messages where the log has no others."""
    sent = np.asarray(data["timestamp"], dtype=np.float64)
    if "timestamp_sample" not in data:
        return sent
    sampled = np.asarray(data["timestamp_sample"], dtype=np.float64)
    return np.where(sampled > 0, sampled, sent)
