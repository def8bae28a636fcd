"""ROS bags read by the source and by rosbags' reader with its deserializer: the same values, side by side."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import Row, best, limit, ratio, show
from rosbags.highlevel import AnyReader

from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag import Rosbag

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from bags import BEGAN, KINDS, SECOND, write

CHANNELS = {
    "time": {"path": "/imu"},
    "gyro": {"path": "/imu.angular_velocity"},
    "accel": {"path": "/imu.linear_acceleration"},
}


def imu_at_200_hz(N: int, picture: int = 0, every: int = 10) -> Callable[..., object]:
    """Return a function that writes N messages of an inertial unit and, beside them, pictures of so many bytes."""

    def messages(types):
        rng = np.random.default_rng(1)
        layout = types("std_msgs/msg/MultiArrayLayout", [], 0)
        for k in range(N):
            stamp = BEGAN + k * SECOND // 200
            yield "/imu", stamp, types.imu(stamp, rng.normal(size=3), rng.normal(size=3))
            if picture and k % every == 0:
                pixels = np.zeros(picture, np.uint8)
                yield "/camera", stamp, types("std_msgs/msg/UInt8MultiArray", layout, pixels)

    return messages


def ours(path: Path) -> list[int]:
    return [len(chunk) for chunk in Rosbag(path=path, channels=CHANNELS).chunks(65_536, Faults())]


def theirs(path: Path) -> list[tuple[float, ...]]:
    found = []
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages([c for c in reader.connections if c.topic == "/imu"]):
            m = reader.deserialize(raw, connection.msgtype)
            w, f, stamp = m.angular_velocity, m.linear_acceleration, m.header.stamp
            found.append((stamp.sec + stamp.nanosec * 1e-9, w.x, w.y, w.z, f.x, f.y, f.z))
    return found


def memory(path: Path) -> float:
    """Return the largest memory of a process that reads a bag, MB."""
    code = f"import rosbag; rosbag.measured({str(path)!r})"
    here = Path(__file__).parent
    done = subprocess.run([sys.executable, "-c", code], cwd=here, capture_output=True, text=True, check=True)
    return float(done.stdout)


def measured(path: str) -> None:
    ours(Path(path))
    status = Path("/proc/self/status").read_text()  # what resource.getrusage says begins with the parent's
    print(float(status.partition("VmHWM:")[2].split()[0]) / 1e3)


def rows(N: int = 20_000) -> list[Row]:
    """Return the rows of the table for bags with N messages of an inertial unit."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        for kind in KINDS:
            path = write(Path(name) / kind, kind, imu_at_200_hz(N))
            mine, other = best(lambda path=path: ours(path), lambda path=path: theirs(path), turns=3)
            found.append(limit(f"ROS bag ({kind}), a message", mine / N * 1e6, "µs", 5))
            found.append(limit(f"rosbags' reader and deserializer ({kind}), a message", other / N * 1e6, "µs"))
            found.append(ratio(f"ROS bag ({kind}), against rosbags", mine, other))
            bare, size = memory(path), N // 80 * 0.36
            path = write(Path(name) / f"{kind}_camera", kind, imu_at_200_hz(N // 4, 360_000, 20))
            more = memory(path) - bare
            found.append(
                limit(f"ROS bag ({kind}), memory that {size:.0f} MB of pictures beside it cost", more, "MB", 20)
            )
            (mine,) = best(lambda path=path: ours(path), turns=3)
            found.append(limit(f"ROS bag ({kind}), a message, with these pictures", mine / N * 4e6, "µs"))
    return found


def main() -> None:
    show("ROS bags", rows())


if __name__ == "__main__":
    main()
