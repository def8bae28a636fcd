"""Reading time of a device's frame from a file: VectorNav, Xsens and a counter's frames, and the copy of the bytes.

Each is read from a file of half a million frames, the best of three runs; beside it, what Python needs to look at every
frame once (`struct.unpack_from` in a loop), which decides nothing and checks no sum.
"""

import struct
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from bench import FRAMING, SIZE, frame
from device_frames import one, source_of, vectornav

from fusion_core.faults import Faults
from fusion_plugins.sources.binary_log import BinaryLog

FRAMES, DISTINCT, RUNS = 500_000, 10_000, 3


def best(do):
    took = []
    for _ in range(RUNS):
        begun = time.perf_counter()
        do()
        took.append(time.perf_counter() - begun)
    return min(took) / FRAMES * 1e6


def looped(data, size):
    for at in range(0, len(data), size):
        struct.unpack_from("<6f", data, at + 4)


def main():
    repeats = FRAMES // DISTINCT
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.bin"
        cases = {
            "binary, CRC-32": (b"".join(frame(k) for k in range(DISTINCT)), None),
            "vectornav_imu": (b"".join(vectornav(k * 1_000_000) for k in range(DISTINCT)), "vectornav_imu"),
            "xsens_mtdata2": (
                b"".join(one(k, 20.0 if k % 100 == 0 else None) for k in range(DISTINCT)),
                "xsens_mtdata2",
            ),
        }
        for name, (data, product) in cases.items():
            path.write_bytes(data * repeats)
            source = (
                BinaryLog(path=path, framing=FRAMING, interval=0.001)
                if product is None
                else source_of(product, {"kind": "binary_log", "path": str(path)})
            )
            read = best(lambda source=source: [len(chunk) for chunk in source.chunks(65_536, Faults())])
            size = SIZE if product is None else len(data) // DISTINCT
            loop = best(lambda data=data, size=size: looped(data[: size * (DISTINCT - 1)] * repeats, size))
            print(f"{name:16} {read:6.2f} us a frame   (a loop of struct.unpack_from: {loop:.2f})")


if __name__ == "__main__":
    main()
