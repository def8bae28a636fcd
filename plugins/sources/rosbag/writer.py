"""A bag of ROS 1 (`.bag`) or ROS 2 (`.mcap`) as a driver writes it: `/imu/data` and `/imu/temperature`, for rehearsals.

The messages have a fixed length: they are laid out as arrays, byte by byte as `sensor_msgs` prescribes, and put into
the file by the writers of rosbags.

::

    Imu           header | orientation 4, covariance 9 | rate 3, covariance 9 | acceleration 3, covariance 9
    Temperature   header | temperature, variance
    header        ROS 1: sequence, sec, nsec, length, frame        ROS 2 (CDR): sec, nanosec, length, frame, 0, filling

An orientation that is not known has -1 for its first covariance. Source: sensor_msgs/Imu.msg, Temperature.msg.
"""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array, Chunk, Integers

BEGAN = 1_767_225_600  # s since 1970, of the first sample: 2026-01-01
SECOND = 10**9
FRAME = "imu_link"
TOPICS = (("/imu/data", "sensor_msgs/msg/Imu"), ("/imu/temperature", "sensor_msgs/msg/Temperature"))
NOTE = ("/note", "std_msgs/msg/String")


class BagWriter:
    """A bag that is being written."""

    names: ClassVar[tuple[str, ...]] = ("gyro", "accel", "temperature")

    def __init__(self, path: Path, *, ros1: bool, note: str) -> None:
        from rosbags.rosbag1 import Writer as Ros1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Ros2
        from rosbags.typesys import Stores, get_typestore

        types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self._path, self._ros1, self._sent = path, ros1, 0
        self._beside = TemporaryDirectory(prefix=".driftlab-", dir=path.parent)
        self._folder = Path(self._beside.name) / "bag"  # of ROS 2, whose bag is a folder of files
        path.unlink(missing_ok=True)
        self._bag: Any = Ros1(path) if ros1 else Ros2(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._bag.open()
        said, text = self._bag.add_connection(*NOTE, typestore=types), types.types[NOTE[1]](note)
        raw = types.serialize_ros1(text, NOTE[1]) if ros1 else types.serialize_cdr(text, NOTE[1])
        self._bag.write(said, BEGAN * SECOND, raw)
        self._topics = [self._bag.add_connection(*topic, typestore=types) for topic in TOPICS]

    def append(self, chunk: Chunk) -> None:
        """Add the rows of a chunk."""
        imu, temperature = np.zeros((len(chunk), 37)), np.zeros((len(chunk), 2))
        imu[:, 3], imu[:, 4] = 1.0, -1.0
        imu[:, 13:16], imu[:, 25:28], temperature[:, 0] = chunk["gyro"], chunk["accel"], chunk["temperature"]
        stamps = BEGAN * SECOND + np.rint(chunk.t * SECOND).astype(np.int64)
        rows = self._messages(stamps, imu), self._messages(stamps, temperature)
        for k, stamp in enumerate(stamps.tolist()):
            for topic, messages in zip(self._topics, rows, strict=True):
                self._bag.write(topic, stamp, messages[k].tobytes())
        self._sent += len(chunk)

    def _messages(self, stamps: Integers, numbers: Array) -> NDArray[np.void]:
        """Return messages of a header and numbers, (N,)."""
        size = len(FRAME) if self._ros1 else len(FRAME) + 1
        first, filling = ("seq", 0) if self._ros1 else ("encoding", -(12 + size) % 8)
        head = [(first, "<u4"), ("sec", "<u4"), ("nsec", "<u4"), ("size", "<u4"), ("frame", f"S{size}")]
        rows = np.zeros(len(stamps), [*head, ("filling", f"V{filling}"), ("numbers", "<f8", numbers.shape[1])])
        rows[first] = self._sent + np.arange(len(rows)) if self._ros1 else 0x100  # CDR, little endian
        rows["sec"], rows["nsec"] = stamps // SECOND, stamps % SECOND
        rows["size"], rows["frame"], rows["numbers"] = size, FRAME.encode(), numbers
        return rows

    def close(self) -> None:
        """Finish the bag."""
        self._bag.close()
        if not self._ros1:
            os.replace(self._folder / "bag.mcap", self._path)
        self._beside.cleanup()
