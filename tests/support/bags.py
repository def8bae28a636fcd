"""ROS bags that rosbags' own writers make, and what its own reader reads back."""

from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("ros1", "sqlite3", "mcap")
SECOND = 10**9
BEGAN = 1_700_000_000 * SECOND
CUSTOM = "acme_msgs/msg/Sample"
TEXT = """std_msgs/Header header
string note
float32[] gains
uint8 flags
int16[3] counts
float64 scale
geometry_msgs/Vector3[] points
uint64 ticks
bool on
sensor_msgs/Imu imu
"""


N, STEP = 3000, SECOND // 200
RNG = np.random.default_rng(3)
GYRO, ACCEL = RNG.normal(size=(N, 3)), RNG.normal(size=(N, 3))
FIELDS = {
    "time": {"path": "/imu/data"},
    "gyro": {"path": "/imu/data.angular_velocity"},
    "accel": {"path": [f"/imu/data.linear_acceleration.{axis}" for axis in "xyz"]},
    "temperature": {"path": "/imu/temperature.temperature"},
}


class Types:
    """Makes messages of either ROS."""

    def __init__(self, ros1):
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self.store.register(get_types_from_msg(TEXT, CUSTOM))
        self.ros1 = ros1

    def __call__(self, kind, *values, **fields):
        return self.store.types[kind](*values, **fields)

    def header(self, stamp, frame="imu_link"):
        time = self("builtin_interfaces/msg/Time", stamp // SECOND, stamp % SECOND)
        return self("std_msgs/msg/Header", stamp=time, frame_id=frame, **({"seq": 7} if self.ros1 else {}))

    def vector(self, values):
        return self("geometry_msgs/msg/Vector3", *map(float, values))

    def imu(self, stamp, gyro, accel, frame="imu_link"):
        nine = np.arange(9.0)
        return self(
            "sensor_msgs/msg/Imu", self.header(stamp, frame), self("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
            nine, self.vector(gyro), nine + 10, self.vector(accel), nine + 20,
        )  # fmt: skip

    def temperature(self, stamp, value):
        return self("sensor_msgs/msg/Temperature", self.header(stamp), float(value), 0.1)

    def bytes(self, message):
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        return bytes(serialize(message, message.__msgtype__))


def write(path: Path, kind: str, messages, compression: str = "") -> Path:
    """Write (topic, time of the log, message) as `messages(Types)` yields them; return where a source finds them."""
    types = Types(kind == "ros1")
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
        if compression:
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, time, message in messages(types):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=types.store)
            writer.write(connections[topic], time, types.bytes(message))
    return path


def of_rosbags(path: Path, topic: str) -> list:
    """Return (time of the log, message) of a topic as rosbags' reader has them."""
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        return [(time, reader.deserialize(raw, c.msgtype)) for c, time, raw in reader.messages(wanted)]


def storage_file(path: Path) -> Path:
    """Return the one file that holds the messages of a bag."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


def stamps(n=N):
    return BEGAN + np.arange(n, dtype=np.int64) * STEP


def unit(types, n=N, late=3_000_000, camera=True):
    """An inertial unit at 200 Hz, its thermometer at 1 Hz, and a camera that writes far more than both."""
    for k, stamp in enumerate(stamps(n).tolist()):
        yield "/imu/data", stamp + late, types.imu(stamp, GYRO[k], ACCEL[k])
        if k % 200 == 0:
            yield "/imu/temperature", stamp + late + 1, types.temperature(stamp, 20 + k / 200)
        if camera and k % 20 == 0:
            picture = types("std_msgs/msg/UInt8MultiArray", types("std_msgs/msg/MultiArrayLayout", [], 0),
                            np.zeros(20_000, np.uint8))  # fmt: skip
            yield "/camera", stamp + late + 2, picture
