"""A ULog as a PX4 vehicle writes it: one gyro and one accelerometer, for rehearsals.

::

    header | flags | information | formats | parameters | subscriptions | a row of each sensor at each sample

Times are those since power-up, `BOOT` before the first sample. There are no synchronisation messages, which the format
leaves to the writer.

Source: the ULog file format (docs.px4.io, Log File Format), PX4's msg/SensorGyro.msg and msg/SensorAccel.msg of 1.14.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import ClassVar

import numpy as np

from fusion_core.chunk import Chunk

BOOT = 20.0  # s
DEVICE = 2490378  # 0x26000A: an ICM-42688-P on the first SPI bus
TOPICS = {"sensor_gyro": "gyro", "sensor_accel": "accel"}
FIELDS = (
    "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;float temperature;"
    "uint32_t error_count;uint8_t[3] clip_counter;uint8_t samples;"
)
ROW = np.dtype([
    ("size", "<u2"), ("type", "u1"), ("subscription", "<u2"), ("timestamp", "<u8"), ("timestamp_sample", "<u8"),
    ("device_id", "<u4"), ("xyz", "<f4", 3), ("temperature", "<f4"), ("error_count", "<u4"), ("clip_counter", "u1", 3),
    ("samples", "u1"),
])  # fmt: skip
PARAMETERS = {
    "CAL_ACC0_ID": DEVICE, "CAL_GYRO0_ID": DEVICE, "SDLOG_MODE": 2, "SDLOG_PROFILE": 5, "SENS_IMU_AUTOCAL": 0,
    "TC_A_ENABLE": 0, "TC_G_ENABLE": 0,
}  # fmt: skip


class ULogWriter:
    """A log that is being written."""

    names: ClassVar[tuple[str, ...]] = ("gyro", "accel", "temperature")

    def __init__(self, path: Path, note: str) -> None:
        self._file = path.open("wb")
        texts = {"sys_name": "PX4", "ver_hw": "SIMULATED", "note": note}
        parts = [b"ULog\x01\x125\x01" + struct.pack("<Q", round(BOOT * 1e6)), _message("B", bytes(40))]
        parts += [_message("I", _keyed(f"char[{len(text)}] {name}") + text.encode()) for name, text in texts.items()]
        parts += [_message("F", f"{topic}:{FIELDS}".encode()) for topic in TOPICS]
        parts += [_message("P", _keyed(f"int32_t {name}") + struct.pack("<i", v)) for name, v in PARAMETERS.items()]
        parts += [_message("A", struct.pack("<BH", 0, k) + topic.encode()) for k, topic in enumerate(TOPICS)]
        self._file.write(b"".join(parts))

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""
        rows = np.zeros((len(chunk), len(TOPICS)), ROW)
        rows["size"], rows["type"], rows["subscription"] = ROW.itemsize - 3, ord("D"), range(len(TOPICS))
        rows["timestamp"] = rows["timestamp_sample"] = np.rint((BOOT + chunk.t) * 1e6)[:, None]
        rows["device_id"], rows["temperature"], rows["samples"] = DEVICE, chunk["temperature"][:, None], 1
        for k, name in enumerate(TOPICS.values()):
            rows["xyz"][:, k] = chunk[name]
        self._file.write(rows.tobytes())

    def close(self) -> None:
        """Finish the log."""
        self._file.close()


def _message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def _keyed(key: str) -> bytes:
    return struct.pack("<B", len(key)) + key.encode()
