"""A PX4 log written from arrays: what a vehicle could have written, for tests and for the proof on measured data.

::

    header | flags | info | formats | parameters | subscriptions | rows in the order of their time, dropouts, text

Source: the ULog file format (docs.px4.io, Log File Format) and PX4's msg/SensorGyro.msg, msg/SensorAccel.msg.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

MAGIC = b"ULog\x01\x125\x01"
SYNC = bytes.fromhex("2f731320250cbb12")
NUMPY = {"uint64_t": "<u8", "uint32_t": "<u4", "uint8_t": "u1", "float": "<f4", "int16_t": "<i2", "int32_t": "<i4"}
STAMPS = ["uint64_t timestamp", "uint64_t timestamp_sample"]
SENSOR = [*STAMPS, "uint32_t device_id", "float x", "float y", "float z", "float temperature", "uint32_t error_count"]
FORMATS = {  # of PX4 1.14; larger fields first, then what fills up to eight bytes
    "sensor_gyro": [*SENSOR, "uint8_t[3] clip_counter", "uint8_t samples"],
    "sensor_accel": [*SENSOR, "uint8_t[3] clip_counter", "uint8_t samples"],
    "sensor_baro": [*STAMPS, "uint32_t device_id", "float pressure", "float temperature", "uint32_t error_count"],
}


@dataclass
class Topic:
    """The rows of one instance of a topic: `fields` by name, (N,) or (N, count), `timestamp` (us) among them."""

    name: str
    fields: Mapping[str, np.ndarray]
    instance: int = 0
    format: Sequence[str] | None = None  # `FORMATS[name]` where nothing is said

    @property
    def types(self) -> Sequence[str]:
        """Type and name of each field."""
        return FORMATS[self.name] if self.format is None else self.format


@dataclass
class Extras:
    """Other records of a log: dropouts as (time in us, ms), lines of text as (time in us, text)."""

    dropouts: Sequence[tuple[int, int]] = ()
    texts: Sequence[tuple[int, str]] = ()
    info: Mapping[str, str] = field(default_factory=lambda: {"sys_name": "PX4", "ver_hw": "DRIFTLAB_TEST"})


def sensor(name, instance, t, xyz, temperature, device_id):
    """Return a topic `sensor_gyro` or `sensor_accel`: t (N,) s, xyz (N, 3), temperature (N,) degC."""
    stamp = np.round(np.asarray(t) * 1e6).astype(np.uint64)
    n = len(stamp)
    fields = {
        "timestamp": stamp + np.uint64(350),  # published after it was sampled
        "timestamp_sample": stamp,
        "device_id": np.full(n, device_id),
        **{axis: np.asarray(xyz)[:, k] for k, axis in enumerate("xyz")},
        "temperature": np.broadcast_to(temperature, n),
        "error_count": np.zeros(n),
        "clip_counter": np.zeros((n, 3)),
        "samples": np.full(n, 8),
    }
    return Topic(name, fields, instance)


def write_ulog(path, topics, parameters=None, extras=None):
    """Write a log and return its path.

    Parameters
    ----------
    path : path-like
    topics : sequence of Topic
        Their rows are written in the order of their time stamps.
    parameters : dict of str to int or float
        Of the vehicle, as TC_G_ENABLE.
    extras : Extras
    """
    extras = extras or Extras()
    start = min((int(topic.fields["timestamp"][0]) for topic in topics if len(topic.fields["timestamp"])), default=0)
    parts = [MAGIC + struct.pack("<Q", start), message("B", bytes(40))]
    parts += [message("I", keyed(f"char[{len(v.encode())}] {k}", v.encode())) for k, v in extras.info.items()]
    formats = {topic.name: topic.types for topic in topics}
    parts += [message("F", f"{name}:{''.join(f'{t};' for t in types)}".encode()) for name, types in formats.items()]
    parts += [message("P", parameter(name, value)) for name, value in (parameters or {}).items()]
    for number, topic in enumerate(topics):
        parts.append(message("A", struct.pack("<BH", topic.instance, number) + topic.name.encode()))
    parts += in_order(topics, extras)
    Path(path).write_bytes(b"".join(parts))
    return Path(path)


def message(kind, payload):
    """Return one message."""
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def keyed(key, value):
    """Return the payload of an information or a parameter."""
    return struct.pack("<B", len(key.encode())) + key.encode() + value


def parameter(name, value):
    """Return the payload of a parameter: whole numbers are INT32, others REAL32."""
    whole = isinstance(value, int)
    return keyed(f"{'int32_t' if whole else 'float'} {name}", struct.pack("<i" if whole else "<f", value))


def in_order(topics, extras):
    """Return rows, dropouts and text as messages in the order of their time, each second begun by a synchronisation."""
    found = [(int(t), 0, message("O", struct.pack("<H", ms))) for t, ms in extras.dropouts]
    found += [(int(t), 0, message("L", struct.pack("<BQ", ord("6"), int(t)) + s.encode())) for t, s in extras.texts]
    for number, topic in enumerate(topics):
        packed = rows(topic)
        raw, size = packed.tobytes(), packed.itemsize
        begin = struct.pack("<HBH", size + 2, ord("D"), number)
        stamps = packed["timestamp"].tolist()
        found += [(t, 1 + number, begin + raw[k * size : (k + 1) * size]) for k, t in enumerate(stamps)]
    found.sort(key=lambda one: one[:2])
    parts, second = [], -1
    for t, _, content in found:
        if t // 1_000_000 > second:
            second = t // 1_000_000
            parts.append(message("S", SYNC))
        parts.append(content)
    return parts


def rows(topic):
    """Return the rows of a topic as PX4 packs them."""
    dtype = []
    for declared in topic.types:
        kind, _, name = declared.partition(" ")
        base, _, count = kind.partition("[")
        dtype.append((name, NUMPY[base], (int(count[:-1]),)) if count else (name, NUMPY[base]))
    packed = np.zeros(len(topic.fields["timestamp"]), np.dtype(dtype))
    for name, values in topic.fields.items():
        packed[name] = values
    return packed
