"""A device on a real pty pair, and the frames that it sends; the frames are packed here without the decoder's code."""

import os
import struct
import threading
import time
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from units_at_rest import unit_at_rest

SYNC = bytes.fromhex("A5 5A")
FRAMING = {
    "kind": "binary",
    "sync": "A5 5A",
    "fields": [
        {"name": "sequence", "type": "uint16"},
        {"name": "gyro", "type": "float64", "count": 3, "unit": "rad/s"},
        {"name": "accel", "type": "float64", "count": 3, "unit": "m/s^2"},
        {"name": "temperature", "type": "int16", "scale": 0.01, "unit": "degC"},
    ],
    "checksum": {"kind": "CRC-32/ISO-HDLC"},
    "counter": {"field": "sequence", "modulo": 65536},
}
SIZE = 2 + 2 + 48 + 2 + 4


def frame(k, gyro=(1e-3, -2e-3, 3e-3), accel=(0.0, 0.0, 9.80665), temperature=25.0):
    body = SYNC + struct.pack("<H6dh", k % 65536, *gyro, *accel, round(temperature * 100))
    return body + struct.pack("<I", zlib.crc32(body))


def unit_frames(seconds, rate, seed=0):
    """Frames of a unit at rest, one after the other."""
    unit = unit_at_rest(seconds=seconds, rate=rate, seed=seed)
    return [frame(k, unit.gyro[k], unit.accel[k], unit.temperature[k]) for k in range(len(unit.t))]


@contextmanager
def live_bench(folder, rate):
    """Yield a folder with a config, and the device that it names."""
    device = Device(folder)
    walk = {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}
    content = {
        "latitude": "40.9 deg",
        "source": {"kind": "serial", "port": str(device.path), "interval": f"{1 / rate} s", "framing": FRAMING},
        "filter": {"align": "1 s", "accel": None, "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": walk}},
    }
    (folder / "live.yaml").write_text(yaml.safe_dump(content))
    yield folder, device
    device.close()


class Device:
    """The far end of a pty; `path` is the port, also after it was unplugged and plugged in again."""

    def __init__(self, folder: Path):
        self.path = folder / "ttyDEVICE"
        self.master = None
        self.plug()

    def plug(self):
        tty = pytest.importorskip("tty", reason="terminals are those of POSIX")
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(slave))
        self.slave = slave

    def unplug(self):
        self.path.unlink()
        os.close(self.slave)
        os.close(self.master)
        self.master = None

    def send(self, data: bytes, wait=True):
        """Write all, waiting while the port's buffer is full; without `wait` the rest is lost, as on a wire."""
        if self.master is None:
            raise OSError("unplugged")
        view = memoryview(data)
        while view:
            try:
                view = view[os.write(self.master, view) :]
            except BlockingIOError:
                if not wait:
                    return
                time.sleep(1e-3)

    def close(self):
        if self.master is not None:
            self.unplug()


def paced(device, frames, rate, stop=None):
    """Send frames at a rate from a thread of its own; return the thread."""

    def run():
        begun = time.monotonic()
        for k, one in enumerate(frames):
            if stop is not None and stop.is_set():
                return
            time.sleep(max(0.0, begun + k / rate - time.monotonic()))
            try:
                device.send(one, wait=False)
            except OSError:
                return  # unplugged

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def some(chunks, count, seconds=20.0):
    """Take chunks until there are `count` samples; the last ones may be more."""
    from fusion_core.chunk import concatenate

    parts, rows, begun = [], 0, time.monotonic()
    for chunk in chunks:
        if len(chunk):
            parts.append(chunk)
            rows += len(chunk)
        if rows >= count:
            return concatenate(parts)
        if time.monotonic() - begun > seconds:
            raise TimeoutError(f"{rows} of {count} samples came in {seconds} s")
    return np.nan
