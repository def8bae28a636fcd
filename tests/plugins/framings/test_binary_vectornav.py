"""The preset of VectorNav units, on a packet of their manual and on frames packed byte by byte."""

import numpy as np
from device_frames import crc_of_vectornav, source_of, vectornav
from recordings_on_disk import read, text

from fusion_plugins.framings.binary import Binary
from fusion_plugins.sources.binary_log import BinaryLog

# UM001, section 5.3.7, example case 1: yaw 43.578686, pitch 1.8847202, roll -2.0249654e-3, CRC 9288
OF_THE_MANUAL = bytes.fromhex("FA010800 93502E42 833EF13F 48B504BB 9288")


def test_the_example_of_vectornavs_manual():
    assert crc_of_vectornav(OF_THE_MANUAL[1:-2]) == OF_THE_MANUAL[-2:]
    framing = Binary.model_validate({
        "sync": "FA 01 08 00", "fields": [{"name": "attitude", "type": "float32", "count": 3}],
        "checksum": {"kind": "CRC-16/XMODEM", "start": 1, "byte_order": "big"},
    })  # fmt: skip
    frames, _ = framing.decode(b"\xfa" + OF_THE_MANUAL + OF_THE_MANUAL, None)
    np.testing.assert_allclose(frames.channels["attitude"], [[43.578686, 1.8847202, -2.0249654e-3]] * 2, rtol=1e-7)


def test_vectornav_over_a_file(tmp_path):
    at = 3 * 10**12 + 20_000_000 * np.array([*range(50), *range(60, 100)], dtype=np.int64)  # ns since start-up
    frames = [vectornav(int(ns), temperature=20 + k / 8) for k, ns in enumerate(at)]
    flipped = bytearray(frames[3])
    flipped[20] ^= 1
    frames[3] = bytes(flipped)
    path = text(tmp_path, OF_THE_MANUAL + b"".join(frames), "vn.bin")
    source = source_of("vectornav_imu", {"kind": "binary_log", "path": str(path)})
    assert isinstance(source, BinaryLog)
    got = read(source)
    kept = np.delete(np.arange(len(at)), 3)
    np.testing.assert_allclose(got.t, (at[kept] - at[0]) * 1e-9, atol=1e-12)
    np.testing.assert_allclose(got["gyro"], [[0.01, -0.02, 0.03]] * len(kept), rtol=1e-7)
    np.testing.assert_allclose(got["accel"][:, 2], -9.8, rtol=1e-7)
    np.testing.assert_allclose(got["temperature"], 20 + kept / 8)
