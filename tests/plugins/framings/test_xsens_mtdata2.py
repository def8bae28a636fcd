"""Messages MTData2, on those that a unit sent and on messages packed byte by byte."""

import struct

import numpy as np
import pytest
from device_frames import one, source_of, xsens
from recordings_on_disk import read, text

from driftlab.config import load_config
from fusion_core.contracts.framing import DAMAGED, GARBAGE
from fusion_core.testing import check_plugin
from fusion_plugins.framings.xsens_mtdata2 import INCOMPLETE, XsensMtdata2
from fusion_plugins.sources.binary_log import BinaryLog

# Payloads that MT Manager recorded and decoded from an MTi-300 (Scottapotamas/xsens-mti, docs/mtmanager_packets.md)
WITH_TEMPERATURE = bytes.fromhex(
    "10 20 02 91 8D 10 60 04 01 36 3F A6 20 10 10 3F 35 E0 42 3F 31 CD 15 BD 9F 49 DB BD A9 38 CF 40 20 0C BD 63 5A 90 "
    "41 1D 08 D4 3E 5F AA 50 40 10 0C B9 11 68 00 3C C9 01 00 3A 0F 7D 00 40 30 0C BC 3B 29 80 3C 35 FC 00 3C A4 6E 00 "
    "80 20 0C 3C AE A2 41 BB 56 D8 00 BA D5 AC 01 80 30 10 3F 80 00 00 37 DF 88 01 B6 89 80 00 B6 08 C0 00 C0 20 0C BE "
    "FB FB F2 3F 33 C4 85 BF A0 A2 C1 08 10 04 42 16 80 00 30 10 04 00 01 86 E1 E0 20 04 00 40 00 03"
)
WITHOUT = bytes.fromhex(
    "10 20 02 8D 90 10 60 04 00 54 DB F1 20 10 10 3F 7F 89 11 BC 11 1D FA 3B A0 CE F0 BD 73 25 73 40 20 0C BD DC F9 D0 "
    "BE 3C 86 19 41 1D 0B 47 40 10 0C B9 8D B0 00 B9 F1 48 00 3C C9 04 30 40 30 0C BC B9 89 2E BB 09 8C 00 3C A7 08 00 "
    "80 20 0C BA 63 BC 01 BC 04 D6 3F BB 6D E3 FE 80 30 10 3F 80 00 01 B5 91 C0 00 B7 2A 08 00 B6 98 40 00 E0 20 04 00 "
    "40 00 03"
)
ONLY_ATTITUDE = bytes.fromhex(
    "10 20 02 46 82 10 60 04 01 C4 FC 3E 20 10 10 3F 71 CE 6C BE A5 6B CF 3C 61 3B D8 BD 69 1D 25 E0 20 04 00 40 00 03"
)


def whole(payload):
    head = b"\xff\x36" + bytes([len(payload)])
    return b"\xfa" + head + payload + bytes([-sum(head + payload) % 256])


def test_messages_that_an_mti_300_sent():
    stream = whole(WITH_TEMPERATURE) + whole(ONLY_ATTITUDE) + whole(WITHOUT)
    frames, _ = XsensMtdata2().decode(stream, None)
    np.testing.assert_array_equal(frames.count, [20332454, 5561329])
    np.testing.assert_allclose(frames.channels["gyro"], [
        [0.02131760, -0.00327826, -0.00163019], [-0.00086874, -0.00810772, -0.00362992]], atol=5e-9)  # fmt: skip
    np.testing.assert_allclose(frames.channels["accel"], [
        [-0.05550629, 9.81465530, 0.21842313], [-0.10789835, -0.18410529, 9.81525326]], atol=5e-9)  # fmt: skip
    np.testing.assert_array_equal(frames.channels["temperature"], [37.625, 37.625])  # held
    assert frames.rejected == {INCOMPLETE: 1}
    frames, _ = XsensMtdata2(clock="packet_counter").decode(stream, None)
    np.testing.assert_array_equal(frames.count, [37261, 36240])


@pytest.mark.parametrize("number", [">3f", ">3d"])
@pytest.mark.parametrize("more", [0, 4, 8])  # east-north-up, north-east-down, north-west-up
def test_the_laws_of_framings(number, more):
    stream = b"".join(one(k, 20 + k / 4, number, more) for k in range(60))
    check_plugin(XsensMtdata2, [XsensMtdata2(), XsensMtdata2(clock="packet_counter")], stream=stream)


def test_a_temperature_holds_across_any_cut():
    stream = b"".join(one(k, 20.0 + k if k % 10 == 5 else None) for k in range(100))
    parts, memory = [], None
    for byte in range(0, len(stream), 17):
        frames, memory = XsensMtdata2().decode(stream[byte : byte + 17], memory)
        parts.append(frames.channels["temperature"])
    expected = [np.nan] * 5 + [20.0 + 10 * ((k - 5) // 10) + 5 for k in range(5, 100)]
    np.testing.assert_array_equal(np.concatenate(parts), expected)


def test_fixed_point_long_messages_and_damage():
    fixed = (0x8021, struct.pack(">3i", 1 << 20, -(1 << 19), 3))
    long = xsens((0x1060, bytes(4)), (0x4020, struct.pack(">3f", 1, 2, 3)), (0xC020, bytes(240)), fixed)
    assert long[3] == 0xFF
    bad = bytearray(one(1))
    bad[10] ^= 64
    frames, _ = XsensMtdata2().decode(long + bytes(bad) + one(2), None)
    np.testing.assert_array_equal(frames.channels["gyro"], [[1, -0.5, 3 / 2**20], [2, 0, -2]])
    assert frames.rejected == {DAMAGED: 1, GARBAGE: len(bad)}


def test_xsens_over_a_file_and_a_port(tmp_path):
    path = text(tmp_path, b"".join(one(k, 25.0 if k % 50 == 0 else None) for k in range(7, 407)), "mti.bin")
    config = tmp_path / "unit.yaml"
    config.write_text("extends: xsens_mtdata2\nsource: {kind: serial, port: /dev/ttyUSB0, interval: 10 ms}\n")
    source = load_config(config, f"{path}::1:2").source
    assert isinstance(source, BinaryLog)
    got = read(source)
    np.testing.assert_allclose(got.t, 1 + np.arange(100) / 100)
    np.testing.assert_array_equal(got["gyro"][:, 0], np.arange(107, 207))
    same = source_of("xsens_mtdata2", {"kind": "binary_log", "path": str(path), "start": "1 s", "stop": "2 s"})
    np.testing.assert_array_equal(read(same)["gyro"], got["gyro"])
